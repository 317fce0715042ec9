"""Which scans may show the same walls: those taken nearby with a like heading, in areas that the topology links."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.topology.hybrid_map import HybridMap


def linked_areas(hybrid_map: HybridMap) -> dict[int, frozenset[int]]:
    """Every area with itself and the areas up to two arcs away: what lies near otherwise does so by chance."""
    one = {area: {area, *hybrid_map.neighbours(area)} for area in hybrid_map.area_ids()}
    return {area: frozenset().union(*(one[next_one] for next_one in near)) for area, near in one.items()}


def neighbours(
    poses: NDArray[np.float64],
    areas: NDArray[np.int64],
    seen_from: NDArray[np.float64],
    seen_from_areas: NDArray[np.int64],
    linked: Mapping[int, Collection[int]],
    reach: float,
    count: int,
) -> list[NDArray[np.int64]]:
    """The nearest keyframes around given poses, in place and heading, in areas that the topology links.

    :param poses: shape (n, 3), of the keyframes; ``areas`` (n,) theirs.
    :param seen_from: shape (m, 3); ``seen_from_areas`` (m,) theirs.
    :param linked: {area: areas whose keyframes may lie in the same place}; what is near by chance only is not matched.
    :param reach: largest distance, m.
    :param count: keyframes at most.
    :returns: m arrays of rows of ``poses``, nearest first; a radian counts as a metre.
    """
    tree = cKDTree(poses[:, :2])
    found = []
    nearby = tree.query_ball_point(seen_from[:, :2], reach, return_sorted=True)
    for pose, area, near in zip(seen_from, seen_from_areas.tolist(), nearby, strict=True):
        rows = np.array([row for row in near if int(areas[row]) in linked[area]], dtype=np.int64)
        cost = np.hypot(*(poses[rows, :2] - pose[:2]).T) + np.abs(se2.wrap(poses[rows, 2] - pose[2]))
        found.append(rows[np.argsort(cost, kind="stable")[:count]])
    return found


def pairs_of(around: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Every pair of different rows once, shape (m, 2), ascending; of row i with each of ``around[i]``."""
    pairs = {(min(i, j), max(i, j)) for i, rows in enumerate(around) for j in rows.tolist() if i != j}
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
