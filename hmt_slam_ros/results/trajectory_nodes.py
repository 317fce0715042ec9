"""The nodes of the final refinement: keyframes, and scans of passes over known ground.

There the robot stores no keyframes, and a match corrects its place, but not the path behind it. With nodes on such
passes, what odometry measured from one known place to the next counts as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import chi_square_gate, matrix_inverse, propagate_covariance
from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME, HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges, edge_chi2
from hmt_slam_ros.hybrid_map.shortest_path import map_pieces, uninformative_belief
from hmt_slam_ros.results.recorder import Recording, keyframe_poses
from hmt_slam_ros.results.trajectories import Trajectory
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Inertia
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, increment_covariance, is_jump, path_covariance

_GATE = chi_square_gate(0.999)
"""Squared Mahalanobis distance of a step of metric SLAM beyond which odometry had a fault."""

_RUN_UP = 10
"""Scans before a motion from which the robot's velocity is learnt."""


class TrajectoryNodes(NamedTuple):
    """n scans of a run, in the order of time.

    :ivar rows: shape (n,), their numbers among all scans, ascending.
    :ivar is_keyframe: shape (n,), whether they are the keyframes of the map, in ascending order.
    :ivar keyframes: shape (n,), reference keyframe of each scan; a keyframe is its own.
    :ivar areas: shape (n,), of the reference keyframes.
    :ivar poses_in_area: shape (n, 3), ``area_T_base``.
    :ivar poses: shape (n, 3), ``map_T_base``.
    """

    rows: Int64
    is_keyframe: Bool
    keyframes: Int64
    areas: Int64
    poses_in_area: Float64
    poses: Float64


def select_nodes(recording: Recording, configuration: Configuration) -> TrajectoryNodes:
    """All keyframes of the robot's own, and scans of the newest log between them that are as far apart as keyframes."""
    hybrid_map, relative, options = recording.hybrid_map, recording.relative_trajectory, configuration.filter
    area_of = {keyframe: area for area in hybrid_map.area_ids() for keyframe in hybrid_map.keyframes(area)}
    ids = np.array(sorted(keyframe for keyframe in area_of if keyframe > NO_KEYFRAME), dtype=np.int64)
    stamps = [recording.replica.scans[keyframe].stamp for keyframe in ids.tolist()]
    own_rows = np.searchsorted(recording.stamps, stamps)
    is_open = (relative.keyframes != NO_KEYFRAME) & (np.arange(len(relative.keyframes)) >= recording.first_scans[-1])
    angle = math.radians(options.keyframe_angle)
    rows = _spaced_rows(*_path(recording.trajectory), own_rows, is_open, options.keyframe_distance, angle)
    is_keyframe, keyframes = np.isin(rows, own_rows), relative.keyframes[rows]
    offsets = np.where(is_keyframe[:, None], 0.0, relative.poses[rows])
    keyframes[is_keyframe] = ids
    areas = np.array([area_of[keyframe] for keyframe in keyframes.tolist()], dtype=np.int64)
    map_T_keyframe = keyframe_poses(hybrid_map, recording.area_poses)
    poses = se2.compose(np.array([map_T_keyframe[keyframe] for keyframe in keyframes.tolist()]), offsets)
    map_T_area = np.array([recording.area_poses[area].mean for area in areas.tolist()])
    return TrajectoryNodes(rows, is_keyframe, keyframes, areas, se2.between(map_T_area, poses), poses)


def _path(poses: Trajectory) -> tuple[Float64, Float64]:
    """The distance and the angle to each of n poses along their path, (n,), m and rad."""
    steps = se2.between(poses[:-1], poses[1:])
    distance, angle = np.cumsum(np.hypot(steps[:, 0], steps[:, 1])), np.cumsum(np.abs(steps[:, 2]))
    return np.concatenate(([0.0], distance)), np.concatenate(([0.0], angle))


@njit(cache=True)
def _spaced_rows(
    distances: Float64, angles: Float64, kept: Int64, is_open: Bool, distance: float, angle: float
) -> Int64:
    """The rows to keep, and open rows a distance or an angle after the last one, but half of it from the next.

    :param kept: ascending.
    """
    rows, count, last, following = np.empty(len(distances), np.int64), 0, kept[0], 0
    for row in range(len(distances)):
        if following < len(kept) and row == kept[following]:
            following += 1
        else:
            before = max(distances[row] - distances[last], (angles[row] - angles[last]) * distance / angle)
            after = np.inf
            if following < len(kept):
                to = kept[following]
                after = max(distances[to] - distances[row], (angles[to] - angles[row]) * distance / angle)
            if not is_open[row] or before < distance or after < 0.5 * distance:
                continue
        rows[count], last = row, row
        count += 1
    return rows[:count]


def node_scans(nodes: TrajectoryNodes, recording: Recording, scans: Iterable[Scan]) -> list[Scan]:
    """The scans of the nodes.

    :param scans: all scans of the newest log, in their order.
    """
    own = nodes.is_keyframe
    known = dict(zip(nodes.rows[own].tolist(), nodes.keyframes[own].tolist(), strict=True))
    found = {row: recording.replica.scans[keyframe] for row, keyframe in known.items()}
    wanted = set(nodes.rows[~own].tolist())
    found |= {row: scan for row, scan in enumerate(scans, recording.first_scans[-1]) if row in wanted}
    return [found[row] for row in nodes.rows.tolist()]


