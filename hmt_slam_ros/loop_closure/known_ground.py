"""Known ground around the robot under one hypothesis: keyframes that it can reach, and the paths there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_paths
from hmt_slam_ros.hybrid_map.surroundings import stack_poses

REACH = 40.0
"""Longest path to a keyframe, m."""

_MAX_SIGMA = 0.3
"""Largest deviation of the position of an area that counts, m: beyond it, walls are not where they are expected."""

_MAX_AREAS, _MAX_KEYFRAMES = 64, 300
"""Areas around the robot, and keyframes, the nearest ones, at most."""

_BESIDE = 1.0
"""Distance up to which a robot can pass from one keyframe to another, m: there is no room for a wall between."""

_MAX_STEP = 3.0
"""Largest distance between keyframes that follow each other on the robot's path, m."""

ROBOT = -1
"""Stands for the robot among rows of keyframes."""


class KnownGround(NamedTuple):
    """Keyframes that the robot can reach, by growing path length; n of them.

    :ivar keyframes: shape (n,).
    :ivar areas: shape (n,), of the keyframes.
    :ivar poses: shape (n, 3), ``base_T_keyframe``, m and rad.
    :ivar lengths: shape (n,), of the path there, m.
    :ivar previous: shape (n,), row of the keyframe that the path passes last, ``ROBOT`` for none.
    """

    keyframes: Int64
    areas: Int64
    poses: Float64
    lengths: Float64
    previous: Int64

    def rows_near(self, position: Float64, radius: float) -> Int64:
        """The rows of the keyframes around a position (2,), the nearest first.

        :param radius: m.
        """
        distances = np.hypot(self.poses[:, 0] - position[0], self.poses[:, 1] - position[1])
        order = np.argsort(distances, kind="stable")
        return order[distances[order] <= radius]

    def has_keyframe_at(self, keyframe: int, pose: Float64, tolerance: float) -> bool:
        """Whether a keyframe is there at a pose, ``base_T_keyframe``.

        :param tolerance: m and rad.
        """
        rows = np.flatnonzero(self.keyframes == keyframe)
        difference = self.poses[rows] - pose
        difference[:, 2] = se2.wrap(difference[:, 2])
        return bool((np.abs(difference) <= tolerance).all(axis=1).any())


def known_ground(hybrid_map: HybridMap, area: int, pose: Float64) -> KnownGround:
    """The known ground around a robot.

    :param area: the robot's.
    :param pose: ``area_T_base``, shape (3,).
    """
    keyframes, areas, poses = _keyframes_around(hybrid_map, area, pose)
    if not len(keyframes):
        return KnownGround(keyframes, areas, poses, np.zeros(0), np.zeros(0, np.int64))
    # The robot is the last node.
    positions = np.concatenate((poses[:, :2], np.zeros((1, 2))))
    distances = np.hypot(*(positions[:, None] - positions[None]).transpose(2, 0, 1))
    graph = scipy.sparse.csr_matrix(np.where(_passable_pairs(distances), np.maximum(distances, 1e-6), 0.0))
    lengths, previous = scipy.sparse.csgraph.dijkstra(
        graph, directed=False, indices=len(keyframes), return_predecessors=True, limit=REACH
    )
    order = np.lexsort((keyframes, lengths[:-1]))
    order = order[np.isfinite(lengths[order])]
    row_of = np.full(len(positions), ROBOT)
    row_of[order] = np.arange(len(order))
    return KnownGround(keyframes[order], areas[order], poses[order], lengths[order], row_of[previous[order]])


def _keyframes_around(hybrid_map: HybridMap, area: int, pose: Float64) -> tuple[Int64, Int64, Float64]:
    """Keyframes in a circle around the robot, in the order of their numbers, with areas and ``base_T_keyframe``."""
    keyframes, areas, poses = [], [], [np.zeros((0, 3))]
    base_T_area = se2.inverse(pose)
    around = shortest_paths(hybrid_map, area, _MAX_SIGMA**2, _MAX_AREAS)
    for other, mean in zip(around.areas.tolist(), around.means, strict=True):
        own = hybrid_map.keyframes(other) if hybrid_map.has_area(other) else {}
        keyframes += list(own)
        areas += [other] * len(own)
        poses.append(se2.compose(se2.compose(base_T_area, mean), stack_poses(own)))
    placed = np.concatenate(poses)
    distances = np.hypot(placed[:, 0], placed[:, 1])
    numbers = np.array(keyframes, dtype=np.int64)
    nearest = np.lexsort((numbers, distances))[:_MAX_KEYFRAMES]
    nearest = nearest[distances[nearest] <= REACH]
    rows = nearest[np.argsort(numbers[nearest])]
    return numbers[rows], np.array(areas, dtype=np.int64)[rows], placed[rows]


def _passable_pairs(distances: Float64) -> Bool:
    """Which keyframes, and the robot as the last, a robot can pass between, shape (n + 1, n + 1).

    :param distances: likewise, of keyframes in the order of their numbers, m.
    """
    count = len(distances) - 1
    joined = distances <= _BESIDE
    steps = np.arange(count - 1)
    joined[steps, steps + 1] |= distances[steps, steps + 1] <= _MAX_STEP
    from_robot = distances[-1, :-1]
    joined[-1, :-1] = from_robot <= min(max(_BESIDE, float(from_robot.min())), _MAX_STEP)
    joined[:-1, -1] = joined[-1, :-1]
    return joined
