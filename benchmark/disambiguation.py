"""Path until a robot is sure of its place, by active disambiguation and without it."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import dropwhile

import numpy as np

from benchmark.driven_run import DrivenRun
from benchmark.kidnapping import draw_drive
from benchmark.open_question import OpenQuestion, QuestionFinder, Verdict, slam_replica
from benchmark.report import Columns, Report, Requirement, table_of
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings, chosen_families, chosen_seeds
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import Configuration, load_configuration, with_changes
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.messages.messages import ClosureDecision
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import Task
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.driven_robot import DrivenLog, DrivenRobot
from hmt_slam_ros.simulation.scenario import START

FAMILIES = ("twins", "ring", "grid", "hall")
CASES = (*FAMILIES, "straight", *(f"{family} kidnapped" for family in FAMILIES))
"""Worlds, and some in which the robot is kidnapped to known ground."""

SEEDS = 10

LIMIT = 60.0
"""Longest path after the question, m."""

_TIME = 400.0  # s, of the simulation

DISAMBIGUATING, EXPLORING, ROUTE = "disambiguating", "exploring", "driving on"

POLICY = (
    "A robot with a laser that sees half a circle drives two laps of a world, or is kidnapped to another part. The "
    "question is the first keyframe event at which a true and a false hypothesis have a probability of 0.2 or more "
    "each. From there the same run goes on in three ways: along the scripted route (driving on), by the explorer "
    "(exploring), and by the explorer with `explorer.disambiguates`. A hypothesis is true if it has the robot's path "
    "of before the question where it is in the ground of before, within 0.5 m and 10 degrees, or on new ground if it "
    "is. A drive ends when true hypotheses, or a false one, have 0.95, or after "
    f"{LIMIT:g} m. The path of one that ends otherwise counts as infinite. Worlds without a question are left out."
)


@dataclass(frozen=True)
class DecidingDrive:
    """The outcome of a drive from a question on.

    :ivar distance: path until the first certainty, m; inf without.
    :ivar verdict: what was certain then.
    :ivar driven: path, m.
    """

    distance: float
    verdict: Verdict
    driven: float

    @property
    def right_distance(self) -> float:
        """Path until the true hypothesis was sure, m; inf where it was not."""
        return self.distance if self.verdict == "right" else math.inf


@dataclass(frozen=True)
class QuestionDrives:
    """The drives from one question.

    :ivar case: name of the worlds.
    :ivar seed: of the world.
    :ivar at: path before the question, m.
    :ivar drives: {way of driving: its outcome}.
    """

    case: str
    seed: int
    at: float
    drives: dict[str, DecidingDrive]


def log_names(case: str, seed: int) -> tuple[str, str]:
    """The names of the scripted drive, and of the same world without a kidnapping."""
    family, _, kidnapped = case.partition(" ")
    given = dict(setting.split("=") for setting in World(family, seed).log.split(",")[1:])
    given |= {"laps": "2"}
    world = ",".join([f"sim:{family}", *("=".join(setting) for setting in given.items())])
    if not kidnapped:
        return world, world
    settings = draw_drive(family, "known", seed).split(",")
    return ",".join([world, *(each for each in settings if each.startswith(("carried=", "to=", "turned=")))]), world


def find_question_drives(case: tuple[str, int], changes: Sequence[str] = ()) -> QuestionDrives | None:
    """The drives from the first question of a drive, None where it has none.

    :param case: name of the worlds, and the seed.
    """
    name, world = log_names(*case)
    log, configuration = open_simulated(name), load_configuration(PARAMETERS, list(changes))
    finder, records = QuestionFinder(configuration, log), log.records()
    question = next((found for record in records if (found := finder.process(record)) is not None), None)
    if question is None:
        return None
    drives = {
        way: _explore(world, question, with_changes(configuration, {"explorer.disambiguates": way == DISAMBIGUATING}))
        for way in (DISAMBIGUATING, EXPLORING)
    }
    drives[ROUTE] = _drive_on(finder, question, records)
    return QuestionDrives(*case, question.at, drives)


def _drive_on(finder: QuestionFinder, question: OpenQuestion, records: Iterator[LogRecord]) -> DecidingDrive:
    """Drive on along the scripted route."""
    driven, last, events = 0.0, question.pose, question.event + 1
    for record in records:
        finder.run.process_record(record)
        assert record.true_pose is not None
        driven, last = driven + math.dist(record.true_pose[:2], last[:2]), record.true_pose
        if len(finder.run.recorder.keyframes) > events:
            events = len(finder.run.recorder.keyframes)
            verdict = question.truth.verdict(finder.replica)
            if verdict != "open":
                return DecidingDrive(driven, verdict, driven)
        if driven >= LIMIT:
            break
    return DecidingDrive(math.inf, "open", driven)


def _explore(world: str, question: OpenQuestion, configuration: Configuration) -> DecidingDrive:
    """Let the explorer drive, from the state of the run at the question."""
    robot = DrivenRobot(open_simulated(world).scenario, question.pose)
    explorer = Explorer(configuration, Replica.from_state(deepcopy(question.state.processes["tlca"].replica)))
    explorer.handle(ClosureDecision(question.event))
    if question.ambiguity is not None:
        explorer.handle(question.ambiguity)
    # A run changes arrays of the state from which it starts.
    state = deepcopy(question.state)
    run = DrivenRun(robot, configuration, explorer, state, continued_records(robot, question))
    distance = 0.0
    for _ in run.drive(Task("explore"), _TIME):
        if robot.distance_traveled > distance:
            distance = robot.distance_traveled
            verdict = question.truth.verdict(slam_replica(run.processes))
            if verdict != "open":
                return DecidingDrive(distance, verdict, distance)
        if distance >= LIMIT or run.outcome is not None:
            break
    return DecidingDrive(math.inf, "open", distance)


def continued_records(robot: DrivenRobot, question: OpenQuestion) -> Iterator[LogRecord]:
    """The measurements of a robot after the last record of a question, with its stamps and odometry continued."""
    later = question.stamp - START
    for record in dropwhile(lambda each: each.source_stamp <= START, DrivenLog("driven", robot).records()):
        measurement, stamp = record.measurement, record.source_stamp + later
        if isinstance(measurement, Odometry):
            measurement = Odometry(stamp, se2.compose(question.odometry, measurement.pose))
        else:
            measurement = replace(measurement, stamp=stamp)
        yield LogRecord(stamp, measurement, record.true_pose)


def measure_disambiguation(settings: Settings) -> Report:
    """Drive on from the questions of all worlds, in three ways."""
    cases = chosen_families(settings, CASES)
    seeds = chosen_seeds(settings, SEEDS)
    worlds = [(case, seed) for case in cases for seed in seeds]
    with ProcessPoolExecutor(settings.runner.jobs, multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(partial(find_question_drives, changes=settings.changes), worlds))
    answers = [answer for answer in found if answer is not None]
    report = Report("disambiguation", "Path until the place is sure", seeds=seeds)
    report.requirements = requirements(answers)
    rows = [
        (case, way, [answer.drives[way] for answer in answers if case in ("all", answer.case)])
        for case in (*cases, "all")
        for way in (DISAMBIGUATING, EXPLORING, ROUTE)
    ]
    report.body = [table_of(_COLUMNS, [row for row in rows if row[2]]), POLICY]
    report.data["answers"] = [asdict(answer) for answer in answers]
    return report


def requirements(answers: Sequence[QuestionDrives]) -> list[Requirement]:
    """Requirements on the path, and on certainty of false hypotheses."""
    by_looks, by_route = ([answer.drives[way] for answer in answers] for way in (DISAMBIGUATING, ROUTE))
    false = float(np.mean([drive.verdict == "wrong" for drive in by_route])) if by_route else 0.0
    return [
        Requirement("path until sure, median", median(by_looks), median(by_route), "m"),
        Requirement("sure of a false hypothesis, share", _share(by_looks, "wrong"), false),
    ]


def median(drives: Sequence[DecidingDrive]) -> float:
    """Median of the path until the true hypothesis was sure, m; inf where it was not in half of the drives."""
    return quantile(drives, 0.5)


def quantile(drives: Sequence[DecidingDrive], share: float) -> float:
    """The smallest path within which the true hypothesis was sure in a share of the drives, m; NaN for no drives."""
    lengths = sorted(drive.right_distance for drive in drives)
    return lengths[max(0, math.ceil(share * len(lengths)) - 1)] if lengths else math.nan


def _share(drives: Sequence[DecidingDrive], verdict: Verdict) -> float:
    return float(np.mean([drive.verdict == verdict for drive in drives])) if drives else math.nan


_Row = tuple[str, str, Sequence[DecidingDrive]]

_COLUMNS: Columns[_Row] = [
    ("world", lambda row: row[0]),
    ("way", lambda row: row[1]),
    ("questions", lambda row: str(len(row[2]))),
    ("m until sure, median", lambda row: f"{quantile(row[2], 0.5):.1f}"),
    ("in 90 %", lambda row: f"{quantile(row[2], 0.9):.1f}"),
    (f"never within {LIMIT:g} m", lambda row: f"{_share(row[2], 'open'):.2f}"),
    ("sure of a false one", lambda row: f"{_share(row[2], 'wrong'):.2f}"),
]
