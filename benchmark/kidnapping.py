"""Recovery of a kidnapped robot: delay and correctness."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmark.kidnapped_drive import (
    DRIFT,
    RIGHT,
    RIGHT_ANGLE,
    Kidnapping,
    LocalizationReport,
    MonitoredRun,
    summarize_drive,
)
from benchmark.logs import open_logs
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.tail import POLICY as TAIL_POLICY
from benchmark.tail import Pair, tail_requirement, tail_table
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.evaluation import StampedPoses, evaluate_relations, true_relations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import SIMULATION_PREFIX, LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Scan

WORLDS = ("office", "busy", "nested", "hall", "ring")
LOGS = ("aces", "intel")
ALIKE = ("hall", "ring")
"""Worlds in which a kidnapping may be invisible, because the view is the same or empty."""

KINDS = ("known", "unknown", "short", "gap")
SEEDS = 10

SOON, SHARE = 5.0, 0.95
"""Path within which a kidnapping has to be detected, m, and smallest share of the cases."""

_DRAWS = 2009
_JUMP = 0.6  # m and rad, in the time between two scans
_STEP = 2.5  # m, by which a robot is moved in short kidnappings
# Parts of the drive after which the robot is kidnapped, and from which it continues.
_AT = {"known": (0.55, 0.7), "unknown": (0.15, 0.25), "short": (0.2, 0.7), "gap": (0.55, 0.7)}
_TO = {"known": (0.72, 0.85), "unknown": (0.3, 0.4), "gap": (0.72, 0.85)}
_GAP = 4.0  # s, without scans from the kidnapping on, in those of kind gap

POLICY = (
    "Two rounds of each world. The robot is kidnapped once, without odometry, and turned by up to 180 degrees: in the "
    f"second round to another part of it (known), in the first one to unmapped ground (unknown), or {_STEP:g} m "
    f"farther on its route (short); or as in known, with {_GAP:g} s without scans (gap). "
    "The kidnapping is noticed when the robot is not localized, or right. A robot is sure while hmt/is_localized "
    f"says so. It is right within {RIGHT:g} m and "
    f"{math.degrees(RIGHT_ANGLE):.0f} degrees of the pose by the nearest keyframe of before, with {100 * DRIFT:g} % "
    "of the distance to that added. Errors are those of metric SLAM's trajectory at relations within the parts before "
    "and after. False alarms are meters on which a robot that was not kidnapped is not localized. In hall and ring the "
    "view after the kidnapping may be the same, or empty. Above 0.9 counts every keyframe event after the kidnapping, "
    "by the probability that the robot is where the most probable hypothesis has it, and by its pose. Events of a "
    "drive depend on each other. The requirement leaves out hall and ring."
)


def draw_drive(world: str, kind: str, seed: int) -> str:
    """The name of a random simulated drive with a kidnapping."""
    random = np.random.Generator(np.random.Philox(key=[_DRAWS + seed, KINDS.index(kind)]))
    at, turned = random.uniform(*_AT[kind]), random.uniform(-180.0, 180.0)
    name = f"{SIMULATION_PREFIX}{world},seed={seed},laps=2"
    if kind == "short":
        log = open_log(name)
        truth = np.array([record.true_pose for record in log.records()])
        gone = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))))
        after = np.searchsorted(gone, gone[int(at * len(gone))] + _STEP)
        to = float(after) / len(gone)
    else:
        to = random.uniform(*_TO[kind])
    return f"{name},carried={at:.4f},to={to:.4f},turned={turned:.1f}"


def leave_gap(records: Iterable[LogRecord], seconds: float) -> Iterator[LogRecord]:
    """The records without the scans of some seconds from the kidnapping on."""
    last: NDArray[np.float64] | None = None
    end = 0
    for record in records:
        if isinstance(record.measurement, Scan) and record.true_pose is not None:
            if last is not None and is_jump(last, record.true_pose):
                end = record.measurement.stamp + round(seconds * NANOSECONDS)
            last = record.true_pose
            if record.measurement.stamp < end:
                continue
        yield record


def is_jump(before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
    """Whether the robot was kidnapped between two true poses, shape (3,)."""
    step = se2.between(before, after)
    return math.hypot(step[0], step[1]) > _JUMP or abs(float(step[2])) > _JUMP


def drive_kidnapped(name: str, changes: Sequence[str] = (), gap: float = 0.0) -> Kidnapping:
    """Drive through a simulated world with a kidnapping.

    :param gap: time without scans from the kidnapping on, s.
    """
    monitored, traveled = MonitoredRun(load_configuration(PARAMETERS, list(changes))), 0.0
    reports: list[LocalizationReport] = []
    stamps, truth, parts = list[int](), list[NDArray[np.float64]](), list[bool]()
    for record in leave_gap(open_log(name).records(), gap):
        monitored.run.process_record(record)
        if not isinstance(record.measurement, Scan) or record.true_pose is None:
            continue
        last = truth[-1] if truth else record.true_pose
        if is_jump(last, record.true_pose):
            monitored.kidnap_stamp = record.measurement.stamp
        elif monitored.kidnap_stamp is not None:
            traveled += math.hypot(*(record.true_pose - last)[:2])
        stamps.append(record.measurement.stamp)
        truth.append(record.true_pose)
        parts.append(monitored.kidnap_stamp is not None)
        report = monitored.report(record.measurement.stamp, record.true_pose, traveled)
        reports += [] if report is None else [report]
    result = monitored.run.finish()
    recording = result.recorder.finish(result.log_progress.stamps)
    own, true = StampedPoses(recording.stamps, recording.trajectory), StampedPoses(np.array(stamps), np.array(truth))
    errors = [_error(own, true, np.array(parts) == part) for part in (False, True)]
    return summarize_drive(reports, (errors[0], errors[1]), traveled)


def _error(own: StampedPoses, truth: StampedPoses, chosen: NDArray[np.bool_]) -> float:
    """Mean error at the relations of a part of a drive, m."""
    part = StampedPoses(truth.stamps[chosen], truth.poses[chosen])
    return evaluate_relations(own, true_relations(part)).overall.translation.mean


@dataclass(frozen=True)
class OrdinaryDrive:
    """The scores of a drive without a kidnapping.

    :ivar driven: m.
    :ivar unsure: path on which the robot was not localized, m.
    """

    driven: float
    unsure: float


def drive_ordinary(path: Path | str, changes: Sequence[str] = ()) -> OrdinaryDrive:
    """Drive without a kidnapping."""
    monitored, driven, unsure = MonitoredRun(load_configuration(PARAMETERS, list(changes))), 0.0, 0.0
    for record in open_log(path).records():
        before = monitored.events
        monitored.run.process_record(record)
        if monitored.events > before:
            traveled = monitored.run.recorder.keyframes[monitored.events - 1].path_length
            unsure += (traveled - driven) * (not monitored.is_localized())
            driven = traveled
    return OrdinaryDrive(driven, unsure)


def measure_kidnapping(settings: Settings) -> Report:
    """Drive in every world, with and without kidnappings."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("kidnapping", "A robot that is kidnapped while it drives", seeds=seeds)
    names = settings.logs_or((*WORLDS, *LOGS))
    worlds = [name for name in names if name in WORLDS]
    cases = [(world, kind, seed) for world in worlds for kind in KINDS for seed in seeds]
    with open_logs([name for name in names if name not in WORLDS]) as logs:
        drives: list[tuple[str, Path | str]] = [(log.name, log.path) for log in logs]
        drives += [(world, f"{SIMULATION_PREFIX}{world},seed={seed},laps=2") for world in worlds for seed in seeds]
        with ProcessPoolExecutor(settings.runner.jobs, multiprocessing.get_context("spawn")) as pool:
            changes = settings.changes
            gaps = [_GAP if kind == "gap" else 0.0 for _, kind, _ in cases]
            found = list(pool.map(drive_kidnapped, [draw_drive(*case) for case in cases], repeat(changes), gaps))
            ordinary_drives = list(pool.map(partial(drive_ordinary, changes=changes), [path for _, path in drives]))
    rows = []
    for world in worlds:
        for kind in KINDS:
            kidnappings = [
                kidnapping for kidnapping, case in zip(found, cases, strict=True) if case[:2] == (world, kind)
            ]
            rows.append([world, kind, *_drive_cells(kidnappings)])
            report.data[f"{world} {kind}"] = [asdict(kidnapping) for kidnapping in kidnappings]
            if world not in ALIKE:
                report.requirements += requirements(f"{world}, {kind}", kidnappings)
    head = ["world", "kidnapped to", "drives", f"noticed within {SOON:g} m", "m until noticed, median"]
    head += ["right at the end", "m until right, median", "m sure of a wrong place", "wrong at the end"]
    head += ["error before [m]", "after [m]"]
    pairs = localizations_by_world([world for world, _, _ in cases], found)
    report.requirements += [tail_requirement(name, own) for name, own in pairs.items() if name not in ALIKE]
    report.body += [table(head, rows), tail_table(pairs)]
    rows = []
    for name in dict.fromkeys(name for name, _ in drives):
        drives_of_log = [
            drive_scores for drive_scores, (drive, _) in zip(ordinary_drives, drives, strict=True) if drive == name
        ]
        driven, unsure = (
            sum(drive_scores.driven for drive_scores in drives_of_log),
            sum(drive_scores.unsure for drive_scores in drives_of_log),
        )
        rows.append([name, str(len(drives_of_log)), f"{driven / 1e3:.2f}", f"{1e3 * unsure / driven:.1f}"])
        report.requirements.append(Requirement(f"{name}: m not sure of the place per km", 1e3 * unsure / driven, 0.0))
        report.data[f"{name} ordinary"] = [asdict(drive_scores) for drive_scores in drives_of_log]
    ordinary = table(["ordinary drive", "drives", "km", "m not sure of the place per km"], rows)
    report.body += [ordinary, POLICY, TAIL_POLICY]
    return report


