"""Tasks of the pilot through nodes, in an institute that was explored."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from std_msgs.msg import String

from benchmark.driven_run import DrivenRun
from benchmark.explore import is_within, mean_speed
from benchmark.institute_drives import AT_PLACE, known_building
from benchmark.institute_maps import LASER, PEOPLE, chart_map, scenario_of
from benchmark.live import PROCESSES
from benchmark.report import Columns, Report, Requirement, mean, table_of
from benchmark.running_nodes import Listener, Parameters
from benchmark.settings import Settings, chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.exploration.roadmap import Roadmap
from hmt_slam_ros.exploration.rooms import named_destinations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.tasks import Task
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import pose_from_message, stamp_from_time
from hmt_slam_ros.ros.topics import DIAGNOSTICS, GROUND_TRUTH, INITIAL_POSE, TASK_GOALS, TASK_RESULTS
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import START

SEEDS = 2
"""Buildings."""

PER_BUILDING = 4
"""Tasks in each of them."""

_EXPLORATION = 2000.0  # s, of the simulation
_SPEED = 0.31  # m/s, paper, table 2
_FROM, _TO = 10.0, 200.0  # s of the scripted drive, between which the robot may start
_START = 0.1  # largest error of initialpose, m

POLICY = (
    f"Nodes as processes over DDS, {PEOPLE} people, a laser that sees all around. The map is the explorer's. At "
    "another visit the robot starts at a random pose in a hallway, without an initial pose, and is sent to "
    f"{PER_BUILDING} random rooms, one after the other. Reached: the pilot reports that the robot arrived, and it is "
    f"within {AT_PLACE:g} m of its true pose at the keyframe of the room. initialpose: the pose that the pilot sends "
    "to slam before doors, against the true pose. A contact is a step that would bring the robot's disc into a surface "
    "or a person."
)

RATE = 2.0
"""Largest speed relative to real time; the robot waits for slam."""

_TIMEOUT = 900.0  # s, for a task, and a node that compiles


class ExploredBuilding(NamedTuple):
    """An explored building with its saved map.

    :ivar seed: of the building.
    :ivar folder: of the map.
    :ivar frames: {area: (``map_T_area``, ``world_T_area``)}, each (3,).
    :ivar rooms: {name: (its area, its place in the world (2,), m)}.
    """

    seed: int
    folder: Path
    frames: dict[int, tuple[Float64, Float64]]
    rooms: dict[str, tuple[int, Float64]]


class TaskScore(NamedTuple):
    """The scores of a task.

    :ivar seed: of the building.
    :ivar run: of the task.
    :ivar error: distance from the room's place at the end, m.
    :ivar starts: errors of the initial poses for slam, m and rad.
    """

    seed: int
    run: TaskRun
    error: float
    starts: list[tuple[float, float]]

    @property
    def is_reached(self) -> bool:
        """Whether the pilot reports arrival, and the robot is at the place."""
        return self.run.text.endswith(": the robot is there") and self.error <= AT_PLACE


def measure_pilot(settings: Settings) -> Report:
    """Explore, save the maps, and send the pilot to rooms."""
    seeds = chosen_seeds(settings, SEEDS)
    configuration = settings.configuration
    explore = partial(explore_building, configuration=configuration, out=settings.out)
    with ProcessPoolExecutor(settings.records.jobs) as pool:
        buildings = list(pool.map(explore, seeds))
    scores = [score for building in buildings for score in run_tasks(building)]
    report = Report("pilot", "Tasks of the pilot through nodes", seeds=seeds)
    report.requirements = requirements(scores)
    report.body += [table_of(_COLUMNS, scores), POLICY]
    return report


def explore_building(seed: int, configuration: Configuration, out: Path) -> ExploredBuilding:
    """Explore a building, and save its map.

    :param out: folder in which that of the map is created.
    :raises HmtSlamError: where the exploration does not end.
    """
    run = DrivenRun(DrivenRobot(scenario_of(seed)), configuration, Explorer(configuration))
    if run.run_task(Task("explore"), _EXPLORATION) is None:
        raise HmtSlamError(f"the explorer did not end in {_EXPLORATION:g} s: see python -m benchmark explore")
    folder = out / f"map{seed}"
    recording = run.save(folder, configuration)
    institute = chart_map(
        run.robot.scenario, recording.hybrid_map, recording.replica.scans, run.robot.true_poses, configuration
    )
    frames = {area: (pose.mean, institute.frames[area]) for area, pose in recording.area_poses.items()}
    roadmap = Roadmap.of_explorer(configuration)
    roadmap.update_everywhere(institute.hybrid_map, institute.scans)
    places = {
        name: (room.opening.area, se2.transform(frames[room.opening.area][1], room.position[None])[0])
        for name, room in named_destinations(known_building(institute, configuration), roadmap.room_numbers()).items()
    }
    return ExploredBuilding(seed, folder, frames, places)


def run_tasks(building: ExploredBuilding) -> list[TaskScore]:
    """Send the robot to random rooms, each different from the one before."""
    draw = np.random.default_rng([building.seed, 3])
    world = f"sim:institute,seed={building.seed},visit=1,changed=0,laps=1,people={PEOPLE},{LASER}"
    scored: list[TaskScore] = []
    with ExitStack() as stack:
        start = InitialSetup(world, _draw_start(world, draw), building.folder)
        session = PilotSession(stack, stack.enter_context(Listener()), start)
        last = ""
        for _ in range(PER_BUILDING):
            others = [name for name in building.rooms if name != last]
            last = others[int(draw.integers(len(others)))]
            scored.append(_score_task(building, session.run(last), last))
    return scored


def _draw_start(world: str, draw: np.random.Generator) -> float:
    """A random time at which the robot is in a hallway, s from the beginning of the scripted drive."""
    simulated = open_simulated(world)
    inside = True
    while inside:
        seconds = float(draw.uniform(_FROM, _TO))
        path = simulated.true_poses(np.array([START + round(NANOSECONDS * seconds)]))[:, :2]
        inside = any(is_within(room, path) for room in simulated.scenario.building.rooms)
    return seconds


def _score_task(building: ExploredBuilding, run: TaskRun, room: str) -> TaskScore:
    """Score a task by the truth."""
    area, place = building.rooms[room]
    in_map, in_world = building.frames[area]
    starts = []
    for given, true in run.starts:
        error = se2.between(se2.compose(in_world, se2.between(in_map, given)), true)
        starts.append((math.hypot(error[0], error[1]), abs(float(error[2]))))
    return TaskScore(building.seed, run, math.dist(place, run.path[-1]), starts)


def requirements(scores: Sequence[TaskScore]) -> list[Requirement]:
    """Requirements on tasks of the pilot."""
    starts = [off for score in scores for off, _ in score.starts]
    speed = mean_speed([score.run.distance for score in scores], [score.run.seconds for score in scores])
    return [
        Requirement("tasks that reach their place", mean([score.is_reached for score in scores]), 1.0, least=1.0),
        Requirement("contacts", float(sum(score.run.contacts for score in scores)), 0.0),
        Requirement("mean speed", speed, math.inf, "m/s", least=_SPEED),
        *([Requirement("initialpose: largest error", max(starts), _START, "m")] if starts else []),
    ]


_COLUMNS: Columns[TaskScore] = [
    ("building", lambda score: str(score.seed)),
    ("task", lambda score: score.run.text.partition(": ")[0]),
    ("result", lambda score: score.run.text.partition(": ")[2]),
    ("off [m]", lambda score: f"{score.error:.2f}"),
    ("distance [m]", lambda score: f"{score.run.distance:.0f}"),
    ("time [s]", lambda score: f"{score.run.seconds:.0f}"),
    ("contacts", lambda score: str(score.run.contacts)),
    ("initialpose off [m]", lambda score: f"{max(off for off, _ in score.starts):.2f}" if score.starts else "-"),
    ("[deg]", lambda score: f"{math.degrees(max(turn for _, turn in score.starts)):.1f}" if score.starts else "-"),
]


class InitialSetup(NamedTuple):
    """The initial state of the nodes.

    :ivar world: ``sim:WORLD,...``.
    :ivar seconds: from the beginning of its scripted drive to the start of the robot.
    :ivar folder: of the map.
    """

    world: str
    seconds: float
    folder: Path


class TaskRun(NamedTuple):
    """The record of a task.

    :ivar text: the pilot's result.
    :ivar path: shape (n, 2), true positions of the robot, m.
    :ivar seconds: simulated time, s.
    :ivar contacts: number of contacts.
    :ivar starts: initial poses for slam, ``map_T_base``, with the true ``world_T_base``, each (3,).
    """

    text: str
    path: Float64
    seconds: float
    contacts: int
    starts: list[tuple[Float64, Float64]]

    @property
    def distance(self) -> float:
        """Path length of the robot, m."""
        return float(np.hypot(*np.diff(self.path, axis=0).T).sum())


class PilotSession:
    """The running nodes with a robot, and their messages."""

    def __init__(self, stack: ExitStack, listener: Listener, start: InitialSetup) -> None:
        """Start the nodes, which end with the stack."""
        self._listener = listener
        self._results: list[str] = []
        self._truths: dict[int, Float64] = {}
        self._starts: list[tuple[int, Float64]] = []
        self._contacts, self._reports = 0, 0
        node = listener.node
        node.create_subscription(
            String, TASK_RESULTS["pilot"], lambda message: self._results.append(message.data), topics.LATCHED
        )
        node.create_subscription(PoseStamped, GROUND_TRUTH, self._add_truth, topics.STREAM)
        node.create_subscription(PoseWithCovarianceStamped, INITIAL_POSE, self._add_initial_pose, topics.STREAM)
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._add_diagnostics, topics.STREAM)
        self._goal_publisher = node.create_publisher(String, TASK_GOALS["pilot"], topics.STREAM)
        shared: Parameters = {"start_from": str(start.folder), "mode": "localization"}
        for name in (*PROCESSES, "pilot"):
            stack.enter_context(listener.running(name, shared))
        listener.wait_until(lambda: self._goal_publisher.get_subscription_count() == 1, _TIMEOUT)
        robot: Parameters = {
            "log": start.world,
            "robot.start": start.seconds,
            "robot.drive": "commands",
            "robot.rate": RATE,
            "robot.scan_listeners": 2,
            "robot.odometry_listeners": 3,
            "robot.discovery_timeout": _TIMEOUT,
        }
        stack.enter_context(listener.running("robot", robot))
        listener.wait_until(lambda: bool(self._truths), _TIMEOUT)

    def run(self, room: str) -> TaskRun:
        """Send the robot to a room.

        :raises HmtSlamError: where the pilot sends no result in time.
        """
        result_count, truth_count, start_count, contacts = (
            len(self._results),
            len(self._truths),
            len(self._starts),
            self._contacts,
        )
        self._goal_publisher.publish(String(data=f"go {room}"))
        self._listener.wait_until(lambda: len(self._results) > result_count, _TIMEOUT)
        reports = self._reports
        # The second report from now on has all contacts up to the end.
        self._listener.wait_until(lambda: self._reports >= reports + 2)
        stamps = list(self._truths)[truth_count:]
        path = np.array([self._truths[stamp][:2] for stamp in stamps])
        seconds = (stamps[-1] - stamps[0]) / NANOSECONDS
        initial_poses = [
            (pose, self._truths[stamp]) for stamp, pose in self._starts[start_count:] if stamp in self._truths
        ]
        return TaskRun(self._results[-1], path, seconds, self._contacts - contacts, initial_poses)

    def _add_truth(self, message: PoseStamped) -> None:
        self._truths[stamp_from_time(message.header.stamp)] = pose_from_message(message.pose)

    def _add_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._starts.append((stamp_from_time(message.header.stamp), pose_from_message(message.pose.pose)))

    def _add_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "/robot":
                self._reports += 1
                # The value is missing before the robot drives.
                self._contacts = next((int(value.value) for value in status.values if value.key == "contacts"), 0)
