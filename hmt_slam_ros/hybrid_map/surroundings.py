"""Which areas lie around an area, where they lie, and what their keyframes saw there.

A keyframe lies in the *place* of the area whose keyframe is nearest to it, among those near enough and in sight.
A parallel corridor behind a wall is therefore another place.
"""

from __future__ import annotations

import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from hmt_slam_ros.arrays import Bool, Float32, Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.registration.likelihood_grid import AreaGrid, GridModel, build_area_grid, build_coarse_grid
from hmt_slam_ros.registration.packed_grid import pack_log_ratio_grid
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.sensors import Scan

Pose = Float64
Grid = TypeVar("Grid")
Unpacked_co = TypeVar("Unpacked_co", covariant=True)

_ORIGIN = np.zeros(3)
"""Pose of a frame in itself."""

NO_AREA = -1
"""Stands for no area in arrays of areas."""

_OCCLUDING_LOG_RATIO = 0.5
"""Log-ratio above which a cell blocks the view, nats."""

_MIN_FREE_FRACTION = 0.5
"""Smallest share of a line of sight that is known as free."""

_MAX_NEIGHBORS = 64
"""Most areas around an area; bounds the work where tight arcs join hundreds."""

_CACHE_BYTES = 4 << 25
"""Size of the grids that are cached, as if none were packed, bytes: those of about thirty places, with which a
comparison is made at most.
"""

_COARSE_CACHE_BYTES = 3 << 25
"""Size of the coarse grids that global localization needs again and again, bytes: those of about forty regions."""

_UNPACKED_BYTES = 1 << 23
"""Size of the cached grids that are not packed, bytes; on Intel Lab no other is used again."""

_COARSE_SPEED = 3
"""Cells of a coarse grid that are made in the time of one of a grid."""


@dataclass(frozen=True, eq=False)
class AreaPlace:
    """An area's keyframes among those of its surroundings.

    :ivar area: the area.
    :ivar keyframe_areas: shape (k,), int64, the area of every keyframe of the area and its surroundings.
    :ivar positions: shape (k, 2), positions of these keyframes, m, area frame.
    :ivar grid: what these keyframes saw, area frame.
    """

    area: int
    keyframe_areas: Int64
    positions: Float64
    grid: AreaGrid


def containing_area(place: AreaPlace, poses: Float64, radius: float) -> int | None:
    """The area in whose place most of the keyframes lie, or None where most lie in no place.

    :param poses: shape (m, 3), ``area_T_base`` of the keyframes in the place's frame.
    :param radius: largest distance to a keyframe of the place, m.
    """
    area = int(containing_areas(place, poses[None, :, :2], radius)[0])
    return None if area == NO_AREA else area


def containing_areas(place: AreaPlace, positions: Float64, radius: float) -> Int64:
    """The area in whose place most of m positions (n, m, 2) lie, or ``NO_AREA``; shape (n,). Of equals the smallest.

    :param radius: largest distance to a keyframe of the place, m.
    """
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
    owners = np.where(nearest < 0, NO_AREA, place.keyframe_areas[nearest]).reshape(count, size)
    areas = np.unique(place.keyframe_areas)
    votes = np.sum(owners[:, :, None] == areas, axis=1)
    is_outside = 2 * votes.sum(axis=1) < size
    return np.where(is_outside, NO_AREA, areas[votes.argmax(axis=1)])


