"""Which scans may show the same walls: those taken nearby with a like heading, in areas that the topology links.

Where a way comes near no other, those of other ways that share most walls with it, however few.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.configuration.topological import Refinement
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.refinement.registration import normal_equations, weighting
from hmt_slam_ros.refinement.surfaces import Surfaces
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reachable
from hmt_slam_ros.topology.unknown import beside

# Keyframes farther apart in number than this were taken on two ways.
_ONE_WAY = 20
# Where ways keep apart: so many keyframes of other ways, within so many times the reach, that share at least so much of
# their points; one out of so many points tells who they are.
_FEW, _FARTHER, _FAR_SHARE, _LOOKED_AT = 5, 5.0, 0.03, 4


class Pairs(NamedTuple):
    """Scans that may overlap.

    :ivar rows: shape (m, 2), each pair once, ascending.
    :ivar least_share: shape (m,), the share of the points of the first that has to meet the second for the two to be
        registered with each other.
    """

    rows: Int64
    least_share: Float64


def linked_areas(hybrid_map: HybridMap) -> dict[int, frozenset[int]]:
    """Every area with itself and the areas up to two arcs away: what lies near otherwise does so by chance."""
    one = {area: {area, *beside(hybrid_map, area)} for area in hybrid_map.area_ids()}
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


def certain_areas(hybrid_map: HybridMap, deviation: float) -> dict[int, frozenset[int]]:
    """Every area with those that lie where they are thought to be, to a deviation in m, as seen from either of both."""
    areas = hybrid_map.area_ids()
    seen = {area: reachable(hybrid_map, area, cost_limit=deviation**2).keys() for area in areas}
    return {area: frozenset(other for other in areas if other in seen[area] or area in seen[other]) for area in areas}


def with_other_ways(
    pairs: Pairs,
    surfaces: Surfaces,
    poses: NDArray[np.float64],
    areas: NDArray[np.int64],
    certain: Mapping[int, Collection[int]],
    options: Refinement,
) -> Pairs:
    """The pairs of keyframes; of those that no other way comes near, also those with other ways that share most walls.

    In a hall, two ways that keep apart see the same walls, and only these hold the one where the other is.

    :param pairs: of keyframes that are near each other.
    :param surfaces: of the keyframes.
    :param poses: shape (n, 3), of the keyframes in the order in which they were taken; ``areas`` (n,) theirs.
    :param certain: {area: areas that lie where they are thought to be, so that the same walls meet}.
    """
    met = np.abs(np.diff(pairs.rows, axis=1)[:, 0]) > _ONE_WAY
    alone = np.setdiff1d(np.arange(len(poses)), pairs.rows[met])
    far = [(i, k) for i in alone.tolist() for k in _sharing_most(i, surfaces, poses, areas, certain, options)]
    rows = np.unique(np.sort(np.array(far, dtype=np.int64).reshape(-1, 2), axis=1), axis=0)
    return Pairs(
        np.concatenate((pairs.rows, rows)), np.concatenate((pairs.least_share, np.full(len(rows), _FAR_SHARE)))
    )


def _sharing_most(
    row: int,
    surfaces: Surfaces,
    poses: NDArray[np.float64],
    areas: NDArray[np.int64],
    certain: Mapping[int, Collection[int]],
    options: Refinement,
) -> list[int]:
    """The keyframes of other ways that share most walls with one, most first."""
    numbers = np.arange(len(poses))
    within = np.hypot(*(poses[:, :2] - poses[row, :2]).T) <= _FARTHER * options.reach
    held = np.isin(areas, sorted(certain[int(areas[row])]))
    others = np.flatnonzero((np.abs(numbers - row) > _ONE_WAY) & within & held)
    one = np.full(len(others), row)
    other_T_one = se2.between(poses[others], poses[one])
    share = normal_equations(
        surfaces, one, surfaces, others, other_T_one, options.first_gate, weighting(options), _LOOKED_AT
    )[2]
    most = np.argsort(-share, kind="stable")[:_FEW]
    found: list[int] = others[most[share[most] >= _FAR_SHARE]].tolist()
    return found


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


def pairs_of(around: list[NDArray[np.int64]], least_share: float) -> Pairs:
    """Every pair of different rows; of row i with each of ``around[i]``."""
    pairs = {(min(i, j), max(i, j)) for i, rows in enumerate(around) for j in rows.tolist() if i != j}
    return Pairs(np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2), np.full(len(pairs), least_share))
