"""Marks with names: error, closures and the path until the first one, with and without marks, some of them wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from benchmark.accepted_closures import RELATIONS, EventWatch, judge_closure
from benchmark.awakening import path_lengths
from benchmark.logs import MeasuredLog, open_logs
from benchmark.loops import false_closures, loops_to_close
from benchmark.outcomes import map_shared
from benchmark.recorded_drive import follow, odometry_at_scans
from benchmark.relation_chains import RelationChains
from benchmark.report import Columns, Report, Requirement, table_of
from benchmark.runs import PARAMETERS
from benchmark.scoring import score_trajectory
from benchmark.settings import Settings, chosen_families, chosen_seeds
from benchmark.simulated.watch import observe_world
from benchmark.simulated.worlds import FAMILIES, World
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.evaluation import Relations, StampedPoses
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.final_map import deskewed_scans, final_map
from hmt_slam_ros.sensors import MarkObservation

COUNTS = (0, 3, 10)
"""Marks of a world or a log."""

WRONG_SHARE = 0.1
"""Share of the passes of a mark that have the name of another one."""

LOG = "aces"
WORLDS = ("office", "grid", "hall", "twins")
SEEDS = 4

RETURN, CLOSE = 60 * 10**9, 1.5
"""Time, ns, and distance, m, between the two passes of a mark of a log."""

DEVIATIONS = np.array([0.03, 0.03, math.radians(1.0)])
"""Deviations of an observation along the robot's axes, m, m and rad."""

POLICY = (
    "Marks are on the ceiling, evenly along the first lap of a simulated drive, and seen within 1.5 m. Of the passes "
    f"of one {100 * WRONG_SHARE:g} % have the name of another. On the log a mark is where the robot was at one end of "
    f"a true relation over more than {RETURN / 1e9:g} s and less than {CLOSE:g} m. It is seen at both ends, with the "
    f"name of another mark in {100 * WRONG_SHARE:g} % of these observations. The relations are drawn, spread evenly "
    "over the log. Each observation has a noise of 3 cm and 1 degree. Loops and closures of simulated drives are "
    "those of loops. The path is that from the begin of a loop until it is closed, of the loops that are closed with "
    "any number of marks. On the log closures are judged by chains of relations, as for recorded, and the first "
    "closure is the path until the first right one is accepted."
)


@dataclass(frozen=True)
class LogOutcome:
    """A run of a recorded log.

    :ivar marks: number of marks.
    :ivar seed: of the run, and of the marks.
    :ivar wrong: number of observations with a wrong name.
    :ivar error: mean error at all relations, m.
    :ivar long_error: the same at those over more than 60 s.
    :ivar worst_error: the largest of these.
    :ivar closures: number of accepted ones that relations judge.
    :ivar false: number of these that are false.
    :ivar first: path until the first right one, m; infinite without one.
    """

    marks: int
    seed: int
    wrong: int
    error: float
    long_error: float
    worst_error: float
    closures: int
    false: int
    first: float


class LogCase(NamedTuple):
    """A number of marks, and a seed."""

    marks: int
    seed: int


@dataclass(frozen=True, eq=False)
class MarkedLog:
    """A log with its records.

    :ivar log: with true relations.
    :ivar records: without marks.
    :ivar settings: parameters that differ from the file.
    """

    log: MeasuredLog
    records: Sequence[LogRecord]
    settings: tuple[str, ...]


def measure_marks(settings: Settings) -> Report:
    """Map worlds and a log with no, few and more marks."""
    report = Report("marks", "Marks with names", seeds=chosen_seeds(settings, SEEDS))
    names = settings.logs_or((*WORLDS, LOG))
    outcomes: list[LogOutcome] = []
    if LOG in names:
        outcomes = _map_log(settings)
        report.body.append(table_of(_LOG_COLUMNS, [(n, _with_marks(outcomes, n)) for n in COUNTS]))
        report.data["log"] = [asdict(outcome) for outcome in outcomes]
    records = _map_worlds(settings, tuple(name for name in names if name != LOG))
    if records:
        report.body.append(table_of(_WORLD_COLUMNS, list(_world_rows(records))))
        report.data["worlds"] = {f"{n}": [_facts(record) for record in own] for n, own in records.items()}
    wrong = sum(outcome.false for outcome in outcomes)
    wrong += sum(len(false_closures(own)) for own in records.values())
    report.requirements.append(Requirement("closures accepted falsely", wrong, 0))
    report.body.append(POLICY)
    return report


