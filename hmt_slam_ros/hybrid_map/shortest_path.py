"""Beliefs over the other areas in the frame of one: composition of arcs along the least uncertain path, Eq. (15).

The cost of an arc depends on the path to it, so the searches of scipy and networkx, with fixed costs, do not apply.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, inverse_pose_covariance, propagate_covariance
from hmt_slam_ros.hybrid_map.hybrid_map import ArcTable, HybridMap

_UNINFORMATIVE_SIGMA = 300.0
"""Deviation of an uninformative belief along each axis, m: more than a building."""

_UNINFORMATIVE_ANGLE = math.pi
"""Deviation of its heading, rad."""


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
    """Arcs that differ from the common map, each once from either side, sorted by source and target.

    :ivar sources: shape (sides,), areas.
    :ivar targets: shape (sides,), areas.
    :ivar is_reversed: shape (sides,), whether the arc is stored from target to source.
    :ivar is_removed: shape (sides,), whether the hypothesis lacks the common arc.
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
    """{area: belief over ``start_T_area``} of :func:`shortest_paths`, in their order."""
    paths = shortest_paths(hybrid_map, area, cost_limit, max_areas, targets)
    beliefs = map(PoseGaussian, paths.means, paths.covariances)
    return dict(zip(paths.areas.tolist(), beliefs, strict=True))


def shortest_paths(
    hybrid_map: HybridMap,
    area: int,
    cost_limit: float = math.inf,
    max_areas: int | None = None,
    targets: Collection[int] = (),
) -> ShortestPaths:
    """The shortest paths from an area, by a bounded Dijkstra search over the arcs.

    The cost of an area is the trace of the positional covariance of its composed belief, m^2. An arc costs the growth
    of that trace, and nothing where a lever arm that turns back shrinks it, so that costs never fall along a path. An
    area keeps the first, cheapest belief; loops are not averaged, as in the global map.

    :param area: where the search starts; it need not be in the map.
    :param cost_limit: areas that cost more than this are left out, m^2.
    :param max_areas: at most this many areas, the start included; None for no bound.
    :param targets: the search ends when all these are found; if empty, when nothing is left.
    """
    wanted = np.array(list(set(targets)), dtype=np.int64)
    size = max(hybrid_map.max_area_id, area, *(b for _, b in hybrid_map.changed_arcs), *targets) + 1
    max_count = size if max_areas is None else min(size, max_areas)
    return ShortestPaths(
        *_dijkstra(area, size, hybrid_map.common.table, _changed_arcs(hybrid_map), cost_limit, max_count, wanted)
    )


def _changed_arcs(hybrid_map: HybridMap) -> _ChangedArcs:
    pairs = np.array(list(hybrid_map.changed_arcs), dtype=np.int64).reshape(-1, 2)
    arcs = list(hybrid_map.changed_arcs.values())
    is_removed = np.array([arc is None for arc in arcs], dtype=np.bool_)
    means = np.array([np.zeros(3) if arc is None else arc.pose.mean for arc in arcs]).reshape(-1, 3)
    covariances = np.array([np.zeros((3, 3)) if arc is None else arc.pose.covariance for arc in arcs]).reshape(-1, 3, 3)
    sources, targets = np.concatenate((pairs, pairs[:, ::-1])).T
    order = np.lexsort((targets, sources))
    row, is_reversed = order % max(1, len(pairs)), order >= len(pairs)
    return _ChangedArcs(sources[order], targets[order], is_reversed, is_removed[row], means[row], covariances[row])


class _DijkstraState(NamedTuple):
    """The areas that a search has reached, each in a row of its own.

    :ivar row: shape (size,), of every area, from 1 on; 0 for one that was not reached.
    :ivar cost: shape (size + 1,), by rows, the least cost so far, -1 if it is final.
    :ivar means: shape (size + 1, 3), by rows.
    :ivar covariances: shape (size + 1, 3, 3), by rows.
    """

    row: Int64
    cost: Float64
    means: Float64
    covariances: Float64


