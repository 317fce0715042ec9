"""Maps of halves of a drive, made apart and merged: joined where they are, joined elsewhere, or not joined."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmark.grid_programs import (
    FAILED,
    JOINS,
    PROGRAM_POLICY,
    ProgramOutcome,
    chosen_programs,
    judge_answer,
    place_grids,
)
from benchmark.logs import LOGS, MeasuredLog, open_logs
from benchmark.placement_truth import (
    COMMON,
    MIN_OVERLAP,
    RIGHT,
    RIGHT_ANGLE,
    KeyframePoses,
    are_right,
    on_common_ground,
    window_errors,
)
from benchmark.report import Columns, Report, Requirement, mean, table_of
from benchmark.runs import Case, Run
from benchmark.settings import Settings, chosen_seeds
from benchmark.simulated.worlds import FAMILIES, World
from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.evaluation import StampedPoses, read_true_poses, read_tum
from hmt_slam_ros.messages.team import Verdict
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.merged_map import RobotMap, read_team
from hmt_slam_ros.team.components import Component
from hmt_slam_ros.team.join import meet

RECORDED = ("aces", "intel", "csail")
WORLDS = ("office", "nested", "grid", "ring", "hall", "twins")
SEEDS = 3

CUTS = (1.0 / 3.0, 0.5, 2.0 / 3.0)
"""Where recorded logs are cut, as shares of their time; simulated ones are cut between their laps."""

POLICY = (
    "A log is cut in two. Each part is mapped by itself, and the second map is merged into the first one. A placement "
    f"is right if most of its windows are within {RIGHT:g} m and {math.degrees(RIGHT_ANGLE):.0f} degrees of the "
    "truth: the true pose of the simulation, or the run over the whole log. *Foreign* pairs are the first half of a "
    "drive and the second half of the next seed's, or of the next log: joined is wrong there. *Common* is the share of "
    f"the second part's keyframes within {COMMON:g} m of one of the first. Error: mean distance of windows from the "
    "truth."
)


@dataclass(frozen=True)
class Merged:
    """The outcome of two maps.

    :ivar family: of the world, or the log.
    :ivar name: of the pair.
    :ivar is_foreign: whether the two are of different buildings.
    :ivar common: share of the second's keyframes on ground of the first.
    :ivar overlap: path of the second on ground of the first, m.
    :ivar verdict: one of ``Verdict``.
    :ivar probability: of the best placement; ``apart`` that of none.
    :ivar is_right: whether the best placement is.
    :ivar windows: number of windows, and ``agreeing`` of those that agree on the best placement.
    :ivar error: mean distance of the windows of the best placement from the truth, m.
    :ivar programs: what external programs made of the grids of the two maps.
    """

    family: str
    name: str
    is_foreign: bool
    common: float
    overlap: float
    verdict: str
    probability: float
    apart: float
    is_right: bool
    windows: int
    agreeing: int
    error: float
    programs: tuple[ProgramOutcome, ...] = ()

    @property
    def is_joined(self) -> bool:
        """Whether the two became one map."""
        return self.verdict == Verdict.JOINED

    @property
    def is_due(self) -> bool:
        """Whether they have enough common ground to be joined."""
        return self.overlap >= MIN_OVERLAP

    @property
    def outcome(self) -> str:
        """Of ``JOINS``."""
        if not self.is_joined:
            return "none"
        return "wrong" if self.is_foreign or not self.is_right else "right"


@dataclass(frozen=True, eq=False)
class MappedHalf:
    """A part of a log: its name, its map and the true poses of the whole log."""

    family: str
    name: str
    folder: Path
    truth: StampedPoses

    def keyframe_poses(self, component: Component) -> KeyframePoses:
        """The poses of the keyframes of a piece of its map."""
        return KeyframePoses.of_scans(component.scans, read_tum(self.folder / "trajectory.tum"), self.truth)


def measure_merge(settings: Settings) -> Report:
    """Map the parts of every log, merge them, and compare the placements with the truth."""
    names = settings.logs_or((*WORLDS, *RECORDED))
    seeds, programs, configuration = chosen_seeds(settings, SEEDS), chosen_programs(), settings.configuration
    report = Report("merge", "Maps merged without a common frame", seeds=seeds)
    found: list[Merged] = []
    with open_logs([name for name in names if name in LOGS]) as logs:
        halves = [_recorded_halves(settings, log) for log in logs]
        worlds = [World(family, seed) for family in names if family in FAMILIES for seed in seeds]
        halves += [_simulated_halves(settings, world) for world in worlds]
        for pairs in halves:
            found += [merge_halves(configuration, first, second, programs) for first, second in pairs]
        for one, other in zip(halves, [*halves[1:], *halves[:1]], strict=True):
            if one is not other:
                found.append(merge_halves(configuration, one[0][0], other[0][1], programs, is_foreign=True))
    wrong = sum(each.outcome == "wrong" for each in found)
    report.requirements.append(Requirement("joined wrongly", wrong, 0.0))
    report.body += [merge_table(found), POLICY]
    if programs:
        report.body += [program_table(found, list(programs)), PROGRAM_POLICY, *_program_faults(found)]
    report.data["pairs"] = [asdict(each) for each in found]
    return report


def _recorded_halves(settings: Settings, log: MeasuredLog) -> list[tuple[MappedHalf, MappedHalf]]:
    """The two parts of a recorded log at every cut."""
    whole = Case(log, 0, changes=settings.changes)
    duration = open_log(log.path).duration
    cases = [whole]
    for cut in CUTS:
        cases.append(Case(log, 0, changes=settings.changes, duration=cut * duration))
        cases.append(Case(log, 0, changes=settings.changes, start=cut * duration))
    of_whole, *parts = settings.runner.runs(cases)
    truth = read_tum(of_whole.folder / "trajectory.tum")
    return [
        _pair_of(log.name, f"{log.name} at {cut:.2f}", parts[2 * n : 2 * n + 2], truth) for n, cut in enumerate(CUTS)
    ]


def _simulated_halves(settings: Settings, world: World) -> list[tuple[MappedHalf, MappedHalf]]:
    """The two laps of a drive."""
    log, simulated = MeasuredLog(world.name, Path(world.log)), open_log(world.log)
    half = 0.5 * simulated.duration
    cases = [
        Case(log, world.seed, changes=settings.changes, duration=half),
        Case(log, world.seed, changes=settings.changes, start=half),
    ]
    return [_pair_of(world.family, world.name, settings.runner.runs(cases), read_true_poses(simulated))]


def _pair_of(family: str, name: str, runs: Sequence[Run], truth: StampedPoses) -> tuple[MappedHalf, MappedHalf]:
    first, second = (MappedHalf(family, name, run.folder, truth) for run in runs)
    return first, second


def merge_halves(
    configuration: Configuration,
    first: MappedHalf,
    second: MappedHalf,
    programs: Mapping[str, Path],
    *,
    is_foreign: bool = False,
) -> Merged:
    """Merge two maps by their largest pieces, and compare with the truth.

    :param programs: {name: external program that places one grid in the other}.
    """
    robots = read_team([first.folder, second.folder])
    one, other = (_largest(robot) for robot in robots)
    met = meet(one, other, configuration)
    best = met.distribution.best
    errors = np.full((1, 2), math.nan)
    if best is not None and not is_foreign:
        errors = window_errors(met, best, first.truth, second.truth)
    poses = first.keyframe_poses(one), second.keyframe_poses(other)
    common = np.zeros(len(poses[1].true), bool) if is_foreign else on_common_ground(poses[0].true, poses[1].true)
    return Merged(
        first.family,
        f"{first.name}, {second.name}" if is_foreign else first.name,
        is_foreign,
        float(np.mean(common)),
        _length_on(poses[1].true, common),
        met.verdict.value,
        0.0 if best is None else best.probability,
        met.distribution.apart,
        are_right(errors),
        len(met.windows),
        0 if best is None else len(best.matches),
        float(np.mean(errors[:, 0])),
        tuple(
            judge_answer(name, place_grids(program, first.folder, second.folder), None if is_foreign else poses)
            for name, program in programs.items()
        ),
    )


def _largest(robot: RobotMap) -> Component:
    return max(robot.components.values(), key=lambda component: len(component.scans))


def _length_on(poses: Float64, common: Bool) -> float:
    """Path between successive poses on common ground, m.

    :param poses: shape (n, 3).
    :param common: shape (n,), whether each is on common ground.
    """
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    return float(steps[common[1:] & common[:-1]].sum())


def merge_table(found: Sequence[Merged]) -> str:
    """A table with a line for each log or family, and one for foreign pairs."""
    columns: Columns[tuple[str, list[Merged]]] = [
        ("maps of", lambda row: row[0]),
        ("pairs", lambda row: str(len(row[1]))),
        ("common", lambda row: f"{100.0 * mean([each.common for each in row[1]]):.0f} %"),
        ("joined right", lambda row: str(sum(each.is_joined and each.is_right for each in row[1]))),
        ("joined wrong", lambda row: str(sum(each.is_joined and not each.is_right for each in row[1]))),
        ("open", lambda row: str(sum(each.verdict == Verdict.OPEN for each in row[1]))),
        ("apart", lambda row: str(sum(each.verdict == Verdict.APART for each in row[1]))),
        ("contradictory", lambda row: str(sum(each.verdict == Verdict.CONTRADICTORY for each in row[1]))),
        ("best placement right", lambda row: str(sum(each.is_right for each in row[1]))),
        ("its probability", lambda row: f"{mean([each.probability for each in row[1]]):.3f}"),
        ("error [m]", lambda row: f"{mean([each.error for each in row[1] if each.is_right]):.3f}"),
    ]
    return table_of(columns, _group(found))


def program_table(found: Sequence[Merged], programs: Sequence[str]) -> str:
    """A table of joins by this package and by external programs, with the lines of :func:`merge_table`.

    :param programs: their names.
    """
    columns: list[tuple[str, Callable[[tuple[str, list[Merged]]], str]]] = [
        ("maps of", lambda row: row[0]),
        ("pairs", lambda row: str(len(row[1]))),
        ("due", lambda row: str(sum(each.is_due for each in row[1]))),
        ("hmt_slam: right, wrong, none", lambda row: _count([each.outcome for each in row[1]], JOINS)),
    ]
    for number, program in enumerate(programs):
        columns.append((f"{program}: right, wrong, none, failed", partial(_program_cell, number)))
    return table_of(columns, _group(found))


def _program_cell(number: int, row: tuple[str, list[Merged]]) -> str:
    return _count([each.programs[number].outcome for each in row[1]], (*JOINS, FAILED))


def _count(outcomes: Sequence[str], kinds: Sequence[str]) -> str:
    return ", ".join(str(outcomes.count(kind)) for kind in kinds)


def _program_faults(found: Sequence[Merged]) -> list[str]:
    """A line for each answer that failed."""
    return [f"{each.name}: {own.answer.fault}." for each in found for own in each.programs if own.answer.fault]


def _group(found: Sequence[Merged]) -> list[tuple[str, list[Merged]]]:
    """The pairs of each log or family, and then the foreign ones."""
    groups = {
        family: [each for each in found if each.family == family and not each.is_foreign]
        for family in dict.fromkeys(each.family for each in found)
    }
    groups["foreign"] = [each for each in found if each.is_foreign]
    return [(name, own) for name, own in groups.items() if own]