def _map_log(settings: Settings) -> list[LogOutcome]:
    cases = [LogCase(marks, seed) for marks in COUNTS for seed in settings.seeds_or(SEEDS)]
    with open_logs([LOG]) as (log,):
        marked = MarkedLog(log, list(open_log(log.path).records()), settings.changes)
        return list(map_shared(map_with_marks, marked, cases, settings.runner.jobs))


def map_with_marks(marked: MarkedLog, case: LogCase) -> LogOutcome:
    """Map a log with some marks."""
    configuration = load_configuration(PARAMETERS, list(marked.settings), case.seed)
    assert marked.log.relations is not None
    marks = draw_marks(marked.log.relations, case)
    records = list(insert_marks(marked.records, marks))
    run, watch = LockStepRun(configuration), EventWatch()
    follow(run, records, watch)
    trajectory, stamps, source_stamps = _final_trajectory(run, marked.log, configuration)
    scores = score_trajectory(StampedPoses(source_stamps, trajectory), marked.log)
    numbers = {int(stamp): n for n, stamp in enumerate(stamps)}
    chains = RelationChains(marked.log.relations, source_stamps, trajectory)
    judged = [judge_closure(closure, numbers, chains, trajectory) for closure in watch.accepted]
    judged = [closure for closure in judged if closure["by"] == RELATIONS]
    travel = list(path_lengths(odometry_at_scans(marked.records)))
    long = scores.over_60_s.translation
    return LogOutcome(
        case.marks,
        case.seed,
        sum(mark.is_wrong for mark in marks),
        scores.overall.translation.mean,
        long.mean,
        long.max,
        len(judged),
        sum(not closure["right"] for closure in judged),
        min((travel[closure["scan"]] for closure in judged if closure["right"]), default=math.inf),
    )


def _final_trajectory(run: LockStepRun, log: MeasuredLog, configuration: Configuration) -> tuple[Float64, Any, Any]:
    """The poses of all scans in the final map, their stamps, and the log's own, ns."""
    result = run.finish()
    stamps = result.log_progress.stamps
    recording = result.recorder.finish(stamps)
    found = final_map(recording, lambda: deskewed_scans(open_log(log.path), configuration), configuration)
    return found.recording.trajectory, stamps, result.log_progress.source_stamps


class SeenMark(NamedTuple):
    """An observation of a mark.

    :ivar source_stamp: on the log's own clock, ns.
    :ivar name: as it is read.
    :ivar pose: ``mark_T_base``, shape (3,).
    :ivar is_wrong: whether the name is that of another mark.
    """

    source_stamp: int
    name: str
    pose: Float64
    is_wrong: bool


def draw_marks(relations: Relations, case: LogCase) -> list[SeenMark]:
    """The observations of some marks, in the order of time."""
    draw = np.random.Generator(np.random.Philox(key=[case.seed, case.marks]))
    span, apart = np.abs(relations.ends - relations.starts), np.hypot(*relations.poses[:, :2].T)
    usable = np.flatnonzero((span > RETURN) & (apart < CLOSE))
    usable = usable[np.argsort(np.maximum(relations.starts, relations.ends)[usable], kind="stable")]
    bins = np.array_split(usable, case.marks) if case.marks else []
    seen: list[SeenMark] = []
    for mark, chosen in enumerate(int(draw.choice(own)) for own in bins if len(own)):
        ends = [(int(relations.starts[chosen]), np.zeros(3)), (int(relations.ends[chosen]), relations.poses[chosen])]
        for stamp, pose in ends:
            is_wrong = bool(draw.random() < WRONG_SHARE) and case.marks > 1
            read = (mark + int(draw.integers(1, case.marks))) % case.marks if is_wrong else mark
            measured = se2.compose(pose, se2.exp(draw.normal(0.0, DEVIATIONS)))
            seen.append(SeenMark(stamp, f"mark {read}", measured, is_wrong))
    return sorted(seen, key=lambda one: one.source_stamp)


def insert_marks(records: Sequence[LogRecord], marks: Sequence[SeenMark]) -> Iterator[LogRecord]:
    """The records of a log with observations of marks, each before the first record that is later."""
    waiting = list(reversed(marks))
    for record in records:
        while waiting and waiting[-1].source_stamp <= record.source_stamp:
            one = waiting.pop()
            stamp = one.source_stamp + record.measurement.stamp - record.source_stamp
            belief = PoseGaussian(one.pose, np.diag(DEVIATIONS**2))
            yield LogRecord(one.source_stamp, MarkObservation(stamp, one.name, belief))
        yield record


