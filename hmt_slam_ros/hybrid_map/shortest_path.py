"""Where the other areas lie seen from one area: composition of arcs along the least uncertain path, Eq. (15).

The cost of an arc depends on the path to it, so the searches of scipy and networkx, which weigh arcs once, do not do.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, inverse_pose_covariance, propagate_covariance
from hmt_slam_ros.hybrid_map.hybrid_map import ArcTable, HybridMap


class ShortestPaths(NamedTuple):
    """Areas in order of cost, of equals the smaller first; the start comes first, with zero covariance.

    :ivar areas: shape (n,).
    :ivar means: shape (n, 3), ``start_T_area``.
    :ivar covariances: shape (n, 3, 3), right tangent frame.
    """

    areas: Int64
    means: Float64
    covariances: Float64


class _ChangedArcs(NamedTuple):
    """Arcs in which a hypothesis differs, each once from either side, sorted by the areas where they begin.

    :ivar sources: shape (sides,), areas.
    :ivar targets: shape (sides,), areas.
    :ivar is_reversed: shape (sides,), whether the arc is stored from ``end`` to ``begin``.
    :ivar is_removed: shape (sides,), whether the hypothesis lacks the arc that is common.
    :ivar means: shape (sides, 3), as stored.
    :ivar covariances: shape (sides, 3, 3), as stored.
    """

    sources: Int64
    targets: Int64
    is_reversed: Bool
    is_removed: Bool
    means: Float64
    covariances: Float64


def shortest_path_beliefs(
    hybrid_map: HybridMap,
    area: int,
    cost_limit: float = math.inf,
    max_areas: int | None = None,
    targets: Collection[int] = (),
) -> dict[int, PoseGaussian]:
    """{area: belief over ``start_T_area``} as :func:`shortest_paths` finds them, in their order."""
    found = shortest_paths(hybrid_map, area, cost_limit, max_areas, targets)
    beliefs = map(PoseGaussian, found.means, found.covariances)
    return dict(zip(found.areas.tolist(), beliefs, strict=True))


def shortest_paths(
    hybrid_map: HybridMap,
    area: int,
    cost_limit: float = math.inf,
    max_areas: int | None = None,
    targets: Collection[int] = (),
) -> ShortestPaths:
    """Bounded Dijkstra over the arcs from ``area``.

    The cost of an area is the trace of the positional covariance of its composed belief, m^2. A step over an arc costs
    the growth of that trace, and nothing where a lever arm turning back shrinks it, so that costs never fall along a
    path. An area keeps the first, cheapest belief by which it was reached; loops are not averaged (the globally
    consistent map does that).

    :param area: where the search starts; it need not be in the map.
    :param cost_limit: areas that cost more than this are left out, m^2.
    :param max_areas: at most this many areas, the start included; None for no bound.
    :param targets: the search ends where all these are found; empty where it goes on.
    """
    wanted = np.array(list(set(targets)), dtype=np.int64)
    size = max(hybrid_map.max_area_id, area, *(b for _, b in hybrid_map.changed_arcs), *targets) + 1
    most = size if max_areas is None else min(size, max_areas)
    return ShortestPaths(
        *_dijkstra(area, size, hybrid_map.common.table, _changed_arcs(hybrid_map), cost_limit, most, wanted)
    )


def _changed_arcs(hybrid_map: HybridMap) -> _ChangedArcs:
    pairs = np.array(list(hybrid_map.changed_arcs), dtype=np.int64).reshape(-1, 2)
    arcs = list(hybrid_map.changed_arcs.values())
    gone = np.array([arc is None for arc in arcs], dtype=np.bool_)
    means = np.array([np.zeros(3) if arc is None else arc.pose.mean for arc in arcs]).reshape(-1, 3)
    covariances = np.array([np.zeros((3, 3)) if arc is None else arc.pose.covariance for arc in arcs]).reshape(-1, 3, 3)
    begin, end = np.concatenate((pairs, pairs[:, ::-1])).T
    order = np.lexsort((end, begin))
    row = order % max(1, len(pairs))
    return _ChangedArcs(begin[order], end[order], order >= len(pairs), gone[row], means[row], covariances[row])


class _DijkstraState(NamedTuple):
    """What a search knows of the areas that it has seen, each in a row of its own.

    :ivar row: shape (size,), of every area, from 1 on; 0 for one that was not seen.
    :ivar cost: shape (size + 1,), by rows, the least cost so far, -1 where it is final.
    :ivar means: shape (size + 1, 3), by rows.
    :ivar covariances: shape (size + 1, 3, 3), by rows.
    """

    row: Int64
    cost: Float64
    means: Float64
    covariances: Float64


@njit(cache=True)
def _dijkstra(
    start: int, size: int, table: ArcTable, own: _ChangedArcs, limit: float, most: int, wanted: Int64
) -> tuple[Int64, Float64, Float64]:
    seen = _DijkstraState(
        np.zeros(size, np.int64), np.empty(size + 1), np.empty((size + 1, 3)), np.empty((size + 1, 3, 3))
    )
    seen.row[start], seen.cost[1] = 1, 0.0
    seen.means[1], seen.covariances[1] = 0.0, 0.0
    rows, last = np.empty(most, np.int64), 1
    areas, count, missing = np.empty(most, np.int64), 0, len(wanted)
    queue = [(0.0, start)]
    while len(queue) > 0 and count < len(rows):
        cost, here = heapq.heappop(queue)
        row = seen.row[here]
        if seen.cost[row] != cost:
            continue  # a cheaper path was found since, or this one twice
        areas[count], rows[count], count = here, row, count + 1
        for area in wanted:
            missing -= area == here
        if missing == 0 and len(wanted) > 0:
            break
        low, high = np.searchsorted(own.sources, here), np.searchsorted(own.sources, here, side="right")
        for k in range(low, high):
            if not (own.is_removed[k] or _has_cheaper_path(seen, own.targets[k], cost)):
                last = _relax_arc(
                    row,
                    own.targets[k],
                    own.means[k],
                    own.covariances[k],
                    own.is_reversed[k],
                    cost,
                    limit,
                    seen,
                    last,
                    queue,
                )
        side = np.int64(table.first[here]) if here < len(table.first) else np.int64(-1)
        while side >= 0:
            there, arc = np.int64(table.opposite_area[side]), side // 2
            if not _has_cheaper_path(seen, there, cost):
                place = low + np.searchsorted(own.targets[low:high], there)
                if place == high or own.targets[place] != there:
                    last = _relax_arc(
                        row,
                        there,
                        table.means[arc],
                        table.covariances[arc],
                        side % 2 == 1,
                        cost,
                        limit,
                        seen,
                        last,
                        queue,
                    )
            side = np.int64(table.next_side[side])
        seen.cost[row] = -1.0
    rows = rows[:count]
    return areas[:count], seen.means[rows], seen.covariances[rows]


@njit(cache=True)
def _has_cheaper_path(seen: _DijkstraState, area: int, cost: float) -> bool:
    """Whether an area was reached at a cost, or a smaller one."""
    known = seen.row[area]
    return known > 0 and seen.cost[known] <= cost


@njit(cache=True)
def _relax_arc(
    row: int,
    there: int,
    mean: Float64,
    covariance: Float64,
    backwards: bool,
    cost: float,
    limit: float,
    seen: _DijkstraState,
    last: int,
    queue: list[tuple[float, int]],
) -> int:
    """See an area over an arc from the area in ``row``; the last row that is in use."""
    if backwards:
        covariance = inverse_pose_covariance(covariance, mean)
        mean = _inverse(mean)
    beyond = propagate_covariance(seen.covariances[row], mean) + covariance  # Eq. (15)
    known = seen.row[there]
    growth = beyond[0, 0] + beyond[1, 1] - (seen.covariances[row, 0, 0] + seen.covariances[row, 1, 1])
    new_cost = max(cost, cost + growth)
    if new_cost > limit or (known > 0 and seen.cost[known] <= new_cost):
        return last
    if known == 0:
        last += 1
        known = seen.row[there] = last
    seen.cost[known] = new_cost
    seen.covariances[known] = beyond
    _compose(seen.means[row], mean, seen.means[known])
    heapq.heappush(queue, (new_cost, there))
    return last


@njit(cache=True)
def _inverse(pose: Float64) -> Float64:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = se2.inverse_position(cos, sin, pose[0], pose[1])
    return np.array((x, y, -pose[2]))


@njit(cache=True)
def _compose(a: Float64, b: Float64, result: Float64) -> None:
    cos, sin = np.cos(a[2]), np.sin(a[2])
    result[0], result[1] = se2.transform_point(a[0], a[1], cos, sin, b[0], b[1])
    result[2] = se2.wrap_by_turns(a[2] + b[2])


# Larger than a building, m, and all headings.
_UNINFORMATIVE_SIGMA, _UNINFORMATIVE_ANGLE = 300.0, math.pi


def uninformative_belief(mean: NDArray[np.float64]) -> PoseGaussian:
    """A belief that could be any.

    :param mean: shape (3,), where it is drawn as long as nothing is known.
    """
    return PoseGaussian(mean, np.diag([_UNINFORMATIVE_SIGMA, _UNINFORMATIVE_SIGMA, _UNINFORMATIVE_ANGLE]) ** 2)


def connected_areas(hybrid_map: HybridMap, area: int) -> dict[int, PoseGaussian]:
    """{other area: belief over ``area_T_other``} of those to which arcs lead that tell something, and of itself."""
    return shortest_path_beliefs(hybrid_map, area, _UNINFORMATIVE_SIGMA**2)


def is_uninformative(belief: PoseGaussian) -> bool:
    """Whether a belief is about as wide as :func:`uninformative_belief`."""
    return bool(np.trace(belief.covariance[:2, :2]) > _UNINFORMATIVE_SIGMA**2)


def informative_arc(hybrid_map: HybridMap, a: int, b: int) -> PoseGaussian | None:
    """The belief over ``a_T_b``, or None where no arc joins the two that tells anything."""
    arc = hybrid_map.arc(a, b)
    return None if arc is None or is_uninformative(arc) else arc


def connected_neighbors(hybrid_map: HybridMap, area: int) -> list[int]:
    """The areas one arc away that tells where they are, ascending."""
    return [other for other in hybrid_map.neighbors(area) if informative_arc(hybrid_map, area, other) is not None]
