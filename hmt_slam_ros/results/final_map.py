"""The final map: keyframes refined jointly over all areas, and every scan of the newest log placed among them."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs, uninformative_belief
from hmt_slam_ros.logs import Log
from hmt_slam_ros.loop_closure.joint_refinement import (
    add_distant_pairs,
    certain_areas,
    linked_areas,
    nearest_keyframes,
    refine_jointly,
    scan_pairs,
)
from hmt_slam_ros.registration.scan_to_scan import (
    ScanSurfaces,
    extract_surfaces,
    normal_equations,
    weighting_from_options,
)
from hmt_slam_ros.results.recorder import Recording, keyframe_poses
from hmt_slam_ros.results.trajectories import Trajectory, trajectory_in_map
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import OdometryBuffer, deskew_scan, path_covariance
from hmt_slam_ros.sensors.scan import SweepCheck

# A scan is where metric SLAM matched it, so that few steps suffice.
_ITERATIONS = 2


def register_scans(
    surfaces: ScanSurfaces,
    poses: NDArray[np.float64],
    scans: ScanSurfaces,
    initial: NDArray[np.float64],
    neighbor_rows: list[NDArray[np.int64]],
    options: RefinementParameters,
) -> NDArray[np.float64]:
    """Register scans with keyframes that stay where they are.

    :param surfaces: of n keyframes.
    :param poses: shape (n, 3), theirs.
    :param scans: m scans.
    :param initial: shape (m, 3), where they are thought to be, with the deviations ``options.scan_sigma`` and
        ``options.scan_angle``.
    :param neighbor_rows: for every scan the rows of the keyframes to register with.
    :returns: shape (m, 3).
    """
    scan_of = np.repeat(np.arange(len(neighbor_rows)), [len(rows) for rows in neighbor_rows])
    keyframe_of = np.concatenate([np.zeros(0, np.int64), *neighbor_rows])
    prior = np.diag([options.scan_sigma**-2, options.scan_sigma**-2, math.radians(options.scan_angle) ** -2])
    placed = initial
    for _ in range(_ITERATIONS):
        relative = se2.between(poses[keyframe_of], placed[scan_of])
        information, gradient, share = normal_equations(
            scans, scan_of, surfaces, keyframe_of, relative, options.last_gate, weighting_from_options(options), 1
        )
        meets = share >= options.min_share
        total, slope = (
            np.broadcast_to(prior, (len(neighbor_rows), 3, 3)).copy(),
            se2.log(se2.between(initial, placed)) @ prior,
        )
        np.add.at(total, scan_of[meets], information[meets])
        np.add.at(slope, scan_of[meets], gradient[meets])
        placed = se2.compose(placed, se2.exp(-np.linalg.solve(total, slope[..., None])[..., 0]))
    return placed


def deskewed_scans(log: Log, configuration: Configuration) -> Iterator[Scan]:
    """All scans in file order, each as soon as the odometry covers its sweep, if it has one.

    :raises HmtSlamError: where the log is faulty.
    """
    odometry, sweeps, waiting = OdometryBuffer(), SweepCheck(), deque[Scan]()
    for record in log.records():
        if isinstance(record.measurement, Odometry):
            odometry.add(record.measurement)
        else:
            waiting.append(sweeps.check(record.measurement)[0])
        while waiting and (waiting[0].sweep_duration == 0.0 or odometry.covers(waiting[0].end_stamp)):
            yield _deskew_by_odometry(waiting.popleft(), odometry, configuration)
    while waiting:
        yield _deskew_by_odometry(waiting.popleft(), odometry, configuration)


def _deskew_by_odometry(scan: Scan, odometry: OdometryBuffer, configuration: Configuration) -> Scan:
    odometry.pose_at(scan.stamp)  # forgets what lies before
    return deskew_scan(scan, odometry, configuration.rtl)


# Scans whose surfaces are in memory at once.
_BATCH = 500


@dataclass(frozen=True, eq=False)
class FinalMap:
    """A run's map and trajectory at their best.

    :ivar recording: with the refined map and trajectory.
    :ivar stages: {name: trajectory} before each step: ``filter`` with the areas as they were traveled through, no loop
        closed, ``arcs`` with the areas where the arcs put them, ``keyframes`` with the refined keyframes.
    """

    recording: Recording
    stages: dict[str, Trajectory]


def final_map(recording: Recording, scans: Iterable[Scan], configuration: Configuration) -> FinalMap:
    """Refine a run's map, if it is one that may change.

    :param scans: all scans of the newest log in its order; those of earlier logs stay where they are to keyframes.
    """
    travelled = trajectory_in_map(
        recording.relative_trajectory, keyframe_poses(recording.hybrid_map, _open_loop_area_poses(recording))
    )
    stages = {"filter": travelled, "arcs": recording.trajectory}
    if not configuration.refinement.iterations or configuration.mode == "localization":
        return FinalMap(recording, stages)
    keyframes = _KeyframeRefinement(recording, configuration)
    refined = _with_keyframe_poses(recording, keyframes.refined_poses(recording))
    stages["keyframes"] = refined.trajectory
    placed = keyframes.registered_trajectory(refined, scans)
    relative = refined.relative_trajectory.with_trajectory(
        placed, keyframe_poses(refined.hybrid_map, refined.area_poses)
    )
    return FinalMap(replace(refined, trajectory=placed, relative_trajectory=relative), stages)


class _KeyframeRefinement:
    """The keyframes of the most probable map, in the order in which they were taken.

    :ivar ids: their ids, ascending.
    :ivar areas: shape (n,), theirs.
    """

    def __init__(self, recording: Recording, configuration: Configuration) -> None:
        hybrid_map = recording.hybrid_map
        area_of = {keyframe: area for area in hybrid_map.area_ids() for keyframe in hybrid_map.keyframes(area)}
        self._configuration = configuration
        self._options = configuration.refinement
        self._linked = linked_areas(hybrid_map)
        self.ids = sorted(area_of)
        self.areas = np.array([area_of[keyframe] for keyframe in self.ids], dtype=np.int64)
        self._surfaces = self._surfaces_of([recording.replica.scans[keyframe] for keyframe in self.ids])

    def _surfaces_of(self, scans: list[Scan]) -> ScanSurfaces:
        return extract_surfaces(scans, self._configuration.local_map.max_range, self._options.max_points)

    def _poses(self, recording: Recording) -> NDArray[np.float64]:
        poses = keyframe_poses(recording.hybrid_map, recording.area_poses)
        return np.array([poses[keyframe] for keyframe in self.ids])

    def _neighbor_rows(
        self, poses: NDArray[np.float64], seen_from: NDArray[np.float64], areas: NDArray[np.int64], count: int
    ) -> list[NDArray[np.int64]]:
        return nearest_keyframes(poses, self.areas, seen_from, areas, self._linked, self._options.reach, count)

    def refined_poses(self, recording: Recording) -> dict[int, NDArray[np.float64]]:
        """{keyframe: ``map_T_base``} by joint refinement; the first keyframe stays."""
        poses = self._poses(recording)
        # Each keyframe is the nearest to itself.
        around = self._neighbor_rows(poses, poses, self.areas, self._options.neighbors + 1)
        near = scan_pairs(around, self._options.min_share)
        certain = certain_areas(recording.hybrid_map, self._options.first_gate)
        pairs = add_distant_pairs(near, self._surfaces, poses, self.areas, certain, self._options)
        motion = self._motion_edges(recording, poses)
        refined = refine_jointly(self._surfaces, poses, pairs, motion, self._options)
        return dict(zip(self.ids, refined, strict=True))

    def _motion_edges(self, recording: Recording, poses: NDArray[np.float64]) -> Edges:
        """From each keyframe to the next the motion that metric SLAM found, as uncertain as the odometry of that way.

        Where no pair of scans overlaps enough, metric SLAM has seen more in its map than odometry could tell. From one
        log to the next nothing is known of it.
        """
        rows, count = _scan_rows(recording, self.ids), len(poses) - 1
        steps = se2.between(poses[:-1], poses[1:])
        covariances = _path_covariances(recording.odometry, rows, self._configuration.motion)
        logs = np.searchsorted(recording.first_scans, rows, side="right")
        for n in np.flatnonzero(np.diff(logs)):
            covariances[n] = uninformative_belief(steps[n]).covariance
        return Edges(np.arange(count), np.arange(1, count + 1), steps, covariances)

    def registered_trajectory(self, recording: Recording, scans: Iterable[Scan]) -> Trajectory:
        """The trajectory with every scan of the newest log registered with the keyframes around it."""
        poses, options = self._poses(recording), self._options
        areas = self.areas[np.searchsorted(self.ids, np.maximum(recording.relative_trajectory.keyframes, self.ids[0]))]
        placed, remaining = recording.trajectory.copy(), iter(scans)
        for first in range(recording.first_scans[-1], len(placed), _BATCH):
            batch = list(itertools.islice(remaining, _BATCH))
            rows = slice(first, first + len(batch))
            around = self._neighbor_rows(poses, placed[rows], areas[rows], options.scan_neighbors)
            placed[rows] = register_scans(
                self._surfaces, poses, self._surfaces_of(batch), placed[rows], around, options
            )
        return placed


def _scan_rows(recording: Recording, keyframes: list[int]) -> NDArray[np.intp]:
    """Numbers of the scans of keyframes."""
    stamps = [recording.replica.scans[keyframe].stamp for keyframe in keyframes]
    return np.searchsorted(recording.stamps, stamps)


def _path_covariances(odometry: Trajectory, rows: NDArray[np.intp], motion: MotionParameters) -> NDArray[np.float64]:
    """Covariances (n - 1, 3, 3) of the odometry along the paths between n scans of the log."""
    steps = se2.between(odometry[:-1], odometry[1:])
    distance = np.concatenate(([0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))))[rows]
    angle = np.concatenate(([0.0], np.cumsum(np.abs(steps[:, 2]))))[rows]
    return np.array(
        [path_covariance(*path, motion) for path in zip(np.diff(distance), np.diff(angle), strict=True)]
    ).reshape(-1, 3, 3)


def _with_keyframe_poses(recording: Recording, poses: Mapping[int, NDArray[np.float64]]) -> Recording:
    """The recording with its keyframes at given ``map_T_base``.

    An area's frame moves with the first of its keyframes. Arcs take over the poses between the frames, and keep their
    covariances as what is known of them at least.
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
    replica = replace(recording.replica, maps=recording.replica.maps | {recording.replica.best_hypothesis: hybrid_map})
    return replace(
        recording,
        replica=replica,
        area_poses=area_poses,
        trajectory=trajectory_in_map(recording.relative_trajectory, poses),
    )


def _open_loop_area_poses(recording: Recording) -> dict[int, PoseGaussian]:
    """``map_T_area`` along the arcs that closed no loop; as it is where no such arc leads there."""
    hybrid_map = recording.hybrid_map
    open_map = HybridMap(changed_areas={area: dict(hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()})
    for a, b, arc in hybrid_map.all_arcs():
        if not arc.closure:
            open_map.set_arc(a, b, arc.pose, closure=False)
    return recording.area_poses | shortest_path_beliefs(open_map, hybrid_map.area_ids()[0])
