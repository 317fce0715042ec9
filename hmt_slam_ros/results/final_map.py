"""The final map: joint refinement of the trajectory, and registration of all scans of the newest log with them."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.logs import Log
from hmt_slam_ros.loop_closure.closure_refinement import arc_edges, stack_edges
from hmt_slam_ros.loop_closure.joint_refinement import (
    ScanPairs,
    add_distant_pairs,
    agree_better,
    certain_areas,
    concatenate_edges,
    linked_areas,
    nearest_keyframes,
    pair_limits,
    refine_jointly,
    scan_pairs,
)
from hmt_slam_ros.messages.messages import Notice
from hmt_slam_ros.registration.scan_to_scan import (
    ScanSurfaces,
    extract_surfaces,
    normal_equations,
    weighting_from_options,
)
from hmt_slam_ros.results.own_recording import with_foreign_ground, with_map, without_foreign_ground
from hmt_slam_ros.results.recorder import Recording, keyframe_poses
from hmt_slam_ros.results.trajectories import Trajectory, trajectory_in_map
from hmt_slam_ros.results.trajectory_nodes import follow_nodes, motion_edges, node_scans, select_nodes
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.odometry import OdometryBuffer, deskew_scan
from hmt_slam_ros.sensors.scan import SweepCheck

_ITERATIONS = 2
"""Gauss-Newton steps of a scan: metric SLAM has matched it already."""

_INCONSISTENCY_GATE = chi_square_gate(0.999)
"""Squared Mahalanobis distance from an arc above which a refined pose contradicts it."""

_BATCH = 500
"""Scans whose surfaces are in memory at once."""


def register_scans(
    surfaces: ScanSurfaces,
    poses: NDArray[np.float64],
    scans: ScanSurfaces,
    initial: NDArray[np.float64],
    neighbor_rows: list[NDArray[np.int64]],
    options: RefinementParameters,
) -> NDArray[np.float64]:
    """Register scans with fixed keyframes.

    :param surfaces: surfaces of n keyframes.
    :param poses: shape (n, 3), poses of the keyframes.
    :param scans: surfaces of m scans.
    :param initial: shape (m, 3), initial poses of the scans, a prior with the deviations ``options.scan_sigma`` and
        ``options.scan_angle``.
    :param neighbor_rows: rows of the keyframes to register with, for each scan.
    :returns: shape (m, 3), poses of the scans.
    """
    scan_of = np.repeat(np.arange(len(neighbor_rows)), [len(rows) for rows in neighbor_rows])
    keyframe_of = np.concatenate([np.zeros(0, np.int64), *neighbor_rows])
    prior = np.diag([options.scan_sigma**-2, options.scan_sigma**-2, math.radians(options.scan_angle) ** -2])
    refined = initial
    for _ in range(_ITERATIONS):
        relative = se2.between(poses[keyframe_of], refined[scan_of])
        information, gradient, share = normal_equations(
            scans, scan_of, surfaces, keyframe_of, relative, options.last_gate, weighting_from_options(options), 1
        )
        matched = share >= options.min_share
        total, slope = (
            np.broadcast_to(prior, (len(neighbor_rows), 3, 3)).copy(),
            se2.log(se2.between(initial, refined)) @ prior,
        )
        np.add.at(total, scan_of[matched], information[matched])
        np.add.at(slope, scan_of[matched], gradient[matched])
        refined = se2.compose(refined, se2.exp(-np.linalg.solve(total, slope[..., None])[..., 0]))
    return refined


def deskewed_scans(log: Log, configuration: Configuration) -> Iterator[Scan]:
    """All scans in file order, each deskewed as soon as the odometry covers its sweep.

    :raises HmtSlamError: where the log is faulty.
    """
    odometry, sweeps, waiting = OdometryBuffer(), SweepCheck(), deque[Scan]()
    for record in log.records():
        if isinstance(record.measurement, Odometry):
            odometry.add(record.measurement)
        elif isinstance(record.measurement, Scan):
            waiting.append(sweeps.check(record.measurement)[0])
        while waiting and (waiting[0].sweep_duration == 0.0 or odometry.covers(waiting[0].end_stamp)):
            yield _deskew_by_odometry(waiting.popleft(), odometry, configuration)
    while waiting:
        yield _deskew_by_odometry(waiting.popleft(), odometry, configuration)


def _deskew_by_odometry(scan: Scan, odometry: OdometryBuffer, configuration: Configuration) -> Scan:
    odometry.pose_at(scan.stamp)  # drops earlier readings
    return deskew_scan(scan, odometry, configuration.rtl)


@dataclass(frozen=True, eq=False)
class FinalMap:
    """The refined map and trajectory of a run.

    :ivar recording: recording with the refined map and trajectory.
    :ivar stages: {name: trajectory} before each step: ``filter`` without loop closures, ``arcs`` with the areas at the
        poses from the arcs, ``keyframes`` with the refined keyframes.
    """

    recording: Recording
    stages: dict[str, Trajectory]


def final_map(recording: Recording, scans: Callable[[], Iterable[Scan]], configuration: Configuration) -> FinalMap:
    """Refine the map of a run, unless the mode is localization.

    :param scans: reads all scans of the newest log in its order; those of earlier logs keep their poses to keyframes.
    """
    open_loop = trajectory_in_map(
        recording.relative_trajectory, keyframe_poses(recording.hybrid_map, _open_loop_area_poses(recording))
    )
    stages = {"filter": open_loop, "arcs": recording.trajectory}
    if not configuration.refinement.iterations or configuration.mode == "localization":
        return FinalMap(recording, stages)
    own = without_foreign_ground(recording)
    refinement = _TrajectoryRefinement(own, scans(), configuration)
    refined = refinement.refined_recording(own)
    refined = replace(refined, notices=recording.notices + _inconsistent_arcs(own.hybrid_map, refined.hybrid_map))
    stages["keyframes"] = refined.trajectory
    trajectory = refinement.registered_trajectory(refined, scans())
    relative = refined.relative_trajectory.with_trajectory(
        trajectory, keyframe_poses(refined.hybrid_map, refined.area_poses)
    )
    refined = replace(refined, trajectory=trajectory, relative_trajectory=relative)
    return FinalMap(refined if own is recording else with_foreign_ground(refined, recording), stages)


class _TrajectoryRefinement:
    """Refinement of the nodes of the trajectory in the most probable map.

    :ivar nodes: n of them, of which k are the keyframes.
    """

    def __init__(self, recording: Recording, scans: Iterable[Scan], configuration: Configuration) -> None:
        self._configuration = configuration
        self._options = configuration.refinement
        self._linked = linked_areas(recording.hybrid_map)
        self.nodes = select_nodes(recording, configuration)
        self._surfaces = self._surfaces_of(node_scans(self.nodes, recording, scans))

    def _surfaces_of(self, scans: list[Scan]) -> ScanSurfaces:
        return extract_surfaces(scans, self._configuration.local_map.max_range, self._options.max_points)

    def _nearest_keyframes(
        self, poses: NDArray[np.float64], seen_from: NDArray[np.float64], areas: NDArray[np.int64], count: int
    ) -> list[NDArray[np.int64]]:
        """The nodes of the nearest keyframes around m poses.

        :param poses: shape (n, 3), of the nodes.
        :param seen_from: shape (m, 3); ``areas`` (m,) theirs.
        """
        own = np.flatnonzero(self.nodes.is_keyframe)
        near = nearest_keyframes(
            poses[own], self.nodes.areas[own], seen_from, areas, self._linked, self._options.reach, count
        )
        return [own[rows] for rows in near]

    def refined_recording(self, recording: Recording) -> Recording:
        """The recording with its nodes at the poses of the joint refinement; the first one is fixed.

        A registration counts where the arcs allow it and its two scans agree better than before. The result counts
        where all pairs together do.
        """
        hybrid_map, nodes, poses = recording.hybrid_map, self.nodes, self.nodes.poses
        pairs = self._pairs(hybrid_map)
        arcs = stack_edges(arc_edges(hybrid_map, hybrid_map.area_ids()), nodes.keyframes[nodes.is_keyframe].tolist())
        of_keyframe = np.flatnonzero(nodes.is_keyframe)
        arcs = replace(arcs, sources=of_keyframe[arcs.sources], targets=of_keyframe[arcs.targets])
        motion = motion_edges(nodes, recording, self._configuration.motion)
        edges = concatenate_edges(motion.matched, arcs)
        limits = pair_limits(hybrid_map, poses, pairs, nodes.areas, nodes.poses_in_area)
        refined = refine_jointly(
            self._surfaces, poses, pairs, edges, self._options, limits=limits, odometry=motion.odometry
        )
        refined = refined if agree_better(self._surfaces, poses, refined, pairs, self._options) else poses
        keyframes = dict(zip(nodes.keyframes[of_keyframe].tolist(), refined[of_keyframe], strict=True))
        return replace(_with_keyframe_poses(recording, keyframes), trajectory=follow_nodes(recording, nodes, refined))

    def _pairs(self, hybrid_map: HybridMap) -> ScanPairs:
        """Nodes that may overlap: each with the keyframes around it, and keyframes with those of distant passes."""
        nodes, options = self.nodes, self._options
        # One more neighbor, since each keyframe is the nearest to itself.
        around = self._nearest_keyframes(nodes.poses, nodes.poses, nodes.areas, options.neighbors + 1)
        few = options.scan_neighbors
        around = [near if own else near[:few] for own, near in zip(nodes.is_keyframe.tolist(), around, strict=True)]
        certain = certain_areas(hybrid_map, options.first_gate)
        near_pairs = scan_pairs(around, options.min_share)
        return add_distant_pairs(near_pairs, self._surfaces, nodes.poses, nodes.areas, certain, options)

    def registered_trajectory(self, recording: Recording, scans: Iterable[Scan]) -> Trajectory:
        """The trajectory with every scan of the newest log registered with the keyframes around it."""
        nodes, options = self.nodes, self._options
        own, poses = nodes.is_keyframe, nodes.poses.copy()
        by_keyframe = keyframe_poses(recording.hybrid_map, recording.area_poses)
        poses[own] = [by_keyframe[keyframe] for keyframe in nodes.keyframes[own].tolist()]
        areas = recording.relative_trajectory.areas(recording.hybrid_map)
        trajectory, remaining = recording.trajectory.copy(), iter(scans)
        for first in range(recording.first_scans[-1], len(trajectory), _BATCH):
            batch = list(itertools.islice(remaining, _BATCH))
            rows = slice(first, first + len(batch))
            around = self._nearest_keyframes(poses, trajectory[rows], areas[rows], options.scan_neighbors)
            trajectory[rows] = register_scans(
                self._surfaces, poses, self._surfaces_of(batch), trajectory[rows], around, options
            )
        return trajectory


def _with_keyframe_poses(recording: Recording, poses: Mapping[int, NDArray[np.float64]]) -> Recording:
    """The recording with its keyframes at given ``map_T_base``.

    The frame of an area moves with its first keyframe. Arcs get the poses between the new frames and keep their
    covariances, which are upper bounds.
    """
    hybrid_map = recording.hybrid_map.branch()
    area_poses = {}
    for area in hybrid_map.area_ids():
        keyframes = dict(hybrid_map.keyframes(area))
        reference, area_T_reference = next(iter(keyframes.items()))
        frame = se2.compose(poses[reference], se2.inverse(area_T_reference))
        area_poses[area] = PoseGaussian(frame, recording.area_poses[area].covariance)
        for keyframe in keyframes:
            hybrid_map.set_keyframe(keyframe, area, se2.between(frame, poses[keyframe]))
    for a, b, arc in list(hybrid_map.all_arcs()):
        mean = se2.between(area_poses[a].mean, area_poses[b].mean)
        hybrid_map.set_arc(a, b, PoseGaussian(mean, arc.pose.covariance), closure=arc.closure)
    return replace(
        with_map(recording, hybrid_map),
        area_poses=area_poses,
        trajectory=trajectory_in_map(recording.relative_trajectory, poses),
    )


def _inconsistent_arcs(before: HybridMap, after: HybridMap) -> tuple[Notice, ...]:
    """What the refinement moved by more than the arcs allow: a sentence on the worst of these arcs, if there is one."""
    moved = []
    for a, b, arc in before.all_arcs():
        refined = after.arc(a, b)
        assert refined is not None
        squared = arc.pose.mahalanobis2(PoseGaussian.from_pose(refined.mean))
        if squared > _INCONSISTENCY_GATE:
            moved.append((squared, a, b, se2.between(arc.pose.mean, refined.mean)))
    if not moved:
        return ()
    _, a, b, offset = max(moved, key=lambda each: each[0])
    distance, turn = float(np.hypot(offset[0], offset[1])), abs(math.degrees(offset[2]))
    return (
        Notice(
            "refinement",
            f"area {b} moved by {distance:.2f} m and {turn:.1f} degrees as seen from area {a}, more than their arc "
            f"allows (one of {len(moved)} such arcs): the map may be wrong there, look at it in map.png",
        ),
    )


def _open_loop_area_poses(recording: Recording) -> dict[int, PoseGaussian]:
    """``map_T_area`` along the arcs that closed no loop; unchanged for areas that these do not reach."""
    hybrid_map = recording.hybrid_map
    open_map = HybridMap(changed_areas={area: dict(hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()})
    for a, b, arc in hybrid_map.all_arcs():
        if not arc.closure:
            open_map.set_arc(a, b, arc.pose, closure=False)
    return recording.area_poses | shortest_path_beliefs(open_map, hybrid_map.area_ids()[0])
