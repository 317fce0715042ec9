"""Which areas lie for certain around one of them, and what their keyframes saw together."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.covariance import carried, of_inverse
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.sensing.view import FREE, seen, view_of
from hmt_slam_ros.topology.area_grid import AreaGrid, GridModel, Points, build_area_grid
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import Reached, reachable
from hmt_slam_ros.topology.transition import Place

Pose = NDArray[np.float64]

# An area has few others around it; this bounds the work where hundreds are joined by tight arcs.
_MOST_AROUND = 64
# Grids are kept up to this size, bytes: those of some ten places of a large building.
_KEPT = 4 << 23


WHOLE_MAP = 4 * _KEPT
"""The same where a whole map is looked through again and again, while it is not known where the robot is, bytes."""

# What the bounds on distances have in hand, m, and the smallest that is not 0.
_ROUNDING, _SMALLEST = 1e-6, 1e-300


@dataclass(frozen=True)
class Nearness:
    """What counts as around an area.

    :ivar sigma: largest deviation of an area's position, m.
    :ivar reach: largest distance between the nearest keyframes of the two, m.
    """

    sigma: float
    reach: float


def areas_around(
    hybrid_map: HybridMap, area: int, nearness: Nearness, without: Collection[int] = ()
) -> dict[int, PoseGaussian]:
    """{other area: belief over ``area_T_other``}, the area itself first, then by growing uncertainty."""
    beliefs = reachable(hybrid_map, area, nearness.sigma**2, _MOST_AROUND)
    here = positions(hybrid_map, area, np.zeros(3))
    found = {}
    for other, belief in beliefs.items():
        near = other == area or gap(here, positions(hybrid_map, other, belief.mean)) <= nearness.reach
        if near and other not in without:
            found[other] = belief
    return found


def stacked(poses: Mapping[int, Pose]) -> NDArray[np.float64]:
    """The poses as an array, shape (n, 3)."""
    return np.array(list(poses.values())).reshape(-1, 3)


def same_poses(one: Mapping[int, Pose], other: Mapping[int, Pose]) -> bool:
    """Whether the same keyframes are in the same places."""
    return one.keys() == other.keys() and all(np.array_equal(pose, other[k]) for k, pose in one.items())


def positions(hybrid_map: HybridMap, area: int, pose: Pose) -> NDArray[np.float64]:
    """Positions of an area's keyframes, shape (n, 2), where the area's frame stands at ``pose``."""
    return se2.transform(pose, stacked(hybrid_map.keyframes(area))[:, :2])


def gap(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Distance between the nearest points of two sets (n, 2), (m, 2), m; inf where one is empty."""
    between = a[:, None] - b[None]
    return float(np.hypot(between[..., 0], between[..., 1]).min(initial=np.inf))


def entry_bounds(
    found: Reached, query: PoseGaussian, lever: float, reach: Float64, scale: float, deviations: float
) -> Float64:
    """Bounds, quick to tell, on the probability that a query lies in the places of areas, shape (n,).

    They are 0 where no keyframe of the area can be near enough to one of the query's.

    :param found: areas seen from the query's area.
    :param query: belief over ``area_T_reference`` of the query's reference.
    :param lever: largest distance of the query's keyframes from their reference, m.
    :param reach: shape (n,), largest distance of the reference from an area's origin if the query is in its place, m.
    :param scale: factor on the deviations of the prior.
    :param deviations: how many deviations are admitted.
    """
    return _entry_bounds(found.means, found.covariances, query.mean, query.covariance, reach, lever, scale, deviations)


@njit(cache=True)
def _entry_bounds(
    means: Float64,
    covariances: Float64,
    mean: Float64,
    covariance: Float64,
    reach: Float64,
    lever: float,
    scale: float,
    deviations: float,
) -> Float64:
    bounds = np.zeros(len(means))
    own = np.sqrt(covariance[0, 0] + covariance[1, 1])
    for n in range(len(means)):
        distance = np.hypot(mean[0] - means[n, 0], mean[1] - means[n, 1])
        # No direction is less certain than all together, and most areas are too far off even so.
        turn = np.sqrt(covariances[n, 2, 2])
        widest = np.sqrt(covariances[n, 0, 0] + covariances[n, 1, 1]) + distance * turn + own
        widest += lever * (turn + np.sqrt(covariance[2, 2]))
        if distance > reach[n] + deviations * scale * widest + 2.0 * _ROUNDING:
            continue
        prior = scale * scale * (carried(of_inverse(covariances[n], means[n]), mean) + covariance)
        half, apart = 0.5 * (prior[0, 0] + prior[1, 1]), 0.5 * (prior[0, 0] - prior[1, 1])
        turn = np.sqrt(apart * apart + prior[0, 1] * prior[0, 1])
        spread = np.sqrt(max(0.0, half + turn)) + lever * np.sqrt(max(0.0, prior[2, 2]))
        if distance > reach[n] + deviations * spread + _ROUNDING:
            continue
        # The area of the disc around the origin times the largest density in it, at most that of a normal of this
        # spread all round.
        off = max(0.0, distance - reach[n]) / max(spread, _ROUNDING)
        density = np.exp(-0.5 * off * off) / max(np.sqrt(max(0.0, half * half - turn * turn)), _ROUNDING)
        bounds[n] = min(1.0, max(0.5 * reach[n] * reach[n] * density, _SMALLEST))
    return bounds