@njit(cache=True)
def _dijkstra(
    start: int, size: int, table: ArcTable, changed: _ChangedArcs, limit: float, max_count: int, wanted: Int64
) -> tuple[Int64, Float64, Float64]:
    reached = _DijkstraState(
        np.zeros(size, np.int64), np.empty(size + 1), np.empty((size + 1, 3)), np.empty((size + 1, 3, 3))
    )
    reached.row[start], reached.cost[1] = 1, 0.0
    reached.means[1], reached.covariances[1] = 0.0, 0.0
    rows, last = np.empty(max_count, np.int64), 1
    areas, count, missing = np.empty(max_count, np.int64), 0, len(wanted)
    queue = [(0.0, start)]
    while len(queue) > 0 and count < len(rows):
        cost, here = heapq.heappop(queue)
        row = reached.row[here]
        if reached.cost[row] != cost:
            continue  # by a cheaper path since
        areas[count], rows[count], count = here, row, count + 1
        for area in wanted:
            missing -= area == here
        if missing == 0 and len(wanted) > 0:
            break
        low, high = np.searchsorted(changed.sources, here), np.searchsorted(changed.sources, here, side="right")
        for k in range(low, high):
            there = changed.targets[k]
            if not (changed.is_removed[k] or _has_cheaper_path(reached, there, cost)):
                mean, covariance = changed.means[k], changed.covariances[k]
                last = _relax_arc(
                    row, there, mean, covariance, changed.is_reversed[k], cost, limit, reached, last, queue
                )
        side = np.int64(table.first[here]) if here < len(table.first) else np.int64(-1)
        while side >= 0:
            there, arc = np.int64(table.opposite_area[side]), side // 2
            if not _has_cheaper_path(reached, there, cost):
                found = low + np.searchsorted(changed.targets[low:high], there)
                if found == high or changed.targets[found] != there:
                    mean, covariance = table.means[arc], table.covariances[arc]
                    last = _relax_arc(row, there, mean, covariance, side % 2 == 1, cost, limit, reached, last, queue)
            side = np.int64(table.next_side[side])
        reached.cost[row] = -1.0
    rows = rows[:count]
    return areas[:count], reached.means[rows], reached.covariances[rows]


@njit(cache=True)
def _has_cheaper_path(reached: _DijkstraState, area: int, cost: float) -> bool:
    """Whether an area was reached at a cost, or a smaller one."""
    row = reached.row[area]
    return row > 0 and reached.cost[row] <= cost


@njit(cache=True)
def _relax_arc(
    row: int,
    there: int,
    mean: Float64,
    covariance: Float64,
    is_reversed: bool,
    cost: float,
    limit: float,
    reached: _DijkstraState,
    last: int,
    queue: list[tuple[float, int]],
) -> int:
    """Reach an area over an arc from the area in ``row``; returns the last row that is in use."""
    if is_reversed:
        covariance = inverse_pose_covariance(covariance, mean)
        mean = _inverse(mean)
    composed = propagate_covariance(reached.covariances[row], mean) + covariance  # Eq. (15)
    target_row = reached.row[there]
    growth = composed[0, 0] + composed[1, 1] - (reached.covariances[row, 0, 0] + reached.covariances[row, 1, 1])
    new_cost = max(cost, cost + growth)
    if new_cost > limit or (target_row > 0 and reached.cost[target_row] <= new_cost):
        return last
    if target_row == 0:
        last += 1
        target_row = reached.row[there] = last
    reached.cost[target_row] = new_cost
    reached.covariances[target_row] = composed
    _compose(reached.means[row], mean, reached.means[target_row])
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


def uninformative_belief(mean: Float64) -> PoseGaussian:
    """A belief that admits any pose in a building.

    :param mean: shape (3,), where the area is drawn meanwhile.
    """
    return PoseGaussian(mean, np.diag([_UNINFORMATIVE_SIGMA, _UNINFORMATIVE_SIGMA, _UNINFORMATIVE_ANGLE]) ** 2)


def is_uninformative(belief: PoseGaussian) -> bool:
    """Whether a belief is about as wide as :func:`uninformative_belief`."""
    return bool(np.trace(belief.covariance[:2, :2]) > _UNINFORMATIVE_SIGMA**2)


def informative_arc(hybrid_map: HybridMap, a: int, b: int) -> PoseGaussian | None:
    """The belief over ``a_T_b``, or None if no informative arc joins the two."""
    arc = hybrid_map.arc(a, b)
    return None if arc is None or is_uninformative(arc) else arc


def connected_areas(hybrid_map: HybridMap, area: int) -> dict[int, PoseGaussian]:
    """{other area: belief over ``area_T_other``} of the areas that informative arcs lead to, and of itself."""
    return shortest_path_beliefs(hybrid_map, area, _UNINFORMATIVE_SIGMA**2)


def connected_neighbors(hybrid_map: HybridMap, area: int) -> list[int]:
    """The areas one informative arc away, ascending."""
    return [other for other in hybrid_map.neighbors(area) if informative_arc(hybrid_map, area, other) is not None]


def map_pieces(hybrid_map: HybridMap) -> list[list[int]]:
    """The areas in pieces that informative arcs hold together, each ascending; the piece with the map's frame first.

    The place of one piece in another is unknown.
    """
    neighbors = {area: list[int]() for area in hybrid_map.area_ids()}
    for a, b, arc in hybrid_map.all_arcs():
        if not is_uninformative(arc.pose):
            neighbors[a].append(b)
            neighbors[b].append(a)
    pieces, left = list[list[int]](), set(neighbors)
    for area in neighbors:
        piece, reached = list[int](), [area]
        while reached:
            here = reached.pop()
            if here in left:
                left.remove(here)
                piece.append(here)
                reached += neighbors[here]
        if piece:
            pieces.append(sorted(piece))
    return pieces