@njit(cache=True)
def _nearest_visible(
    positions: Float64, keyframes: Float64, radius: float, log_ratio: Float32, free: Bool, origin: Float64, cell: float
) -> Int64:
    """Index of the nearest keyframe within ``radius`` that is visible from every position, or -1."""
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
def _is_visible(start: Float64, end: Float64, log_ratio: Float32, free: Bool, origin: Float64, cell: float) -> bool:
    """Whether no known surface lies between two points, and most of the line is known as free."""
    rows, columns = free.shape
    steps = int(np.ceil(np.hypot(end[0] - start[0], end[1] - start[1]) / (0.5 * cell))) + 1
    free_steps = 0
    for s in range(steps):
        share = s / steps
        c = int(np.floor((start[0] + share * (end[0] - start[0]) - origin[0]) / cell))
        r = int(np.floor((start[1] + share * (end[1] - start[1]) - origin[1]) / cell))
        if not (0 <= c < columns and 0 <= r < rows):
            continue
        if log_ratio[r, c] > _OCCLUDING_LOG_RATIO:
            return False
        free_steps += free[r, c]
    return free_steps >= _MIN_FREE_FRACTION * steps


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
    beliefs = shortest_path_beliefs(hybrid_map, area, neighborhood.max_sigma**2, _MAX_NEIGHBORS)
    own = keyframe_positions(hybrid_map, area)
    found = {}
    for other, belief in beliefs.items():
        is_near = (
            other == area
            or min_distance(own, keyframe_positions(hybrid_map, other, belief.mean)) <= neighborhood.max_distance
        )
        if is_near and other not in excluded:
            found[other] = belief
    return found


def stack_poses(poses: Mapping[int, Pose]) -> Float64:
    """The poses as an array, shape (n, 3)."""
    return np.array(list(poses.values())).reshape(-1, 3)


def has_same_poses(first: Mapping[int, Pose], second: Mapping[int, Pose]) -> bool:
    """Whether both hold the same keyframes at the same poses."""
    return first.keys() == second.keys() and all(np.array_equal(pose, second[k]) for k, pose in first.items())


def keyframe_positions(hybrid_map: HybridMap, area: int, pose: Pose = _ORIGIN) -> Float64:
    """Positions of an area's keyframes, shape (n, 2), m, where the area's frame is at ``pose``; by default in it."""
    return se2.transform(pose, stack_poses(hybrid_map.keyframes(area))[:, :2])


def min_distance(a: Float64, b: Float64) -> float:
    """Distance between the nearest points of two sets (n, 2), (m, 2), m; inf where one is empty."""
    return float(_min_distance(np.ascontiguousarray(a), np.ascontiguousarray(b)))


@njit(cache=True)
def _min_distance(a: Float64, b: Float64) -> float:
    """:func:`min_distance`, without arrays of all pairs."""
    smallest = np.inf
    for i in range(len(a)):
        for j in range(len(b)):
            smallest = min(smallest, np.hypot(a[i, 0] - b[j, 0], a[i, 1] - b[j, 1]))
    return smallest


def consistent_pose(
    belief: PoseGaussian, area: int, other: int, global_poses: Mapping[int, PoseGaussian], gate: float
) -> Pose:
    """``area_T_other`` of the global map where it agrees with the belief, else the belief's mean.

    They disagree where a hypothesis has an arc that the global map lacks.

    :param gate: largest squared Mahalanobis distance that counts as agreement.
    """
    one, two = global_poses.get(area), global_poses.get(other)
    if one is None or two is None:
        return belief.mean
    pose = se2.between(one.mean, two.mean)
    difference = se2.log(se2.between(belief.mean, pose))
    agrees = float(difference @ np.linalg.solve(belief.covariance, difference)) <= gate
    return pose if agrees else belief.mean


class KnownGrid(NamedTuple):
    """A grid that a cache holds.

    :ivar key: digest of its keyframes and their poses.
    :ivar size: of the grid, bytes.
    """

    key: int
    size: int


@dataclass(frozen=True)
class GridCacheState:
    """Which grids a cache holds, the least recently used first. Those of a restored cache are made when needed.

    :ivar grids: those of area grids.
    :ivar coarse_grids: those of coarse grids.
    """

    grids: tuple[KnownGrid, ...] = ()
    coarse_grids: tuple[KnownGrid, ...] = ()


class _Packed(Protocol[Unpacked_co]):
    """A packed grid."""

    def unpack(self) -> Unpacked_co: ...


