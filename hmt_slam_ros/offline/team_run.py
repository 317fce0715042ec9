"""A run of several robots at once, in lock-step: each with its processes, and all with one clock and one network."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import itemgetter

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.logs.records import Log, LogRecord
from hmt_slam_ros.messages.messages import ClosureDecision, Message
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.team import JoinedGround, TeamGoal, TeamPlacement
from hmt_slam_ros.offline.lock_step import LockStepRun, RunResult
from hmt_slam_ros.process_table import TEAM
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.team.standing import StandingTimer
from hmt_slam_ros.team.team import Team, TeamState

_SESSION = "lock-step"
"""Of all maps: a run that goes on has the map of the one before."""


class _Radio:
    """The process team of a robot; its messages, and those of the explorer, wait for the others."""

    def __init__(self, team: Team) -> None:
        self.team = team
        self.sent: deque[Message] = deque()
        self._standing = StandingTimer()

    def handle(self, message: Message) -> list[Message]:
        """Let the process handle a message; the robot's other processes need no answer."""
        self.sent += self.team.handle(message)
        return []

    def note_record(self, seconds: float, caused: Sequence[Message]) -> None:
        """Send the goals of the explorer, and let a process whose robot stands go on.

        :param seconds: time of a record, s.
        :param caused: messages that it caused.
        """
        self.sent += [message for message in caused if isinstance(message, TeamGoal)]
        if any(isinstance(message, ClosureDecision) for message in caused):
            self._standing.note_event(seconds)
        elif self._standing.is_due(seconds, is_searching=self.team.is_searching):
            self._standing.note_status(seconds)
            self.handle(self.team.status)


class TeamRun:
    """Maps several logs at once, as if the robots had begun to drive at the same time.

    :ivar runs: {robot: its run}.
    """

    def __init__(
        self,
        configuration: Configuration,
        logs: Mapping[str, Log],
        on_placement: Callable[[float, TeamPlacement], None] | None = None,
        on_sent: Callable[[str, Message], None] | None = None,
        states: Mapping[str, RunState] | None = None,
        observers: Mapping[str, Mapping[str, Process]] | None = None,
    ) -> None:
        """:param logs: {name of a robot: its log}.

        :param on_placement: called with the time since the start, s, and each new answer of a robot.
        :param on_sent: called with the name of a robot and each message that it sends to the others.
        :param states: {robot: state from which its run goes on}. How the maps lie is found again.
        :param observers: {robot: {name: process}}, additional processes that receive the messages of its chain.
        """
        self._logs, self._on_placement, self._on_sent = logs, on_placement, on_sent
        begin = {name: (states or {}).get(name, RunState()) for name in logs}
        self._radios = {
            name: _Radio(TEAM.make(configuration, TeamState(name, _SESSION, state.processes["tlca"].replica)))
            for name, state in begin.items()
        }
        self.runs = {
            name: LockStepRun(
                configuration, state=state, observers={TEAM.name: self._radios[name], **(observers or {}).get(name, {})}
            )
            for name, state in begin.items()
        }
        self._seconds = 0.0

    @property
    def teams(self) -> dict[str, Team]:
        """{robot: its process team}."""
        return {name: radio.team for name, radio in self._radios.items()}

    def run(self, on_state: Callable[[str, RunState], None] | None = None) -> dict[str, RunResult]:
        """Map all logs to their ends, and finish the search; the result of each robot.

        All know of one another from the start, as nodes do by the statuses that they repeat.

        :param on_state: called with each robot and its state after its last record, before ``EndOfLog``.
        """
        for radio in self._radios.values():
            radio.sent.append(radio.team.status)
        self._exchange()
        for seconds, name, record in heapq.merge(*map(self._timed_records, self._logs), key=itemgetter(0)):
            self._seconds = seconds
            self._radios[name].note_record(seconds, self.runs[name].process_record(record))
            self._exchange()
        if on_state:
            for name, run in self.runs.items():
                on_state(name, run.state)
        results = {name: run.finish() for name, run in self.runs.items()}
        self._exchange()
        while any(team.is_searching for team in self.teams.values()):
            for radio in self._radios.values():
                radio.sent += radio.team.search(1, may_wait=False)
            self._exchange()
        return results

    def _timed_records(self, name: str) -> Iterator[tuple[float, str, LogRecord]]:
        """The records of a log, each with the time since its first one, s."""
        start = None
        for record in self.runs[name].unread_records(self._logs[name]):
            start = record.source_stamp if start is None else start
            yield 1e-9 * (record.source_stamp - start), name, record

    def _exchange(self) -> None:
        """Deliver what the robots sent to all others, and what these answer."""
        while any(radio.sent for radio in self._radios.values()):
            for name, radio in self._radios.items():
                if radio.sent:
                    self._deliver(name, radio.sent.popleft())

    def _deliver(self, sender: str, message: Message) -> None:
        if isinstance(message, TeamPlacement) and self._on_placement:
            self._on_placement(self._seconds, message)
        if isinstance(message, JoinedGround):
            self.runs[sender].lock_step.feed(message)
            return
        if self._on_sent:
            self._on_sent(sender, message)
        for name, radio in self._radios.items():
            if name != sender and isinstance(message, TeamGoal):
                self.runs[name].lock_step.feed(message)
            elif name != sender:
                radio.handle(message)
