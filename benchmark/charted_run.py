"""Map a log and record the cost over time: ``python -m benchmark.charted_run VARIANT LOG --out DIR ...``.

VARIANT is ``areas``, as ``hmt_slam map`` does it, or ``metric``: the same program with a single area, which is a
Rao-Blackwellized particle filter over one global map. The other arguments are those of ``hmt_slam map``. DIR gets the
trajectory and a report.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hmt_slam_ros.area_abstraction.aam import Aam
from hmt_slam_ros.cli.arguments import build_parser, chosen_configuration
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import StampedPoses, write_tum
from hmt_slam_ros.logs import Log, LogRecord
from hmt_slam_ros.messages.messages import AreaEvents, Keyframe, Message
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.offline.lock_step import RunResult
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.final_map import FinalMap, deskewed_scans, final_map

SAMPLES = 200
"""Smallest number of points of the curve of memory over time, for logs with as many scans."""

AREAS, METRIC = "areas", "metric"


class OneArea:
    """Replacement for the area abstraction, in which no keyframe ever leaves the first area."""

    def __init__(self, _configuration: Configuration) -> None:
        pass

    def handle(self, message: Message) -> list[Message]:
        """The empty answer to a ``Keyframe``."""
        return [AreaEvents(message.sequence, ())] if isinstance(message, Keyframe) else []


VARIANTS: dict[str, Callable[[Configuration], Process]] = {AREAS: Aam, METRIC: OneArea}


class TimedLog:
    """A log with the CPU time that reading or simulating it takes.

    :ivar seconds: spent so far.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self.seconds = 0.0

    @property
    def name(self) -> str:
        """Of the log."""
        return self._log.name

    @property
    def scan_count(self) -> int:
        """Number of scans."""
        return self._log.scan_count

    @property
    def duration(self) -> float:
        """Seconds from the first to the last record."""
        return self._log.duration

    def records(self) -> Iterator[LogRecord]:
        """The records of the log."""
        records = self._log.records()
        while True:
            begin = time.process_time()
            record = next(records, None)
            self.seconds += time.process_time() - begin
            if record is None:
                return
            yield record


def resident_bytes(process: int | str = "self") -> int:
    """Current resident memory of an OS process, by default this one."""
    return int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def map_and_monitor(
    variant: str, log: TimedLog, configuration: Configuration
) -> tuple[RunResult, FinalMap, dict[str, Any]]:
    """Map a log; return the results and their cost."""
    gc.freeze()
    every = max(1, log.scan_count // SAMPLES)
    memory = [(0, resident_bytes())]

    def sample(scans: int) -> None:
        if scans % every == 0:
            memory.append((scans, resident_bytes()))

    result = run_log(log, configuration, sample, VARIANTS[variant])
    memory.append((len(result.log_progress.stamps), resident_bytes()))
    begin, log_seconds = time.process_time(), log.seconds
    final = final_map(
        result.recorder.finish(result.log_progress.stamps), partial(deskewed_scans, log, configuration), configuration
    )
    hybrid_map = final.recording.hybrid_map
    refinement = time.process_time() - begin - (log.seconds - log_seconds)
    facts = {
        "particles": configuration.filter.particles,
        "scans": len(result.log_progress.stamps),
        "traveled_m": final.recording.probabilities[-1].path_length,
        "areas": len(hybrid_map.area_ids()),
        "loop_closures": sum(arc.closure for _, _, arc in hybrid_map.all_arcs()),
        "log_s": log.seconds,
        "refinement_s": refinement,
        "particle_map_bytes": result.map_bytes,
        "memory": [{"s": _seconds(result, scans), "bytes": size} for scans, size in memory],
        "ms_per_scan": {name: float(1e3 * np.mean(spent)) for name, spent in result.seconds_per_scan.items()},
        "cost": _cost(result, every),
    }
    return result, final, facts


def _seconds(result: RunResult, scans: int) -> float:
    """Time of the log after a number of scans, s."""
    return float(result.log_progress.stamps[max(0, scans - 1)] - result.log_progress.stamps[0]) / 1e9


def _cost(result: RunResult, every: int) -> list[dict[str, float]]:
    """Mean time of all processes for a scan over the log, ms."""
    spent = 1e3 * np.sum(list(result.seconds_per_scan.values()), axis=0)
    begins = range(0, len(spent), every)
    return [{"s": _seconds(result, k + 1), "ms": float(spent[k : k + every].mean())} for k in begins]


def main(arguments: list[str]) -> int:
    """Run; return the exit status."""
    variant, *rest = arguments
    options = build_parser().parse_args(["map", *rest])
    try:
        configuration = chosen_configuration(options)
        result, final, facts = map_and_monitor(variant, TimedLog(open_log(options.log)), configuration)
    except HmtSlamError as fault:
        print(f"charted_run: {fault}", file=sys.stderr)
        return 2
    options.out.mkdir(parents=True)
    write_tum(
        options.out / "trajectory.tum", StampedPoses(result.log_progress.source_stamps, final.recording.trajectory)
    )
    (options.out / "report.json").write_text(json.dumps(facts), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
