"""Which scans may show the same walls: those taken nearby with a like heading, in areas that the topology links."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int64
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
    known = np.unique(np.concatenate((areas, seen_from_areas)))
    allowed = np.array([[other in linked[area] for other in known.tolist()] for area in known.tolist()])
    rows = _nearest(
        poses, np.searchsorted(known, areas), seen_from, np.searchsorted(known, seen_from_areas), allowed, reach, count
    )
    return [own[own >= 0] for own in rows]


@njit(cache=True)
def _nearest(
    poses: Float64, areas: Int64, seen_from: Float64, seen_from_areas: Int64, allowed: Bool, reach: float, count: int
) -> Int64:
    """:func:`neighbours` as an array (m, count), filled up with -1; ``allowed[a, b]`` where b is linked with a."""
    rows, costs = np.full((len(seen_from), count), -1), np.empty(count)
    for i in range(len(seen_from)):
        held = 0
        for k in range(len(poses)):
            dx, dy = poses[k, 0] - seen_from[i, 0], poses[k, 1] - seen_from[i, 1]
            squared = dx * dx + dy * dy
            if squared > reach * reach or not allowed[seen_from_areas[i], areas[k]]:
                continue
            turn = poses[k, 2] - seen_from[i, 2]
            cost = np.sqrt(squared) + abs(turn - 2.0 * np.pi * np.floor(turn / (2.0 * np.pi) + 0.5))
            if held == count and cost >= costs[count - 1]:
                continue
            held = min(held + 1, count)
            at = held - 1
            while at > 0 and costs[at - 1] > cost:
                costs[at], rows[i, at] = costs[at - 1], rows[i, at - 1]
                at -= 1
            costs[at], rows[i, at] = cost, k
    return rows


def pairs_of(around: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Every pair of different rows once, shape (m, 2), ascending; of row i with each of ``around[i]``."""
    pairs = {(min(i, j), max(i, j)) for i, rows in enumerate(around) for j in rows.tolist() if i != j}
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
