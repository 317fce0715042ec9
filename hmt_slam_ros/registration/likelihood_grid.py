"""Likelihood grid of an area: log-likelihood ratios of surface, free and unknown space around its keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float32, Float64, Int32, Int64, UInt8
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.se2 import transform_point
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.registration.packed_grid import PackedRatios, pack_ratios, unpack_flags
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.sensors import Scan

_MAX_GAP = 0.3
"""Distance of neighboring end points of a scan up to which the surface between them is filled, m."""

_ON_SURFACE, _IN_FREE_SPACE = 0.3, -0.5
"""Log-ratios from which a sample is on a known surface, and in free space: 0.25 m or more from a surface."""

_REACH = 5.0
"""Distance from a surface up to which a grid knows it, in deviations of an end point."""

_MARGIN = 3
"""Distance in which cells on every side of a sample have to be free, so that it is in free space, half cells."""


@dataclass(frozen=True)
class GridModel:
    """The model of the likelihood of a surface at a place, relative to unknown space.

    A building has walls beside walls, so a constant p(z | unknown) is no background. ``surface_ratio`` is therefore far
    below that of the sensor's precision: it compares a surface of the map with one that the building might have.

    :ivar cell: edge of a cell, m.
    :ivar sigma: deviation of an end point from the surface, m.
    :ivar surface_ratio: p(z | surface at distance 0) / p(z | unknown), above 1.
    :ivar free_ratio: p(z | known free) / p(z | unknown), below 1.
    :ivar max_range: largest range of end points, m.
    :ivar spacing: edge of the voxels, which have one sample each, m.
    """

    cell: float = 0.1
    sigma: float = 0.1
    surface_ratio: float = 3.0
    free_ratio: float = 0.1
    max_range: float = 30.0
    spacing: float = 0.2

    @classmethod
    def from_configuration(cls, configuration: Configuration) -> GridModel:
        """As configured."""
        options = configuration.tsbi
        return cls(
            options.search_cell,
            options.surface_sigma,
            options.surface_ratio,
            options.free_ratio,
            configuration.local_map.max_range,
            options.sample_spacing,
        )


@dataclass(frozen=True, eq=False)
class AreaGrid:
    """Log-likelihood ratios around an area, and its surface points.

    :ivar origin: shape (2,), the corner of cell (0, 0), m, area frame.
    :ivar cell: edge of a cell, m.
    :ivar log_ratio: shape (rows, columns), float32, indexed [y, x]: log p(z | map) / p(z | unknown) of a surface
        measured in the cell; above 0 near a surface, below 0 in free space, 0 where nothing is known.
    :ivar fine_log_ratio: shape (2 rows, 2 columns), float32, the same at the centers of cells half as long; smooth
        enough for interpolation, and ``log_ratio`` is the mean of four.
    :ivar free: shape (rows, columns), whether a beam passed through the cell.
    :ivar points: shape (n, 2), one point per voxel of the surfaces that stayed, m, area frame: nearly independent
        samples. Beside a robot that people follow, most end points are on people.
    """

    origin: Float64
    cell: float
    log_ratio: Float32
    fine_log_ratio: Float32
    free: Bool
    points: Float64

    @property
    def nbytes(self) -> int:
        """Memory of the grid, bytes."""
        return self.log_ratio.nbytes + self.fine_log_ratio.nbytes + self.free.nbytes + self.points.nbytes

    def shift_origin(self, shift: Float64) -> AreaGrid:
        """The same grid in a parallel frame with its origin at ``shift``, shape (2,), of this frame."""
        return replace(self, origin=self.origin - shift, points=self.points - shift)

    def compare(self, points: Float64, pose: Float64) -> Agreement:
        """Agreement of surface samples of another map with this one.

        :param points: shape (n, 2), m.
        :param pose: ``grid_T_points``, shape (3,).
        """
        on, free = _count_agreement(se2.transform(pose, points), self.fine_log_ratio, self.origin, 0.5 * self.cell)
        return Agreement(len(points), on, free)

    def pack(self) -> PackedAreaGrid:
        """The grid, packed."""
        fine = pack_ratios(self.fine_log_ratio)
        return PackedAreaGrid(self.origin, self.cell, fine, np.packbits(self.free), self.points)


class PackedAreaGrid(NamedTuple):
    """A packed :class:`AreaGrid`.

    :ivar free: shape (ceil(rows * columns / 8),), bits.
    """

    origin: Float64
    cell: float
    fine_log_ratio: PackedRatios
    free: UInt8
    points: Float64

    def unpack(self) -> AreaGrid:
        """The grid."""
        fine = self.fine_log_ratio.unpack()
        free = unpack_flags(self.free, (fine.shape[0] // 2, fine.shape[1] // 2))
        return AreaGrid(self.origin, self.cell, _downsample(fine), fine, free, self.points)


def build_area_grid(scans: Sequence[Scan], poses: Float64, model: GridModel) -> AreaGrid:
    """The grid of keyframes.

    :param scans: the keyframes' scans.
    :param poses: shape (len(scans), 3), ``area_T_base``.
    """
    hits, lasers, numbers = _end_points(scans, poses, model.max_range)
    if not len(hits):
        return _empty_grid(model.cell)
    origin, (rows, columns) = _extent(hits, lasers, model)
    counts = _count_scans((rows, columns), origin, model.cell, lasers, hits, numbers)
    fine = _log_ratios((2 * rows, 2 * columns), origin, hits, numbers, counts.free, model)
    static = hits[_mark_static(hits, counts, origin, model.cell)]
    return AreaGrid(origin, model.cell, _downsample(fine), fine, counts.free, thin_points(static, model.spacing))


def build_coarse_grid(scans: Sequence[Scan], poses: Float64, model: GridModel) -> LogRatioGrid:
    """The log-ratios of keyframes at the centers of the cells, which take a third of the time of the whole grid.

    The arguments are those of :func:`build_area_grid`.
    """
    hits, lasers, numbers = _end_points(scans, poses, model.max_range)
    if not len(hits):
        empty = _empty_grid(model.cell)
        return LogRatioGrid(empty.log_ratio, empty.origin, empty.cell)
    origin, shape = _extent(hits, lasers, model)
    free = _mark_free(shape, origin, model.cell, lasers, hits)
    return LogRatioGrid(_log_ratios(shape, origin, hits, numbers, free, model), origin, model.cell)


def _extent(hits: Float64, lasers: Float64, model: GridModel) -> tuple[Float64, tuple[int, int]]:
    """The corner (2,) of a grid around end points and lasers, each (n, 2), m, and its numbers of rows and columns."""
    reach = _REACH * model.sigma
    smallest, largest = _limits(np.concatenate((hits, lasers)))
    # The corner is a multiple of the cell, so that cells of all grids of an area coincide.
    origin = np.floor((smallest - reach) / model.cell) * model.cell
    columns, rows = (np.ceil((largest + reach - origin) / model.cell).astype(np.int64) + 1).tolist()
    return origin, (rows, columns)


def _log_ratios(
    shape: tuple[int, int], origin: Float64, hits: Float64, numbers: Int64, free: Bool, model: GridModel
) -> Float32:
    """The log-ratios at the centers of cells, of which ``free`` has as many or half as many along an edge.

    :param hits: end points, shape (n, 2), m; ``numbers`` (n,), of their scans.
    """
    log_ratios = np.full(shape, np.inf, dtype=np.float32)
    cell = model.cell * (free.shape[0] / shape[0])
    _lower_distances(log_ratios, origin, cell, hits, numbers, _REACH * model.sigma)
    _convert_to_log_ratio(log_ratios, free, model.sigma, model.surface_ratio, model.free_ratio)
    return log_ratios


def surface_points(scan: Scan, model: GridModel) -> Float64:
    """The surface points of a scan, one per voxel, m, base frame, shape (n, 2)."""
    return thin_points(_end_points([scan], np.zeros((1, 3)), model.max_range)[0], model.spacing)


def _empty_grid(cell: float) -> AreaGrid:
    nothing = np.zeros((2, 2), dtype=np.float32)
    return AreaGrid(np.zeros(2), cell, nothing[:1, :1], nothing, np.zeros((1, 1), np.bool_), np.zeros((0, 2)))


def _end_points(scans: Sequence[Scan], poses: Float64, max_range: float) -> tuple[Float64, Float64, Int64]:
    """End points and the position of the laser at each, area frame, (n, 2), and the number of its scan, (n,)."""
    points, origins = (
        np.concatenate([np.zeros((0, 2)), *parts])
        for parts in ([scan.points for scan in scans], [scan.origins for scan in scans])
    )
    counts = np.array([len(scan.points) for scan in scans], dtype=np.int64)
    return _place_points(points, origins, counts, poses, max_range)


@njit(cache=True)
def _place_points(
    points: Float64, origins: Float64, counts: Int64, poses: Float64, max_range: float
) -> tuple[Float64, Float64, Int64]:
    """The points within a range of their origins, both (n, 2), with the scans' poses, in the order of the scans."""
    placed, lasers, numbers = np.empty_like(points), np.empty_like(points), np.empty(len(points), np.int64)
    begin, held = 0, 0
    for scan in range(len(counts)):
        cos, sin = np.cos(poses[scan, 2]), np.sin(poses[scan, 2])
        for k in range(begin, begin + counts[scan]):
            if np.hypot(points[k, 0] - origins[k, 0], points[k, 1] - origins[k, 1]) > max_range:
                continue
            for source, target in ((points, placed), (origins, lasers)):
                target[held] = transform_point(poses[scan, 0], poses[scan, 1], cos, sin, source[k, 0], source[k, 1])
            numbers[held] = scan
            held += 1
        begin += counts[scan]
    return placed[:held], lasers[:held], numbers[:held]


