"""Buildings: walls, furniture, and the way that the robot drives through them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2

_DECIMALS = 3  # of metres: corners meant to be the same are the same


def outline_of_cells(
    inside: NDArray[np.bool_], xs: NDArray[np.float64], ys: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The segments between cells that are inside and cells that are not, as long as they go straight on.

    :param inside: shape (rows, columns); what lies beyond the grid is not inside.
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

    :param rectangles: shape (n, 4), smallest x and y, largest x and y, m; to the millimetre.
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
    """Row, first column and column behind the last of every run of marked cells."""
    changes = np.diff(np.pad(marked.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, begin = np.nonzero(changes == 1)
    return rows, begin, np.nonzero(changes == -1)[1]


Point = tuple[float, float]


def _no_pieces() -> NDArray[np.float64]:
    return np.empty((0, 5))


def _no_doors() -> NDArray[np.float64]:
    return np.empty((0, 4))


class TopologicalStates(NamedTuple):
    """Where a robot in the hallways passes what topological localization has to tell apart.

    After Tomatis, Nourbakhsh and Siegwart (2003), section 2.1: openings from a hallway to an open room, and crossings.

    :ivar poses: shape (s, 3), in the middle of a hallway, looking through the opening to its side, m and rad; at a
        crossing where both hallways meet, looking along the one that ends there.
    :ivar ahead: shape (s,), from there to the opening in the hallway's side, m.
    :ivar widths: shape (s,), of the openings, m.
    :ivar crossings: shape (s,), whether it is a crossing of hallways; else it is an open room's door.
    """

    poses: NDArray[np.float64]
    ahead: NDArray[np.float64]
    widths: NDArray[np.float64]
    crossings: NDArray[np.bool_]

    @property
    def openings(self) -> NDArray[np.float64]:
        """The middles of the openings, shape (s, 3), m, each with the heading through it, rad."""
        zeros = np.zeros_like(self.ahead)
        return se2.compose(self.poses, np.stack((self.ahead, zeros, zeros), axis=1))


def _no_states() -> TopologicalStates:
    return TopologicalStates(np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0, dtype=np.bool_))


@dataclass(frozen=True, eq=False)
class Building:
    """A world for one robot; all in one frame, m and rad.

    :ivar walls: shape (n, 4), x and y of both ends of each wall.
    :ivar route: shape (k, 2), way-points of the robot, k >= 2; the same one first and last for a closed route.
    :ivar furniture: shape (m, 5), x, y, heading, length and width of each piece that may be moved.
    :ivar doors: shape (d, 4), x and y of both ends of each door that may be closed; they are open.
    :ivar rooms: shape (r, 5), likewise x, y, heading, length and width of each room beside the corridors that is open.
    :ivar twin_frames: {name: shape (3,)}, frames in which parts of the building that are the same look the same.
    :ivar states: the topological states of the hallways, of a building in which they are counted.
    """

    walls: NDArray[np.float64]
    route: NDArray[np.float64]
    furniture: NDArray[np.float64] = field(default_factory=_no_pieces)
    doors: NDArray[np.float64] = field(default_factory=_no_doors)
    rooms: NDArray[np.float64] = field(default_factory=_no_pieces)
    twin_frames: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    states: TopologicalStates = field(default_factory=_no_states)

    def transform(self, pose: NDArray[np.float64]) -> Building:
        """The same building, its origin at a pose (3,)."""
        pieces, rooms = (
            np.concatenate((se2.compose(pose, own[:, :3]), own[:, 3:]), axis=1) for own in (self.furniture, self.rooms)
        )
        places = {name: se2.compose(pose, place) for name, place in self.twin_frames.items()}
        states = self.states._replace(poses=se2.compose(pose, self.states.poses))
        route = se2.transform(pose, self.route)
        return Building(
            _transform_lines(pose, self.walls), route, pieces, _transform_lines(pose, self.doors), rooms, places, states
        )


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
    """One side of a corridor in a floor plan: along it and out of it, in steps of right angles.

    :ivar origin: where it begins, m.
    :ivar along: unit vector along it.
    :ivar out: unit vector away from the corridor.
    """

    origin: Point
    along: Point
    out: Point

    def point(self, along: float, out: float) -> Point:
        """A point by its distances from the side's begin, m."""
        return (
            self.origin[0] + along * self.along[0] + out * self.out[0],
            self.origin[1] + along * self.along[1] + out * self.out[1],
        )

    def rectangle(self, along: Point, out: Point) -> tuple[float, float, float, float]:
        """The rectangle between two distances along and two out of the side, m, as `FloorPlan.cut_rectangle` takes
        it."""
        (ax, ay), (bx, by) = self.point(along[0], out[0]), self.point(along[1], out[1])
        return min(ax, bx), min(ay, by), max(ax, bx), max(ay, by)


class FloorPlan:
    """A floor plan that is made by cutting free rectangles out of solid stone; they may overlap."""

    def __init__(self) -> None:
        self._rectangles: list[tuple[float, float, float, float]] = []

    def cut_rectangle(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Cut out a rectangle, m."""
        self._rectangles.append((x0, y0, x1, y1))

    def cut_corridor(self, start: Point, end: Point, width: float) -> None:
        """Cut out a corridor along the x or the y axis; its ends are half a width beyond both points of its middle."""
        (x0, x1), (y0, y1) = sorted((start[0], end[0])), sorted((start[1], end[1]))
        self.cut_rectangle(x0 - 0.5 * width, y0 - 0.5 * width, x1 + 0.5 * width, y1 + 0.5 * width)

    def cut_ring(self, half_x: float, half_y: float, width: float) -> None:
        """Cut out a ring of corridors around the origin; its middle is a rectangle of the half sides given."""
        corners = [(-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y)]
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            self.cut_corridor(start, end, width)

    def walls(self) -> NDArray[np.float64]:
        """The walls around all that is free, shape (n, 4), m."""
        return outline_of_rectangles(np.array(self._rectangles))


def sides_of_ring(half_x: float, half_y: float, width: float, *, outer: bool) -> list[Side]:
    """The four outer or inner sides of a ring as `FloorPlan.cut_ring` makes it, counter-clockwise from the lower one.

    Each begins at its corner; the lengths are 2 half_x and 2 half_y in turn, plus or minus a width.
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
