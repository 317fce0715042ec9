"""Growth of memory, cost and errors over repeated laps on known ground."""

from __future__ import annotations

import gc
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

from benchmark.charted_run import resident_bytes
from benchmark.logs import open_logs
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.evaluation import (
    Relations,
    StampedPoses,
    evaluate_relations,
    read_relations,
    read_true_poses,
    true_relations,
)
from hmt_slam_ros.logs.records import SIMULATION_PREFIX, Log, LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import PoseReset
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.output_folder import scan_bytes
from hmt_slam_ros.sensors import Scan

WORLDS = ("office", "nested", "hall")
LAPS, STEADY = 20, 3
"""Number of laps of a simulated world, and the lap from which on growth is measured."""

LOGS = ("intel",)
PASSES = 3
"""Number of passes of a real log."""

GROWTH = 0.05
"""Largest growth of areas, keyframes and memory."""

NOISE = 0.1
"""Largest growth of the cost of a scan, and of errors, which vary as much between laps."""

_BETWEEN = 60 * NANOSECONDS

POLICY = (
    f"One run of {LAPS} laps of each world (seed 0), and one in which a real log is played {PASSES} times. At the end "
    "of each pass the robot is put at the beginning without an initial pose, and maps on until it is relocalized. The "
    f"growth is that from lap {STEADY} to the last, of a log from its first pass to the last. Areas and keyframes are "
    "those of the most probable map. Memory is the resident memory of the one OS process with all five processes, "
    "libraries and kernels, after a garbage collection. The recorded poses, stamps and costs of every scan, some 200 "
    "bytes for the output, are subtracted. The cost of a scan is CPU time of the processes. Errors are those of metric "
    "SLAM's trajectory in the final map, before the final refinement, at relations within the lap."
)


@dataclass(frozen=True)
class Lap:
    """The size of a run after a lap.

    :ivar areas: of the most probable map.
    :ivar keyframes: likewise.
    :ivar scans: kept in memory.
    :ivar scan_bytes: memory of these.
    :ivar resident: memory of the OS process, bytes.
    :ivar recorded: part of it for trajectories of the output, bytes.
    :ivar hypotheses: alive.
    :ivar milliseconds: of computing for a scan of the lap, mean.
    """

    areas: int
    keyframes: int
    scans: int
    scan_bytes: int
    resident: int
    recorded: int
    hypotheses: int
    milliseconds: float


@dataclass(frozen=True, eq=False)
class Laps:
    """A run of several laps.

    :ivar laps: in their order.
    :ivar errors: mean error of translation at the relations of each lap, m.
    """

    laps: tuple[Lap, ...]
    errors: tuple[float, ...]

    def growth(self, value: Callable[[Lap], float], steady: int) -> float:
        """Growth of a value from the end of lap ``steady`` to that of the last one, as a share."""
        return value(self.laps[-1]) / value(self.laps[steady - 1]) - 1.0


def measure_laps(settings: Settings) -> Report:
    """Drive the laps, and compare the last with the first."""
    report = Report("laps", "Repeated laps on known ground", seeds=(0,))
    configuration = settings.configuration
    names = settings.logs_or((*WORLDS, *LOGS))
    with open_logs([name for name in names if name not in WORLDS]) as logs:
        jobs: dict[str, tuple[str, Path | None, int]] = {
            name: (f"{SIMULATION_PREFIX}{name},laps={LAPS}", None, LAPS) for name in names if name in WORLDS
        }
        jobs |= {log.name: (str(log.path), log.relations_file, PASSES) for log in logs}
        # Memory is measured for a separate process of each.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), max_tasks_per_child=1) as pool:
            runs = {name: pool.submit(drive_laps, *job, configuration) for name, job in jobs.items()}
            found = {name: run.result() for name, run in runs.items()}
    for name, laps in found.items():
        report.requirements += requirements(name, laps)
        report.data[name] = [asdict(lap) | {"error": own} for lap, own in zip(laps.laps, laps.errors, strict=True)]
    report.body += [_table(found), POLICY]
    return report


def requirements(name: str, found: Laps) -> list[Requirement]:
    """Requirements on the growth of a run: its areas, keyframes, memory, cost of a scan and error."""
    count = len(found.laps)
    steady = STEADY if count > STEADY else 1
    since = f"{name}, lap {steady} to {count}: growth of"
    cost, error = ([*values] for values in ((lap.milliseconds for lap in found.laps), found.errors))
    return [
        Requirement(f"{since} areas", found.growth(lambda lap: lap.areas, steady), GROWTH),
        Requirement(f"{since} keyframes", found.growth(lambda lap: lap.keyframes, steady), GROWTH),
        Requirement(f"{since} memory", found.growth(lambda lap: lap.resident - lap.recorded, steady), GROWTH),
        Requirement(f"{since} the cost of a scan", cost[-1] / cost[steady - 1] - 1.0, NOISE),
        Requirement(f"{since} the error", error[-1] / error[steady - 1] - 1.0, NOISE),
    ]