class MotionEdges(NamedTuple):
    """What is known of the motion from each node to the next, with the covariance of odometry.

    :ivar matched: edges of the motion by metric SLAM.
    :ivar odometry: edges of the motion by odometry.
    """

    matched: Edges
    odometry: Edges


def motion_edges(nodes: TrajectoryNodes, recording: Recording, motion: MotionParameters) -> MotionEdges:
    """The motion along the trajectory, by odometry.

    The steps of metric SLAM have the corrections of the robot's place as well, and those between two areas what
    closures moved. They count where odometry had a fault between two keyframes or jumped, and between two pieces of the
    map, whose distance is unknown. The edge from one log to the next is uninformative.
    """
    odometry = recording.odometry[nodes.rows]
    by_slam, by_odometry = (se2.between(poses[:-1], poses[1:]) for poses in (nodes.poses, odometry))
    covariances = _path_covariances(recording.odometry, nodes.rows, motion)
    every = np.ones(len(by_slam), np.bool_)
    uncertain = covariances + _arc_covariances(nodes, recording.hybrid_map)
    is_fault = edge_chi2(_chain_edges(by_odometry, uncertain, every), nodes.poses) > _GATE
    is_fault[is_fault] = [
        (nodes.is_keyframe[edge] and nodes.is_keyframe[edge + 1])
        or _jumps(recording, nodes.rows[edge], nodes.rows[edge + 1], motion)
        for edge in np.flatnonzero(is_fault).tolist()
    ]
    piece_of = {area: number for number, piece in enumerate(map_pieces(recording.hybrid_map)) for area in piece}
    pieces = np.array([piece_of[area] for area in nodes.areas.tolist()])
    matched = is_fault | (np.diff(pieces) != 0)
    covariances[matched] = _path_covariances(recording.trajectory, nodes.rows, motion)[matched]
    logs = np.searchsorted(recording.first_scans, nodes.rows, side="right")
    for edge in np.flatnonzero(np.diff(logs)).tolist():
        matched[edge], covariances[edge] = True, uninformative_belief(by_slam[edge]).covariance
    return MotionEdges(_chain_edges(by_slam, covariances, matched), _chain_edges(by_odometry, covariances, ~matched))


def _jumps(recording: Recording, first: int, last: int, motion: MotionParameters) -> bool:
    """Whether odometry moved between two scans of a log as the robot can hardly have, by its velocity before."""
    inertia, jumps = Inertia(motion), False
    for row in range(max(recording.first_scans[-1], first - _RUN_UP), last):
        seconds = 1e-9 * float(recording.stamps[row + 1] - recording.stamps[row])
        if seconds <= 0.0:
            continue
        predicted, step = inertia.predict(seconds), se2.between(recording.odometry[row], recording.odometry[row + 1])
        covariance = increment_covariance(step, motion)
        if is_jump(RelativeMotion(step, covariance), predicted):
            jumps |= row >= first
        else:
            inertia.observe(step, matrix_inverse(covariance))
    return jumps


def _chain_edges(steps: Float64, covariances: Float64, chosen: Bool) -> Edges:
    """The chosen edges of those from each node to the next."""
    sources = np.flatnonzero(chosen)
    return Edges(sources, sources + 1, steps[chosen], covariances[chosen])


def _arc_covariances(nodes: TrajectoryNodes, hybrid_map: HybridMap) -> Float64:
    """What the arc between their areas leaves open of the pose of each of n nodes but the first in the one before it.

    :returns: shape (n - 1, 3, 3), zero within an area.
    """
    covariances = np.zeros((len(nodes.rows) - 1, 3, 3))
    for row in np.flatnonzero(np.diff(nodes.areas)).tolist():
        arc = hybrid_map.arc(int(nodes.areas[row]), int(nodes.areas[row + 1]))
        if arc is not None:
            covariances[row] = propagate_covariance(arc.covariance, nodes.poses_in_area[row + 1])
    return covariances


def _path_covariances(odometry: Trajectory, rows: Int64, motion: MotionParameters) -> Float64:
    """Covariances of the odometry between n scans of the log, shape (n - 1, 3, 3)."""
    distance, angle = (np.diff(along[rows]) for along in _path(odometry))
    return np.array([path_covariance(*path, motion) for path in zip(distance, angle, strict=True)]).reshape(-1, 3, 3)


def follow_nodes(recording: Recording, nodes: TrajectoryNodes, refined: Float64) -> Trajectory:
    """The trajectory with its nodes at refined poses, and each scan moved with the nodes around it in its log.

    :param refined: shape (n, 3), of the nodes.
    """
    trajectory, scans = recording.trajectory.copy(), np.arange(len(recording.trajectory))
    # A keyframe may have moved since its scan was placed.
    trajectory[nodes.rows] = nodes.poses
    following = np.searchsorted(nodes.rows, scans, side="right")
    before, after = np.maximum(following - 1, 0), np.minimum(following, len(nodes.rows) - 1)
    logs, node_logs = (np.searchsorted(recording.first_scans, rows, side="right") for rows in (scans, nodes.rows))
    before = np.where(node_logs[before] == logs, before, after)
    after = np.where(node_logs[after] == logs, after, before)
    first, last = nodes.rows[before], nodes.rows[after]
    share = np.where(last > first, (scans - first) / np.maximum(last - first, 1), 0.0)
    moved = [se2.compose(refined[node], se2.between(nodes.poses[node], trajectory)) for node in (before, after)]
    return se2.interpolate(moved[0], moved[1], np.clip(share, 0.0, 1.0))
