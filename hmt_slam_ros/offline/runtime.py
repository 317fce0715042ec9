"""The five processes in lock-step in one process: every message is delivered in the order in which it was said."""

from __future__ import annotations

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros import composition
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.logs.records import Log, LogRecord
from hmt_slam_ros.loop_closure.tlca import Tlca
from hmt_slam_ros.messages.messages import Carried, EndOfLog, Message
from hmt_slam_ros.messages.routing import HEARD_BY, Process
from hmt_slam_ros.real_time_localization.rtl import Rtl
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.results.log_reading import LogState, Reading, goes_on
from hmt_slam_ros.results.recorder import Recorder
from hmt_slam_ros.sensors import Scan


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
    :ivar log: which scans were read.
    :ivar seconds_per_scan: {process: shape (m,) seconds}, of the scans that this run read.
    :ivar map_bytes: what the maps of all particles took at most.
    """

    recorder: Recorder
    log: LogState
    seconds_per_scan: dict[str, NDArray[np.float64]]
    map_bytes: int


class Run:
    """The five processes and the recorder in lock-step, from the start or from a state on.

    :ivar lock_step: that runs them.
    :ivar recorder: that listens.
    """

    def __init__(
        self,
        configuration: Configuration,
        abstraction: Callable[[Configuration], Process] | None = None,
        state: RunState | None = None,
        others: Mapping[str, Process] | None = None,
    ) -> None:
        """:param abstraction: what makes areas of keyframes instead of the AAM, such as nothing.

        :param state: to go on from.
        :param others: {name: process}, which listen as well.
        """
        state = state or RunState()
        self._slam = composition.metric_slam(configuration, state.slam)
        self._aam = composition.area_abstraction(configuration, state.aam)
        self._tsbi = composition.topological_inference(configuration, state.tsbi)
        self._tlca = Tlca(configuration, state.tlca)
        self._rtl = Rtl(configuration, state.rtl)
        self.recorder = Recorder(configuration, state.recorder)
        self.lock_step = LockStep(
            {
                "slam": self._slam,
                "aam": abstraction(configuration) if abstraction else self._aam,
                "tsbi": self._tsbi,
                "tlca": self._tlca,
                "rtl": self._rtl,
                "recorder": self.recorder,
                **(others or {}),
            }
        )
        self._reading = Reading(state.log)
        self._spent = {name: array("d") for name in self.lock_step.processes if name != "recorder"}

    @property
    def scans(self) -> int:
        """Scans of the newest log that were read."""
        return self._reading.scans

    @property
    def recorded_bytes(self) -> int:
        """What is kept of every scan for the output: where it was taken, its stamps, and what it cost."""
        costs = sum(len(spent) * spent.itemsize for spent in self._spent.values())
        return costs + self._reading.stamp_bytes + self.recorder.past.table_bytes

    @property
    def state(self) -> RunState:
        """All that is known, between two records of the log."""
        return RunState(
            self._reading.state,
            self._slam.state,
            self._aam.state,
            self._tsbi.state,
            self._tlca.state,
            self._rtl.state,
            self.recorder.record(),
        )

    def unread(self, log: Log) -> Iterator[LogRecord]:
        """The records of a log that were not read.

        Where it is a further one, the robot may be anywhere, at any time.

        :raises HmtSlamError: where it is not as it was when the others were read.
        """
        if not goes_on(self._reading.state, log):
            self.lock_step.feed(EndOfLog())
            self.lock_step.feed(Carried())
            self._reading.begin(log)
        return self._reading.unread(log)

    def read(self, record: LogRecord) -> None:
        """Take in a record."""
        self.lock_step.feed(record.measurement)
        self._reading.note(record)
        if isinstance(record.measurement, Scan):
            taken = self.lock_step.take_seconds()
            for name, spent in self._spent.items():
                spent.append(taken.get(name, 0.0))

    def finish(self) -> RunResult:
        """End the run."""
        self.lock_step.feed(EndOfLog())
        seconds = {name: np.array(spent) for name, spent in self._spent.items()}
        return RunResult(self.recorder, self._reading.state, seconds, self._slam.map_bytes)


def run_log(
    log: Log,
    configuration: Configuration,
    progress: Callable[[int], None] | None = None,
    abstraction: Callable[[Configuration], Process] | None = None,
    state: RunState | None = None,
    keep: Callable[[RunState], None] | None = None,
    lasting: bool = False,
) -> RunResult:
    """Map a whole log.

    :param log: the newest of the state's logs, or a further one.
    :param progress: called with the number of scans read, after each.
    :param abstraction: what makes areas of keyframes instead of the AAM, such as nothing.
    :param state: to go on from, at the first record that it does not know.
    :param keep: called with the state after the last record, before the end of the log is told.
    :param lasting: whether the recorder keeps a record of what was said, and not the messages, so that a run may last.
    :raises HmtSlamError: where the log is faulty.
    """
    run = Run(configuration, abstraction, state)
    for record in run.unread(log):
        run.read(record)
        if lasting:
            run.recorder.fold()
        if progress and isinstance(record.measurement, Scan):
            progress(run.scans)
    if keep:
        keep(run.state)
    return run.finish()
