"""The pipelined runtime: topology runs in a second OS process, while metric SLAM works ahead in the first.

Each process receives the same messages in the same order as in lock-step, so that the results are the same bytes.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
import traceback
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice
from multiprocessing.connection import Connection
from typing import Any, cast

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.records import Log, LogRecord
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS, Checkpointable, Process
from hmt_slam_ros.metric_slam.speculation import SpeculationRecord, SpeculativeSlam
from hmt_slam_ros.offline.lock_step import LockStep, LockStepRun, RunResult
from hmt_slam_ros.process_memory import ResourceUsage, resource_usage
from hmt_slam_ros.process_table import COORDINATOR
from hmt_slam_ros.results.hmt_map import RunState

TOPOLOGY = ("aam", "tsbi", "tlca")
"""The processes in the second OS process."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
"""Signals with a handler of the command line."""

_END_TIMEOUT = 10.0
"""Time for the second OS process to end, s."""


class PipelinedRun(LockStepRun):
    """A run of all processes and the recorder in two OS processes; a context manager ends the second."""

    def __init__(self, configuration: Configuration, state: RunState | None = None) -> None:
        """:param state: state from which the run continues."""
        super().__init__(configuration, state=state)
        topology = {name: self._processes.pop(name) for name in TOPOLOGY}
        slam = self._processes[COORDINATOR]
        assert isinstance(slam, SpeculativeSlam)
        self._worker = TopologyWorker(topology)
        processes = {name: process for name, process in self.lock_step.processes.items() if name not in TOPOLOGY}
        self.lock_step = self._pipeline = Pipeline(processes, slam, self._worker)

    def __enter__(self) -> PipelinedRun:
        return self

    def __exit__(self, *_exception: object) -> None:
        self._worker.close()

    def finish(self) -> RunResult:
        """End the run and return its result."""
        result = super().finish()
        return replace(result, topology_usage=self._worker.usage, speculation=self.speculation)

    @property
    def speculation(self) -> SpeculationRecord:
        """How often metric SLAM worked ahead."""
        return self._pipeline.slam.record

    def process_states(self) -> dict[str, Any]:
        """{process: state}."""
        return {**super().process_states(), **self._worker.request_states()}

    def unread_records(self, log: Log) -> Iterator[LogRecord]:
        """The unread records of a log, which metric SLAM may process before their turn; see :class:`LockStepRun`."""
        self._pipeline.records = ReadAhead(super().unread_records(log))
        return self._pipeline.records


class ReadAhead(Iterator[LogRecord]):
    """The records of a log, of which further ones can be read before their turn."""

    def __init__(self, records: Iterator[LogRecord]) -> None:
        self._records = records
        self._waiting = deque[LogRecord]()
        self._fault: Exception | None = None

    def __next__(self) -> LogRecord:
        if self._waiting:
            return self._waiting.popleft()
        if self._fault is not None:
            raise self._fault
        return next(self._records)

    def peek(self, number: int) -> LogRecord | None:
        """The record after ``number`` others whose turn has not come; None after the last, or where reading failed.

        :param number: of records that were peeked at before, at most.
        """
        if number == len(self._waiting) and self._fault is None:
            try:
                self._waiting.extend(islice(self._records, 1))
            except Exception as fault:
                self._fault = fault
        return self._waiting[number] if number < len(self._waiting) else None


