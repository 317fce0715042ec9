"""Exploration of institutes by the explorer, and missions to the rooms that it finds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmark.driven_run import DrivenRun, true_place
from benchmark.institute_maps import NEAR, PEOPLE, ChartScores, chart_map, scenario_of, score_chart
from benchmark.report import Columns, Report, Requirement, mean, table_of
from benchmark.settings import Settings, chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.tasks import Task
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import START

SEEDS = 5
"""Buildings, each explored once."""

MISSIONS, MISSION_DISTANCE = 5, 180.0
"""Smallest number of missions in each building, and smallest distance in all, m; as many as in the paper in five."""

_TIME, _MISSION = 2000.0, 300.0  # s, of the simulation, for an exploration and for a mission
_MOST = 4 * MISSIONS  # missions in a building, for those that fail without a path
_PASSED = 1.0  # m, from a state's place
_OFF = 0.3  # largest distance from the place of a successful mission, m
_STATES, _CONFUSED, _PAPER_SPEED = 0.98, 0.092, 0.31  # paper, tables 1 and 2

POLICY = (
    f"An institute of 13 states with {PEOPLE} people and a laser that sees all around. The explorer drives the robot "
    "by the package's own SLAM, without a map, in lock-step. Passed: states to whose place the robot came within "
    f"{_PASSED:g} m. On the chart: states with a node of the chart within {NEAR:g} m. Confused: nodes that are a "
    "crossing instead of a door or the other way round, or at no state; ends of hallways do not count. Rooms entered: "
    f"true rooms in which the robot was. Then at least {MISSIONS} missions follow, until they are {MISSION_DISTANCE:g} "
    "m in all, each to a different random room that the explorer named, with mapping going on. A mission succeeds if "
    f"the explorer reports within {_MISSION:g} s that the robot arrived, and the robot is within {_OFF:g} m of its "
    "true pose at the keyframe of the place. A contact is a step that would bring the robot's disc, 0.25 m, into a "
    "surface or a person. The paper's five explorations, 343 m in all, end before the rooms, which are entered by "
    "backtracking later."
)


class Exploration(NamedTuple):
    """The scores of an exploration.

    :ivar finished: whether the explorer reported its end.
    :ivar distance: driven, m.
    :ivar seconds: simulated time, s.
    :ivar contacts: number of contacts.
    :ivar passed: states that the robot passed.
    :ivar entered: rooms in which the robot was.
    :ivar rooms: open rooms of the building.
    :ivar named: rooms that the explorer named.
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


class RoomMission(NamedTuple):
    """The scores of a mission.

    :ivar success: whether the robot is at its goal, and reports it.
    :ivar off: distance from there, m.
    :ivar distance: driven, m.
    :ivar seconds: simulated time, s.
    :ivar contacts: number of contacts.
    """

    success: bool
    off: float
    distance: float
    seconds: float
    contacts: int


def measure_explore(settings: Settings) -> Report:
    """Explore institutes, and drive missions in them."""
    seeds = chosen_seeds(settings, SEEDS)
    configuration = settings.configuration
    explorations: list[Exploration] = []
    missions: dict[str, list[RoomMission]] = {}
    for seed in seeds:
        run = DrivenRun(DrivenRobot(scenario_of(seed)), configuration, Explorer(configuration))
        explorations.append(_explore(run, configuration))
        missions[str(seed)] = _drive_missions(run, seed)
    every = [mission for own in missions.values() for mission in own]
    report = Report("explore", "Exploration of an institute, and missions", seeds=seeds)
    report.requirements = _requirements(explorations, every)
    report.body = [
        table_of(_EXPLORATION_COLUMNS, zip(seeds, explorations, strict=True)),
        table_of(_MISSION_COLUMNS, (missions | {"all": every}).items()),
        POLICY,
    ]
    return report


def _explore(run: DrivenRun[Explorer], configuration: Configuration) -> Exploration:
    """Explore, and compare the map with the truth."""
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
    """Whether any position (n, 2) of a path is in a room (5,)."""
    local = se2.transform(se2.inverse(room[:3]), path)
    return bool(np.any((np.abs(local[:, 0]) < 0.5 * room[3]) & (np.abs(local[:, 1]) < 0.5 * room[4])))


