"""Buildings: walls, furniture, route and topological states, and floor plans that make them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2

_DECIMALS = 3
"""Decimals of coordinates in m, so that equal corners are equal numbers."""


def outline_of_cells(
    inside: NDArray[np.bool_], xs: NDArray[np.float64], ys: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The longest straight segments between inside and outside cells.

    :param inside: shape (rows, columns); cells beyond the grid are outside.
    :param xs: shape (columns + 1,), x of the cells' sides, m, increasing.
    :param ys: shape (rows + 1,), y of the cells' sides, m, increasing.
    :returns: shape (n, 4), x and y of both ends, m.
    """
    padded = np.pad(inside, 1)
    upright, begin, end = _runs((padded[1:-1, :-1] != padded[1:-1, 1:]).T)
    vertical = np.stack((xs[upright], ys[begin], xs[upright], ys[end]), axis=1)
    level, begin, end = _runs(padded[:-1, 1:-1] != padded[1:, 1:-1])
    return np.concatenate((vertical, np.stack((xs[begin], ys[level], xs[end], ys[level]), axis=1)))


def outline_of_rectangles(rectangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The outline of the union of rectangles.

    :param rectangles: shape (n, 4), smallest x and y, largest x and y, m; to the millimeter.
    :returns: shape (k, 4), x and y of both ends, m.
    """
    corners = np.round(rectangles, _DECIMALS)
    xs, ys = np.unique(corners[:, [0, 2]]), np.unique(corners[:, [1, 3]])
    inside = np.zeros((ys.size - 1, xs.size - 1), dtype=np.bool_)
    left, right = np.searchsorted(xs, corners[:, 0]), np.searchsorted(xs, corners[:, 2])
    low, high = np.searchsorted(ys, corners[:, 1]), np.searchsorted(ys, corners[:, 3])
    for k in range(len(corners)):
        inside[low[k] : high[k], left[k] : right[k]] = True
    return outline_of_cells(inside, xs, ys)


def _runs(marked: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Row, first column and end column of every run of marked cells."""
    changes = np.diff(np.pad(marked.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, begin = np.nonzero(changes == 1)
    return rows, begin, np.nonzero(changes == -1)[1]


Point = tuple[float, float]


def _no_pieces() -> NDArray[np.float64]:
    return np.empty((0, 5))


def _no_doors() -> NDArray[np.float64]:
    return np.empty((0, 4))


class TopologicalStates(NamedTuple):
    """The true states of topological localization: open doors and crossings.

    After Tomatis, Nourbakhsh and Siegwart (2003), section 2.1.

    :ivar poses: shape (s, 3), in the middle of a hallway, facing the opening to its side, m and rad; at a crossing in
        the middle of both hallways, facing along the one that ends there.
    :ivar ahead: shape (s,), distance to the opening in the hallway's side, m.
    :ivar widths: shape (s,), of the openings, m.
    :ivar crossings: shape (s,), whether it is a crossing; else the door of an open room.
    """

    poses: NDArray[np.float64]
    ahead: NDArray[np.float64]
    widths: NDArray[np.float64]
    crossings: NDArray[np.bool_]

    @property
    def openings(self) -> NDArray[np.float64]:
        """Poses of the openings, shape (s, 3): their middle, m, and the heading through them, rad."""
        zeros = np.zeros_like(self.ahead)
        return se2.compose(self.poses, np.stack((self.ahead, zeros, zeros), axis=1))


def _no_states() -> TopologicalStates:
    return TopologicalStates(np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0, dtype=np.bool_))


@dataclass(frozen=True, eq=False)
class Building:
    """A simulated world, in one frame, m and rad.

    :ivar walls: shape (n, 4), x and y of both ends of each wall.
    :ivar route: shape (k, 2), way-points of the robot, k >= 2; the first and the last are equal for a closed route.
    :ivar furniture: shape (m, 5), x, y, heading, length and width of each movable piece.
    :ivar doors: shape (d, 4), x and y of both ends of each open door that later visits may find closed.
    :ivar rooms: shape (r, 5), x, y, heading, length and width of each open room beside the corridors.
    :ivar twin_frames: {name: shape (3,)}, frames in which identical parts of the building have equal coordinates.
    :ivar states: the topological states of the hallways, where the family has them.
    """

    walls: NDArray[np.float64]
    route: NDArray[np.float64]
    furniture: NDArray[np.float64] = field(default_factory=_no_pieces)
    doors: NDArray[np.float64] = field(default_factory=_no_doors)
    rooms: NDArray[np.float64] = field(default_factory=_no_pieces)
    twin_frames: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    states: TopologicalStates = field(default_factory=_no_states)

    def transform(self, pose: NDArray[np.float64]) -> Building:
        """The building moved to a pose (3,) of its origin."""
        pieces, rooms = (
            np.concatenate((se2.compose(pose, rows[:, :3]), rows[:, 3:]), axis=1)
            for rows in (self.furniture, self.rooms)
        )
        frames = {name: se2.compose(pose, frame) for name, frame in self.twin_frames.items()}
        states = self.states._replace(poses=se2.compose(pose, self.states.poses))
        walls, doors = _transform_lines(pose, self.walls), _transform_lines(pose, self.doors)
        return Building(walls, se2.transform(pose, self.route), pieces, doors, rooms, frames, states)


def _transform_lines(pose: NDArray[np.float64], lines: NDArray[np.float64]) -> NDArray[np.float64]:
    ends = [se2.transform(pose, lines[:, :2]), se2.transform(pose, lines[:, 2:])]
    return np.concatenate(ends, axis=1)


def furniture_walls(pieces: NDArray[np.float64]) -> NDArray[np.float64]:
    """The walls (4 n, 4), m, of pieces of furniture (n, 5) as in `Building`."""
    signs = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    corners = [se2.transform(piece[:3], signs * piece[3:]) for piece in pieces]
    sides = [np.concatenate((four, np.roll(four, -1, axis=0)), axis=1) for four in corners]
    return np.concatenate(sides) if sides else np.empty((0, 4))


class Side(NamedTuple):
    """One side of a corridor in a floor plan, along the x or the y axis.

    :ivar origin: its begin, m.
    :ivar along: unit vector along it.
    :ivar out: unit vector away from the corridor.
    """

    origin: Point
    along: Point
    out: Point

    def point(self, along: float, out: float) -> Point:
        """A point by its distances from the side's origin, m."""
        return (
            self.origin[0] + along * self.along[0] + out * self.out[0],
            self.origin[1] + along * self.along[1] + out * self.out[1],
        )

    def rectangle(self, along: Point, out: Point) -> tuple[float, float, float, float]:
        """The rectangle between two distances along and two out of the side, m, for `FloorPlan.cut_rectangle`."""
        (ax, ay), (bx, by) = self.point(along[0], out[0]), self.point(along[1], out[1])
        return min(ax, bx), min(ay, by), max(ax, bx), max(ay, by)


class FloorPlan:
    """A floor plan: the union of free rectangles."""

    def __init__(self) -> None:
        self._rectangles: list[tuple[float, float, float, float]] = []

    def cut_rectangle(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Add a free rectangle, m."""
        self._rectangles.append((x0, y0, x1, y1))

    def cut_corridor(self, start: Point, end: Point, width: float) -> None:
        """Add a corridor along the x or the y axis, half a width longer than its middle line at both ends, m."""
        (x0, x1), (y0, y1) = sorted((start[0], end[0])), sorted((start[1], end[1]))
        self.cut_rectangle(x0 - 0.5 * width, y0 - 0.5 * width, x1 + 0.5 * width, y1 + 0.5 * width)

    def cut_ring(self, half_x: float, half_y: float, width: float) -> None:
        """Add a ring of corridors around the origin, with a middle line of these half sides, m."""
        corners = [(-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y)]
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            self.cut_corridor(start, end, width)

    def walls(self) -> NDArray[np.float64]:
        """The outline of the free space, shape (n, 4), m."""
        return outline_of_rectangles(np.array(self._rectangles))


def sides_of_ring(half_x: float, half_y: float, width: float, *, outer: bool) -> list[Side]:
    """The four outer or inner sides of a ring (`FloorPlan.cut_ring`), counterclockwise from the lower one.

    Their lengths are 2 half_x and 2 half_y in turn, plus or minus a width.
    """
    away = 0.5 * width if outer else -0.5 * width
    x, y = half_x + away, half_y + away
    out = 1.0 if outer else -1.0
    return [
        Side((-x, -y), (1.0, 0.0), (0.0, -out)),
        Side((x, -y), (0.0, 1.0), (out, 0.0)),
        Side((x, y), (-1.0, 0.0), (0.0, out)),
        Side((-x, y), (0.0, -1.0), (-out, 0.0)),
    ]
