"""Metric SLAM that works ahead: while topology computes the answer to a keyframe event, the next scans are processed.

Most answers change nothing in metric SLAM. So a copy of it, which shares the maps until it writes to them, goes on as
if that were so. Where it was, metric SLAM goes on as that copy. Otherwise the copy is dropped, and the scans are
processed again. Both ways the messages are those of metric SLAM alone, in the same order.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EarlyEstimate,
    Hypotheses,
    Keyframe,
    LocalEstimate,
    Message,
)
from hmt_slam_ros.metric_slam.slam import MetricSlam, SlamState
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.submap.local_filter import FilterFactory
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.submap.particle_filter import ParticleFilters

_MOST_FORKS = 2
"""Keyframe events whose answers may be assumed; more make a wrong assumption dearer."""


@dataclass
class SpeculationRecord:
    """How often metric SLAM worked ahead.

    :ivar scans: number of scans that were processed ahead.
    :ivar confirmed: number of answers that were as assumed.
    :ivar refuted: {cause: number of answers after which copies were dropped}; the causes are "area" and "hypotheses",
        which began or ended, "closure", "keyframes" that were removed, "lost" for a robot that was or is, and "reset".
    :ivar repeated: number of scans that were processed again.
    :ivar dropped_seconds: computing time of the copies that were dropped, s.
    """

    scans: int = 0
    confirmed: int = 0
    refuted: dict[str, int] = field(default_factory=dict)
    repeated: int = 0
    dropped_seconds: float = 0.0

    def __str__(self) -> str:
        answers = self.confirmed + sum(self.refuted.values())
        causes = ", ".join(f"{cause} {count}" for cause, count in sorted(self.refuted.items()))
        return (
            f"{self.confirmed} of {answers} answers as assumed{causes and f' (others: {causes})'}, {self.repeated} of "
            f"{self.scans} scans processed again, {self.dropped_seconds:.2f} s"
        )


class _Step(NamedTuple):
    """A measurement that was processed before its turn, and the messages that answer it."""

    measurement: Message
    answers: Sequence[Message]


@dataclass
class _Fork:
    """A copy that assumes an answer.

    :ivar answers: the messages that follow the answer at once.
    :ivar seconds: computing time, s.
    """

    slam: MetricSlam
    answers: list[Message] = field(default_factory=list)
    seconds: float = 0.0

    def compute(self, work: Callable[[], list[Message]]) -> list[Message]:
        """The messages of some work of the copy."""
        begin = time.perf_counter()
        answers = work()
        self.seconds += time.perf_counter() - begin
        return answers


class SpeculativeSlam(MetricSlam):
    """The metric SLAM process, ahead of the answers that are due.

    A runtime that has the measurements before their turn calls :meth:`work_ahead`. One in which they come while an
    answer is due calls :meth:`look_ahead`. Without either it is :class:`MetricSlam`.

    :ivar record: how often it worked ahead.
    """

    def __init__(
        self,
        configuration: Configuration,
        state: SlamState | None = None,
        filters: Callable[[LocalMapping], FilterFactory] = ParticleFilters,
    ) -> None:
        """Parameters as of :class:`MetricSlam`."""
        super().__init__(configuration, state, filters)
        self._forks = deque[_Fork]()
        self._steps = deque[_Step]()
        # Measurements that this has and the copies do not.
        self._unseen = list[Scan | Odometry]()
        self._early = list[EarlyEstimate]()
        self.record = SpeculationRecord()

    @property
    def state(self) -> SlamState:
        """The whole state, as a value; measurements that were processed before their turn have to come first."""
        assert not self._steps
        return super().state

    @property
    def steps_ahead(self) -> int:
        """Number of measurements that were processed before their turn, which has not come."""
        return len(self._steps)

    @property
    def has_more(self) -> bool:
        """Whether scans are left since a batch was full."""
        return self.is_interrupted or self._front.is_interrupted

    def process_batch(self) -> list[Message]:
        """Process the next batch; returns the messages whose turn has come."""
        if self._front.is_interrupted and self._forks:
            self._go_on(self._front.process_queue)
            return []
        return self.process_queue()

    @property
    def _front(self) -> MetricSlam:
        return self._forks[-1].slam if self._forks else self

    @property
    def _may_fork(self) -> bool:
        """Whether one more answer may be assumed. In mode lifelong an event depends on all keyframes before it."""
        is_due = self.is_awaiting_decision and not self._state.reset_pending
        return is_due and len(self._forks) < _MOST_FORKS and self.mode != "lifelong"

    def _fork_front(self) -> None:
        self._forks.append(_Fork(self._front.fork()))
        self._go_on(self._front.assume_unchanged)

    def work_ahead(self, measurement: Scan | Odometry) -> bool:
        """Process a measurement before its turn, the first that was not; :meth:`handle` gets it later.

        :returns: whether it was processed; not where no answer is due, or too many would be assumed.
        """
        # The measurement comes after all answers, of which each may lead to the next event.
        while self._front.is_awaiting_decision and self._may_fork:
            self._fork_front()
        front = self._front
        if front is self or front.is_awaiting_decision:
            return False
        answers = self._forks[-1].compute(lambda: front.handle(measurement))
        self._steps.append(_Step(measurement, answers))
        self.record.scans += _count_scans(answers)
        return True

    def look_ahead(self) -> list[EarlyEstimate]:
        """As in :class:`MetricSlam`; scans that wait for an answer are processed ahead, up to one further event."""
        if self._forks:
            self._pass_on()
        if self._front.is_awaiting_decision and self._may_fork:
            self._fork_front()
        front, event = self._front, self.keyframe_events - 1
        early = [estimate for estimate in self._early if estimate.scan_index >= self._next_early]
        self._early = []
        front._next_early = max([self._next_early, *(estimate.scan_index + 1 for estimate in early)])
        early += [replace(estimate, event=event) for estimate in MetricSlam.look_ahead(front)]
        self._next_early = front._next_early
        return early

    def _pass_on(self) -> None:
        """Give the copies what has come."""
        for measurement in self._unseen:
            for fork in self._forks:
                fork.slam.enqueue(measurement)
            if not self._front.is_interrupted:
                self._go_on(self._front.process_queue)
        self._unseen = []

    def _go_on(self, work: Callable[[], list[Message]]) -> None:
        """Let the newest copy do some work; its estimates are early ones."""
        answers = self._forks[-1].compute(work)
        self._forks[-1].answers.extend(answers)
        self.record.scans += _count_scans(answers)
        self._early += [
            EarlyEstimate(own.stamp, own.scan_index, self.keyframe_events - 1, own.area, own.pose, own.odometry)
            for own in answers
            if isinstance(own, LocalEstimate)
        ]

    def handle(self, message: Message) -> list[Message]:
        """As in :class:`MetricSlam`."""
        if isinstance(message, Scan | Odometry):
            return self._handle_measurement(message)
        if self._forks and (cause := self._contradiction(message)) is not None:
            self._drop_forks(cause)
        if self._forks and isinstance(message, ClosureDecision):
            return self._adopt_fork(message)
        return super().handle(message)

    def _handle_measurement(self, measurement: Scan | Odometry) -> list[Message]:
        if self._steps:
            step = self._steps.popleft()
            assert step.measurement is measurement
            return self._send(step.answers)
        if self._forks:
            self._unseen.append(measurement)
        return super().handle(measurement)

    def _contradiction(self, message: Message) -> str | None:
        """What a message changes that the copies assume, None where nothing."""
        if isinstance(message, Hypotheses | ClosureDecision) and self._front.mode == self.mode:
            return self.change_by(message)
        return "reset"

    def _adopt_fork(self, decision: ClosureDecision) -> list[Message]:
        """Go on as the copy that assumed this answer; returns what it has sent since."""
        self._pass_on()
        fork = self._forks.popleft()
        self.adopt(fork.slam, decision)
        self._early = [estimate for estimate in self._early if estimate.scan_index >= self.processed_scans]
        self.record.confirmed += 1
        return self._send(fork.answers)

    def _send(self, answers: Sequence[Message]) -> list[Message]:
        """Messages whose turn has come; the keyframe among them is part of the map from now on."""
        for answer in answers:
            if isinstance(answer, Keyframe):
                self.add_to_replica(answer)
        return list(answers)

    def _drop_forks(self, cause: str) -> None:
        for fork in self._forks:
            fork.slam.release()
            self.record.repeated += _count_scans(fork.answers)
            self.record.dropped_seconds += fork.seconds
        self.record.refuted[cause] = self.record.refuted.get(cause, 0) + 1
        self.record.repeated += sum(_count_scans(step.answers) for step in self._steps)
        self._forks.clear()
        self._steps.clear()
        self._unseen, self._early = [], []


def _count_scans(answers: Sequence[Message]) -> int:
    return sum(isinstance(answer, LocalEstimate) for answer in answers)
