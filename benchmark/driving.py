"""Drives of a simulated robot to goals, among walls, furniture and people."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.exploration.laser_views import LaserViews
from hmt_slam_ros.exploration.local_motion import MotionLimits, command_towards
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.building import Building, FloorPlan
from hmt_slam_ros.simulation.drive import ACCELERATION, TURN_ACCELERATION
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.simulation.settings import Settings as WorldSettings

LASERS: dict[str, dict[str, float | int]] = {
    "360°": {"field_of_view": 360.0, "beams": 720},
    "180°": {"field_of_view": 180.0, "beams": 361},
}

_PEOPLE = 4
_TIME = 120.0  # s, for a goal
_DOORS, _DOOR, _ROOM, _WALL = 8, 0.9, 3.0, 0.2


class Leg(NamedTuple):
    """The drive to one goal.

    :ivar reached: whether the robot arrived in time.
    :ivar contacts: number of contacts.
    :ivar distance: driven, m.
    :ivar seconds: simulated time, s.
    """

    reached: bool
    contacts: int
    distance: float
    seconds: float


def scenario_of(family: str, seed: int, laser: str, people: int = _PEOPLE) -> Scenario:
    """A floor with furniture and people."""
    if family == "institute":
        settings = f"odometry=0,people={people}" + "".join(f",{name}={value}" for name, value in LASERS[laser].items())
        return open_simulated(f"sim:institute,seed={seed},{settings}").scenario
    return Scenario(_doors(seed), WorldSettings(seed=seed, laps=1, odometry=0.0, **LASERS[laser]))  # type: ignore[arg-type]


def _doors(seed: int) -> Building:
    """Rooms in a row with a door from each to the next."""
    draw, plan = np.random.default_rng(seed), FloorPlan()
    route = [(0.5 * _ROOM, 0.0)]
    for k in range(_DOORS + 1):
        begin = k * (_ROOM + _WALL)
        plan.cut_rectangle(begin, -0.5 * _ROOM, begin + _ROOM, 0.5 * _ROOM)
        if k:
            y = draw.uniform(-0.5, 0.5) * (_ROOM - _DOOR - 0.4)
            plan.cut_rectangle(begin - _WALL - 0.01, y - 0.5 * _DOOR, begin + 0.01, y + 0.5 * _DOOR)
            # The scripted route, of which only the centers of the rooms are goals.
            route += [(begin - 0.5 * _ROOM, y), (begin + 0.4 * _ROOM, y), (begin + 0.5 * _ROOM, 0.0)]
    pose = np.array([*draw.uniform(-5.0, 5.0, 2), draw.uniform(-3.0, 3.0)])
    return Building(plan.walls(), np.array(route)).transform(pose)


def goals_of(scenario: Scenario) -> NDArray[np.float64]:
    """Goals in their order, shape (n, 2), m."""
    route = scenario.building.route
    if len(scenario.building.states.poses):
        return route[1:]
    middles = route[::3]
    return np.concatenate((middles[1:], middles[-2::-1]))


def drive_goals(scenario: Scenario, max_goals: int | None = None) -> Iterator[Leg]:
    """Drive from goal to goal, with a leg for each.

    :param max_goals: number of goals, None for all.
    """
    limits = motion_limits(scenario.settings)
    robot = DrivenRobot(scenario)
    for goal in goals_of(scenario)[:max_goals]:
        contacts, distance, begin = robot.contacts, robot.distance_traveled, robot.stamp
        reached = _drive_to(robot, goal, limits)
        seconds = (robot.stamp - begin) / NANOSECONDS
        yield Leg(reached, robot.contacts - contacts, robot.distance_traveled - distance, seconds)
        if not reached:
            robot.kidnap(np.array([*goal, robot.pose[2]]))


def motion_limits(settings: WorldSettings) -> MotionLimits:
    """The limits of a simulated robot."""
    turn_rate, period = math.radians(settings.turn_rate), 1.0 / settings.rate
    return MotionLimits(settings.speed, turn_rate, ACCELERATION, TURN_ACCELERATION, settings.radius, period=period)


def _drive_to(robot: DrivenRobot, goal: NDArray[np.float64], limits: MotionLimits) -> bool:
    """Drive to a goal; return whether the robot arrives in time."""
    end, views, before = robot.stamp + round(_TIME * NANOSECONDS), LaserViews(), robot.pose
    while robot.stamp < end:
        scan = robot.measure()[1]
        if scan is not None:
            ahead = se2.transform(se2.inverse(robot.pose), goal[None])[0]
            views.move(se2.between(before, robot.pose))
            before = robot.pose
            command = command_towards(views.add(scan), ahead, robot.velocity, limits)
            if command.arrived:
                return True
            robot.set_velocity(command.speed, command.turn_rate)
        robot.advance()
    return False
