"""Which areas lie around one of them, and where in an area a pose may be: the transition model of Eq. (6).

A keyframe lies in the *place* of the area whose keyframe is the nearest to it, among those near enough and in sight,
so that a parallel corridor behind a wall is another place. The robot entered an area where most of the keyframes in
question lie in its place. Under the belief of the arcs that is a probability pi(gamma); places exclude each other, so
the pi sum to 1 at most, and what is left is the probability of new ground: the paper's constant n is no constant.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, inverse_pose_covariance, propagate_covariance
from hmt_slam_ros.geometry.se2 import transform_point
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import ShortestPaths, shortest_path_beliefs
from hmt_slam_ros.registration.likelihood_grid import AreaGrid, GridModel, build_area_grid
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.polar_scan import FREE, classify_points, to_polar_scan

_DRAWS = 512
# Log-ratio above which a cell bars the view, and the share of a line of sight that has to be known as free.
_BARRIER = 0.5
_SEEN = 0.5
_NOWHERE = -1


@dataclass(frozen=True, eq=False)
class AreaPlace:
    """An area's keyframes among those of its surroundings.

    :ivar area: the area.
    :ivar keyframe_areas: shape (k,), int64, the area of every keyframe of the area and its surroundings.
    :ivar positions: shape (k, 2), where they were taken, m, area frame.
    :ivar grid: what these keyframes saw, area frame.
    """

    area: int
    keyframe_areas: NDArray[np.int64]
    positions: NDArray[np.float64]
    grid: AreaGrid


class Transition(NamedTuple):
    """P(gamma | d): ``known`` {area: pi} and ``new``; the sum is 1."""

    known: dict[int, float]
    new: float


def transition_model(shares: Mapping[int, float], new_floor: float) -> Transition:
    """The transition model from the probability of every place by itself.

    Those were computed one by one, and may add up to more than 1 where beliefs over areas side by side disagree. New
    ground keeps at least ``new_floor``, as belief and place are models: arcs can be worse than they say, and a cupboard
    in a known room is near its keyframes.
    """
    total = sum(shares.values())
    new = max(1.0 - total, new_floor)
    scale = (1.0 - new) / total if total > 0.0 else 0.0
    return Transition({area: scale * share for area, share in shares.items()}, new if total > 0.0 else 1.0)


def containing_area(place: AreaPlace, poses: NDArray[np.float64], radius: float) -> int | None:
    """The area in whose place most of the keyframes lie, or None where most lie in no place.

    :param poses: shape (m, 3), ``area_T_base`` of the keyframes in the place's frame.
    :param radius: farthest distance to a keyframe of the place, m.
    """
    owner = int(_containing_areas(place, poses[None, :, :2], radius)[0])
    return None if owner == _NOWHERE else owner


class EntryPrior(NamedTuple):
    """How the keyframes come to lie in an area's place, by the arcs.

    :ivar probability: pi(gamma), the probability that they do, exactly 0 where no draw says so.
    :ivar median_mahalanobis2: squared Mahalanobis distance from the belief's mean of half of the poses in which they
        do.
    """

    probability: float
    median_mahalanobis2: float


def entry_prior(place: AreaPlace, belief: PoseGaussian, poses: NDArray[np.float64], radius: float) -> EntryPrior:
    """The probability of a place, and what poses it is made of.

    :param belief: over ``area_T_reference``.
    :param poses: shape (m, 3), ``reference_T_base`` of the keyframes.
    :param radius: farthest distance to a keyframe of the place, m.
    """
    inside = _containing_areas(place, _sampled_positions(belief, poses), radius) == place.area
    distances = np.sum(_normal_points()[inside] ** 2, axis=1)
    return EntryPrior(float(np.mean(inside)), float(np.median(distances)) if inside.any() else 0.0)


def sampled_entry_bound(
    known: NDArray[np.float64], belief: PoseGaussian, poses: NDArray[np.float64], radius: float
) -> float:
    """No less than the share of :func:`entry_prior`, whatever is around the area, from its keyframes' positions (k, 2)
    alone.

    One of the keyframes in question at least has to be near to one of the area's.
    """
    return float(np.mean(_any_near(_sampled_positions(belief, poses), known, radius)))


def _sampled_positions(belief: PoseGaussian, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions of keyframes (m, 3) under draws from the belief over their reference, shape (draws, m, 2)."""
    return _transformed_positions(_normal_points(), belief.mean, np.linalg.cholesky(belief.covariance), poses)


