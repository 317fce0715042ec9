"""The lock-step runtime: all processes in one program, with messages delivered in the order of sending."""

from __future__ import annotations

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.logs.records import Log, LogRecord
from hmt_slam_ros.messages.messages import EndOfLog, Message, PoseReset
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS, Checkpointable, Process
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.metric_slam.speculation import SpeculationRecord
from hmt_slam_ros.process_memory import ResourceUsage
from hmt_slam_ros.process_table import COORDINATOR, PROCESSES, RECORDER
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.results.log_reading import LogProgress, LogReader, is_newest_log
from hmt_slam_ros.results.recorder import Recorder
from hmt_slam_ros.sensors import Scan


@dataclass
class LockStep:
    """A deterministic scheduler.

    :ivar processes: {name in ``SUBSCRIPTIONS``: process}.
    :ivar seconds: {name: computing time since the last call of :meth:`take_seconds`, s}.
    """

    processes: Mapping[str, Process]
    seconds: dict[str, float] = field(default_factory=dict)
    _subscribers: dict[type, list[tuple[str, Process]]] = field(default_factory=dict)

    def feed(self, *messages: Message) -> list[Message]:
        """Deliver messages and all messages that they cause; returns these."""
        pending, caused = deque(messages), list[Message]()
        while pending:
            answers = self.deliver(pending.popleft())
            pending.extend(answers)
            caused += answers
        return caused

    def deliver(self, message: Message) -> list[Message]:
        """Deliver a message; returns the messages that answer it."""
        answers: list[Message] = []
        for name, process in self._subscribers_of(type(message)):
            begin = time.perf_counter()
            answers += process.handle(message)
            self.add_seconds(name, time.perf_counter() - begin)
        return answers

    def add_seconds(self, name: str, seconds: float) -> None:
        """Add to the computing time of a process."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds

    def _subscribers_of(self, kind: type) -> list[tuple[str, Process]]:
        if kind not in self._subscribers:
            self._subscribers[kind] = [
                entry for entry in self.processes.items() if issubclass(kind, SUBSCRIPTIONS[entry[0]])
            ]
        return self._subscribers[kind]

    def take_seconds(self) -> dict[str, float]:
        """The computing time of each process since the last call, s."""
        taken, self.seconds = self.seconds, {}
        return taken


@dataclass(frozen=True, eq=False)
class RunResult:
    """The result of a run.

    :ivar recorder: recorder of the messages.
    :ivar log_progress: progress through the logs.
    :ivar seconds_per_scan: {process: shape (m,), computing time for each scan of this run, s}.
    :ivar map_bytes: peak memory of the maps of all particles, bytes.
    :ivar topology_usage: resources of the second OS process, None in lock-step.
    :ivar speculation: how often metric SLAM worked ahead, None in lock-step.
    """

    recorder: Recorder
    log_progress: LogProgress
    seconds_per_scan: dict[str, NDArray[np.float64]]
    map_bytes: int
    topology_usage: ResourceUsage | None = None
    speculation: SpeculationRecord | None = None


class LockStepRun:
    """A run of all processes and the recorder in lock-step.

    :ivar lock_step: scheduler of the processes.
    :ivar recorder: recorder of the messages.
    """

    def __init__(
        self,
        configuration: Configuration,
        abstraction: Callable[[Configuration], Process] | None = None,
        state: RunState | None = None,
        observers: Mapping[str, Process] | None = None,
    ) -> None:
        """:param abstraction: makes the process that replaces the AAM.

        :param state: state from which the run continues.
        :param observers: {name: process}, additional processes that receive messages.
        """
        state = state or RunState()
        self._processes: dict[str, Checkpointable] = {
            row.name: row.make(configuration, state.processes[row.name]) for row in PROCESSES
        }
        replaced = {"aam": abstraction(configuration)} if abstraction else {}
        self.recorder = Recorder(configuration, state.recorder)
        self.lock_step = LockStep({**self._processes, **replaced, RECORDER.name: self.recorder, **(observers or {})})
        self._log_reader = LogReader(state.log)
        self._seconds_per_scan = {name: array("d") for name in self.lock_step.processes if name != RECORDER.name}

    @property
    def scans_read(self) -> int:
        """Number of scans read of the newest log."""
        return self._log_reader.scans_read

    @property
    def recorded_bytes(self) -> int:
        """Memory of the poses, stamps and costs of all scans, bytes."""
        costs = sum(len(seconds) * seconds.itemsize for seconds in self._seconds_per_scan.values())
        return costs + self._log_reader.stamp_bytes + self.recorder.earlier_record.table_bytes

    @property
    def state(self) -> RunState:
        """The state between two records of the log."""
        states = self.process_states()
        ordered = {row.name: states[row.name] for row in PROCESSES}
        return RunState(self._log_reader.state, ordered, self.recorder.record())

    def process_states(self) -> dict[str, Any]:
        """{process: state}."""
        return {name: process.state for name, process in self._processes.items()}

    def unread_records(self, log: Log) -> Iterator[LogRecord]:
        """The unread records of a log. A further log begins with a reset of the robot's pose.

        :raises HmtSlamError: where the records that were read differ from those of the log.
        """
        if not is_newest_log(self._log_reader.state, log):
            self.lock_step.feed(EndOfLog())
            self.lock_step.feed(PoseReset())
            self._log_reader.begin_log(log)
        return self._log_reader.unread_records(log)

    def process_record(self, record: LogRecord) -> list[Message]:
        """Process a record; returns the messages that it caused."""
        caused = self.lock_step.feed(record.measurement)
        self._log_reader.mark_read(record)
        if isinstance(record.measurement, Scan):
            spent = self.lock_step.take_seconds()
            for name, seconds in self._seconds_per_scan.items():
                seconds.append(spent.get(name, 0.0))
        return caused

    def finish(self) -> RunResult:
        """End the run and return its result."""
        self.lock_step.feed(EndOfLog())
        slam = self._processes[COORDINATOR]
        assert isinstance(slam, MetricSlam)
        seconds = {name: np.array(values) for name, values in self._seconds_per_scan.items()}
        return RunResult(self.recorder, self._log_reader.state, seconds, slam.peak_map_bytes)