_Worlds = dict[int, list[dict[str, Any]]]


def _map_worlds(settings: Settings, names: tuple[str, ...]) -> _Worlds:
    """{number of marks: records of the worlds}."""
    if not names:
        return {}
    families = [name for name in chosen_families(settings, WORLDS, (*FAMILIES, LOG)) if name != LOG]
    cases = [
        World(family, seed, f"marks={marks},wrong_marks={WRONG_SHARE if marks else 0.0}")
        for marks in COUNTS
        for family in families
        for seed in chosen_seeds(settings, SEEDS)
    ]
    found = list(map_shared(_observe, settings.changes, cases, settings.runner.jobs))
    size = len(found) // len(COUNTS)
    return {marks: found[n * size : (n + 1) * size] for n, marks in enumerate(COUNTS)}


def _observe(changes: tuple[str, ...], world: World) -> dict[str, Any]:
    return observe_world(world, changes)


def _with_marks(outcomes: Sequence[LogOutcome], marks: int) -> list[LogOutcome]:
    return [outcome for outcome in outcomes if outcome.marks == marks]


def _median(values: Sequence[float]) -> str:
    return f"{np.median(values):.1f}" if len(values) else "-"


_LOG_COLUMNS: Columns[tuple[int, list[LogOutcome]]] = [
    (f"marks, {LOG}", lambda row: str(row[0])),
    ("runs", lambda row: str(len(row[1]))),
    ("observations with a wrong name", lambda row: str(sum(one.wrong for one in row[1]))),
    ("error, mean [m]", lambda row: f"{np.mean([one.error for one in row[1]]):.4f}"),
    ("over 60 s [m]", lambda row: f"{np.mean([one.long_error for one in row[1]]):.4f}"),
    ("its max [m]", lambda row: f"{max(one.worst_error for one in row[1]):.2f}"),
    ("first closure, median [m]", lambda row: _median([one.first for one in row[1]])),
    ("closures", lambda row: str(sum(one.closures for one in row[1]))),
    ("of them false", lambda row: str(sum(one.false for one in row[1]))),
]


class WorldRow(NamedTuple):
    """The worlds of a family with some marks.

    :ivar common: (seed, number of a loop) of those that are closed with any number of marks.
    """

    family: str
    marks: int
    records: list[dict[str, Any]]
    common: set[tuple[int, int]]


def _closing_paths(record: dict[str, Any]) -> dict[tuple[int, int], float]:
    """{(seed, number of a loop): path until it was closed, m}, of those that can be closed."""
    return {
        (record["seed"], number): loop["closed_at"] - loop["begin"]
        for number, loop in enumerate(record["loops"])
        if loop["can_be_closed"] and loop["closed_at"] is not None
    }


def _world_rows(records: _Worlds) -> Iterator[WorldRow]:
    for family in FAMILIES:
        own = {n: [record for record in found if record["family"] == family] for n, found in records.items()}
        if any(own.values()):
            closed = [{key for record in found for key in _closing_paths(record)} for found in own.values()]
            for n, found in own.items():
                yield WorldRow(family, n, found, set.intersection(*closed))


def _common_paths(row: WorldRow) -> list[float]:
    paths = {key: path for record in row.records for key, path in _closing_paths(record).items()}
    return [path for key, path in paths.items() if key in row.common]


def _map_error(row: WorldRow) -> float:
    return float(np.mean([error["translation"] for record in row.records for error in record["area_poses"]]))


_WORLD_COLUMNS: Columns[WorldRow] = [
    ("family", lambda row: row.family),
    ("marks", lambda row: str(row.marks)),
    ("runs", lambda row: str(len(row.records))),
    ("error of areas, mean [m]", lambda row: f"{_map_error(row):.3f}"),
    ("loops to close", lambda row: str(len(loops_to_close(row.records)))),
    ("closed", lambda row: str(sum(len(_closing_paths(record)) for record in row.records))),
    ("path until then, median [m]", lambda row: _median(_common_paths(row))),
    ("mean [m]", lambda row: f"{np.mean(_common_paths(row)):.1f}" if row.common else "-"),
    ("closures accepted", lambda row: str(sum(len(record["accepted"]) for record in row.records))),
    ("of them false", lambda row: str(len(false_closures(row.records)))),
]


def _facts(record: dict[str, Any]) -> dict[str, Any]:
    return {name: record[name] for name in ("world", "accepted", "loops", "area_poses", "cpu_s")}
