"""The distribution of the pose over a few seconds of a log, scan by scan: ESS, modes, and when they are decided.

The stretch is the doorway of the CSAIL log, in which odometry stands still for five scans and then jumps by the motion
since. The log is run as configured, where scans wait for the odometry after the stop, and without patience, where each
scan is matched at once, with the odometry that there is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.logs import MeasuredLog, open_logs
from benchmark.report import Report, table
from benchmark.runs import PARAMETERS, Case, Run
from benchmark.settings import Settings
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.evaluation import StampedPoses, evaluate_relations, read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.submap.local_filter import ParticleFilterState
from hmt_slam_ros.submap.pose_modes import normalize_weights

LOG, BEGIN, END = "csail", 67.8, 70.3
"""The log, and the part of it that is shown, s since its first record."""

SEED = 0

RUNS: dict[str, tuple[str, ...]] = {"as configured": (), "without patience": ("motion.patience=0",)}
"""{name of a run: parameters that differ}; the first has the trajectory that all are compared with."""


@dataclass(frozen=True, eq=False)
class Mode:
    """A mode of the pose.

    :ivar mass: its share in the weights.
    :ivar pose: ``area_T_base`` of its heaviest particle, shape (3,), m and rad.
    """

    mass: float
    pose: Float64


@dataclass(frozen=True)
class ScanModes:
    """The distribution of the pose after a scan, under the most probable hypothesis.

    :ivar stamp: of the scan in the log, ns.
    :ivar seconds: since the first record.
    :ivar area: the robot's area.
    :ivar hypotheses: number of hypotheses.
    :ivar effective_samples: ESS of the particles.
    :ivar deviation: of the motion since the last keyframe, under all modes, along its least certain direction, m.
    :ivar modes: that of the leading particle first.
    """

    stamp: int
    seconds: float
    area: int
    hypotheses: int
    effective_samples: float
    deviation: float
    modes: tuple[Mode, ...]


def measure_modes(settings: Settings) -> Report:
    """Run the log with and without patience, and list the modes of the pose over the stretch."""
    report = Report("modes", "The distribution of the pose over a doorway", seeds=(SEED,))
    changes = {name: (*settings.changes, *own) for name, own in RUNS.items()}
    with open_logs([LOG]) as (log,):
        followed = {name: follow_modes(log.path, own, BEGIN, END) for name, own in changes.items()}
        runs = settings.runner.runs([Case(log, SEED, changes=own) for own in changes.values()])
        rows = [_error_cells(name, log, run) for name, run in zip(RUNS, runs, strict=True)]
    report.body = [table(["run", "mean error [m]", "over 60 s [m]"], rows)]
    reference = read_tum(runs[0].folder / "trajectory.tum")
    for name, scans in followed.items():
        errors = mode_errors(scans, reference)
        report.body += [f"{name[0].upper()}{name[1:]}:", mode_table(scans, errors)]
        report.data[name] = [_scan_data(scan, own) for scan, own in zip(scans, errors, strict=True)]
    return report


def _error_cells(name: str, log: MeasuredLog, run: Run) -> list[str]:
    assert log.relations is not None
    errors = evaluate_relations(read_tum(run.folder / "trajectory.tum"), log.relations)
    return [name, f"{errors.overall.translation.mean:.4f}", f"{errors.over_60_s.translation.mean:.4f}"]


def follow_modes(path: Path | str, changes: tuple[str, ...], begin: float, end: float) -> list[ScanModes]:
    """The distributions after the scans of a part of a log, which is run up to there.

    Scans that waited for odometry are processed together; of these the last one is listed.

    :param path: of the log, or the name of a simulated one.
    :param changes: parameters that differ from the file, as ``name=value``.
    :param begin: s since the first record.
    :param end: likewise.
    """
    run = LockStepRun(load_configuration(PARAMETERS, list(changes)))
    slam = run.lock_step.processes["slam"]
    assert isinstance(slam, MetricSlam)
    source_stamps, processed, scans = dict[int, int](), 0, list[ScanModes]()
    for record in open_log(path).records():
        source_stamps[record.measurement.stamp] = record.source_stamp
        first = next(iter(source_stamps))
        if (record.measurement.stamp - first) / NANOSECONDS > end:
            break
        run.process_record(record)
        last = run.recorder.last_estimate
        if last is None or slam.processed_scans == processed:
            continue
        processed, seconds = slam.processed_scans, (last.stamp - first) / NANOSECONDS
        if seconds >= begin:
            scans.append(_current_modes(slam, source_stamps[last.stamp], seconds))
    return scans


def _current_modes(slam: MetricSlam, stamp: int, seconds: float) -> ScanModes:
    hypothesis = slam.replica.best_hypothesis
    own = slam.state.live_hypotheses[hypothesis].particle_filter
    assert own is not None
    return ScanModes(
        stamp,
        seconds,
        own.area,
        len(slam.replica.probabilities),
        1.0 / float(np.sum(normalize_weights(own.log_weights) ** 2)),
        math.sqrt(float(np.linalg.eigvalsh(own.tracking_covariance[:2, :2]).max())),
        modes_of(own),
    )


def modes_of(state: ParticleFilterState) -> tuple[Mode, ...]:
    """The modes of a particle filter, that of the leading particle first, with its pose."""
    weights, leading = normalize_weights(state.log_weights), int(state.members[state.leader])
    modes = []
    for number in sorted(range(len(state.modes)), key=lambda number: number != leading):
        rows = np.flatnonzero(state.members == number)
        head = state.leader if number == leading else rows[np.argmax(weights[rows])]
        modes.append(Mode(float(weights[rows].sum()), state.poses[head]))
    return tuple(modes)


def mode_errors(scans: Sequence[ScanModes], reference: StampedPoses) -> list[Float64]:
    """The error of each mode of each scan, shape (modes, 3), in the frame of the right pose, m and rad.

    It is that of the motion since the first scan, and NaN from where the robot changes its area, and its frame, on.

    :param reference: a trajectory that is taken for right.
    """
    right = dict(zip(reference.stamps.tolist(), reference.poses, strict=True))
    first, errors = scans[0], list[Float64]()
    for scan in scans:
        motion = se2.between(right[first.stamp], right[scan.stamp])
        own = se2.between(first.modes[0].pose, np.array([mode.pose for mode in scan.modes]))
        errors.append(se2.between(motion, own) if scan.area == first.area else np.full(own.shape, np.nan))
    return errors


def mode_table(scans: Sequence[ScanModes], errors: Sequence[Float64]) -> str:
    """A Markdown table with a line for each scan.

    :param errors: of its modes, shape (modes, 3), m and rad.
    """
    head = ["s", "hypotheses", "ESS", "deviation [m]", "modes", "mass: error forward, to the left [m], in heading [°]"]
    return table(head, map(_scan_cells, scans, errors))


def _scan_cells(scan: ScanModes, errors: Float64) -> list[str]:
    masses = [
        f"{mode.mass:.2f}: {forward:+.2f}, {left:+.2f}, {math.degrees(turned):+.1f}"
        for mode, (forward, left, turned) in zip(scan.modes, errors, strict=True)
    ]
    figures = [str(scan.hypotheses), f"{scan.effective_samples:.1f}", f"{scan.deviation:.3f}", str(len(scan.modes))]
    return [f"{scan.seconds:.2f}", *figures, "; ".join(masses)]


def _scan_data(scan: ScanModes, errors: Float64) -> dict[str, object]:
    """A scan for JSON, with an error of null where there is none."""
    modes = [
        {"mass": mode.mass, "error": None if np.isnan(error).any() else error.tolist()}
        for mode, error in zip(scan.modes, errors, strict=True)
    ]
    names = ("seconds", "hypotheses", "effective_samples", "deviation")
    return {name: getattr(scan, name) for name in names} | {"modes": modes}
