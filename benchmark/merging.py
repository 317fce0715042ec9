"""Maps of halves of a drive, made apart and merged: joined where they are, joined elsewhere, or not joined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmark.logs import LOGS, MeasuredLog, open_logs
from benchmark.report import Columns, Report, Requirement, mean, table_of
from benchmark.runs import Case, Run
from benchmark.settings import Settings, chosen_seeds
from benchmark.simulated.worlds import FAMILIES, World
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.evaluation import StampedPoses, read_true_poses, read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.team import Verdict
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.merged_map import RobotMap, read_team
from hmt_slam_ros.team.components import Component
from hmt_slam_ros.team.join import Meeting, meet
from hmt_slam_ros.team.placement import Placement

RECORDED = ("aces", "intel", "csail")
WORLDS = ("office", "nested", "grid", "ring", "hall", "twins")
SEEDS = 3

CUTS = (1.0 / 3.0, 0.5, 2.0 / 3.0)
"""Where recorded logs are cut, as shares of their time; simulated ones are cut between their laps."""

_RIGHT, _RIGHT_ANGLE = 1.0, math.radians(15.0)
COMMON = 2.0
"""Distance of positions of two drives within which they are on common ground, m."""

POLICY = (
    "A log is cut in two. Each part is mapped by itself, and the second map is merged into the first one. A placement "
    f"is right if most of its windows are within {_RIGHT:g} m and {math.degrees(_RIGHT_ANGLE):.0f} degrees of the "
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
    :ivar verdict: one of ``Verdict``.
    :ivar probability: of the best placement; ``apart`` that of none.
    :ivar is_right: whether the best placement is.
    :ivar windows: number of windows, and ``agreeing`` of those that agree on the best placement.
    :ivar error: mean distance of the windows of the best placement from the truth, m.
    """

    family: str
    name: str
    is_foreign: bool
    common: float
    verdict: str
    probability: float
    apart: float
    is_right: bool
    windows: int
    agreeing: int
    error: float

    @property
    def is_joined(self) -> bool:
        """Whether the two became one map."""
        return self.verdict == Verdict.JOINED


@dataclass(frozen=True, eq=False)
class _Half:
    """A part of a log: its name, its map and the true poses of the whole log."""

    family: str
    name: str
    folder: Path
    truth: StampedPoses


def measure_merge(settings: Settings) -> Report:
    """Map the parts of every log, merge them, and compare the placements with the truth."""
    names = settings.logs_or((*WORLDS, *RECORDED))
    seeds = chosen_seeds(settings, SEEDS)
    report = Report("merge", "Maps merged without a common frame", seeds=seeds)
    found: list[Merged] = []
    with open_logs([name for name in names if name in LOGS]) as logs:
        halves = [_recorded_halves(settings, log) for log in logs]
        worlds = [World(family, seed) for family in names if family in FAMILIES for seed in seeds]
        halves += [_simulated_halves(settings, world) for world in worlds]
        for pairs in halves:
            found += [_merge(settings, first, second, is_foreign=False) for first, second in pairs]
        for one, other in zip(halves, [*halves[1:], *halves[:1]], strict=True):
            if one is not other:
                found.append(_merge(settings, one[0][0], other[0][1], is_foreign=True))
    wrong = sum(each.is_joined and (each.is_foreign or not each.is_right) for each in found)
    report.requirements.append(Requirement("joined wrongly", wrong, 0.0))
    report.body += [merge_table(found), POLICY]
    report.data["pairs"] = [asdict(each) for each in found]
    return report


def _recorded_halves(settings: Settings, log: MeasuredLog) -> list[tuple[_Half, _Half]]:
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


def _simulated_halves(settings: Settings, world: World) -> list[tuple[_Half, _Half]]:
    """The two laps of a drive."""
    log, simulated = MeasuredLog(world.name, Path(world.log)), open_log(world.log)
    half = 0.5 * simulated.duration
    cases = [
        Case(log, world.seed, changes=settings.changes, duration=half),
        Case(log, world.seed, changes=settings.changes, start=half),
    ]
    return [_pair_of(world.family, world.name, settings.runner.runs(cases), read_true_poses(simulated))]


def _pair_of(family: str, name: str, runs: Sequence[Run], truth: StampedPoses) -> tuple[_Half, _Half]:
    first, second = (_Half(family, name, run.folder, truth) for run in runs)
    return first, second


def _merge(settings: Settings, first: _Half, second: _Half, *, is_foreign: bool) -> Merged:
    """Merge two maps by their largest pieces, and compare with the truth."""
    robots = read_team([first.folder, second.folder])
    one, other = (_largest(robot) for robot in robots)
    met = meet(one, other, settings.configuration)
    best = met.distribution.best
    errors = np.full((1, 2), math.nan)
    if best is not None and not is_foreign:
        errors = window_errors(met, best, first.truth, second.truth)
    return Merged(
        first.family,
        f"{first.name}, {second.name}" if is_foreign else first.name,
        is_foreign,
        0.0 if is_foreign else _common_share(one, other, first.truth),
        met.verdict.value,
        0.0 if best is None else best.probability,
        met.distribution.apart,
        are_right(errors),
        len(met.windows),
        0 if best is None else len(best.matches),
        float(np.mean(errors[:, 0])),
    )


def _largest(robot: RobotMap) -> Component:
    return max(robot.components.values(), key=lambda component: len(component.scans))


def window_errors(met: Meeting, placement: Placement, first: StampedPoses, second: StampedPoses) -> Float64:
    """Distance, m, and angle, rad, of every window of a placement from the truth, shape (n, 2).

    :param first: true poses of the first robot; ``second`` likewise.
    """
    errors = []
    for number, match in placement.matches.items():
        known, area_T_known = next(iter(met.pair.hybrid_map.keyframes(match.area).items()))
        reference = next(iter(met.windows[number].poses))
        true = se2.between(_true_pose(met, first, known), _true_pose(met, second, reference))
        error = se2.between(true, se2.between(area_T_known, match.belief.mean))
        errors.append((math.hypot(error[0], error[1]), abs(float(error[2]))))
    return np.array(errors)


def are_right(errors: Float64) -> bool:
    """Whether most windows are where they truly are.

    :param errors: those of :func:`window_errors`.
    """
    return bool(np.mean((errors[:, 0] <= _RIGHT) & (errors[:, 1] <= _RIGHT_ANGLE)) > 0.5)


def _true_pose(met: Meeting, truth: StampedPoses, keyframe: int) -> Float64:
    stamps = np.array([met.pair.scans[keyframe].stamp])
    return np.asarray(truth.poses[truth.nearest_indices(stamps)[0]], dtype=np.float64)


def _common_share(one: Component, other: Component, truth: StampedPoses) -> float:
    """Share of the keyframes of the second that are near one of the first."""
    first, second = (
        truth.poses[truth.nearest_indices(np.array([scan.stamp for scan in part.scans.values()]))][:, :2]
        for part in (one, other)
    )
    return float(np.mean((distances_between(second, first) <= COMMON).any(axis=1)))


def distances_between(one: Float64, other: Float64) -> Float64:
    """Distances of positions (n, 2) from others (m, 2), shape (n, m), m."""
    return np.asarray(np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1)))


def merge_table(found: Sequence[Merged]) -> str:
    """A table with a line for each log or family, and one for foreign pairs."""
    groups = {
        family: [each for each in found if each.family == family and not each.is_foreign]
        for family in dict.fromkeys(each.family for each in found)
    }
    groups["foreign"] = [each for each in found if each.is_foreign]
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
    return table_of(columns, [(name, own) for name, own in groups.items() if own])