@njit(cache=True)
def _transformed_positions(
    normal: NDArray[np.float64], mean: NDArray[np.float64], root: NDArray[np.float64], poses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Positions of the poses (m, 3) that are carried by ``mean exp(root normal)``, for each of n points (n, 3)."""
    positions = np.empty((normal.shape[0], poses.shape[0], 2))
    cos, sin = np.cos(mean[2]), np.sin(mean[2])
    for n in range(normal.shape[0]):
        a, b, c = normal[n]
        turn = root[2, 0] * a + root[2, 1] * b + root[2, 2] * c
        x, y = se2.exp_shift(root[0, 0] * a, root[1, 0] * a + root[1, 1] * b, turn)
        x, y = transform_point(mean[0], mean[1], cos, sin, x, y)
        turned_cos, turned_sin = np.cos(mean[2] + turn), np.sin(mean[2] + turn)
        for k in range(poses.shape[0]):
            placed_x, placed_y = transform_point(x, y, turned_cos, turned_sin, poses[k, 0], poses[k, 1])
            positions[n, k, 0], positions[n, k, 1] = placed_x, placed_y
    return positions


@njit(cache=True)
def _any_near(positions: NDArray[np.float64], known: NDArray[np.float64], radius: float) -> NDArray[np.bool_]:
    """Which of n draws of m positions (n, m, 2) have one within ``radius`` of one of (k, 2), shape (n,)."""
    near = np.zeros(positions.shape[0], np.bool_)
    for n in range(positions.shape[0]):
        for m in range(positions.shape[1]):
            for k in range(known.shape[0]):
                dx, dy = positions[n, m, 0] - known[k, 0], positions[n, m, 1] - known[k, 1]
                if dx * dx + dy * dy <= radius * radius:
                    near[n] = True
                    break
            if near[n]:
                break
    return near


@cache
def _normal_points() -> NDArray[np.float64]:
    """Points of a low-discrepancy sequence made normal, shape (draws, 3), the first one 0; the same at every call.

    They are the multiples of powers of the number g with g^4 = g + 1, which generalizes the golden ratio.
    """
    g = 1.2207440846057596
    steps = np.arange(_DRAWS)[:, None] / g ** np.arange(1, 4)
    return np.asarray(ndtri((0.5 + steps) % 1.0), dtype=np.float64)


def _containing_areas(place: AreaPlace, positions: NDArray[np.float64], radius: float) -> NDArray[np.int64]:
    """The area that most of the m positions (n, m, 2) belong to, shape (n,); of equals the smallest."""
    count, size = positions.shape[:2]
    nearest = _nearest_visible(
        positions.reshape(-1, 2),
        place.positions,
        radius,
        place.grid.log_ratio,
        place.grid.free,
        place.grid.origin,
        place.grid.cell,
    )
    owners = np.where(nearest < 0, _NOWHERE, place.keyframe_areas[nearest]).reshape(count, size)
    areas = np.unique(place.keyframe_areas)
    votes = np.sum(owners[:, :, None] == areas, axis=1)
    outside = 2 * votes.sum(axis=1) < size
    return np.where(outside, _NOWHERE, areas[votes.argmax(axis=1)])


@njit(cache=True)
def _nearest_visible(
    positions: NDArray[np.float64],
    keyframes: NDArray[np.float64],
    radius: float,
    log_ratio: NDArray[np.float32],
    free: NDArray[np.bool_],
    origin: NDArray[np.float64],
    cell: float,
) -> NDArray[np.int64]:
    """Index of the nearest keyframe within ``radius`` that can be seen from every position, or -1."""
    found = np.full(positions.shape[0], -1)
    distance2 = np.empty(keyframes.shape[0])
    for n in range(positions.shape[0]):
        for k in range(keyframes.shape[0]):
            distance2[k] = (keyframes[k, 0] - positions[n, 0]) ** 2 + (keyframes[k, 1] - positions[n, 1]) ** 2
        while found[n] < 0:
            nearest = distance2.argmin()
            if distance2[nearest] > radius * radius:
                break
            if _is_visible(positions[n], keyframes[nearest], log_ratio, free, origin, cell):
                found[n] = nearest
            distance2[nearest] = np.inf
    return found


@njit(cache=True)
def _is_visible(
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    log_ratio: NDArray[np.float32],
    free: NDArray[np.bool_],
    origin: NDArray[np.float64],
    cell: float,
) -> bool:
    """Whether no known surface lies between two points and most of the way is known to be free."""
    rows, columns = free.shape
    steps = int(np.ceil(np.hypot(end[0] - start[0], end[1] - start[1]) / (0.5 * cell))) + 1
    seen = 0
    for s in range(steps):
        share = s / steps
        c = int(np.floor((start[0] + share * (end[0] - start[0]) - origin[0]) / cell))
        r = int(np.floor((start[1] + share * (end[1] - start[1]) - origin[1]) / cell))
        if not (0 <= c < columns and 0 <= r < rows):
            continue
        if log_ratio[r, c] > _BARRIER:
            return False
        seen += free[r, c]
    return seen >= _SEEN * steps


Pose = NDArray[np.float64]

# An area has few others around it; this bounds the work where hundreds are joined by tight arcs.
_MOST_AROUND = 64
# Grids are kept up to this size, bytes: those of some ten places of a large building.
_CACHE_BYTES = 4 << 23


WHOLE_MAP_CACHE_BYTES = 4 * _CACHE_BYTES
"""The same where a whole map is looked through again and again, while it is not known where the robot is, bytes."""

# What the bounds on distances have in hand, m, and the smallest that is not 0.
_ROUNDING, _SMALLEST = 1e-6, 1e-300


@dataclass(frozen=True)
class Neighborhood:
    """What counts as around an area.

    :ivar max_sigma: largest deviation of an area's position, m.
    :ivar max_distance: largest distance between the nearest keyframes of the two, m.
    """

    max_sigma: float
    max_distance: float


def areas_around(
    hybrid_map: HybridMap, area: int, neighborhood: Neighborhood, excluded: Collection[int] = ()
) -> dict[int, PoseGaussian]:
    """{other area: belief over ``area_T_other``}, the area itself first, then by growing uncertainty."""
    beliefs = shortest_path_beliefs(hybrid_map, area, neighborhood.max_sigma**2, _MOST_AROUND)
    here = keyframe_positions(hybrid_map, area, np.zeros(3))
    found = {}
    for other, belief in beliefs.items():
        near = (
            other == area
            or min_distance(here, keyframe_positions(hybrid_map, other, belief.mean)) <= neighborhood.max_distance
        )
        if near and other not in excluded:
            found[other] = belief
    return found


def stack_poses(poses: Mapping[int, Pose]) -> NDArray[np.float64]:
    """The poses as an array, shape (n, 3)."""
    return np.array(list(poses.values())).reshape(-1, 3)


def has_same_poses(one: Mapping[int, Pose], other: Mapping[int, Pose]) -> bool:
    """Whether the same keyframes are in the same places."""
    return one.keys() == other.keys() and all(np.array_equal(pose, other[k]) for k, pose in one.items())


def keyframe_positions(hybrid_map: HybridMap, area: int, pose: Pose) -> NDArray[np.float64]:
    """Positions of an area's keyframes, shape (n, 2), where the area's frame stands at ``pose``."""
    return se2.transform(pose, stack_poses(hybrid_map.keyframes(area))[:, :2])


def min_distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Distance between the nearest points of two sets (n, 2), (m, 2), m; inf where one is empty."""
    between = a[:, None] - b[None]
    return float(np.hypot(between[..., 0], between[..., 1]).min(initial=np.inf))


def quick_entry_bounds(
    found: ShortestPaths, query: PoseGaussian, lever: float, reach: Float64, scale: float, deviations: float
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
    return _quick_entry_bounds(
        found.means, found.covariances, query.mean, query.covariance, reach, lever, scale, deviations
    )


@njit(cache=True)
def _quick_entry_bounds(
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
        prior = (
            scale * scale * (propagate_covariance(inverse_pose_covariance(covariances[n], means[n]), mean) + covariance)
        )
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


def consistent_pose(
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


class GridCache:
    """Grids and places, built from the keyframes' scans and kept while they are in use."""

    def __init__(
        self, scans: Mapping[int, Scan], model: GridModel, neighborhood: Neighborhood, max_bytes: int = _CACHE_BYTES
    ) -> None:
        """:param scans: {keyframe: scan}, which may grow.

        :param max_bytes: size of the grids that are kept, bytes.
        """
        self._scans = scans
        self._max_bytes = max_bytes
        self._model = model
        self._neighborhood = neighborhood
        self._grids: OrderedDict[bytes, AreaGrid] = OrderedDict()

    def clear(self) -> None:
        """Keep no grid, as scans have changed."""
        self._grids.clear()

    def grid(self, keyframes: Mapping[int, Pose]) -> AreaGrid:
        """What the keyframes saw, placed at the given poses."""
        poses = stack_poses(keyframes)
        key = np.array(list(keyframes), dtype=np.int64).tobytes() + poses.tobytes()
        if key not in self._grids:
            self._grids[key] = build_area_grid([self._scans[k] for k in keyframes], poses, self._model)
            self._evict_oldest()
        self._grids.move_to_end(key)
        return self._grids[key]

    def static_points(self, keyframes: Mapping[int, Pose]) -> Float64:
        """Surface points of the keyframes, shape (n, 2), m, that none of them sees through: nobody who walked by."""
        points = self.grid(keyframes).points
        passed = np.zeros(len(points), dtype=np.bool_)
        for keyframe, pose in keyframes.items():
            passed |= (
                classify_points(to_polar_scan(self._scans[keyframe]), se2.transform(se2.inverse(pose), points)) == FREE
            )
        return points[~passed]

    def _evict_oldest(self) -> None:
        """Forget the grids that were not used for longest, but not the newest."""
        size = sum(grid.nbytes for grid in self._grids.values())
        while size > self._max_bytes and len(self._grids) > 1:
            size -= self._grids.popitem(last=False)[1].nbytes

    def forget(self) -> None:
        """Forget all grids."""
        self._grids.clear()

    def grid_before(self, hybrid_map: HybridMap, poses: Mapping[int, Pose], keyframe: int) -> AreaGrid:
        """What keyframes before a given one saw, of the areas that stand at ``poses``, {area: pose}."""
        old: dict[int, Pose] = {}
        for area, pose in poses.items():
            placed = {k: at for k, at in hybrid_map.keyframes(area).items() if k < keyframe}
            old |= zip(placed, se2.compose(pose, stack_poses(placed)), strict=True)
        return self.grid(old)

    def place(
        self,
        hybrid_map: HybridMap,
        area: int,
        excluded: Collection[int],
        before: float = math.inf,
        max_sigma: float | None = None,
    ) -> AreaPlace:
        """An area with those around it, so that an overlap is not cut off at the area's edge.

        :param excluded: areas that are left out.
        :param before: keyframes from this one on are left out as well.
        :param max_sigma: largest deviation of another area's position, m, if not that which counts as around elsewhere.
        """
        nearness = self._neighborhood if max_sigma is None else replace(self._neighborhood, max_sigma=max_sigma)
        around = areas_around(hybrid_map, area, nearness, excluded)
        return self.place_among(hybrid_map, area, {other: belief.mean for other, belief in around.items()}, before)

    def place_among(
        self, hybrid_map: HybridMap, area: int, poses: Mapping[int, Pose], before: float = math.inf
    ) -> AreaPlace:
        """The place of ``area`` among the areas that stand at ``poses``, {other area: ``area_T_other``}."""
        keyframes: dict[int, Pose] = {}
        owners: list[int] = []
        for other, pose in poses.items():
            placed = {k: at for k, at in hybrid_map.keyframes(other).items() if k < before}
            keyframes |= zip(placed, se2.compose(pose, stack_poses(placed)), strict=True)
            owners += [other] * len(placed)
        return AreaPlace(area, np.array(owners, dtype=np.int64), stack_poses(keyframes)[:, :2], self.grid(keyframes))
