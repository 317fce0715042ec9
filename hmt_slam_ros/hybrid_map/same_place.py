"""The probability that two areas are one place in a map.

They are where few arcs lead from one to the other, a closure among them, and the arcs have them at one place. Areas at
one place that only the way around a loop joins are two in a topology that leaves the loop open.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cache
from statistics import NormalDist

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions

_QUANTILES = 16
"""Quantiles of a normal distribution along each axis, of whose pairs positions are made."""


_MAX_ARCS = 3
"""Arcs by way of which two areas are joined: a closure, and from there one step to either side."""


def areas_of(hybrid_map: HybridMap, keyframes: Collection[int]) -> dict[int, int]:
    """{keyframe: its area} of those that are in a map."""
    wanted = set(keyframes)
    return {k: area for area in hybrid_map.area_ids() for k in wanted & hybrid_map.keyframes(area).keys()}


def middle_keyframe(hybrid_map: HybridMap, area: int) -> int | None:
    """The keyframe that is the nearest to the middle of an area, of equals the smaller; None without keyframes."""
    keyframes = hybrid_map.keyframes(area)
    if not keyframes:
        return None
    middle = np.mean([pose[:2] for pose in keyframes.values()], axis=0)
    return min(keyframes, key=lambda k: (float(np.hypot(*(keyframes[k][:2] - middle))), k))


def are_joined(hybrid_map: HybridMap, area: int, other: int) -> bool:
    """Whether an arc joins two areas, or a closure with one more arc at each end at most."""
    if hybrid_map.arc_value(area, other) is not None:
        return True
    reached = {(area, False)}
    for _ in range(_MAX_ARCS):
        reached |= {
            (neighbor, closed or _is_closure(hybrid_map, here, neighbor))
            for here, closed in reached
            for neighbor in hybrid_map.neighbors(here)
        }
    return (other, True) in reached


def _is_closure(hybrid_map: HybridMap, area: int, other: int) -> bool:
    value = hybrid_map.arc_value(area, other)
    return value is not None and value.closure


def same_place_probability(hybrid_map: HybridMap, first: int, second: int, radius: float, scale: float) -> float:
    """The probability that a keyframe is near one of the other's area, by the arcs between both areas.

    1 where they are in the same area, 0 where their areas are not joined or the map lacks one of them.

    :param first: a keyframe.
    :param second: another one.
    :param radius: largest distance of near keyframes, m.
    :param scale: factor on the deviations of the arcs.
    """
    areas = areas_of(hybrid_map, (first, second))
    if len(areas) < 2:
        return 0.0
    area, other = areas[first], areas[second]
    if area == other or not are_joined(hybrid_map, area, other):
        return float(area == other)
    belief = shortest_path_beliefs(hybrid_map, area, targets=(other,)).get(other)
    if belief is None:
        return 0.0
    belief = PoseGaussian(belief.mean, scale**2 * belief.covariance)
    there = _near_probability(hybrid_map, area, belief, hybrid_map.keyframes(other)[second], radius)
    here = _near_probability(hybrid_map, other, belief.inverse(), hybrid_map.keyframes(area)[first], radius)
    return max(there, here)


def _near_probability(hybrid_map: HybridMap, area: int, belief: PoseGaussian, pose: Float64, radius: float) -> float:
    """The probability that a pose in another area is near a keyframe of an area.

    :param belief: over ``area_T_other``.
    :param pose: in the other area, shape (3,).
    """
    placed = belief.compose(PoseGaussian.from_pose(pose))
    values, vectors = np.linalg.eigh(placed.covariance[:2, :2])
    offsets = _normal_points() * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    cos, sin = np.cos(placed.mean[2]), np.sin(placed.mean[2])
    positions = placed.mean[:2] + offsets @ np.array([[cos, sin], [-sin, cos]])
    differences = positions[:, None] - keyframe_positions(hybrid_map, area)
    return float(np.mean((np.sum(differences**2, axis=2) <= radius**2).any(axis=1)))


@cache
def _normal_points() -> Float64:
    """Points of a standard normal distribution in the plane, shape (n, 2), all equally probable."""
    normal = NormalDist()
    quantiles = [normal.inv_cdf((k + 0.5) / _QUANTILES) for k in range(_QUANTILES)]
    return np.array([(x, y) for x in quantiles for y in quantiles])
