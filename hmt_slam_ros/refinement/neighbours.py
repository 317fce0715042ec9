"""Which scans may show the same walls: those taken nearby with a like heading, in areas that the topology links."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.topology.hybrid_map import HybridMap

# Keyframes farther apart in number than this were taken on two ways.
_ONE_WAY = 20
# Where ways keep apart: so many keyframes of other ways, within so many times the reach.
_FEW, _FARTHER = 5, 3.0


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
    passed: int = -1,
) -> list[NDArray[np.int64]]:
    """The nearest keyframes around given poses, in place and heading, in areas that the topology links.

    :param poses: shape (n, 3), of the keyframes; ``areas`` (n,) theirs.
    :param seen_from: shape (m, 3); ``seen_from_areas`` (m,) theirs.
    :param linked: {area: areas whose keyframes may lie in the same place}; what is near by chance only is not matched.
    :param reach: largest distance, m.
    :param count: keyframes at most.
    :param passed: rows of ``poses`` and ``seen_from`` that are apart by this or less are left out.
    :returns: m arrays of rows of ``poses``, nearest first; a radian counts as a metre.
    """
    known = np.unique(np.concatenate((areas, seen_from_areas)))
    allowed = np.array([[other in linked[area] for other in known.tolist()] for area in known.tolist()])
    rows = _nearest(
        poses, np.searchsorted(known, areas), seen_from, np.searchsorted(known, seen_from_areas), allowed, reach, count,
        passed,
    )  # fmt: skip
    return [own[own >= 0] for own in rows]


def with_other_ways(
    around: list[NDArray[np.int64]],
    poses: NDArray[np.float64],
    areas: NDArray[np.int64],
    linked: Mapping[int, Collection[int]],
    reach: float,
) -> list[NDArray[np.int64]]:
    """The neighbours of keyframes; of those that no other way comes near also the nearest on other ways, farther away.

    In a hall, two ways that keep apart see the same walls, and only these hold the one where the other is.

    :param around: of :func:`neighbours`, for each of the keyframes.
    :param poses: shape (n, 3), of the keyframes in the order in which they were taken; ``areas`` (n,) theirs.
    :param reach: largest distance of those that are near, m.
    """
    farther = neighbours(poses, areas, poses, areas, linked, _FARTHER * reach, _FEW, _ONE_WAY)
    alone = [bool(np.all(np.abs(rows - i) <= _ONE_WAY)) for i, rows in enumerate(around)]
    return [
        np.concatenate((rows, others)) if apart else rows
        for rows, others, apart in zip(around, farther, alone, strict=True)
    ]


@njit(cache=True)
def _nearest(
    poses: Float64, areas: Int64, seen_from: Float64, seen_from_areas: Int64, allowed: Bool, reach: float, count: int,
    passed: int,
) -> Int64:
    """:func:`neighbours` as an array (m, count), filled up with -1; ``allowed[a, b]`` where b is linked with a.

    Rows that are apart from each other by ``passed`` or less are left out.
    """  # fmt: skip
    rows, costs = np.full((len(seen_from), count), -1), np.empty(count)
    for i in range(len(seen_from)):
        held = 0
        for k in range(len(poses)):
            dx, dy = poses[k, 0] - seen_from[i, 0], poses[k, 1] - seen_from[i, 1]
            squared = dx * dx + dy * dy
            if abs(k - i) <= passed or squared > reach * reach or not allowed[seen_from_areas[i], areas[k]]:
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
