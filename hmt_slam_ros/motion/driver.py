"""Obstacle avoidance with the dynamic window.

Fox, Burgard and Thrun (1997), The dynamic window approach to collision avoidance. Of the velocities that can be reached
until the next command, those are admissible from which the robot can stop before it touches anything; of these the one
is taken that turns best towards the goal, is fast, and has far to go. The goal is what `local_path` finds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.se2 import exp_shift
from hmt_slam_ros.motion.local_path import path_ahead
from hmt_slam_ros.sensing import Scan

_SPEEDS, _TURN_RATES = 9, 21  # velocities that are tried
_HEADING, _CLEARANCE, _PROGRESS = 0.8, 0.1, 1.0  # alpha, beta and gamma of the objective; the last per m
_LOOK = 0.6  # s, after which the heading and the progress of velocities are compared
_FAR = 1.5  # m, beyond which nothing in the way counts
_STRAIGHT = 1e-4  # rad/s


@dataclass(frozen=True)
class Limits:
    """What a robot can do, and how near it may come.

    :ivar speed: at most, m/s.
    :ivar turn_rate: at most, rad/s.
    :ivar acceleration: m/s^2, to brake as well.
    :ivar turn_acceleration: rad/s^2.
    :ivar radius: of its body, m.
    :ivar margin: that it keeps beyond that, m.
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


class Command(NamedTuple):
    """What to do until the next scan.

    :ivar speed: m/s, never backwards.
    :ivar turn_rate: rad/s.
    :ivar arrived: whether the goal is reached, and the robot is to stand.
    """

    speed: float
    turn_rate: float
    arrived: bool


def command_towards(scan: Scan, goal: NDArray[np.float64], velocity: tuple[float, float], limits: Limits) -> Command:
    """The velocities with which to drive towards a goal around what the newest scan shows.

    It does not see behind what hides the rest, and remembers nothing: goals are to be in sight, or nearly.

    :param scan: of any field of view; where nothing is seen the way is taken to be free.
    :param goal: shape (2,), m, the robot's frame.
    :param velocity: of the robot now, m/s and rad/s.
    """
    if math.hypot(goal[0], goal[1]) <= limits.tolerance:
        return Command(0.0, 0.0, arrived=True)
    radius = limits.radius + limits.margin
    ahead = path_ahead(scan.points, goal, radius, _field(scan))
    near = scan.points[np.hypot(*scan.points.T) < _FAR + radius]
    window = _window(velocity, math.hypot(goal[0], goal[1]) - 0.5 * limits.tolerance, limits)
    speed, turn_rate = _best(near, ahead, window, radius, limits.period, limits.acceleration)
    return Command(speed, turn_rate, arrived=False)


def _field(scan: Scan) -> float:
    """Largest bearing to both sides of the robot at which a laser sees, rad."""
    first, last = scan.angle_min, scan.angle_min + scan.angle_increment * (scan.ranges.size - 1)
    gap = abs(scan.angle_increment)
    if abs(last - first) + 1.5 * gap >= 2.0 * math.pi:
        return math.pi
    turn = float(scan.laser_pose[2])
    return max(0.0, min(max(first, last) + turn, -min(first, last) - turn)) + gap


def _window(velocity: tuple[float, float], left: float, limits: Limits) -> NDArray[np.float64]:
    """Smallest and largest speed and turn rate that can be reached, and from which it can stop at the goal, (2, 2).

    :param left: to the goal, m.
    """
    change, turn = limits.acceleration * limits.period, limits.turn_acceleration * limits.period
    fastest = min(limits.speed, math.sqrt(2.0 * limits.acceleration * left))
    low = max(0.0, min(velocity[0], limits.speed) - change)
    slow = max(-limits.turn_rate, min(velocity[1], limits.turn_rate) - turn)
    quick = min(limits.turn_rate, max(velocity[1], -limits.turn_rate) + turn)
    return np.array([[low, max(low, min(fastest, velocity[0] + change))], [slow, quick]])


@njit(cache=True)
def _best(
    points: Float64, ahead: Float64, window: Float64, radius: float, period: float, brake: float
) -> tuple[float, float]:
    """The admissible velocity that is best; where there is none, braking, and turning towards the goal."""
    best, speed, turn_rate = -math.inf, window[0, 0], 0.0
    bearing = math.atan2(ahead[1], ahead[0])
    turn_rate = min(max(bearing / period, window[1, 0]), window[1, 1])
    for i in range(_SPEEDS):
        v = window[0, 0] + (window[0, 1] - window[0, 0]) * i / (_SPEEDS - 1)
        for k in range(_TURN_RATES):
            omega = window[1, 0] + (window[1, 1] - window[1, 0]) * k / (_TURN_RATES - 1)
            free = _free(points, v, omega, radius)
            # Until the next command it goes on like this, and then it brakes.
            if v * period + 0.5 * v * v / brake > free:
                continue
            facing, nearer = _gain(ahead, v, omega)
            score = _HEADING * facing + _CLEARANCE * free / _FAR + _PROGRESS * nearer
            if score > best:
                best, speed, turn_rate = score, v, omega
    return speed, turn_rate


@njit(cache=True)
def _gain(ahead: Float64, v: float, omega: float) -> tuple[float, float]:
    """How well the robot looks towards a point in a while, from 0 to 1 for straight at it; how much nearer it is, m."""
    heading = omega * _LOOK
    shift_x, shift_y = exp_shift(v * _LOOK, 0.0, heading)
    x, y = ahead[0] - shift_x, ahead[1] - shift_y
    off = math.atan2(y, x) - heading
    off = abs(math.atan2(math.sin(off), math.cos(off)))
    return 1.0 - off / math.pi, math.hypot(ahead[0], ahead[1]) - math.hypot(x, y)


@njit(cache=True)
def _free(points: Float64, v: float, omega: float, radius: float) -> float:
    """How far a disc goes on an arc before it touches any of the points, m, `_FAR` at most."""
    free = _FAR
    if v <= 0.0:
        return free
    side = 1.0 if omega >= 0.0 else -1.0
    for n in range(len(points)):
        # Mirrored, so that the arc bends to the left.
        x, y = points[n, 0], side * points[n, 1]
        if x * x + y * y <= radius * radius:
            # Too near already: away from it, but no nearer.
            free = 0.0 if x > 0.0 else free
        elif abs(omega) < _STRAIGHT:
            if x > 0.0 and abs(y) < radius:
                free = min(free, x - math.sqrt(radius * radius - y * y))
        else:
            free = min(free, _along_arc(x, y, v / abs(omega), radius))
    return free


@njit(cache=True)
def _along_arc(x: float, y: float, bend: float, radius: float) -> float:
    """The way along an arc to the left of radius ``bend`` until a disc touches a point, m; inf where it never does."""
    away = math.hypot(x, bend - y)
    if abs(bend - away) >= radius or away == 0.0:
        return math.inf
    # The angle under which the middle of the arc sees the point, less that between contact and closest approach.
    cosine = (bend * bend + away * away - radius * radius) / (2.0 * bend * away)
    angle = math.atan2(x, bend - y) - math.acos(min(1.0, max(-1.0, cosine)))
    return bend * (angle if angle >= 0.0 else angle + 2.0 * math.pi)
