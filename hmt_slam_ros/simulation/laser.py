"""The simulated laser: ray casting in a grid of walls, and noise.

A beam walks from cell to cell, and stops at the first cell whose walls it meets. It may begin outside the grid.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.traversal import GridWalk, next_cell
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.settings import Settings

_SLACK = 1e-9
"""Share by which walls are longer at both ends, so that no beam passes between two walls of one corner."""

_SKIN = 1e-6
"""Distance from a cell up to which a wall belongs to it, in cells."""

_CELL = 1.0
"""Side of a cell, m."""

_RANGE_MIN = 0.02
"""Smallest range of the laser, m."""


class WallIndex(NamedTuple):
    """Walls, sorted by the cells of a grid.

    :ivar walls: shape (n, 4), x and y of both ends, m.
    :ivar corner: shape (2,), lower left corner of the grid, m.
    :ivar shape: shape (2,), columns and rows.
    :ivar cell: side of a cell, m.
    :ivar starts: shape (columns * rows + 1,), begin of each cell in ``members``.
    :ivar members: numbers of the walls, cell by cell.
    """

    walls: Float64
    corner: Float64
    shape: Int64
    cell: float
    starts: Int32
    members: Int32


def wall_index(walls: NDArray[np.float64], cell: float = _CELL) -> WallIndex:
    """Sort walls (n, 4), m, n >= 1, into cells."""
    walls = np.ascontiguousarray(walls, dtype=np.float64)
    ends = walls.reshape(-1, 2)
    corner = ends.min(axis=0) - cell
    shape = np.ceil((ends.max(axis=0) - corner) / cell).astype(np.int64) + 1
    counts = np.zeros(shape[0] * shape[1] + 1, dtype=np.int32)
    _fill_cells(walls, corner, shape, cell, counts, np.empty(0, dtype=np.int32))
    starts = np.cumsum(counts, dtype=np.int32)
    members = np.empty(starts[-1], dtype=np.int32)
    _fill_cells(walls, corner, shape, cell, starts[:-1].copy(), members)
    return WallIndex(walls, corner, shape, cell, starts, members)


@njit(cache=True)
def _fill_cells(walls: Float64, corner: Float64, shape: Int64, cell: float, at: Int32, members: Int32) -> None:
    """Count the walls of each cell at its number + 1 in ``at``; or, with ``members``, fill them in from ``at`` on."""
    for k in range(walls.shape[0]):
        ax, ay = (walls[k, 0] - corner[0]) / cell, (walls[k, 1] - corner[1]) / cell
        bx, by = (walls[k, 2] - corner[0]) / cell, (walls[k, 3] - corner[1]) / cell
        dx, dy = bx - ax, by - ay
        length = math.hypot(dx, dy)
        for row in range(int(min(ay, by) - _SKIN), int(max(ay, by) + _SKIN) + 1):
            for column in range(int(min(ax, bx) - _SKIN), int(max(ax, bx) + _SKIN) + 1):
                # Distance of the cell's middle from the wall's line, compared with that of its farthest corner.
                away = abs(dx * (row + 0.5 - ay) - dy * (column + 0.5 - ax))
                if away <= 0.5 * (abs(dx) + abs(dy)) + _SKIN * (1.0 + length):
                    number = row * shape[0] + column
                    if members.size:
                        members[at[number]] = k
                        at[number] += 1
                    else:
                        at[number + 1] += 1


@njit(cache=True)
def cast_rays(index: WallIndex, origins: Float64, angles: Float64, reach: float) -> Float64:
    """Distance to the nearest wall along each beam.

    :param origins: shape (n, 2), m.
    :param angles: shape (n,), rad.
    :param reach: m.
    :returns: shape (n,), m; inf without a wall within reach.
    """
    distances = np.empty(angles.shape[0])
    for n in range(angles.shape[0]):
        distances[n] = _cast_ray(index, origins[n, 0], origins[n, 1], math.cos(angles[n]), math.sin(angles[n]), reach)
    return distances


@njit(cache=True)
def has_line_of_sight(index: WallIndex, starts: Float64, ends: Float64) -> Bool:
    """Whether there is no wall between two points, for each of n pairs (n, 2), m; shape (n,)."""
    clear = np.empty(starts.shape[0], dtype=np.bool_)
    for n in range(starts.shape[0]):
        dx, dy = ends[n, 0] - starts[n, 0], ends[n, 1] - starts[n, 1]
        away = math.hypot(dx, dy)
        if away == 0.0:
            clear[n] = True
        else:
            clear[n] = _cast_ray(index, starts[n, 0], starts[n, 1], dx / away, dy / away, away) == math.inf
    return clear


@njit(cache=True)
def _cast_ray(index: WallIndex, x: float, y: float, cos: float, sin: float, reach: float) -> float:
    columns, rows = index.shape[0], index.shape[1]
    gx, gy = (x - index.corner[0]) / index.cell, (y - index.corner[1]) / index.cell
    enter, leave_x = _clip_to_grid(gx, cos, columns)
    other, leave_y = _clip_to_grid(gy, sin, rows)
    enter, leave = max(enter, other), min(leave_x, leave_y, reach / index.cell)
    if enter > leave:
        return math.inf
    column = min(max(int(gx + enter * cos), 0), columns - 1)
    row = min(max(int(gy + enter * sin), 0), rows - 1)
    step_x, per_x, next_x = _axis_steps(gx, cos, column)
    step_y, per_y, next_y = _axis_steps(gy, sin, row)
    walk = GridWalk(column, row, next_x, next_y, step_x, step_y, per_x, per_y)
    nearest = math.inf
    while 0 <= walk.column < columns and 0 <= walk.row < rows:
        number = walk.row * columns + walk.column
        for place in range(index.starts[number], index.starts[number + 1]):
            nearest = min(nearest, _distance_to_wall(index.walls, index.members[place], x, y, cos, sin))
        border = min(walk.next_x, walk.next_y)
        if nearest <= border * index.cell or border > leave:
            break
        walk = next_cell(walk)
    return nearest if nearest <= reach else math.inf


@njit(cache=True)
def _axis_steps(start: float, direction: float, cell: int) -> tuple[int, float, float]:
    """Along one axis: the cell step, the length of a beam per cell, and its length to the border of a cell."""
    step = 1 if direction > 0.0 else -1
    if direction == 0.0:
        return step, math.inf, math.inf
    return step, 1.0 / abs(direction), (cell + (direction > 0.0) - start) / direction


@njit(cache=True)
def _clip_to_grid(start: float, direction: float, size: int) -> tuple[float, float]:
    """Lengths at which a beam enters the interval from 0 to ``size``, 0 at least, and leaves it."""
    if direction == 0.0:
        return (0.0, math.inf) if 0.0 <= start <= size else (math.inf, 0.0)
    a, b = -start / direction, (size - start) / direction
    return max(0.0, min(a, b)), max(a, b)


@njit(cache=True)
def _distance_to_wall(walls: Float64, k: int, x: float, y: float, cos: float, sin: float) -> float:
    """Distance along a beam to a wall, inf for a miss or a parallel wall."""
    ox, oy = walls[k, 0] - x, walls[k, 1] - y
    dx, dy = walls[k, 2] - walls[k, 0], walls[k, 3] - walls[k, 1]
    cross = cos * dy - sin * dx
    if cross == 0.0:
        return math.inf
    share = (ox * sin - oy * cos) / cross
    distance = (ox * dy - oy * dx) / cross
    return distance if distance >= 0.0 and -_SLACK <= share <= 1.0 + _SLACK else math.inf


@njit(cache=True)
def shorten_at_discs(discs: Float64, origins: Float64, angles: Float64, distances: Float64) -> None:
    """Shorten distances (n,), m, by discs; a beam from within a disc passes it.

    :param discs: shape (k, 3), x, y and radius, m.
    :param origins: shape (n, 2), m.
    :param angles: shape (n,), rad.
    """
    for n in range(angles.shape[0]):
        cos, sin = math.cos(angles[n]), math.sin(angles[n])
        for k in range(discs.shape[0]):
            dx, dy, radius = discs[k, 0] - origins[n, 0], discs[k, 1] - origins[n, 1], discs[k, 2]
            ahead = dx * cos + dy * sin
            inside = radius * radius - (dx * sin - dy * cos) ** 2
            if ahead > 0.0 and inside > 0.0 and dx * dx + dy * dy > radius * radius:
                distances[n] = min(distances[n], ahead - math.sqrt(inside))


@njit(cache=True)
def clearance(walls: Float64, points: Float64) -> Float64:
    """Distance of each point (n, 2) from the nearest of the walls (k, 4), m; shape (n,)."""
    nearest = np.full(points.shape[0], math.inf)
    for n in range(points.shape[0]):
        for k in range(walls.shape[0]):
            dx, dy = walls[k, 2] - walls[k, 0], walls[k, 3] - walls[k, 1]
            px, py = points[n, 0] - walls[k, 0], points[n, 1] - walls[k, 1]
            share = min(1.0, max(0.0, (px * dx + py * dy) / max(dx * dx + dy * dy, 1e-300)))
            nearest[n] = min(nearest[n], (px - share * dx) ** 2 + (py - share * dy) ** 2)
    return np.sqrt(nearest)


class Laser:
    """A planar range finder that faces ahead or back.

    :ivar pose: shape (3,), ``base_T_laser``, m and rad.
    :ivar angles: shape (n,), of the beams, rad.
    :ivar half_field: half the field of view, rad.
    :ivar reach: m.
    :ivar times: shape (n,), of each beam after the first, s; shape (1,) without time between them.
    """

    def __init__(self, settings: Settings, *, faces_back: bool = False) -> None:
        self.pose = np.array([-settings.forward, 0.0, math.pi] if faces_back else [settings.forward, 0.0, 0.0])
        self._noise = Purpose.REAR_LASER if faces_back else Purpose.LASER
        self.times = np.linspace(0.0, settings.sweep, settings.beams if settings.sweep > 0.0 else 1)
        self._settings = settings
        self.reach = settings.range
        field = math.radians(settings.field_of_view)
        self.half_field = 0.5 * field
        # In a full circle the last beam differs from the first.
        gaps = settings.beams - 1 if settings.field_of_view < 360.0 else settings.beams
        self._first, self._gap = -self.half_field, field / gaps
        self.angles = self._first + self._gap * np.arange(settings.beams)

    def distances(
        self, poses: NDArray[np.float64], walls: WallIndex, discs: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """True distance along each beam, shape (n,), m; inf for nothing within reach.

        :param poses: shape (n, 3), ``world_T_base`` at each beam, or (1, 3) for all.
        :param discs: shape (k, 3), x, y and radius of people, m.
        """
        lasers = se2.compose(poses, self.pose)
        origins = np.ascontiguousarray(np.broadcast_to(lasers[:, :2], (self.angles.size, 2)))
        angles = lasers[:, 2] + self.angles
        distances = cast_rays(walls, origins, angles, self.reach)
        shorten_at_discs(discs, origins, angles, distances)
        return distances

    def scan(self, number: int, stamp: int, distances: NDArray[np.float64]) -> Scan:
        """The scan of true distances (n,), m, with noise; lost beams read inf.

        :param number: of the scan, which determines its noise.
        """
        settings = self._settings
        draw = random_stream(settings.run_seed, self._noise, number)
        ranges = distances + settings.range_noise * draw.standard_normal(distances.size)
        lost = (draw.random(distances.size) < settings.dropout) | (ranges >= settings.range)
        kept = np.where(lost, np.inf, np.maximum(ranges, 0.0))
        gap = settings.sweep / max(1, settings.beams - 1)
        return Scan(stamp, kept.astype(np.float32), self._first, self._gap, _RANGE_MIN, settings.range, self.pose, gap)
