"""Where the other areas lie seen from one area: composition of arcs along the least uncertain path, Eq. (15)."""

from __future__ import annotations

import heapq
import itertools
import math

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.hybrid_map import HybridMap


def reachable(
    hybrid_map: HybridMap, area: int, cost_limit: float = math.inf, max_areas: int | None = None
) -> dict[int, PoseGaussian]:
    """Bounded Dijkstra over the arcs from ``area``.

    The cost of an area is the trace of the positional covariance of its composed belief, m^2. A step over an arc costs
    the growth of that trace, and nothing where a lever arm turning back shrinks it, so that costs never fall along a
    path. An area keeps the first, cheapest belief by which it was reached; loops are not averaged (the globally
    consistent map does that).

    :param area: where the search starts; it need not be in the map.
    :param cost_limit: areas that cost more than this are left out, m^2.
    :param max_areas: at most this many areas, the start included; None for no bound.
    :returns: {area: belief over ``start_T_area``} in order of cost, of equals the first found; the start comes first,
        with zero covariance.
    """
    found: dict[int, PoseGaussian] = {}
    ties = itertools.count()
    queue = [(0.0, next(ties), area, PoseGaussian(np.zeros(3), np.zeros((3, 3))))]
    while queue and (max_areas is None or len(found) < max_areas):
        cost, _, here, belief = heapq.heappop(queue)
        if here in found:
            continue
        found[here] = belief
        for there in hybrid_map.neighbours(here):
            arc = None if there in found else hybrid_map.arc(here, there)
            if arc is None:
                continue
            beyond = belief.compose(arc)  # Eq. (15)
            cost_beyond = max(cost, cost + _positional_trace(beyond) - _positional_trace(belief))
            if cost_beyond <= cost_limit:
                heapq.heappush(queue, (cost_beyond, next(ties), there, beyond))
    return found


def _positional_trace(belief: PoseGaussian) -> float:
    return float(belief.covariance[0, 0] + belief.covariance[1, 1])