class _RecentGrids(Generic[Grid]):
    """Grids of keyframes at poses, of which the least recently used are packed, and at last evicted.

    :ivar known: {key: size unpacked, bytes} of those that are held, or were when the cache was saved.
    """

    def __init__(
        self, pack: Callable[[Grid], _Packed[Grid]], max_bytes: int, unpacked_bytes: int = _UNPACKED_BYTES
    ) -> None:
        """:param max_bytes: size of all, as if unpacked, bytes; the newest one is kept in any case.

        :param unpacked_bytes: size of those that are not packed, likewise.
        """
        self._pack = pack
        self._max_bytes, self._unpacked_bytes = max_bytes, unpacked_bytes
        self.known: OrderedDict[int, int] = OrderedDict()
        self._grids: OrderedDict[int, Grid] = OrderedDict()
        self._packed: dict[int, _Packed[Grid]] = {}

    def clear(self) -> None:
        self.known.clear()
        self._grids.clear()
        self._packed.clear()

    def get(
        self,
        keyframes: Mapping[int, Pose],
        build: Callable[[Mapping[int, Pose]], tuple[Grid, int]],
        rebuild: Callable[[Mapping[int, Pose]], tuple[Grid, int]],
    ) -> Grid:
        """The grid of the keyframes; ``build`` makes it, and says its size, bytes.

        :param rebuild: makes a grid again that was held when the cache was saved.
        """
        key = _key(keyframes)
        if key in self._grids:
            grid = self._grids.pop(key)
        elif key in self._packed:
            grid = self._packed[key].unpack()
        elif key in self.known:
            grid, _ = rebuild(keyframes)
        else:
            grid, self.known[key] = build(keyframes)
            self._evict()
        self._grids[key] = grid
        self.known.move_to_end(key)
        self._pack_oldest()
        return grid

    def _evict(self) -> None:
        size = sum(self.known.values())
        while size > self._max_bytes and len(self.known) > 1:
            evicted, own = self.known.popitem(last=False)
            self._grids.pop(evicted, None)
            self._packed.pop(evicted, None)
            size -= own

    def _pack_oldest(self) -> None:
        """Pack the least recently used grids; one that was packed before stays so while it is unpacked, too."""
        size = sum(self.known[key] for key in self._grids)
        while size > self._unpacked_bytes and len(self._grids) > 1:
            key, grid = self._grids.popitem(last=False)
            size -= self.known[key]
            if key not in self._packed:
                self._packed[key] = self._pack(grid)


def _key(keyframes: Mapping[int, Pose]) -> int:
    """A digest of keyframes and their poses, of 48 bits."""
    content = np.array(list(keyframes), dtype=np.int64).tobytes() + stack_poses(keyframes).tobytes()
    return int.from_bytes(hashlib.blake2b(content, digest_size=6).digest())


def _ignore(_: int) -> None:
    """Count nothing."""


