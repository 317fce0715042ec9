"""Local motion: obstacle avoidance with the dynamic window, along a short path around the surfaces in view.

1. A shortest path to the goal is searched in a grid of these (`local_goal`). Cells cost more near surfaces, so that
   paths pass the middle of doors, and outside the field of view. This keeps the dynamic window out of dead ends, as in
   Brock and Khatib (1999), High-speed navigation using the global dynamic window approach.
2. Of the velocities within reach until the next command, those are admissible from which the robot can stop before a
   contact. The best of these by heading, clearance and progress is taken, as in Fox, Burgard and Thrun (1997), The
   dynamic window approach to collision avoidance.

The search is a kernel: a new scipy graph for every scan takes twice its time.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.exploration.laser_views import ObstacleView
from hmt_slam_ros.geometry.se2 import exp_shift

_CELL = 0.1
"""Side of a cell, m."""

_HALF = 40
"""Cells from the robot to the border of the grid."""

_SIDE = 2 * _HALF + 1

_INFLATION_DISTANCE, _INFLATION_COST = 0.35, 4.0
"""Distance beyond the radius up to which a cell costs more, m, and its additional cost at a surface, in cells."""

_UNSEEN_COST = 2.0
"""Additional cost of a cell outside the field of view, in cells."""

_REMAINING_COST = 2.0
"""Cost of the remaining distance to a goal that is not reached, per m."""

_LINE_CLEARANCE = 0.2
"""Clearance of a straight line beyond the radius, m."""

_MIN_LOOKAHEAD = 0.7
"""Smallest distance of the local goal along the path, m."""

_SPEEDS, _TURN_RATES = 9, 21
"""Numbers of speeds and turn rates that are evaluated."""

_HEADING, _CLEARANCE, _PROGRESS = 0.8, 0.1, 1.0
"""Weights of the objective (Fox et al.: alpha, beta and gamma); the last per m."""

_SIMULATION_TIME = 0.6
"""Time after which heading and progress are evaluated, s."""

_MAX_FREE_DISTANCE = 1.5
"""Distance beyond which obstacles are ignored, m."""

_STRAIGHT = 1e-4
"""Turn rates below this are 0, rad/s."""


def local_goal(points: Float64, goal: Float64, radius: float, field: float = math.pi) -> Float64:
    """The point to drive to, on the shortest free path to a goal, or to the best reachable cell.

    It is the farthest point on the path with a straight line well clear of surfaces, at least 0.7 m along the path.

    :param points: shape (n, 2), end points of beams, m, the robot's frame.
    :param goal: shape (2,), m, the robot's frame; it may be beyond the grid, which reaches 4 m.
    :param radius: smallest distance of the robot's middle from surfaces, m.
    :param field: largest bearing of beams, rad.
    :returns: shape (2,), m; the robot's own position where no other is better.
    """
    return _local_goal(np.ascontiguousarray(points), np.asarray(goal, dtype=np.float64), radius, field)


@njit(cache=True)
def _local_goal(points: Float64, goal: Float64, radius: float, field: float) -> Float64:
    away = _obstacle_distances(points, radius + _INFLATION_DISTANCE)
    column, row = round(goal[0] / _CELL) + _HALF, round(goal[1] / _CELL) + _HALF
    last = row * _SIDE + column if 0 <= column < _SIDE and 0 <= row < _SIDE else -1
    before, reached = _search_path(away, goal, radius, field, last)
    path = [reached]
    while before[path[-1]] >= 0:
        path.append(before[path[-1]])
    path.reverse()
    chosen, length = path[0], 0.0
    for k in range(1, len(path)):
        length += _cell_distance(path[k - 1], path[k])
        if length <= _MIN_LOOKAHEAD or _clearance_on_line(away, path[k]) >= radius + _LINE_CLEARANCE:
            chosen = path[k]
    if chosen == last:
        return goal.copy()
    return np.array([_CELL * (chosen % _SIDE - _HALF), _CELL * (chosen // _SIDE - _HALF)])


@njit(cache=True)
def _clearance_on_line(away: Float64, cell: int) -> float:
    """Smallest distance between surfaces and the straight line from the robot to a cell, m."""
    columns, rows = cell % _SIDE - _HALF, cell // _SIDE - _HALF
    steps, nearest = max(abs(columns), abs(rows)), math.inf
    for k in range(steps + 1):
        row, column = round(rows * k / steps) + _HALF, round(columns * k / steps) + _HALF
        nearest = min(nearest, away[row * _SIDE + column])
    return nearest


@njit(cache=True)
def _obstacle_distances(points: Float64, farthest: float) -> Float64:
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
def _search_path(away: Float64, goal: Float64, radius: float, field: float, last: int) -> tuple[Int64, int]:
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
        if cost + _REMAINING_COST * left < least:
            best, least = cell, cost + _REMAINING_COST * left
        for row in range(max(0, cell // _SIDE - 1), min(_SIDE, cell // _SIDE + 2)):
            for column in range(max(0, cell % _SIDE - 1), min(_SIDE, cell % _SIDE + 2)):
                other = row * _SIDE + column
                # From a cell too near to a surface, steps away from it are allowed.
                if away[other] < radius and (away[cell] >= radius or away[other] <= away[cell]):
                    continue
                price = 1.0 + _INFLATION_COST * min(
                    1.0, (radius + _INFLATION_DISTANCE - away[other]) / _INFLATION_DISTANCE
                )
                if abs(math.atan2(row - _HALF, column - _HALF)) > field:
                    price += _UNSEEN_COST
                then = cost + _cell_distance(cell, other) * price
                if then < costs[other]:
                    costs[other], before[other] = then, cell
                    heapq.heappush(queue, (then, other))
    return before, best


@njit(cache=True)
def _cell_distance(cell: int, other: int) -> float:
    """Distance between two cells, m."""
    return _CELL * math.hypot(cell % _SIDE - other % _SIDE, cell // _SIDE - other // _SIDE)


@dataclass(frozen=True)
class MotionLimits:
    """Limits of a robot's motion.

    :ivar speed: at most, m/s.
    :ivar turn_rate: at most, rad/s.
    :ivar acceleration: also for braking, m/s^2.
    :ivar turn_acceleration: rad/s^2.
    :ivar radius: of its body, m.
    :ivar margin: distance from surfaces beyond the radius, m.
    :ivar period: from one command to the next, s.
    :ivar tolerance: distance from the goal at which it has arrived, m.
    """

    speed: float
    turn_rate: float
    acceleration: float
    turn_acceleration: float
    radius: float
    margin: float = 0.05
    period: float = 0.2
    tolerance: float = 0.15


class MotionCommand(NamedTuple):
    """Command until the next scan.

    :ivar speed: m/s, never backwards.
    :ivar turn_rate: rad/s.
    :ivar arrived: whether the goal is reached, and the robot stands.
    """

    speed: float
    turn_rate: float
    arrived: bool


def command_towards(
    view: ObstacleView, goal: NDArray[np.float64], velocity: tuple[float, float], limits: MotionLimits
) -> MotionCommand:
    """The velocities towards a goal around the surfaces in view.

    Hidden surfaces are unknown, and nothing is remembered. So goals should be visible, or nearly.

    :param view: of any field; directions without a return are taken to be free.
    :param goal: shape (2,), m, the robot's frame.
    :param velocity: of the robot now, m/s and rad/s.
    """
    if math.hypot(goal[0], goal[1]) <= limits.tolerance:
        return MotionCommand(0.0, 0.0, arrived=True)
    radius = limits.radius + limits.margin
    ahead = local_goal(view.points, goal, radius, view.field)
    near = view.points[np.hypot(*view.points.T) < _MAX_FREE_DISTANCE + radius]
    window = _dynamic_window(velocity, math.hypot(goal[0], goal[1]) - 0.5 * limits.tolerance, limits)
    speed, turn_rate = _best_velocity(near, ahead, window, radius, limits.period, limits.acceleration)
    return MotionCommand(speed, turn_rate, arrived=False)


def turn_in_place(angle: float, limits: MotionLimits) -> MotionCommand:
    """The command for a turn on the spot by an angle, rad."""
    rate = min(limits.turn_rate, math.sqrt(2.0 * limits.turn_acceleration * abs(angle)), abs(angle) / limits.period)
    return MotionCommand(0.0, math.copysign(rate, angle), arrived=False)


def _dynamic_window(velocity: tuple[float, float], remaining: float, limits: MotionLimits) -> NDArray[np.float64]:
    """Smallest and largest speed, m/s, and turn rate, rad/s, within reach, with a stop at the goal, (2, 2).

    :param remaining: distance to the goal, m.
    """
    change, turn = limits.acceleration * limits.period, limits.turn_acceleration * limits.period
    fastest = min(limits.speed, math.sqrt(2.0 * limits.acceleration * remaining))
    low = max(0.0, min(velocity[0], limits.speed) - change)
    slow = max(-limits.turn_rate, min(velocity[1], limits.turn_rate) - turn)
    quick = min(limits.turn_rate, max(velocity[1], -limits.turn_rate) + turn)
    return np.array([[low, max(low, min(fastest, velocity[0] + change))], [slow, quick]])


@njit(cache=True)
def _best_velocity(
    points: Float64, ahead: Float64, window: Float64, radius: float, period: float, brake: float
) -> tuple[float, float]:
    """The best admissible velocity; for none, braking and turning towards the goal."""
    best, speed, turn_rate = -math.inf, window[0, 0], 0.0
    bearing = math.atan2(ahead[1], ahead[0])
    turn_rate = min(max(bearing / period, window[1, 0]), window[1, 1])
    for i in range(_SPEEDS):
        v = window[0, 0] + (window[0, 1] - window[0, 0]) * i / (_SPEEDS - 1)
        for k in range(_TURN_RATES):
            omega = window[1, 0] + (window[1, 1] - window[1, 0]) * k / (_TURN_RATES - 1)
            free = _free_distance(points, v, omega, radius)
            # The robot keeps the velocity until the next command, and then brakes.
            if v * period + 0.5 * v * v / brake > free:
                continue
            facing, nearer = _heading_and_progress(ahead, v, omega)
            score = _HEADING * facing + _CLEARANCE * free / _MAX_FREE_DISTANCE + _PROGRESS * nearer
            if score > best:
                best, speed, turn_rate = score, v, omega
    return speed, turn_rate


@njit(cache=True)
def _heading_and_progress(ahead: Float64, v: float, omega: float) -> tuple[float, float]:
    """Alignment with a point after the simulation time, 0 to 1 for straight at it, and the decrease of distance, m."""
    heading = omega * _SIMULATION_TIME
    shift_x, shift_y = exp_shift(v * _SIMULATION_TIME, 0.0, heading)
    x, y = ahead[0] - shift_x, ahead[1] - shift_y
    off = math.atan2(y, x) - heading
    off = abs(math.atan2(math.sin(off), math.cos(off)))
    return 1.0 - off / math.pi, math.hypot(ahead[0], ahead[1]) - math.hypot(x, y)


@njit(cache=True)
def _free_distance(points: Float64, v: float, omega: float, radius: float) -> float:
    """Distance of a disc along an arc until it touches a point, m, `_MAX_FREE_DISTANCE` at most."""
    free = _MAX_FREE_DISTANCE
    if v <= 0.0:
        return free
    side = 1.0 if omega >= 0.0 else -1.0
    for n in range(len(points)):
        # Mirrored, so that the arc bends to the left.
        x, y = points[n, 0], side * points[n, 1]
        if x * x + y * y <= radius * radius:
            # Too near already: only motion away from the point is free.
            free = 0.0 if x > 0.0 else free
        elif abs(omega) < _STRAIGHT:
            if x > 0.0 and abs(y) < radius:
                free = min(free, x - math.sqrt(radius * radius - y * y))
        else:
            free = min(free, _distance_along_arc(x, y, v / abs(omega), radius))
    return free


@njit(cache=True)
def _distance_along_arc(x: float, y: float, bend: float, radius: float) -> float:
    """Distance along an arc to the left of radius ``bend`` until a disc touches a point, m; inf for never."""
    away = math.hypot(x, bend - y)
    if abs(bend - away) >= radius or away == 0.0:
        return math.inf
    # The angle under which the middle of the arc sees the point, less that between contact and closest approach.
    cosine = (bend * bend + away * away - radius * radius) / (2.0 * bend * away)
    angle = math.atan2(x, bend - y) - math.acos(min(1.0, max(-1.0, cosine)))
    return bend * (angle if angle >= 0.0 else angle + 2.0 * math.pi)