def localizations_by_world(worlds: Sequence[str], found: Sequence[Kidnapping]) -> dict[str, list[Pair]]:
    """The localizations of some drives, together except for those in worlds that look alike.

    :param worlds: the world of each drive.
    """
    pairs: dict[str, list[Pair]] = {}
    for world, drive in zip(worlds, found, strict=True):
        pairs.setdefault(world if world in ALIKE else "other worlds", []).extend(drive.localizations)
    return pairs


def requirements(name: str, found: Sequence[Kidnapping]) -> list[Requirement]:
    """Requirements on the delay of detections, and on confident wrong answers."""
    noticed = float(np.mean([kidnapping.noticed <= SOON for kidnapping in found]))
    wrong = sum(kidnapping.confident > 0.0 or kidnapping.wrong for kidnapping in found)
    return [
        Requirement(f"{name}: noticed within {SOON:g} m", noticed, 1.0, least=SHARE),
        Requirement(f"{name}: drives with a confident wrong answer", wrong, 0),
    ]


def _drive_cells(found: Sequence[Kidnapping]) -> list[str]:
    recoveries = [kidnapping.again for kidnapping in found]
    return [
        str(len(found)),
        f"{np.mean([kidnapping.noticed <= SOON for kidnapping in found]):.2f}",
        f"{np.median([kidnapping.noticed for kidnapping in found]):.1f}",
        str(sum(not math.isinf(kidnapping) for kidnapping in recoveries)),
        f"{np.median(recoveries):.1f}",
        f"{np.mean([kidnapping.confident for kidnapping in found]):.1f}",
        str(sum(kidnapping.wrong for kidnapping in found)),
        *(f"{np.mean([kidnapping.errors[k] for kidnapping in found]):.3f}" for k in (0, 1)),
    ]
