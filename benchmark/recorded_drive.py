"""A recorded log that was mapped once, with the states that other drives continue from."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.accepted_closures import DefiniteClosure, EventWatch
from benchmark.awakening import MappedLog, path_lengths, process_records, scan_records
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.logs import LogRecord
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.final_map import deskewed_scans, final_map
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.sensors import Odometry, Scan

POINTS = 24
"""Scans after which the state is kept, at most."""

_FIRST, _LAST = 0.15, 0.9  # parts of the path, between which they lie


@dataclass(frozen=True, eq=False)
class MappedDrive:
    """A log that was mapped.

    :ivar whole: the drive in the map of the whole log, with the trajectory of the final map as truth.
    :ivar halves: the maps of the first and the second half.
    :ivar states: {number of a scan: state after it}.
    :ivar keyframes: numbers of the scans of all keyframe events, increasing.
    :ivar closures: that TLCA accepted.
    """

    whole: MappedLog
    halves: tuple[RunState, RunState]
    states: dict[int, RunState]
    keyframes: Sequence[int]
    closures: Sequence[DefiniteClosure]


def map_drive(path: Path | str, configuration: Configuration) -> MappedDrive:
    """Map a log, and its second half by itself."""
    log = open_log(path)
    records = list(log.records())
    scans = scan_records(records)
    middle, travel = len(scans) // 2, np.array(list(path_lengths(odometry_at_scans(records))))
    points = np.unique(np.searchsorted(travel, np.linspace(_FIRST, _LAST, POINTS) * travel[-1]))
    watch, run = EventWatch(), LockStepRun(configuration)
    stops = {int(scans[n]) + 1: int(n) for n in (*points, middle - 1)}
    states = {}
    for begin, end in zip([0, *sorted(stops)], [*sorted(stops), len(records)], strict=True):
        follow(run, records[begin:end], watch)
        if end in stops:
            states[stops[end]] = run.state
            run = LockStepRun(configuration, state=deepcopy(run.state))
    whole, result = run.state, run.finish()
    recording = result.recorder.finish(result.log_progress.stamps)
    truth = final_map(recording, lambda: deskewed_scans(log, configuration), configuration).recording.trajectory
    second = process_records(LockStepRun(configuration), records[scans[middle - 1] + 1 :]).state
    halves = states[middle - 1], second
    mapped = MappedLog(configuration, records, whole, scans, truth, range(len(scans)))
    keyframes = [mapped.numbers[stamp] for stamp in watch.stamps]
    return MappedDrive(mapped, halves, {int(n): states[int(n)] for n in points}, keyframes, watch.accepted)


def follow(run: LockStepRun, records: Collection[LogRecord], watch: EventWatch) -> None:
    """Process records, and take in what they cause."""
    for record in records:
        run.process_record(record)
        watch.update(run)


def odometry_at_scans(records: Sequence[LogRecord]) -> Float64:
    """The last odometry reading at each scan, shape (n, 3); the first reading at scans before it."""
    readings = [record.measurement.pose for record in records if isinstance(record.measurement, Odometry)]
    last, poses = readings[0], list[Float64]()
    for record in records:
        if isinstance(record.measurement, Odometry):
            last = record.measurement.pose
        elif isinstance(record.measurement, Scan):
            poses.append(last)
    return np.array(poses)
