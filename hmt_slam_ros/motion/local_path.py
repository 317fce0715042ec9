"""A short path around what a scan shows: Dijkstra's on a small grid about the robot.

What is out of the laser's field is taken to be free, but costs more. Each cell costs the more the nearer it is to a
surface, so that a path keeps to the middle of a door. As in Brock and Khatib (1999), High-speed navigation using the
global dynamic window approach, this is what keeps the dynamic window out of dead ends.
"""

from __future__ import annotations

import heapq
import math

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int64

_CELL = 0.1  # m
_HALF = 40  # cells from the robot's to the grid's border
_SIDE = 2 * _HALF + 1
_SHY, _SHYNESS = 0.35, 4.0  # m beyond the radius, within which a cell costs up to so many times more
_UNSEEN = 2.0  # what a cell costs more that is out of the laser's field
_HUNGER = 2.0  # what a metre that is left to the goal counts, where the goal is not reached
_CLEAR = 0.2  # m beyond the radius, what a straight line keeps away
_AHEAD = 0.7  # m, along the path, at least


def path_ahead(points: Float64, goal: Float64, radius: float, field: float = math.pi) -> Float64:
    """Where to look on the shortest free path to a goal, or on that to the best place on the way there.

    It is the farthest place on the path to which the straight line is well clear of surfaces, and at least 0.7 m along
    the path.

    :param points: shape (n, 2), where surfaces are seen, m, the robot's frame.
    :param goal: shape (2,), m, the robot's frame; it may be beyond the grid, which reaches 4 m.
    :param radius: that the middle of the robot has to keep off, m.
    :param field: largest bearing at which surfaces are seen, rad.
    :returns: shape (2,), m; the robot's own place where there is no better one.
    """
    return _path_ahead(np.ascontiguousarray(points), np.asarray(goal, dtype=np.float64), radius, field)


@njit(cache=True)
def _path_ahead(points: Float64, goal: Float64, radius: float, field: float) -> Float64:
    away = _distances(points, radius + _SHY)
    column, row = round(goal[0] / _CELL) + _HALF, round(goal[1] / _CELL) + _HALF
    last = row * _SIDE + column if 0 <= column < _SIDE and 0 <= row < _SIDE else -1
    before, reached = _search(away, goal, radius, field, last)
    path = [reached]
    while before[path[-1]] >= 0:
        path.append(before[path[-1]])
    path.reverse()
    chosen, length = path[0], 0.0
    for k in range(1, len(path)):
        length += _length(path[k - 1], path[k])
        if length <= _AHEAD or _on_line(away, path[k]) >= radius + _CLEAR:
            chosen = path[k]
    if chosen == last:
        return goal.copy()
    return np.array([_CELL * (chosen % _SIDE - _HALF), _CELL * (chosen // _SIDE - _HALF)])


@njit(cache=True)
def _on_line(away: Float64, cell: int) -> float:
    """The smallest distance from surfaces on the straight line from the robot to a cell, m."""
    columns, rows = cell % _SIDE - _HALF, cell // _SIDE - _HALF
    steps, nearest = max(abs(columns), abs(rows)), math.inf
    for k in range(steps + 1):
        row, column = round(rows * k / steps) + _HALF, round(columns * k / steps) + _HALF
        nearest = min(nearest, away[row * _SIDE + column])
    return nearest


@njit(cache=True)
def _distances(points: Float64, farthest: float) -> Float64:
    """Distance of the middle of every cell from the nearest point, m, ``farthest`` at most, shape (cells,)."""
    away = np.full(_SIDE * _SIDE, farthest)
    span = int(farthest / _CELL) + 1
    for n in range(len(points)):
        x, y = points[n, 0] / _CELL + _HALF, points[n, 1] / _CELL + _HALF
        if not (-span <= x < _SIDE + span and -span <= y < _SIDE + span):
            continue
        for row in range(max(0, int(y) - span), min(_SIDE, int(y) + span + 2)):
            for column in range(max(0, int(x) - span), min(_SIDE, int(x) + span + 2)):
                distance = _CELL * math.hypot(column - x, row - y)
                away[row * _SIDE + column] = min(away[row * _SIDE + column], distance)
    return away


@njit(cache=True)
def _search(away: Float64, goal: Float64, radius: float, field: float, last: int) -> tuple[Int64, int]:
    """The cell before each on the cheapest path from the robot, -1 for none, and the goal's or the best reached."""
    start = _HALF * _SIDE + _HALF
    costs = np.full(_SIDE * _SIDE, math.inf)
    before = np.full(_SIDE * _SIDE, -1)
    costs[start] = 0.0
    best, least = start, math.inf
    queue = [(0.0, start)]
    while len(queue) > 0:
        cost, cell = heapq.heappop(queue)
        if cost > costs[cell]:
            continue
        if cell == last:
            return before, cell
        left = math.hypot(_CELL * (cell % _SIDE - _HALF) - goal[0], _CELL * (cell // _SIDE - _HALF) - goal[1])
        if cost + _HUNGER * left < least:
            best, least = cell, cost + _HUNGER * left
        for row in range(max(0, cell // _SIDE - 1), min(_SIDE, cell // _SIDE + 2)):
            for column in range(max(0, cell % _SIDE - 1), min(_SIDE, cell % _SIDE + 2)):
                other = row * _SIDE + column
                # Out of what is too near it may go away from the surfaces.
                if away[other] < radius and (away[cell] >= radius or away[other] <= away[cell]):
                    continue
                price = 1.0 + _SHYNESS * min(1.0, (radius + _SHY - away[other]) / _SHY)
                if abs(math.atan2(row - _HALF, column - _HALF)) > field:
                    price += _UNSEEN
                then = cost + _length(cell, other) * price
                if then < costs[other]:
                    costs[other], before[other] = then, cell
                    heapq.heappush(queue, (then, other))
    return before, best


@njit(cache=True)
def _length(cell: int, other: int) -> float:
    """From one cell to another, m."""
    return _CELL * math.hypot(cell % _SIDE - other % _SIDE, cell // _SIDE - other // _SIDE)
