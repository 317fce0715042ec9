"""Exploration of institutes by a team of explorers, compared with one alone."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from benchmark.driven_run import RobotProcess
from benchmark.explore import is_within
from benchmark.institute_maps import PEOPLE, scenario_of
from benchmark.report import Columns, Report, Requirement, mean, table_of
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings, chosen_seeds
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import Task
from hmt_slam_ros.messages.team import TeamPlacement, TeamRendezvous, Verdict
from hmt_slam_ros.offline.team_run import TeamRun
from hmt_slam_ros.simulation.driven_robot import DrivenLog, DrivenRobot
from hmt_slam_ros.simulation.scenario import START

SEEDS = 5
"""Buildings, each explored by one robot and by two."""

SHARE = 0.6
"""Largest time of two explorers, as a share of one's."""

_TIME = 2000.0
"""Longest exploration, s."""

_RENDEZVOUS_TIME = 0.5
"""After the start, s: between the first keyframes of the robots."""

_RENDEZVOUS_COVARIANCE = np.diag([0.1, 0.1, math.radians(3.0)]) ** 2
"""Of where one robot stands as seen from the other, m and rad, squared."""

POLICY = (
    f"An institute of 13 states with {PEOPLE} people and lasers that see all around. Explorers drive the robots by the "
    "package's own SLAM, in lock-step. Two begin at one place, back to back, and know nothing of it, or have a "
    "rendezvous there: who puts two robots side by side knows how they stand. With team.uses_ground they share their "
    "ground once they are joined. The time is that until the last explorer reports its end. *In both* counts rooms "
    "that both robots entered after they were joined."
)


@dataclass(frozen=True)
class TeamExploration:
    """An exploration by some robots.

    :ivar seed: of the building.
    :ivar robots: number of robots.
    :ivar has_rendezvous: whether they know how they stood at the start.
    :ivar seconds: until the last one reported its end; inf without.
    :ivar joined: time until the first join, s; inf without.
    :ivar distance: of all robots, m.
    :ivar entered: rooms in which any robot was.
    :ivar rooms: of the building.
    :ivar in_both: rooms that more than one robot entered after the join.
    :ivar contacts: of all robots.
    """

    seed: int
    robots: int
    has_rendezvous: bool
    seconds: float
    joined: float
    distance: float
    entered: int
    rooms: int
    in_both: int
    contacts: int


class _ExploringTeam:
    """Robots with their explorers in one building.

    :ivar robots: {name: robot}.
    :ivar processes: {name: the robot as a process}.
    """

    def __init__(self, seed: int, robots: int) -> None:
        scenario = scenario_of(seed)
        begin, names = DrivenRobot(scenario).pose, [f"robot {n}" for n in range(1, robots + 1)]
        self.robots = {
            name: DrivenRobot(scenario, se2.compose(begin, np.array([0.0, 0.0, n * math.pi])))
            for n, name in enumerate(names)
        }
        self.processes = {name: RobotProcess(robot) for name, robot in self.robots.items()}

    @property
    def is_over(self) -> bool:
        """Whether all have reported their ends."""
        return all(process.outcome is not None for process in self.processes.values())


class _ExplorerLog(DrivenLog):
    """The measurements of a robot until all have reported their ends."""

    def __init__(self, exploration: _ExploringTeam, name: str) -> None:
        super().__init__(name, exploration.robots[name], _TIME)
        self._exploration = exploration

    def records(self) -> Iterator[LogRecord]:
        """All measurements from now on."""
        for record in super().records():
            if self._exploration.is_over:
                return
            yield record


