"""Furniture: its placement, and moves between and during visits."""

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

_MIN_DISTANCE_TO_ROUTE = 0.6
"""Smallest distance of furniture from the robot's route, m."""

_MOVE_DEVIATIONS = np.array([0.7, 0.7, 0.5])
"""Deviations of a move, m, m, rad."""

_TRIES = 10
"""Draws of a new pose for a piece, at most."""

_SAMPLING_PERIOD = 0.5
"""Time between two checks of what the robot sees, s."""

_MIN_UNSEEN_TIME = 5.0
"""Shortest time without sight of a piece in which it is moved, s."""


class FurnitureSchedule(NamedTuple):
    """Poses of the furniture over time.

    :ivar times: shape (k,), s, increasing from 0; at each one a piece has been moved.
    :ivar pieces: shape (k, m, 5), as in `Building`, from each of these times on.
    """

    times: NDArray[np.float64]
    pieces: NDArray[np.float64]


def furnish(draw: np.random.Generator, rooms: Sequence[Rectangle], route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Draw up to four pieces for every room, each along a wall and off the route.

    :param rooms: smallest x and y, largest x and y, m.
    :param route: shape (k, 2), m.
    :returns: shape (m, 5), as in `Building`.
    """
    route_points = _sample_route(route)
    pieces = []
    for room in rooms:
        for _ in range(draw.integers(1, 5)):
            piece = _draw_piece_at_wall(draw, room)
            if clearance(furniture_walls(piece[None]), route_points).min() > _MIN_DISTANCE_TO_ROUTE:
                pieces.append(piece)
    return np.array(pieces).reshape(-1, 5)


def _sample_route(route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points on the route, 0.1 m apart at most, shape (n, 2)."""
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
    """The building at a later visit: with some pieces moved, and some doors off the route closed."""
    if not settings.visit:
        return building
    route_points, walls = _sample_route(building.route), wall_index(building.walls)
    draw = random_stream(settings.run_seed, Purpose.CHANGES, 0)
    pieces = building.furniture.copy()
    for k in np.flatnonzero(draw.random(len(pieces)) < settings.changed):
        moved = _draw_moved_piece(draw, walls, route_points, pieces[k], pieces[k])
        pieces[k] = pieces[k] if moved is None else moved
    distances = np.array([clearance(door[None], route_points).min() for door in building.doors])
    closed = building.doors[(distances > _MIN_DISTANCE_TO_ROUTE) & (draw.random(len(distances)) < settings.changed)]
    return replace(building, walls=np.concatenate((building.walls, closed)), furniture=pieces)


def schedule_furniture(building: Building, walls: WallIndex, drive: Drive, settings: Settings) -> FurnitureSchedule:
    """Draw moves of pieces while the robot does not see them: near their old pose, and off its route.

    :param walls: of the building, without its furniture.
    """
    times = np.arange(0.0, drive.duration, _SAMPLING_PERIOD)
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
    """Whether any corner of a piece is within reach and visible from points (n, 2), shape (n,)."""
    seen = np.zeros(len(eyes), dtype=np.bool_)
    for corner in furniture_walls(piece[None])[:, :2]:
        near = np.hypot(*(eyes - corner).T) <= reach
        seen |= near & has_line_of_sight(walls, eyes, np.broadcast_to(corner, eyes.shape).copy())
    return seen


def _unseen_gaps(seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The middle of every long enough gap between two samples in which a piece is seen."""
    samples = np.flatnonzero(seen)
    gaps = np.flatnonzero(np.diff(samples) * _SAMPLING_PERIOD > _MIN_UNSEEN_TIME)
    return (samples[gaps] + samples[gaps + 1]) // 2


def _draw_moved_piece(
    draw: np.random.Generator,
    walls: WallIndex,
    route_points: NDArray[np.float64],
    piece: NDArray[np.float64],
    home: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """A new pose of a piece near its home, in the same room, off the route; None if none is found."""
    for _ in range(_TRIES):
        pose = se2.compose(home[:3], _MOVE_DEVIATIONS * draw.standard_normal(3))
        moved = np.array([*pose, *home[3:]])
        sides = np.concatenate((furniture_walls(moved[None]), [[*piece[:2], *pose[:2]]]))
        free = has_line_of_sight(walls, sides[:, :2].copy(), sides[:, 2:].copy()).all()
        if free and clearance(furniture_walls(moved[None]), route_points).min() > _MIN_DISTANCE_TO_ROUTE:
            return moved
    return None
