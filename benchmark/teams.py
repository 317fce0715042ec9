"""Teams of robots that map at once, from unknown starts: joins, right and wrong, and the path until then."""

from __future__ import annotations

import math
import multiprocessing
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark import tail
from benchmark.logs import LOGS, open_logs
from benchmark.placement_truth import COMMON, MIN_OVERLAP, are_right, distances_between, window_errors
from benchmark.report import Columns, Report, Requirement, mean, table_of
from benchmark.runs import PARAMETERS, Case
from benchmark.settings import Settings, chosen_seeds
from benchmark.simulated.worlds import FAMILIES, World
from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.evaluation import StampedPoses, read_true_poses, read_tum
from hmt_slam_ros.logs.records import Log
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.team import TeamPlacement, Verdict
from hmt_slam_ros.offline.lock_step import RunResult
from hmt_slam_ros.offline.team_run import TeamRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.team.team import Team

RECORDED = ("aces", "intel", "csail", "hospital")
WORLDS = ("office", "busy", "nested", "grid", "ring", "straight", "hall", "twins")
SEEDS = 5

SIZES = (2, 3, 4, 5, 6)
"""Robots of a simulated team, in turn for the seeds."""

CUTS = (0.3, 0.45, 0.6, 0.75)
"""Where recorded logs are cut, as shares of their time."""

_STEP = 0.2
"""Distance of the positions between which ground is common, m."""

POLICY = (
    "All robots of a team drive at once, in lock-step. A recorded log is cut in two. In a simulated world each robot "
    "drives one lap of the same route; they begin equally far apart on it. *Overlap* is the path of both robots of a "
    f"pair on ground where the other has been before, or was later; from {MIN_OVERLAP:g} m on a join is due. A join is "
    "right if most of its windows are within 1 m and 15 degrees of the truth: the true pose of the simulation, or the "
    "run over the whole log. The path until the join is that of the robots of a pair, on average, since the first of "
    "them was on the other's ground. Answers are those of the first robot of a pair; one counts where the third "
    "digit of its probability is new."
)


@dataclass(frozen=True)
class PairOutcome:
    """What two robots of a team found.

    :ivar family: of the world, or the log.
    :ivar name: of the pair.
    :ivar overlap: path of both on common ground, m.
    :ivar is_joined: whether they are joined at the end.
    :ivar false_joins: answers that joined them wrongly.
    :ivar path: until the first right join, m; inf without.
    :ivar answers: (probability of the best placement, whether it is right) of all answers.
    :ivar share: computing time of a robot's process, as a share of its duration.
    :ivar sent: by one of them, as documents, bytes per meter of its path.
    :ivar keyframes: number of those of its own ground that a robot has at the end, on average.
    """

    family: str
    name: str
    overlap: float
    is_joined: bool
    false_joins: int
    path: float
    answers: tuple[tuple[float, bool], ...]
    share: float
    sent: float
    keyframes: float

    @property
    def is_due(self) -> bool:
        """Whether they have enough common ground to be joined."""
        return self.overlap >= MIN_OVERLAP


@dataclass(frozen=True)
class _TeamDrive:
    """A drive, the parts of it that robots drive, as shares of its time, and the truth if it is not that of the log."""

    family: str
    name: str
    path: Path | str
    parts: tuple[tuple[float, float], ...]
    truth: StampedPoses | None


def measure_team(settings: Settings) -> Report:
    """Drive the parts of all logs at once."""
    names, seeds = settings.logs_or((*WORLDS, *RECORDED)), chosen_seeds(settings, SEEDS)
    report = Report("team", "Teams of robots without known starts", seeds=seeds)
    with open_logs([name for name in names if name in LOGS]) as logs:
        drives = []
        for log in logs:
            whole = settings.runner.runs([Case(log, 0, changes=settings.changes)])[0]
            truth = read_tum(whole.folder / "trajectory.tum")
            drives += [
                _TeamDrive(log.name, f"{log.name} at {cut:g}", log.path, ((0.0, cut), (cut, 1.0)), truth)
                for cut in CUTS
            ]
        for family in (name for name in names if name in FAMILIES):
            for n, seed in enumerate(seeds):
                size, world = SIZES[n % len(SIZES)], World(family, seed)
                drives.append(_TeamDrive(family, f"{world.name}, {size} robots", *_laps(world, size), None))
        with ProcessPoolExecutor(settings.runner.jobs, multiprocessing.get_context("spawn")) as pool:
            found = [pair for pairs in pool.map(partial(_drive_at_once, settings.changes), drives) for pair in pairs]
    report.requirements = requirements(found)
    report.body = [team_table(found), POLICY, tail.tail_table({"best placements": _answers(found)}), tail.POLICY]
    report.data["pairs"] = [asdict(pair) for pair in found]
    return report