def thin_points(points: Float64, spacing: float) -> Float64:
    """The mean point of every occupied voxel, shape (n, 2), ordered by voxel."""
    return _mean_points(points, spacing) if len(points) else points


@njit(cache=True)
def _mean_points(points: Float64, spacing: float) -> Float64:
    """:func:`thin_points` of one point at least."""
    smallest, largest = _limits(points)
    first, last = np.floor(smallest / spacing), np.floor(largest / spacing)
    columns, rows = int(last[0] - first[0]) + 1, int(last[1] - first[1]) + 1
    sums, counts = np.zeros((columns, rows, 2)), np.zeros((columns, rows), np.int64)
    occupied = 0
    for n in range(points.shape[0]):
        column = int(np.floor(points[n, 0] / spacing) - first[0])
        row = int(np.floor(points[n, 1] / spacing) - first[1])
        occupied += counts[column, row] == 0
        counts[column, row] += 1
        sums[column, row] += points[n]
    means, held = np.empty((occupied, 2)), 0
    for column in range(columns):
        for row in range(rows):
            if counts[column, row] > 0:
                means[held] = sums[column, row] / counts[column, row]
                held += 1
    return means


@njit(cache=True)
def _limits(points: Float64) -> tuple[Float64, Float64]:
    """The smallest and the largest coordinates of points, shape (2,) each, in a tenth of numpy's time."""
    smallest, largest = points[0].copy(), points[0].copy()
    for n in range(points.shape[0]):
        for axis in range(2):
            smallest[axis] = min(smallest[axis], points[n, axis])
            largest[axis] = max(largest[axis], points[n, axis])
    return smallest, largest