class GridCache:
    """Grids and places, built from the keyframes' scans. The least recently used grids are packed, then evicted."""

    def __init__(
        self,
        scans: Mapping[int, Scan],
        model: GridModel,
        neighborhood: Neighborhood,
        max_bytes: int = _CACHE_BYTES,
        count_cells: Callable[[int], None] = _ignore,
    ) -> None:
        """:param scans: {keyframe: scan}, which may grow.

        :param max_bytes: size of the cached grids, bytes.
        :param count_cells: is called with the number of cells of every grid that is built because it was not held. It
            is not for those that were held when the cache was saved: a restored run counts what the other one counts.
        """
        self._scans = scans
        self._model = model
        self._neighborhood = neighborhood
        self._count_cells = count_cells
        self._grids = _RecentGrids[AreaGrid](AreaGrid.pack, max_bytes)
        self._coarse_grids = _RecentGrids[LogRatioGrid](pack_log_ratio_grid, _COARSE_CACHE_BYTES)

    @property
    def state(self) -> GridCacheState:
        """Which grids are held."""
        return GridCacheState(
            tuple(KnownGrid(*item) for item in self._grids.known.items()),
            tuple(KnownGrid(*item) for item in self._coarse_grids.known.items()),
        )

    def restore(self, state: GridCacheState) -> None:
        """Hold the grids of a saved state."""
        self._grids.known.update(state.grids)
        self._coarse_grids.known.update(state.coarse_grids)

    def clear(self) -> None:
        """Drop all grids."""
        self._grids.clear()
        self._coarse_grids.clear()

    def grid(self, keyframes: Mapping[int, Pose]) -> AreaGrid:
        """What the keyframes saw, placed at the given poses."""
        return self._grids.get(keyframes, self._build, self._rebuild)

    def holds_grid(self, keyframes: Mapping[int, Pose]) -> bool:
        """Whether :meth:`grid` is held."""
        return _key(keyframes) in self._grids.known

    def _build(self, keyframes: Mapping[int, Pose]) -> tuple[AreaGrid, int]:
        grid, size = self._rebuild(keyframes)
        self._count_cells(grid.log_ratio.size)
        return grid, size

    def _rebuild(self, keyframes: Mapping[int, Pose]) -> tuple[AreaGrid, int]:
        grid = build_area_grid([self._scans[k] for k in keyframes], stack_poses(keyframes), self._model)
        return grid, grid.nbytes

    def coarse_grid(self, keyframes: Mapping[int, Pose]) -> LogRatioGrid:
        """The log-ratios of what the keyframes saw, which take a sixth of the memory of :meth:`grid` and outlast it."""
        return self._coarse_grids.get(keyframes, self._build_coarse, self._rebuild_coarse)

    def _build_coarse(self, keyframes: Mapping[int, Pose]) -> tuple[LogRatioGrid, int]:
        grid, size = self._rebuild_coarse(keyframes)
        self._count_cells(grid.log_ratio.size // _COARSE_SPEED)
        return grid, size

    def _rebuild_coarse(self, keyframes: Mapping[int, Pose]) -> tuple[LogRatioGrid, int]:
        grid = build_coarse_grid([self._scans[k] for k in keyframes], stack_poses(keyframes), self._model)
        return grid, grid.log_ratio.nbytes

    def grid_before(self, hybrid_map: HybridMap, poses: Mapping[int, Pose], keyframe: int) -> AreaGrid:
        """What the keyframes before a given one saw, of areas at ``poses``, {area: pose}."""
        return self.grid(keyframes_before(hybrid_map, poses, keyframe)[0])

    def place(
        self,
        hybrid_map: HybridMap,
        area: int,
        excluded: Collection[int],
        before: float = math.inf,
        max_sigma: float | None = None,
    ) -> AreaPlace:
        """An area's place with the areas around it, so that no overlap ends at the area's edge.

        :param excluded: areas that are left out.
        :param before: keyframes from this one on are left out as well.
        :param max_sigma: largest deviation of another area's position, m; that of the neighborhood if None.
        """
        neighborhood = self._neighborhood if max_sigma is None else replace(self._neighborhood, max_sigma=max_sigma)
        around = areas_around(hybrid_map, area, neighborhood, excluded)
        return self.place_among(hybrid_map, area, {other: belief.mean for other, belief in around.items()}, before)

    def place_among(
        self, hybrid_map: HybridMap, area: int, poses: Mapping[int, Pose], before: float = math.inf
    ) -> AreaPlace:
        """The place of ``area`` among areas at ``poses``, {other area: ``area_T_other``}."""
        keyframes, areas = keyframes_before(hybrid_map, poses, before)
        return AreaPlace(area, np.array(areas, dtype=np.int64), stack_poses(keyframes)[:, :2], self.grid(keyframes))


def keyframes_before(
    hybrid_map: HybridMap, poses: Mapping[int, Pose], before: float
) -> tuple[dict[int, Pose], list[int]]:
    """Keyframes before a given one in the common frame of their areas, {keyframe: pose}, and the area of each.

    :param poses: {area: pose of its frame}, m and rad.
    """
    keyframes: dict[int, Pose] = {}
    areas: list[int] = []
    for area, pose in poses.items():
        own = {k: in_area for k, in_area in hybrid_map.keyframes(area).items() if k < before}
        keyframes |= zip(own, se2.compose(pose, stack_poses(own)), strict=True)
        areas += [area] * len(own)
    return keyframes, areas