def agreeing(
    belief: PoseGaussian, area: int, other: int, global_poses: Mapping[int, PoseGaussian], gate: float
) -> Pose:
    """``area_T_other`` as the globally consistent map has it, where that agrees with the belief, else its mean.

    A hypothesis with an arc that the global map does not know places areas elsewhere than that map does.
    """
    one, two = global_poses.get(area), global_poses.get(other)
    if one is None or two is None:
        return belief.mean
    pose = se2.between(one.mean, two.mean)
    away = se2.log(se2.between(belief.mean, pose))
    agrees = float(away @ np.linalg.solve(belief.covariance, away)) <= gate
    return pose if agrees else belief.mean


class Views:
    """Grids and places, built from the keyframes' scans and kept while they are in use."""

    def __init__(self, scans: Mapping[int, Scan], model: GridModel, nearness: Nearness, kept: int = _KEPT) -> None:
        """:param scans: {keyframe: scan}, which may grow.

        :param kept: size of the grids that are kept, bytes.
        """
        self._scans = scans
        self._kept = kept
        self._model = model
        self._nearness = nearness
        self._grids: OrderedDict[bytes, AreaGrid] = OrderedDict()

    def clear(self) -> None:
        """Keep no grid, as scans have changed."""
        self._grids.clear()

    def grid(self, keyframes: Mapping[int, Pose]) -> AreaGrid:
        """What the keyframes saw, placed at the given poses."""
        poses = stacked(keyframes)
        key = np.array(list(keyframes), dtype=np.int64).tobytes() + poses.tobytes()
        if key not in self._grids:
            self._grids[key] = build_area_grid([self._scans[k] for k in keyframes], poses, self._model)
            self._drop_oldest()
        self._grids.move_to_end(key)
        return self._grids[key]

    def lasting(self, keyframes: Mapping[int, Pose]) -> Points:
        """Surface points of the keyframes, shape (n, 2), m, that none of them sees through: nobody who walked by."""
        points = self.grid(keyframes).points
        passed = np.zeros(len(points), dtype=np.bool_)
        for keyframe, pose in keyframes.items():
            passed |= seen(view_of(self._scans[keyframe]), se2.transform(se2.inverse(pose), points)) == FREE
        return points[~passed]

    def _drop_oldest(self) -> None:
        """Forget the grids that were not used for longest, but not the newest."""
        size = sum(grid.nbytes for grid in self._grids.values())
        while size > self._kept and len(self._grids) > 1:
            size -= self._grids.popitem(last=False)[1].nbytes

    def forget(self) -> None:
        """Forget all grids."""
        self._grids.clear()

    def seen_before(self, hybrid_map: HybridMap, poses: Mapping[int, Pose], keyframe: int) -> AreaGrid:
        """What keyframes before a given one saw, of the areas that stand at ``poses``, {area: pose}."""
        old: dict[int, Pose] = {}
        for area, pose in poses.items():
            placed = {k: at for k, at in hybrid_map.keyframes(area).items() if k < keyframe}
            old |= zip(placed, se2.compose(pose, stacked(placed)), strict=True)
        return self.grid(old)

    def place(
        self,
        hybrid_map: HybridMap,
        area: int,
        without: Collection[int],
        before: float = math.inf,
        sigma: float | None = None,
    ) -> Place:
        """An area with those around it, so that an overlap is not cut off at the area's edge.

        :param without: areas that are left out.
        :param before: keyframes from this one on are left out as well.
        :param sigma: largest deviation of another area's position, m, if not that which counts as around elsewhere.
        """
        nearness = self._nearness if sigma is None else replace(self._nearness, sigma=sigma)
        around = areas_around(hybrid_map, area, nearness, without)
        return self.place_of(hybrid_map, area, {other: belief.mean for other, belief in around.items()}, before)

    def place_of(self, hybrid_map: HybridMap, area: int, poses: Mapping[int, Pose], before: float = math.inf) -> Place:
        """The place of ``area`` among the areas that stand at ``poses``, {other area: ``area_T_other``}."""
        keyframes: dict[int, Pose] = {}
        owners: list[int] = []
        for other, pose in poses.items():
            placed = {k: at for k, at in hybrid_map.keyframes(other).items() if k < before}
            keyframes |= zip(placed, se2.compose(pose, stacked(placed)), strict=True)
            owners += [other] * len(placed)
        return Place(area, np.array(owners, dtype=np.int64), stacked(keyframes)[:, :2], self.grid(keyframes))
