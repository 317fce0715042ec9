"""Furniture: where it stands, and when it is moved while the robot does not see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.simulation.building import Building, furniture_walls
from hmt_slam_ros.simulation.drive import Drive
from hmt_slam_ros.simulation.laser import WallIndex, clearance, has_line_of_sight, wall_index
from hmt_slam_ros.simulation.settings import Settings

Rectangle = tuple[float, float, float, float]

_BERTH = 0.6  # m, between furniture and the robot's way
_MOVE = np.array([0.7, 0.7, 0.5])  # deviation of a move, m, m, rad
_TRIES = 10
_LOOK = 0.5  # s, between two looks of the robot around
_GAP = 5.0  # s, that nobody sees a piece while it is moved, at least


class FurnitureSchedule(NamedTuple):
    """Where the furniture stands over time.

    :ivar times: shape (k,), s, increasing from 0; at each one piece has been moved.
    :ivar pieces: shape (k, m, 5), as in `Building`, from each of these times on.
    """

    times: NDArray[np.float64]
    pieces: NDArray[np.float64]


def furnish(draw: np.random.Generator, rooms: Sequence[Rectangle], route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Put up to four pieces into every room, each along a wall and out of the way.

    :param rooms: smallest x and y, largest x and y, m.
    :param route: shape (k, 2), m.
    :returns: shape (m, 5), as in `Building`.
    """
    way = _sample_route(route)
    pieces = []
    for room in rooms:
        for _ in range(draw.integers(1, 5)):
            piece = _draw_piece_at_wall(draw, room)
            if clearance(furniture_walls(piece[None]), way).min() > _BERTH:
                pieces.append(piece)
    return np.array(pieces).reshape(-1, 5)


def _sample_route(route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of the lines between way-points, 0.1 m apart at most, shape (n, 2)."""
    parts = [
        start + np.linspace(0.0, 1.0, 2 + int(np.hypot(*(end - start)) / 0.1))[:, None] * (end - start)
        for start, end in pairwise(route)
    ]
    return np.concatenate(parts)


def _draw_piece_at_wall(draw: np.random.Generator, room: Rectangle) -> NDArray[np.float64]:
    length, width = draw.uniform(0.6, 1.6), draw.uniform(0.4, 0.8)
    low, high = np.array(room[:2]), np.array(room[2:])
    axis, far = draw.integers(2), draw.random() < 0.5
    middle = np.empty(2)
    middle[axis] = draw.uniform(low[axis] + 0.5 * length, high[axis] - 0.5 * length)
    across = 1 - axis
    away = 0.5 * width + draw.uniform(0.02, 0.1)
    middle[across] = high[across] - away if far else low[across] + away
    return np.array([*middle, 0.5 * np.pi * axis, length, width])


def change_since_first_visit(building: Building, settings: Settings) -> Building:
    """The building as it is at a later visit: pieces moved, doors that are not on the way closed, some of both."""
    if not settings.visit:
        return building
    way, walls = _sample_route(building.route), wall_index(building.walls)
    draw = random_stream(settings.run_seed, Purpose.CHANGES, 0)
    pieces = building.furniture.copy()
    for k in np.flatnonzero(draw.random(len(pieces)) < settings.changed):
        moved = _draw_moved_piece(draw, walls, way, pieces[k], pieces[k])
        pieces[k] = pieces[k] if moved is None else moved
    aside = np.array([clearance(door[None], way).min() > _BERTH for door in building.doors], dtype=np.bool_)
    closed = building.doors[aside & (draw.random(len(aside)) < settings.changed)]
    return replace(building, walls=np.concatenate((building.walls, closed)), furniture=pieces)


def schedule_furniture(building: Building, walls: WallIndex, drive: Drive, settings: Settings) -> FurnitureSchedule:
    """Move pieces at random between two visits of the robot: out of its sight, not far, and never into its way.

    :param walls: of the building, without its furniture.
    """
    times = np.arange(0.0, drive.duration, _LOOK)
    eyes = drive.poses(times)[:, :2]
    moves: list[tuple[float, int, NDArray[np.float64]]] = []
    for k, piece in enumerate(building.furniture if settings.moved > 0.0 else ()):
        draw = random_stream(settings.run_seed, Purpose.FURNITURE, k)
        at = piece
        for gap in _unseen_gaps(_is_visible(walls, eyes, piece, settings.range)):
            time, there = times[gap], draw.random() < settings.moved
            found = _draw_moved_piece(draw, walls, eyes, at, piece) if there else None
            if found is not None and not _is_visible(walls, eyes[gap : gap + 1], found, settings.range)[0]:
                moves.append((float(time), k, found))
                at = found
    pieces = [building.furniture]
    for _, k, piece in sorted(moves, key=lambda move: move[:2]):
        pieces.append(pieces[-1].copy())
        pieces[-1][k] = piece
    return FurnitureSchedule(np.array([0.0, *sorted(time for time, _, _ in moves)]), np.array(pieces))


def _is_visible(
    walls: WallIndex, eyes: NDArray[np.float64], piece: NDArray[np.float64], reach: float
) -> NDArray[np.bool_]:
    """Whether any corner of a piece is in reach and in sight from each of some points (n, 2), shape (n,)."""
    seen = np.zeros(len(eyes), dtype=np.bool_)
    for corner in furniture_walls(piece[None])[:, :2]:
        near = np.hypot(*(eyes - corner).T) <= reach
        seen |= near & has_line_of_sight(walls, eyes, np.broadcast_to(corner, eyes.shape).copy())
    return seen


def _unseen_gaps(seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The middle of every gap that is long enough between two stretches in which something is seen."""
    looks = np.flatnonzero(seen)
    gaps = np.flatnonzero(np.diff(looks) * _LOOK > _GAP)
    return (looks[gaps] + looks[gaps + 1]) // 2


def _draw_moved_piece(
    draw: np.random.Generator,
    walls: WallIndex,
    way: NDArray[np.float64],
    piece: NDArray[np.float64],
    home: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """A place for a piece about its home, in the same room, off the way; None where none is found."""
    for _ in range(_TRIES):
        pose = se2.compose(home[:3], _MOVE * draw.standard_normal(3))
        moved = np.array([*pose, *home[3:]])
        sides = np.concatenate((furniture_walls(moved[None]), [[*piece[:2], *pose[:2]]]))
        free = has_line_of_sight(walls, sides[:, :2].copy(), sides[:, 2:].copy()).all()
        if free and clearance(furniture_walls(moved[None]), way).min() > _BERTH:
            return moved
    return None