def _laps(world: World, size: int) -> tuple[str, tuple[tuple[float, float], ...]]:
    """Two laps of a world, and the lap of each of so many robots: all begin equally far apart."""
    name = re.sub(",laps=[0-9]+", "", world.log) + ",laps=2"
    return name, tuple((0.5 * n / size, 0.5 * n / size + 0.5) for n in range(size))


def _drive_at_once(changes: Sequence[str], drive: _TeamDrive) -> list[PairOutcome]:
    """Run a team over the parts of a drive."""
    configuration = load_configuration(PARAMETERS, list(changes))
    whole = open_log(drive.path)
    logs = {
        f"robot {n}": open_log(drive.path, start=a * whole.duration, duration=(b - a) * whole.duration)
        for n, (a, b) in enumerate(drive.parts, 1)
    }
    truth = drive.truth or read_true_poses(whole)
    answers: list[tuple[float, TeamPlacement, bool]] = []

    def note(seconds: float, placement: TeamPlacement) -> None:
        if placement.robot == placement.first:
            meeting = run.teams[placement.first].meetings[placement.second]
            best = meeting.distribution.best
            is_right = best is not None and are_right(window_errors(meeting, best, truth, truth))
            answers.append((seconds, placement, is_right))

    sent: Counter[str] = Counter()
    run = TeamRun(configuration, logs, note, lambda robot, message: sent.update({robot: len(encode(message))}))
    results = run.run()
    tracks = {name: _Track.of_log(log, truth) for name, log in logs.items()}
    costs = {
        name: _Cost.of_robot(result, tracks[name], sent[name], _own_keyframes(run.teams[name]))
        for name, result in results.items()
    }
    outcomes = []
    for first, second in combinations(logs, 2):
        own = [each for each in answers if (each[1].first, each[1].second) == (first, second)]
        name, cost = f"{drive.name}, {first} and {second}", _Cost.of_both(costs[first], costs[second])
        outcomes.append(_outcome(drive.family, name, tracks[first], tracks[second], own, cost))
    return outcomes


class _Cost(NamedTuple):
    """What a robot of a team computes, sends and stores: see :class:`PairOutcome`."""

    share: float
    sent: float
    keyframes: float

    @classmethod
    def of_robot(cls, result: RunResult, track: _Track, sent: int, keyframes: int) -> _Cost:
        computed = float(result.seconds_per_scan["team"].sum())
        return cls(computed / float(track.seconds[-1]), sent / float(track.lengths[-1]), keyframes)

    @classmethod
    def of_both(cls, one: _Cost, other: _Cost) -> _Cost:
        return cls(*(0.5 * (a + b) for a, b in zip(one, other, strict=True)))


def _own_keyframes(team: Team) -> int:
    return sum(keyframe >= 0 for keyframe in Replica.from_state(team.state.replica).scans)


@dataclass(frozen=True, eq=False)
class _Track:
    """Where a robot truly was.

    :ivar seconds: shape (n,), since its first scan.
    :ivar positions: shape (n, 2), m.
    :ivar lengths: shape (n,), of its path until then, m.
    """

    seconds: Float64
    positions: Float64
    lengths: Float64

    @classmethod
    def of_log(cls, log: Log, truth: StampedPoses) -> _Track:
        """The track of a part of a log."""
        scans = [r.measurement for r in log.records() if isinstance(r.measurement, Scan)]
        stamps = np.array([scan.stamp for scan in scans])
        positions = truth.poses[truth.nearest_indices(stamps)][:, :2]
        lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(positions, axis=0).T))))
        kept = np.unique(
            np.searchsorted(lengths, np.arange(0.0, lengths[-1] + _STEP, _STEP)).clip(max=len(lengths) - 1)
        )
        return cls(1e-9 * (stamps[kept] - stamps[0]), positions[kept], lengths[kept])

    def length_at(self, seconds: float) -> float:
        """Path until a time, m."""
        return float(np.interp(seconds, self.seconds, self.lengths))

    def length_where(self, flags: Bool) -> float:
        """Length of the path to positions with a flag, m.

        :param flags: shape (n,).
        """
        return float(np.diff(self.lengths)[flags[1:]].sum())


