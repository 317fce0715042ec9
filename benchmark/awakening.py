"""A robot wakes up somewhere in a map that was saved: how far does it travel until it knows where, and is it right?"""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmark.logs import BUNDLED, opened
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs import LogRecord, open_log
from hmt_slam_ros.offline.runtime import Run
from hmt_slam_ros.offline.saved_map import RunState
from hmt_slam_ros.processes.messages import Carried
from hmt_slam_ros.processes.replica import Replica
from hmt_slam_ros.sensing import Scan

LOGS = ("aces", "intel", BUNDLED)
WORLDS = ("office", "busy", "nested", "grid")
ALIKE = ("grid",)
"""Worlds whose every place exists several times, so that where it is cannot be known."""

STARTS = 100
"""Places of every log at which the robot wakes up."""

FAR = 20.0
"""m of travel within which the place is to be known."""

SURE = 0.9
RIGHT_SHARE = 0.95

_RIGHT, _RIGHT_ANGLE = 0.5, math.radians(10.0)
# The log's last part is left out: a drive that ends says nothing of 20 m.
_LAST = 0.05
_DRAWS = 2008

POLICY = (
    "The whole log is mapped; then the robot wakes up at keyframes drawn from it and drives on as it did. What it sees "
    "is in the map already, from the same day; `python -m benchmark sessions` wakes it up where the map knows another "
    "part of the log. In grid every place exists several times, so that only wrong answers are asked for. "
    "It says that it knows its place when the hypotheses in which it is not lost have a probability of "
    f"{SURE:g}; that is right within {_RIGHT:g} m and {math.degrees(_RIGHT_ANGLE):.0f} degrees of where the map has "
    "this part of the log. A confident wrong answer is one that is off by more at any keyframe after that."
)


@dataclass(frozen=True)
class Awakening:
    """What came of one start.

    :ivar found: m of travel until the robot said that it knows its place; inf where it never did.
    :ivar right: whether it was right at the end of the travel.
    :ivar wrong: whether it was sure of a wrong place at any time.
    """

    found: float
    right: bool
    wrong: bool


@dataclass(frozen=True, eq=False)
class Mapped:
    """A log that was mapped, and what is known of it.

    :ivar records: of the log.
    :ivar state: after the last of them.
    :ivar truth: {stamp of a keyframe's scan: ``map_T_base`` (3,)}.
    :ivar areas: {area: ``map_T_area`` (3,)}.
    :ivar starts: indices of the records that are keyframes' scans.
    """

    records: Sequence[LogRecord]
    state: RunState
    truth: dict[int, NDArray[np.float64]]
    areas: dict[int, NDArray[np.float64]]
    starts: Sequence[int]


def measure_awakening(settings: Settings) -> Report:
    """Map the logs, and wake up in them."""
    report = Report("awakening", "Waking up in a saved map", seeds=(0,))
    names = settings.logs_or((*LOGS, *WORLDS))
    rows = []
    with opened([name for name in names if name not in WORLDS]) as logs:
        paths: dict[str, Path | str] = {log.name: log.path for log in logs}
        paths |= {name: f"sim:{name},seed=0" for name in names if name in WORLDS}
        for name, path in paths.items():
            found = awakenings(mapped(path), len(settings.seeds_or(STARTS)), settings.runner.jobs)
            rows.append(_row(name, found))
            report.data[name] = [asdict(one) for one in found]
            share = float(np.mean([one.right and one.found <= FAR and not one.wrong for one in found]))
            if name not in ALIKE:
                asked = Requirement(f"{name}: right within {FAR:g} m", share, 1.0, least=RIGHT_SHARE)
                report.requirements.append(asked)
            wrong = sum(one.wrong for one in found)
            report.requirements.append(Requirement(f"{name}: confident wrong answers", wrong, 0))
    columns = ["log", "starts", f"right within {FAR:g} m", "m until known, mean", "median", "wrong", "never known"]
    report.body += [table(columns, rows), POLICY]
    return report


def mapped(path: Path | str) -> Mapped:
    """Map a whole log."""
    run = Run(Configuration())
    records = list(open_log(path).records())
    for record in records:
        run.read(record)
    state, areas = run.state, _area_poses(run, {})
    replica = Replica.of(state.tsbi.replica)
    hybrid_map = replica.maps[replica.best]
    truth = {
        replica.scans[keyframe].stamp: se2.compose(areas[area], pose)
        for area in hybrid_map.area_ids()
        for keyframe, pose in hybrid_map.keyframes(area).items()
    }
    scans = [n for n, record in enumerate(records) if isinstance(record.measurement, Scan)]
    starts = [n for n in scans[: int((1.0 - _LAST) * len(scans))] if records[n].measurement.stamp in truth]
    return Mapped(records, state, truth, areas, starts)


def awakenings(log: Mapped, count: int, jobs: int) -> list[Awakening]:
    """Wake up at ``count`` places of a log."""
    drawn = np.random.default_rng(_DRAWS).choice(len(log.starts), count)
    # Forked, so that none has to load the map.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
        return list(pool.map(partial(awakened, log), [log.starts[n] for n in drawn]))


def awakened(log: Mapped, start: int) -> Awakening:
    """Wake up at a record of a log, and drive on from there."""
    run = Run(Configuration(), state=log.state)
    run.lock_step.feed(Carried())
    travelled, found, right, wrong = 0.0, math.inf, False, False
    last: NDArray[np.float64] | None = None
    for record in log.records[start:]:
        run.read(record)
        true = log.truth.get(record.measurement.stamp) if isinstance(record.measurement, Scan) else None
        if true is None:
            continue
        travelled += 0.0 if last is None else math.hypot(*(true - last)[:2])
        last = true
        if _known(run):
            found = min(found, travelled)
            right = _is_right(run, log.areas, true)
            wrong |= not right
        if travelled >= FAR:
            break
    return Awakening(found, right, wrong)


def _known(run: Run) -> bool:
    """Whether the robot is sure of its place."""
    told = run.recorder.hypotheses
    if not told:
        return False
    return sum(leaf.probability for leaf in told[max(told)].leaves if not leaf.lost) >= SURE


def _is_right(run: Run, before: dict[int, NDArray[np.float64]], true: NDArray[np.float64]) -> bool:
    """Whether the last estimate is near the truth.

    :param before: where the areas of the map were.
    :param true: ``map_T_base``, shape (3,).
    """
    last = run.recorder.last
    area = None if last is None else _area_poses(run, before).get(last.area)
    if last is None or area is None:
        return False
    away = se2.between(true, se2.compose(area, last.pose.mean))
    return bool(math.hypot(away[0], away[1]) <= _RIGHT and abs(away[2]) <= _RIGHT_ANGLE)


def _area_poses(run: Run, before: dict[int, NDArray[np.float64]]) -> dict[int, NDArray[np.float64]]:
    """{area: ``map_T_area`` (3,)} as TLCA told last, or before the run."""
    told = run.recorder.accepted
    for sequence in sorted(told, reverse=True):
        if told[sequence].global_poses:
            return {entry.area: entry.pose.mean for entry in told[sequence].global_poses}
    return before


def _row(name: str, found: Sequence[Awakening]) -> list[str]:
    known = [one.found for one in found if one.right]
    share = np.mean([one.right and one.found <= FAR and not one.wrong for one in found])
    mean, median = (f"{of(known):.1f}" if known else "-" for of in (np.mean, np.median))
    wrong, never = sum(one.wrong for one in found), sum(math.isinf(one.found) for one in found)
    return [name, str(len(found)), f"{share:.2f}", mean, median, str(wrong), str(never)]