def _drive_missions(run: DrivenRun[Explorer], seed: int) -> list[RoomMission]:
    """Drive to random rooms, each different from the one before."""
    draw, robot, begin = np.random.default_rng(seed), run.robot, run.robot.distance_traveled
    found: list[RoomMission] = []
    last = ""
    while len(found) < MISSIONS or (robot.distance_traveled - begin < MISSION_DISTANCE and len(found) < _MOST):
        names = [
            name for name in run.driver.exploration_map.named_places() if name.startswith("room ") and name != last
        ]
        if not names:
            found.append(RoomMission(False, math.inf, 0.0, 0.0, 0))
            continue
        last = names[int(draw.integers(len(names)))]
        found.append(_drive_mission(run, last))
    return found


def _drive_mission(run: DrivenRun[Explorer], name: str) -> RoomMission:
    """Drive to a named place."""
    robot, place = run.robot, true_place(run, name)
    distance, begin, contacts = robot.distance_traveled, robot.stamp, robot.contacts
    outcome = run.run_task(Task("go", name), _MISSION)
    off = float(np.hypot(*(robot.pose - place)[:2]))
    success = outcome is not None and outcome.succeeded and off <= _OFF
    seconds = (robot.stamp - begin) / NANOSECONDS
    return RoomMission(success, off, robot.distance_traveled - distance, seconds, robot.contacts - contacts)


def _requirements(explorations: Sequence[Exploration], missions: Sequence[RoomMission]) -> list[Requirement]:
    charts = [exploration.chart for exploration in explorations]
    states, rooms = sum(chart.states for chart in charts), sum(exploration.rooms for exploration in explorations)
    contacts = sum(drive.contacts for drive in explorations) + sum(mission.contacts for mission in missions)
    passed, entered = sum(drive.passed for drive in explorations), sum(drive.entered for drive in explorations)
    detected, confused = sum(chart.detected for chart in charts), sum(chart.confused for chart in charts)
    distances, seconds = [mission.distance for mission in missions], [mission.seconds for mission in missions]
    least = MISSION_DISTANCE * len(explorations)
    return [
        Requirement("explorations that end", mean([drive.finished for drive in explorations]), 1.0, least=1.0),
        Requirement("states passed", passed / states, 1.0, least=_STATES),
        Requirement("rooms entered", entered / rooms, 1.0, least=_STATES),
        Requirement("states on the chart", detected / states, 1.0, least=_STATES),
        Requirement("nodes confused, of the states", confused / states, _CONFUSED),
        Requirement("missions that succeed", mean([mission.success for mission in missions]), 1.0, least=1.0),
        Requirement("distance of missions", sum(distances), math.inf, "m", least=least),
        Requirement("mean speed of missions", mean_speed(distances, seconds), math.inf, "m/s", least=_PAPER_SPEED),
        Requirement("contacts", float(contacts), 0.0),
    ]


def mean_speed(distances: Sequence[float], seconds: Sequence[float]) -> float:
    """Total distance of some drives by their total time, m/s."""
    return sum(distances) / max(1e-9, sum(seconds))


_EXPLORATION_COLUMNS: Columns[tuple[int, Exploration]] = [
    ("exploration", lambda row: str(row[0])),
    ("distance [m]", lambda row: f"{row[1].distance:.0f}"),
    ("time [s]", lambda row: f"{row[1].seconds:.0f}"),
    ("states", lambda row: str(row[1].chart.states)),
    ("passed", lambda row: str(row[1].passed)),
    ("on the chart", lambda row: str(row[1].chart.detected)),
    ("confused", lambda row: str(row[1].chart.confused)),
    ("rooms entered", lambda row: f"{row[1].entered} of {row[1].rooms}"),
    ("rooms named", lambda row: str(row[1].named)),
    ("contacts", lambda row: str(row[1].contacts)),
]


_MISSION_COLUMNS: Columns[tuple[str, Sequence[RoomMission]]] = [
    ("missions", lambda row: row[0]),
    ("number", lambda row: str(len(row[1]))),
    ("success", lambda row: str(sum(mission.success for mission in row[1]))),
    ("distance [m]", lambda row: f"{sum(mission.distance for mission in row[1]):.0f}"),
    ("mean speed [m/s]", lambda row: f"{mean_speed([m.distance for m in row[1]], [m.seconds for m in row[1]]):.2f}"),
    ("off, median [m]", lambda row: f"{np.median([mission.off for mission in row[1]]):.2f}"),
    ("most", lambda row: f"{max(mission.off for mission in row[1]):.2f}"),
    ("contacts", lambda row: str(sum(mission.contacts for mission in row[1]))),
]