def _outcome(
    family: str,
    name: str,
    first: _Track,
    second: _Track,
    answers: Sequence[tuple[float, TeamPlacement, bool]],
    cost: _Cost,
) -> PairOutcome:
    common: Bool = distances_between(first.positions, second.positions) <= COMMON
    overlap = first.length_where(np.any(common, axis=1)) + second.length_where(np.any(common, axis=0))
    joins = [(seconds, right) for seconds, placement, right in answers if placement.verdict is Verdict.JOINED]
    right_join = next((seconds for seconds, right in joins if right), math.inf)
    path = math.inf
    if math.isfinite(right_join):
        # When one of them was first on ground where the other had been.
        met = float(np.where(common, np.maximum(first.seconds[:, None], second.seconds[None]), math.inf).min())
        path = mean([track.length_at(right_join) - track.length_at(min(met, right_join)) for track in (first, second)])
    return PairOutcome(
        family,
        name,
        overlap,
        bool(answers) and answers[-1][1].verdict is Verdict.JOINED,
        sum(not right for _, right in joins),
        path,
        tuple((placement.probability, right) for _, placement, right in answers if placement.probability > 0.0),
        *cost,
    )


def _answers(found: Sequence[PairOutcome]) -> list[tail.Pair]:
    return [answer for pair in found for answer in pair.answers]


def requirements(found: Sequence[PairOutcome]) -> list[Requirement]:
    """Requirements on joins."""
    due = [pair for pair in found if pair.is_due]
    paths = sorted(pair.path for pair in due)
    return [
        Requirement("joined wrongly", sum(pair.false_joins for pair in found), 0.0),
        Requirement("due and joined, share", mean([pair.is_joined for pair in due]), math.inf, least=0.95),
        Requirement("path until the join, median", paths[len(paths) // 2] if paths else math.nan, 10.0, "m"),
        Requirement("in 90 %", paths[int(0.9 * len(paths))] if paths else math.nan, 25.0, "m"),
        Requirement("sent by a robot, most", max((1e-3 * pair.sent for pair in found), default=0.0), 10.0, "kB/m"),
        tail.tail_requirement("best placements", _answers(found)),
    ]


def team_table(found: Sequence[PairOutcome]) -> str:
    """A table with a line for each log or family."""
    groups: Mapping[str, list[PairOutcome]] = {
        family: [pair for pair in found if pair.family == family]
        for family in dict.fromkeys(pair.family for pair in found)
    }
    columns: Columns[tuple[str, list[PairOutcome]]] = [
        ("parts of", lambda row: row[0]),
        ("pairs", lambda row: str(len(row[1]))),
        ("overlap, mean", lambda row: f"{mean([pair.overlap for pair in row[1]]):.0f} m"),
        ("due", lambda row: str(sum(pair.is_due for pair in row[1]))),
        ("of them joined", lambda row: str(sum(pair.is_due and pair.is_joined for pair in row[1]))),
        ("others joined", lambda row: str(sum(not pair.is_due and pair.is_joined for pair in row[1]))),
        ("joined wrongly", lambda row: str(sum(pair.false_joins > 0 for pair in row[1]))),
        ("path until joined, median", lambda row: _median_path(row[1])),
        ("computing time of a robot", lambda row: f"{100.0 * mean([pair.share for pair in row[1]]):.1f} %"),
        ("sent by a robot", lambda row: f"{1e-3 * mean([pair.sent for pair in row[1]]):.1f} kB/m"),
        ("own keyframes of a robot", lambda row: f"{mean([pair.keyframes for pair in row[1]]):.0f}"),
    ]
    return table_of(columns, list(groups.items()))


def _median_path(pairs: Sequence[PairOutcome]) -> str:
    paths = sorted(pair.path for pair in pairs if math.isfinite(pair.path))
    return f"{paths[len(paths) // 2]:.1f} m" if paths else "-"