@njit(cache=True)
def _convert_to_log_ratio(fine: Float32, free: Bool, sigma: float, surface_ratio: float, free_ratio: float) -> None:
    """Convert squared distances to a blend of surface and free space; cells are those of ``free``, or quarters of them.

    Free space counts in full from two or three sigma on: beams that graze a wall see free space right up to it, and
    unequal flanks would pull a match away from the wall.
    """
    log_free, far, shift = np.log(free_ratio), np.float32(14.0 * sigma**2), fine.shape[0] // free.shape[0] - 1
    for r in range(fine.shape[0]):
        for c in range(fine.shape[1]):
            is_free = free[r >> shift, c >> shift]
            if fine[r, c] > far and not is_free:
                fine[r, c] = 0.0
                continue
            if fine[r, c] == np.inf:
                fine[r, c] = log_free
                continue
            near = np.exp(-0.5 * fine[r, c] / sigma**2)
            away = 1.0 + (free_ratio - 1.0) * (1.0 - np.sqrt(np.sqrt(near))) if is_free else 1.0
            fine[r, c] = np.log(away + (surface_ratio - away) * (near if near >= 1e-3 else 0.0))


@njit(cache=True)
def _downsample(fine: Float32) -> Float32:
    """The means of squares of four cells, in a tenth of numpy's time."""
    coarse = np.empty((fine.shape[0] // 2, fine.shape[1] // 2), np.float32)
    for r in range(coarse.shape[0]):
        for c in range(coarse.shape[1]):
            above = fine[2 * r, 2 * c] + fine[2 * r, 2 * c + 1]
            coarse[r, c] = (above + (fine[2 * r + 1, 2 * c] + fine[2 * r + 1, 2 * c + 1])) / np.float32(4.0)
    return coarse


class _ScanCounts(NamedTuple):
    """What the scans show of each cell; shapes (rows, columns).

    :ivar free: whether a beam passed, up to one cell before its end point.
    :ivar passed: how many scans passed, but did not end there.
    :ivar ended: how many scans ended there.
    """

    free: Bool
    passed: Int32
    ended: Int32


@njit(cache=True)
def _count_scans(
    shape: tuple[int, int], origin: Float64, cell: float, lasers: Float64, points: Float64, scans: Int64
) -> _ScanCounts:
    """The counts of beams from ``lasers`` to ``points``, each (n, 2), of the scans with the ascending numbers (n,)."""
    free, passed, ended = np.zeros(shape, np.bool_), np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    last = np.full(shape, -1, np.int32)
    begin = 0
    while begin < points.shape[0]:
        end, scan = begin, np.int32(scans[begin])
        while end < points.shape[0] and scans[end] == scan:
            row, column = int((points[end, 1] - origin[1]) / cell), int((points[end, 0] - origin[0]) / cell)
            ended[row, column] += last[row, column] != scan
            last[row, column] = scan
            end += 1
        for k in range(begin, end):
            x0, y0, dx, dy, steps = _beam_in_cells(lasers[k], points[k], origin, cell)
            for s in range(steps - 1):
                row, column = int(y0 + dy * s / steps), int(x0 + dx * s / steps)
                free[row, column] = True
                passed[row, column] += last[row, column] != scan
                last[row, column] = scan
        begin = end
    return _ScanCounts(free, passed, ended)


@njit(cache=True)
def _beam_in_cells(
    laser: Float64, point: Float64, origin: Float64, cell: float
) -> tuple[float, float, float, float, int]:
    """Where a beam begins, (x, y), and its length along x and y, all in cells, and its number of steps."""
    x, y = (laser[0] - origin[0]) / cell, (laser[1] - origin[1]) / cell
    dx, dy = (point[0] - origin[0]) / cell - x, (point[1] - origin[1]) / cell - y
    return x, y, dx, dy, int(np.ceil(max(abs(dx), abs(dy))))


@njit(cache=True)
def _mark_free(shape: tuple[int, int], origin: Float64, cell: float, lasers: Float64, points: Float64) -> Bool:
    """Whether a beam from ``lasers`` to ``points``, each (n, 2), passed, up to one cell before its end point."""
    free = np.zeros(shape, np.bool_)
    for k in range(points.shape[0]):
        x, y, dx, dy, steps = _beam_in_cells(lasers[k], points[k], origin, cell)
        along_x, along_y = dx / max(1, steps), dy / max(1, steps)
        for s in range(steps - 1):
            free[int(y + along_y * s), int(x + along_x * s)] = True
    return free


@njit(cache=True)
def _mark_static(points: Float64, counts: _ScanCounts, origin: Float64, cell: float) -> Bool:
    """Mark the end points (n, 2) on objects that stayed, shape (n,).

    One that moved was passed by as many scans as ended on it, in its cell and in those around. Walls are passed on one
    side alone, and posts seldom.
    """
    passed, ended = counts.passed, counts.ended
    stayed = np.zeros(points.shape[0], np.bool_)
    for k in range(points.shape[0]):
        row, column = int((points[k, 1] - origin[1]) / cell), int((points[k, 0] - origin[0]) / cell)
        for r in range(max(0, row - 1), min(passed.shape[0], row + 2)):
            for c in range(max(0, column - 1), min(passed.shape[1], column + 2)):
                stayed[k] |= passed[r, c] == 0 or passed[r, c] < ended[r, c]
    return stayed


@njit(cache=True)
def _lower_distances(
    distance2: Float32, origin: Float64, cell: float, points: Float64, scans: Int64, reach: float
) -> None:
    """Lower every cell near a surface to the squared distance from its center to it, m^2.

    The gaps along the surfaces of each scan are filled. Of points within a sixteenth of a cell the first counts: in a
    room that many scans show, most are.

    :param points: shape (n, 2), m, in the order of the beams of each scan.
    :param scans: number of the scan of each point, shape (n,).
    """
    is_lowered = np.zeros(distance2.shape, np.uint16)
    for k in range(points.shape[0]):
        count = 1
        if k + 1 < points.shape[0] and scans[k] == scans[k + 1]:
            length = np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
            count = int(np.ceil(length / cell)) if length <= _MAX_GAP else 1
        for i in range(max(1, count)):
            x, y = points[k, 0], points[k, 1]
            if i > 0:
                x += (points[k + 1, 0] - x) * (i / count)
                y += (points[k + 1, 1] - y) * (i / count)
            x, y = (x - origin[0]) / cell, (y - origin[1]) / cell
            column, row = int(x), int(y)
            part = np.uint16(1 << (4 * int(4.0 * (y - row)) + int(4.0 * (x - column))))
            if not is_lowered[row, column] & part:
                is_lowered[row, column] |= part
                _lower_around(distance2, x - 0.5, y - 0.5, cell, reach)


@njit(cache=True)
def _lower_around(distance2: Float32, x: float, y: float, cell: float, reach: float) -> None:
    """Lower the cells around a point, whose coordinates are in cells from the center of cell (0, 0)."""
    span = int(np.ceil(reach / cell))
    rows, columns = distance2.shape
    area, squares = np.float32(cell * cell), np.empty(2 * span + 1, np.float32)
    column, row = round(x), round(y)
    first, last = max(0, column - span), min(columns, column + span + 1)
    left = np.float32(x - first)
    for c in range(last - first):
        squares[c] = (np.float32(c) - left) * (np.float32(c) - left)
    for r in range(max(0, row - span), min(rows, row + span + 1)):
        up = np.float32((r - y) ** 2)
        # A slice, and a choice instead of a branch, so that the compiler vectorizes. The added 0 prevents a masked
        # store, which is ten times slower on AMD's processors.
        part = distance2[r, first:last]
        for c in range(last - first):
            d2 = (squares[c] + up) * area
            part[c] = (d2 if d2 < part[c] else part[c]) + np.float32(0.0)


@njit(cache=True)
def _count_agreement(points: Float64, fine: Float32, origin: Float64, cell: float) -> tuple[int, int]:
    on, free = 0, 0
    for n in range(points.shape[0]):
        column, row = int(np.floor((points[n, 0] - origin[0]) / cell)), int(np.floor((points[n, 1] - origin[1]) / cell))
        if _MARGIN <= column < fine.shape[1] - _MARGIN and _MARGIN <= row < fine.shape[0] - _MARGIN:
            on += fine[row, column] > _ON_SURFACE
            free += fine[row, column] < _IN_FREE_SPACE and _free_around(fine, row, column)
    return on, free


@njit(cache=True)
def _free_around(fine: Float32, row: int, column: int) -> bool:
    """Whether it is free on all sides: at the edge of free space there may be a wall that a beam grazed."""
    across = max(fine[row, column - _MARGIN], fine[row, column + _MARGIN])
    return bool(max(across, fine[row - _MARGIN, column], fine[row + _MARGIN, column]) < _IN_FREE_SPACE)
