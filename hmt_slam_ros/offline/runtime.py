"""The five processes in lock-step in one process: every message is delivered in the order in which it was said."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.logs.records import Log
from hmt_slam_ros.offline.recorder import Recorder
from hmt_slam_ros.processes.aam import Aam
from hmt_slam_ros.processes.messages import EndOfLog, Message
from hmt_slam_ros.processes.routing import HEARD_BY, Process
from hmt_slam_ros.processes.rtl import Rtl
from hmt_slam_ros.processes.slam import MetricSlam
from hmt_slam_ros.processes.tlca import Tlca
from hmt_slam_ros.processes.tsbi import Tsbi
from hmt_slam_ros.sensing import Scan


@dataclass
class LockStep:
    """A deterministic scheduler.

    :ivar processes: {name: process}, of those named in ``HEARD_BY``.
    :ivar seconds: {name: seconds spent since the last call of :meth:`take_seconds`}.
    """

    processes: Mapping[str, Process]
    seconds: dict[str, float] = field(default_factory=dict)
    _hearers: dict[type, list[tuple[str, Process]]] = field(default_factory=dict)

    def feed(self, message: Message) -> None:
        """Deliver a message and everything that is said because of it."""
        pending: deque[Message] = deque([message])
        while pending:
            current = pending.popleft()
            for name, process in self._hearers_of(type(current)):
                begin = time.perf_counter()
                pending.extend(process.handle(current))
                self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin

    def _hearers_of(self, kind: type) -> list[tuple[str, Process]]:
        if kind not in self._hearers:
            self._hearers[kind] = [entry for entry in self.processes.items() if issubclass(kind, HEARD_BY[entry[0]])]
        return self._hearers[kind]

    def take_seconds(self) -> dict[str, float]:
        """Seconds that each process spent since the last call."""
        taken, self.seconds = self.seconds, {}
        return taken


@dataclass(frozen=True, eq=False)
class RunResult:
    """What a run leaves.

    :ivar recorder: what was said.
    :ivar stamps: shape (n,), int64, stamp of every scan on the log's running clock, ns, increasing.
    :ivar source_stamps: shape (n,), int64, the log's own stamp of every scan in file order, ns.
    :ivar seconds_per_scan: {process: shape (n,) seconds}.
    :ivar map_bytes: what the maps of all particles took at most.
    """

    recorder: Recorder
    stamps: NDArray[np.int64]
    source_stamps: NDArray[np.int64]
    seconds_per_scan: dict[str, NDArray[np.float64]]
    map_bytes: int


def run_log(
    log: Log,
    configuration: Configuration,
    progress: Callable[[int], None] | None = None,
    abstraction: Callable[[Configuration], Process] = Aam,
) -> RunResult:
    """Map a whole log.

    :param progress: called with the number of scans read, after each.
    :param abstraction: what makes areas of keyframes, such as nothing.
    :raises HmtSlamError: where the log is faulty.
    """
    recorder, slam = Recorder(configuration), MetricSlam(configuration)
    lock_step = LockStep(
        {
            "slam": slam,
            "aam": abstraction(configuration),
            "tsbi": Tsbi(configuration),
            "tlca": Tlca(configuration),
            "rtl": Rtl(configuration),
            "recorder": recorder,
        }
    )
    stamps: list[tuple[int, int]] = []
    spent: list[dict[str, float]] = []
    for record in log.records():
        lock_step.feed(record.measurement)
        if isinstance(record.measurement, Scan):
            stamps.append((record.measurement.stamp, record.source_stamp))
            spent.append(lock_step.take_seconds())
            if progress:
                progress(len(stamps))
    lock_step.feed(EndOfLog())
    seconds = {
        name: np.array([taken.get(name, 0.0) for taken in spent]) for name in lock_step.processes if name != "recorder"
    }
    running, source = np.array(stamps, dtype=np.int64).reshape(-1, 2).T
    return RunResult(recorder, running, source, seconds, slam.map_bytes)