class Pipeline(LockStep):
    """A scheduler that lets metric SLAM work ahead while topology computes an answer.

    :ivar slam: metric SLAM, one of the processes.
    :ivar records: the records that follow.
    """

    def __init__(self, processes: Mapping[str, Process], slam: SpeculativeSlam, worker: TopologyWorker) -> None:
        super().__init__(processes)
        self.slam, self.records = slam, ReadAhead(iter(()))
        self._worker = worker
        self._seconds_ahead = deque[float]()

    def feed(self, *messages: Message) -> list[Message]:
        """Deliver messages and all messages that they cause; returns these."""
        self._count_seconds_ahead()
        pending, caused = deque(messages), list[Message]()
        while pending:
            requests = self._deliver_all(pending, caused)
            for answer in self._request(requests) if requests else ():
                caused.append(answer)
                pending.extend(self.deliver(answer))
        return caused

    def _deliver_all(self, pending: deque[Message], caused: list[Message]) -> list[Message]:
        """Deliver what is pending, and what that causes here; returns the messages that topology gets."""
        requests = []
        while pending:
            message = pending.popleft()
            answers = self.deliver(message)
            pending.extend(answers)
            caused += answers
            if isinstance(message, self._worker.subscriptions):
                requests.append(message)
        return requests

    def _request(self, messages: list[Message]) -> list[Message]:
        """The messages of topology that others cause; metric SLAM works ahead until they are there."""
        self._worker.send(messages)
        while not self._worker.has_answer and self._work_ahead():
            pass
        answers, seconds = self._worker.receive()
        for name, own in seconds.items():
            self.add_seconds(name, own)
        return answers

    def _work_ahead(self) -> bool:
        """Process one more record before its turn; returns whether there was one."""
        record = self.records.peek(self.slam.steps_ahead)
        begin = time.perf_counter()
        if record is None or not self.slam.work_ahead(record.measurement):
            return False
        self._seconds_ahead.append(time.perf_counter() - begin)
        return True

    def _count_seconds_ahead(self) -> None:
        """Count the time that the next record took before its turn, or that was spent in vain."""
        count = len(self._seconds_ahead) - self.slam.steps_ahead or 1
        for _ in range(min(count, len(self._seconds_ahead))):
            self.add_seconds(COORDINATOR, self._seconds_ahead.popleft())


class TopologyWorker:
    """The topological processes in a child process, which is forked."""

    def __init__(self, processes: Mapping[str, Checkpointable]) -> None:
        """:param processes: {name: process}, in the order in which they get a message."""
        self.subscriptions = tuple({kind for name in processes for kind in SUBSCRIPTIONS[name]})
        context = multiprocessing.get_context("fork")
        self._connection, remote = context.Pipe()
        self._process = context.Process(target=_serve, args=(remote, self._connection, processes), daemon=True)
        # What a signal raises in a hook that Python calls at a fork is lost.
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        self._process.start()
        remote.close()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)

    def send(self, messages: list[Message]) -> None:
        """Let the processes handle messages; :meth:`receive` has to follow."""
        self._connection.send(messages)

    @property
    def has_answer(self) -> bool:
        """Whether :meth:`receive` would return at once."""
        return self._connection.poll()

    def receive(self) -> tuple[list[Message], dict[str, float]]:
        """Wait for the messages that the last ones caused, and the computing time {process: s}.

        :raises Exception: that a process raised.
        """
        return cast(tuple[list[Message], dict[str, float]], self._receive())

    def request_states(self) -> dict[str, Any]:
        """{process: state}."""
        self._connection.send(None)
        return cast(dict[str, Any], self._receive())

    def _receive(self) -> object:
        try:
            answer = self._connection.recv()
        except EOFError as fault:
            self._process.join(_END_TIMEOUT)
            raise HmtSlamError(
                f"the process of topology ended with status {self._process.exitcode}: see the messages before, free "
                "memory, or use --jobs 1"
            ) from fault
        if isinstance(answer, Exception):
            raise answer
        return answer

    @property
    def usage(self) -> ResourceUsage:
        """Resources of the child process so far."""
        return resource_usage(self._process.pid or 0)

    def close(self) -> None:
        """End the child process."""
        self._connection.close()
        self._process.join(_END_TIMEOUT)
        if self._process.is_alive():
            self._process.kill()


def _serve(connection: Connection, parent_end: Connection, processes: Mapping[str, Checkpointable]) -> None:
    """Answer requests until the parent closes its end."""
    parent_end.close()
    # The parent decides what an interrupt means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    lock_step = LockStep(processes)
    while True:
        try:
            messages = connection.recv()
        except EOFError:
            return
        try:
            if messages is None:
                answer: object = {name: process.state for name, process in processes.items()}
            else:
                answer = lock_step.feed(*messages), lock_step.take_seconds()
        except Exception as fault:
            fault.add_note(traceback.format_exc())
            answer = fault
        connection.send(answer)
