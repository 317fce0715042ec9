"""Exploration of institutes by the explorer, and missions to the rooms that it found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmark.driven_run import DrivenRun, true_place
from benchmark.institute_maps import NEAR, PEOPLE, ChartScores, chart_map, scenario_of, score_chart
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings, chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.tasks import Task
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import START

SEEDS = 5
"""Buildings, each explored once."""

MISSIONS, MISSION_DISTANCE = 5, 180.0
"""In each of them missions are at least so many and so long in all, m: in five, 25 and 900 m, as in the paper."""

_TIME, _MISSION = 2000.0, 300.0  # s, of the simulation, for an exploration and for a mission
_MOST = 4 * MISSIONS  # missions in a building, where they fail without a way
_PASSED = 1.0  # m, from a state's place
_OFF = 0.3  # m, from a place, where a mission is a success
_STATES, _CONFUSED, _PAPER_SPEED = 0.98, 0.092, 0.31  # paper, tables 1 and 2

POLICY = (
    f"An institute of 13 states with {PEOPLE} people and a laser that sees all around. The robot knows nothing of it, "
    "and is driven by the explorer by what the package's own SLAM says, all in lock-step. Passed: states to whose "
    f"place the robot came within {_PASSED:g} m. On the chart: states with a node of the chart within "
    f"{NEAR:g} m. Confused: nodes that are a crossing where there is a door or the other way, or at no state; ends of "
    "hallways are not counted. Rooms entered: true ones that the robot was in. "
    f"Then at least {MISSIONS} missions one after the other, until they are {MISSION_DISTANCE:g} m in all, each to another one, "
    "drawn by chance, of the rooms that the explorer found and named, with mapping going on. A mission is a success "
    "where the robot says that it is there, in "
    f"{_MISSION:g} s and is within {_OFF:g} m of where it truly was when it took the keyframe that stands for the "
    "place. A contact is counted where a step would bring the robot's disc, 0.25 m, into a surface or a person. The "
    "paper's five explorations, 343 m in all, end before the rooms, which are entered by backtracking afterwards."
)


class Exploration(NamedTuple):
    """An exploration.

    :ivar finished: whether the explorer said that it is at its end.
    :ivar distance: driven.
    :ivar seconds: of the simulation.
    :ivar contacts: how often the robot came upon something.
    :ivar passed: states that the robot passed.
    :ivar entered: rooms in which it was.
    :ivar rooms: open rooms of the building.
    :ivar named: rooms that the explorer found.
    :ivar chart: of the map, against the truth.
    """

    finished: bool
    distance: float
    seconds: float
    contacts: int
    passed: int
    entered: int
    rooms: int
    named: int
    chart: ChartScores


class Mission(NamedTuple):
    """A mission.

    :ivar success: whether the robot is where it was to go, and knows it.
    :ivar off: distance from there, m.
    :ivar distance: driven.
    :ivar seconds: of the simulation.
    :ivar contacts: how often the robot came upon something.
    """

    success: bool
    off: float
    distance: float
    seconds: float
    contacts: int


def measure_explore(settings: Settings) -> Report:
    """Explore institutes, and go on missions there."""
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    explorations: list[Exploration] = []
    missions: list[list[Mission]] = []
    for seed in seeds:
        robot = DrivenRobot(scenario_of(seed))
        run = DrivenRun(robot, configuration, Explorer(configuration))
        explorations.append(_explore(run, configuration))
        missions.append(_drive_missions(run, seed))
    report = Report("explore", "Exploration of an institute, and missions", seeds=seeds)
    report.requirements = _requirements(
        explorations, [mission for missions_of_seed in missions for mission in missions_of_seed]
    )
    report.body += [_table_of_explorations(seeds, explorations), _table_of_missions(seeds, missions), POLICY]
    return report


def _explore(run: DrivenRun[Explorer], configuration: Configuration) -> Exploration:
    """Explore, and compare with the truth."""
    robot, scenario = run.robot, run.robot.scenario
    outcome = run.run_task(Task("explore"), _TIME)
    path = robot.true_poses(np.arange(START, robot.stamp, NANOSECONDS // 5))[:, :2]
    states, rooms = scenario.building.states, scenario.building.rooms
    distances = [float(np.hypot(*(path - state[:2]).T).min()) for state in states.poses]
    exploration_map = run.driver.exploration_map
    institute = chart_map(
        scenario, exploration_map.hybrid_map, exploration_map.replica.scans, robot.true_poses, configuration
    )
    return Exploration(
        outcome is not None,
        robot.distance_traveled,
        (robot.stamp - START) / NANOSECONDS,
        robot.contacts,
        sum(state_distance <= _PASSED for state_distance in distances),
        sum(is_within(room, path) for room in rooms),
        len(rooms),
        sum(name.startswith("room ") for name in exploration_map.named_places()),
        score_chart(institute),
    )


def is_within(room: Float64, path: Float64) -> bool:
    """Whether any of some places (n, 2) is in a room (5,)."""
    local = se2.transform(se2.inverse(room[:3]), path)
    return bool(np.any((np.abs(local[:, 0]) < 0.5 * room[3]) & (np.abs(local[:, 1]) < 0.5 * room[4])))


def _drive_missions(run: DrivenRun[Explorer], seed: int) -> list[Mission]:
    """Go to rooms drawn by chance, never twice in a row to the same."""
    draw, robot, begin = np.random.default_rng(seed), run.robot, run.robot.distance_traveled
    found: list[Mission] = []
    last = ""
    while len(found) < MISSIONS or (robot.distance_traveled - begin < MISSION_DISTANCE and len(found) < _MOST):
        names = [
            name for name in run.driver.exploration_map.named_places() if name.startswith("room ") and name != last
        ]
        if not names:
            found.append(Mission(False, math.inf, 0.0, 0.0, 0))
            continue
        last = names[int(draw.integers(len(names)))]
        found.append(_drive_mission(run, last))
    return found


def _drive_mission(run: DrivenRun[Explorer], name: str) -> Mission:
    """Go to a place."""
    robot, place = run.robot, true_place(run, name)
    distance, begin, contacts = robot.distance_traveled, robot.stamp, robot.contacts
    outcome = run.run_task(Task("go", name), _MISSION)
    off = float(np.hypot(*(robot.pose - place)[:2]))
    success = outcome is not None and outcome.succeeded and off <= _OFF
    seconds = (robot.stamp - begin) / NANOSECONDS
    return Mission(success, off, robot.distance_traveled - distance, seconds, robot.contacts - contacts)


def _requirements(explorations: Sequence[Exploration], missions: Sequence[Mission]) -> list[Requirement]:
    charts = [one.chart for one in explorations]
    states, rooms = sum(one.states for one in charts), sum(one.rooms for one in explorations)
    contacts = sum(one.contacts for one in explorations) + sum(one.contacts for one in missions)
    distance = sum(one.distance for one in missions)
    speed = distance / max(1e-9, sum(one.seconds for one in missions))
    return [
        Requirement("explorations that end", float(np.mean([one.finished for one in explorations])), 1.0, least=1.0),
        Requirement("states passed", sum(one.passed for one in explorations) / states, 1.0, least=_STATES),
        Requirement("rooms entered", sum(one.entered for one in explorations) / rooms, 1.0, least=_STATES),
        Requirement("states on the chart", sum(one.detected for one in charts) / states, 1.0, least=_STATES),
        Requirement("nodes confused, of the states", sum(one.confused for one in charts) / states, _CONFUSED),
        Requirement("missions that succeed", float(np.mean([one.success for one in missions])), 1.0, least=1.0),
        Requirement("way of missions", distance, math.inf, "m", least=MISSION_DISTANCE * len(explorations)),
        Requirement("mean speed of missions", speed, math.inf, "m/s", least=_PAPER_SPEED),
        Requirement("contacts", float(contacts), 0.0),
    ]


def _table_of_explorations(seeds: Sequence[int], explorations: Sequence[Exploration]) -> str:
    head = [
        "exploration",
        "way [m]",
        "time [s]",
        "states",
        "passed",
        "on the chart",
        "confused",
        "rooms entered",
        "rooms named",
        "contacts",
    ]
    rows = [
        [
            str(seed),
            f"{one.distance:.0f}",
            f"{one.seconds:.0f}",
            str(one.chart.states),
            str(one.passed),
            str(one.chart.detected),
            str(one.chart.confused),
            f"{one.entered} of {one.rooms}",
            str(one.named),
            str(one.contacts),
        ]
        for seed, one in zip(seeds, explorations, strict=True)
    ]
    return table(head, rows)


def _table_of_missions(seeds: Sequence[int], missions: Sequence[Sequence[Mission]]) -> str:
    head = ["missions", "number", "success", "way [m]", "mean speed [m/s]", "off, median [m]", "most", "contacts"]
    every = [one for own in missions for one in own]
    rows = [
        [name, *_mission_cells(own)] for name, own in (*zip(map(str, seeds), missions, strict=True), ("all", every))
    ]
    return table(head, rows)


def _mission_cells(missions: Sequence[Mission]) -> list[str]:
    distance, off = sum(one.distance for one in missions), np.array([one.off for one in missions])
    speed = distance / max(1e-9, sum(one.seconds for one in missions))
    return [
        str(len(missions)),
        str(sum(one.success for one in missions)),
        f"{distance:.0f}",
        f"{speed:.2f}",
        f"{np.median(off):.2f}",
        f"{off.max():.2f}",
        str(sum(one.contacts for one in missions)),
    ]