def explore_together(changes: tuple[str, ...], seed: int, robots: int, has_rendezvous: bool = False) -> TeamExploration:
    """Let some robots explore a building.

    :param has_rendezvous: whether the first two know how they stand at the start.
    """
    configuration = load_configuration(PARAMETERS, ["team.uses_ground=true", *changes])
    exploration, joined = _ExploringTeam(seed, robots), math.inf

    def note(seconds: float, placement: TeamPlacement) -> None:
        nonlocal joined
        if placement.verdict is Verdict.JOINED:
            joined = min(joined, seconds)

    observers: dict[str, dict[str, Process]] = {
        name: {"explorer": Explorer(configuration, robot=name), "robot": process}
        for name, process in exploration.processes.items()
    }
    logs = {name: _ExplorerLog(exploration, name) for name in exploration.robots}
    run = TeamRun(configuration, logs, note, observers=observers)
    for own in run.runs.values():
        own.lock_step.feed(Task("explore"))
    if has_rendezvous:
        for team in run.teams.values():
            team.handle(_rendezvous_at_start(exploration))
    run.run()
    rooms, found = exploration.robots["robot 1"].scenario.building.rooms, list(exploration.robots.values())
    paths = [robot.true_poses(np.arange(START, robot.stamp, NANOSECONDS // 5))[:, :2] for robot in found]
    # Five positions a second.
    later = [path[min(len(path), int(5.0 * min(joined, _TIME))) :] for path in paths]
    return TeamExploration(
        seed,
        robots,
        has_rendezvous,
        max(robot.stamp - START for robot in found) / NANOSECONDS if exploration.is_over else math.inf,
        joined,
        sum(robot.distance_traveled for robot in found),
        sum(any(is_within(room, path) for path in paths) for room in rooms),
        len(rooms),
        sum(sum(is_within(room, path) for path in later if len(path)) > 1 for room in rooms),
        sum(robot.contacts for robot in found),
    )


def _rendezvous_at_start(exploration: _ExploringTeam) -> TeamRendezvous:
    """How the first two robots stand, by whoever put them there."""
    (name, first), (other, second), *_ = exploration.robots.items()
    stamp = START + round(_RENDEZVOUS_TIME * NANOSECONDS)
    return TeamRendezvous(
        name, stamp, other, stamp, PoseGaussian(se2.between(first.pose, second.pose), _RENDEZVOUS_COVARIANCE)
    )


def measure_team_exploration(settings: Settings) -> Report:
    """Explore institutes by one robot, and by two."""
    seeds = chosen_seeds(settings, SEEDS)
    cases = [(seed, *case) for seed in seeds for case in ((1, False), (2, False), (2, True))]
    with ProcessPoolExecutor(settings.runner.jobs, multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(partial(explore_together, tuple(settings.changes)), *zip(*cases, strict=True)))
    report = Report("team_exploration", "Exploration by a team", seeds=seeds)
    report.requirements = requirements(found)
    report.body = [table_of(_COLUMNS, found), POLICY]
    report.data["explorations"] = [asdict(exploration) for exploration in found]
    return report


def requirements(found: list[TeamExploration]) -> list[Requirement]:
    """Requirements on the time of two, and on what they explored."""
    together = [each for each in found if each.robots == 2]
    entered = sum(each.entered for each in together) / sum(each.rooms for each in together)
    return [
        Requirement("time of two explorers, as a share of one's", _share_of_one(found, False), SHARE),
        Requirement("the same with a rendezvous at the start", _share_of_one(found, True), SHARE),
        Requirement("rooms entered by two", entered, 1.0, least=0.98),
        Requirement("rooms that both entered after they were joined", float(sum(e.in_both for e in together)), 0.0),
        Requirement("contacts", float(sum(each.contacts for each in found)), 0.0),
    ]


def _share_of_one(found: list[TeamExploration], has_rendezvous: bool) -> float:
    """Time of two, as a share of that of one, on average."""
    alone = {each.seed: each.seconds for each in found if each.robots == 1}
    together = [each for each in found if each.robots == 2 and each.has_rendezvous == has_rendezvous]
    return mean([each.seconds / alone[each.seed] for each in together])


_COLUMNS: Columns[TeamExploration] = [
    ("building", lambda row: str(row.seed)),
    ("robots", lambda row: str(row.robots)),
    ("rendezvous", lambda row: "yes" if row.has_rendezvous else "no"),
    ("time [s]", lambda row: f"{row.seconds:.0f}"),
    ("joined after [s]", lambda row: f"{row.joined:.0f}"),
    ("distance of all [m]", lambda row: f"{row.distance:.0f}"),
    ("rooms entered", lambda row: f"{row.entered} of {row.rooms}"),
    ("in both", lambda row: str(row.in_both)),
    ("contacts", lambda row: str(row.contacts)),
]