def drive_laps(log: str, relations: Path | None, count: int, configuration: Configuration) -> Laps:
    """Drive over a log ``count`` times, or over a simulated log with as many laps."""
    gc.freeze()
    source, run = open_log(log), LockStepRun(configuration)
    times = 1 if relations is None else count
    ends = [round(source.scan_count * times * (lap + 1) / count) for lap in range(count)]
    laps: list[Lap] = []
    begin = time.process_time()
    for record, is_restart in _replay(source, times):
        if is_restart:
            run.lock_step.feed(PoseReset())
        run.process_record(record)
        run.recorder.compact()
        if isinstance(record.measurement, Scan) and run.scans_read == ends[len(laps)]:
            seconds = time.process_time() - begin
            laps.append(_measure_lap(run, seconds / (ends[len(laps)] - ([0, *ends][len(laps)]))))
            begin = time.process_time()
    known = None if relations is None else read_relations(relations)
    return Laps(tuple(laps), tuple(_lap_errors(run, source, known, ends)))


def _replay(log: Log, count: int) -> Iterator[tuple[LogRecord, bool]]:
    """The records of repeated passes of a log on one clock, each with whether a pass begins."""
    shift = stamp = 0
    for number in range(count):
        for n, record in enumerate(log.records()):
            is_restart = number > 0 and n == 0
            if is_restart:
                shift = stamp + _BETWEEN - record.measurement.stamp
            stamp = record.measurement.stamp + shift
            yield replace(record, measurement=replace(record.measurement, stamp=stamp)), is_restart


def _measure_lap(run: LockStepRun, seconds: float) -> Lap:
    """The size of a run after a lap.\n
    :param seconds: mean cost of a scan of the lap.
    """
    gc.collect()
    slam = run.lock_step.processes["slam"]
    assert isinstance(slam, MetricSlam)
    replica = slam.replica
    hybrid_map, scans = replica.maps[replica.best_hypothesis], replica.scans
    areas = hybrid_map.area_ids()
    keyframes = sum(len(hybrid_map.keyframes(area)) for area in areas)
    memory = (scan_bytes(scans.values()), resident_bytes(), run.recorded_bytes)
    return Lap(len(areas), keyframes, len(scans), *memory, len(replica.maps), 1e3 * seconds)


def _lap_errors(run: LockStepRun, log: Log, known: Relations | None, ends: Sequence[int]) -> Iterator[float]:
    """Mean error at the relations of each lap, m.

    :param known: true relations of a real log; None for a simulated one.
    :param ends: number of scans at the end of each lap.
    """
    result = run.finish()
    recording, stamps = result.recorder.finish(result.log_progress.stamps), result.log_progress.source_stamps
    truth = read_true_poses(log) if known is None else None
    for first, end in pairwise([0, *ends]):
        rows = slice(first, end)
        lap = StampedPoses(stamps[rows], recording.trajectory[rows])
        if truth is not None:
            true = StampedPoses(truth.stamps[rows], truth.poses[rows])
            yield evaluate_relations(lap, true_relations(true)).overall.translation.mean
        elif known is not None:
            yield evaluate_relations(lap, known).overall.translation.mean


def _table(found: Mapping[str, Laps]) -> str:
    head = ["log", "lap", "areas", "keyframes", "their scans [MB]", "resident [MB]", "recorded [MB]", "hypotheses"]
    rows = []
    for name, run in found.items():
        for number in _tabulated_laps(len(run.laps)):
            lap = run.laps[number - 1]
            memory = (f"{lap.scan_bytes / 1e6:.1f}", f"{lap.resident / 1e6:.0f}", f"{lap.recorded / 1e6:.1f}")
            figures = [lap.areas, lap.keyframes, *memory]
            figures += [lap.hypotheses, f"{lap.milliseconds:.2f}", f"{run.errors[number - 1]:.4f}"]
            rows.append([name, str(number), *map(str, figures)])
    return table([*head, "ms a scan", "error [m]"], rows)


def _tabulated_laps(count: int) -> list[int]:
    """The laps of the table: the first ones, every fifth, and the last."""
    return [lap for lap in range(1, count + 1) if lap <= STEADY or lap % 5 == 0 or lap == count]
