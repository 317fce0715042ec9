"""Goals that a driven robot reaches among walls, furniture and people, and what it touches on its way."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from hmt_slam_ros.exploration.local_motion import Limits, command_towards
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.building import Building, FloorPlan
from hmt_slam_ros.simulation.drive import ACCELERATION, TURN_ACCELERATION
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.simulation.settings import Settings as WorldSettings

SEEDS = 3
"""Floors of every kind."""

FAMILIES = ("institute", "doors")

LASERS: dict[str, dict[str, float | int]] = {
    "360°": {"field_of_view": 360.0, "beams": 720},
    "180°": {"field_of_view": 180.0, "beams": 361},
}

_PEOPLE = 4
_TIME = 120.0  # s, for a goal
_PAPER_SPEED = 0.31  # m/s, Tomatis et al. (2003), table 2
_REACHED, _STEP = 0.98, 0.05
_DOORS, _DOOR, _ROOM, _WALL = 8, 0.9, 3.0, 0.2

POLICY = (
    f"institute: the way-points of the default route one after the other, with {_PEOPLE} people; some are 30 m apart, "
    f"and those in rooms are entered from the middle of the hallway. doors: {_DOORS} doors of {_DOOR:g} m, anywhere in "
    "the walls between rooms in a row; goals are the middles of the rooms, there and back. Poses are true ones. A goal "
    f"counts as reached within 0.15 m and {_TIME:g} s; a robot that does not reach one is carried there. A contact is "
    "counted where a step would bring the robot's disc, 0.25 m, into a surface or a person. Mean speed: over all the "
    "time, turns on the spot included; the robot of the paper was as fast as is required here. Time of a step: of this "
    "process, from scan and goal to the velocities."
)


class Leg(NamedTuple):
    """The way to one goal.

    :ivar reached: whether the robot arrived in time.
    :ivar contacts: how often it came upon something.
    :ivar metres: driven.
    :ivar seconds: of the simulation.
    :ivar steps: computing times of the commands, s.
    """

    reached: bool
    contacts: int
    metres: float
    seconds: float
    steps: list[float]


def measure_driving(settings: Settings) -> Report:
    """Drive robots from goal to goal."""
    chosen = chosen_families(settings, FAMILIES)
    seeds = chosen_seeds(settings, SEEDS)
    legs = {
        (family, laser): [leg for seed in seeds for leg in driven(scenario_of(family, seed, laser))]
        for family in chosen
        for laser in LASERS
    }
    every = [leg for own in legs.values() for leg in own]
    report = Report("driving", "Driving among obstacles", seeds=seeds)
    report.requirements = [
        Requirement("goals reached", float(np.mean([leg.reached for leg in every])), 1.0, least=_REACHED),
        Requirement("contacts", float(sum(leg.contacts for leg in every)), 0.0),
        Requirement("mean speed", _speed(every), math.inf, "m/s", least=_PAPER_SPEED),
        Requirement("time of a step, 95 %", float(np.quantile(_steps(every), 0.95)), _STEP, "s"),
    ]
    head = ["world", "laser", "goals", "reached", "contacts", "way [m]", "mean speed [m/s]", "step [ms]", "95 %"]
    report.body += [table(head, [[*key, *_cells(own)] for key, own in legs.items()]), POLICY]
    return report


def scenario_of(family: str, seed: int, laser: str, people: int = _PEOPLE) -> Scenario:
    """A floor with what is about in it."""
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
        plan.free(begin, -0.5 * _ROOM, begin + _ROOM, 0.5 * _ROOM)
        if k:
            y = draw.uniform(-0.5, 0.5) * (_ROOM - _DOOR - 0.4)
            plan.free(begin - _WALL - 0.01, y - 0.5 * _DOOR, begin + 0.01, y + 0.5 * _DOOR)
            # The scripted way, of which only the middles of the rooms are goals.
            route += [(begin - 0.5 * _ROOM, y), (begin + 0.4 * _ROOM, y), (begin + 0.5 * _ROOM, 0.0)]
    pose = np.array([*draw.uniform(-5.0, 5.0, 2), draw.uniform(-3.0, 3.0)])
    return Building(plan.walls(), np.array(route)).placed(pose)


def goals_of(scenario: Scenario) -> NDArray[np.float64]:
    """Where to drive one after the other, (n, 2), m."""
    route = scenario.building.route
    if len(scenario.building.states.poses):
        return route[1:]
    middles = route[::3]
    return np.concatenate((middles[1:], middles[-2::-1]))


def driven(scenario: Scenario, most: int | None = None) -> Iterator[Leg]:
    """Drive from goal to goal.

    :param most: of the goals, None for all.
    """
    settings = scenario.settings
    limits = Limits(
        settings.speed,
        math.radians(settings.turn_rate),
        ACCELERATION,
        TURN_ACCELERATION,
        settings.radius,
        period=1.0 / settings.rate,
    )
    robot = DrivenRobot(scenario)
    for goal in goals_of(scenario)[:most]:
        steps: list[float] = []
        contacts, metres, begin = robot.contacts, robot.travelled, robot.stamp
        reached = _drive_to(robot, goal, limits, steps)
        seconds = (robot.stamp - begin) / NANOSECONDS
        yield Leg(reached, robot.contacts - contacts, robot.travelled - metres, seconds, steps)
        if not reached:
            robot.carry(np.array([*goal, robot.pose[2]]))


def _drive_to(robot: DrivenRobot, goal: NDArray[np.float64], limits: Limits, steps: list[float]) -> bool:
    """Whether it arrives in time; ``steps`` gets the computing times."""
    end = robot.stamp + round(_TIME * NANOSECONDS)
    while robot.stamp < end:
        scan = robot.measure()[1]
        if scan is not None:
            ahead = se2.transform(se2.inverse(robot.pose), goal[None])[0]
            begin = time.process_time()
            command = command_towards(scan, ahead, robot.velocity, limits)
            steps.append(time.process_time() - begin)
            if command.arrived:
                return True
            robot.command(command.speed, command.turn_rate)
        robot.drive()
    return False


def _speed(legs: Sequence[Leg]) -> float:
    return sum(leg.metres for leg in legs) / sum(leg.seconds for leg in legs)


def _steps(legs: Sequence[Leg]) -> NDArray[np.float64]:
    return np.array([step for leg in legs for step in leg.steps])


def _cells(legs: Sequence[Leg]) -> list[str]:
    median, most = 1e3 * np.quantile(_steps(legs), (0.5, 0.95))
    return [
        str(len(legs)),
        str(sum(leg.reached for leg in legs)),
        str(sum(leg.contacts for leg in legs)),
        f"{sum(leg.metres for leg in legs):.0f}",
        f"{_speed(legs):.2f}",
        f"{median:.1f}",
        f"{most:.1f}",
    ]
