"""Metric SLAM that works ahead: while topology computes the answer to a keyframe event, the next scans are processed.

Most answers change nothing in metric SLAM. So a copy of it, which shares the maps until it writes to them, goes on as
if that were so. Where it was, metric SLAM goes on as that copy. Otherwise the copy is dropped, and the scans are
processed again. Both ways the messages are those of metric SLAM alone, in the same order.
"""

from __future__ import annotations

import time
from collections import ChainMap, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EarlyEstimate,
    Hypotheses,
    Hypothesis,
    Keyframe,
    LocalEstimate,
    Message,
)
from hmt_slam_ros.metric_slam.look_ahead import LookAhead
from hmt_slam_ros.metric_slam.slam import MetricSlam, SlamState
from hmt_slam_ros.sensors import Measurement, Odometry, Scan
from hmt_slam_ros.submap.local_filter import FilterFactory
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.submap.particle_filter import ParticleFilters

_MOST_ASSUMED = 2
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


class _Fork(MetricSlam):
    """A copy that goes on before the answer to the last event. It reads the same replica, but adds nothing to it.

    At the end :class:`SpeculativeSlam` has to adopt it, or to release its maps.

    :ivar answers: the messages that follow the answer at once.
    :ivar seconds: computing time, s.
    :ivar assumed_scans: {keyframe that is no part of the map yet: its scan}.
    """

    answers: list[Message]
    seconds: float
    assumed_scans: dict[int, Scan]

    @classmethod
    def from_slam(cls, slam: MetricSlam) -> _Fork:
        """A copy in the same state."""
        fork = cls.__new__(cls)
        assumed = slam.assumed_scans if isinstance(slam, _Fork) else {}
        vars(fork).update(vars(slam), answers=[], seconds=0.0, assumed_scans=assumed)
        fork.intake = slam.intake.copy()
        fork._live_hypotheses = {name: live.branch(name) for name, live in fork._live_hypotheses.items()}
        return fork

    def add_to_replica(self, keyframe: Keyframe) -> None:
        """Keep the scan alone: the keyframe is part of the map once the copy is adopted."""
        self.assumed_scans = {**self.assumed_scans, keyframe.sequence: keyframe.scan}

    @property
    def keyframe_scans(self) -> Mapping[int, Scan]:
        """As of metric SLAM, with the keyframes that are no part of the map yet."""
        return ChainMap(self.assumed_scans, self._replica.scans)

    def assume_unchanged(self) -> list[Message]:
        """Go on as if the answer that is due changed nothing; returns the messages of the scans that waited."""
        self._state = replace(self._state, awaiting_decision=False)
        return self.process_queue()

    def compute(self, work: Callable[[], list[Message]]) -> list[Message]:
        """The messages of some work of this copy."""
        begin = time.perf_counter()
        answers = work()
        self.seconds += time.perf_counter() - begin
        return answers


class SpeculativeSlam(MetricSlam):
    """The metric SLAM process, ahead of the answers that are due.

    A runtime that has the measurements before their turn calls :meth:`work_ahead`. One in which they come while an
    answer is due calls :meth:`look_ahead`. Without either it is :class:`MetricSlam`.

    :ivar most_assumed: number of answers that may be assumed at a time.
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
        self._unseen = list[Measurement]()
        self._early = list[EarlyEstimate]()
        self._look_ahead: LookAhead | None = None
        self._next_early = 0
        self.most_assumed = _MOST_ASSUMED
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
        return self._forks[-1] if self._forks else self

    @property
    def _may_fork(self) -> bool:
        """Whether one more answer may be assumed. In mode lifelong an event depends on all keyframes before it."""
        is_due = self.is_awaiting_decision and not self._state.reset_pending
        return is_due and len(self._forks) < self.most_assumed and self.mode != "lifelong"

    def _fork_front(self) -> None:
        fork = _Fork.from_slam(self._front)
        self._forks.append(fork)
        self._go_on(fork.assume_unchanged)

    def work_ahead(self, measurement: Measurement) -> bool:
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
        """Estimates of the scans that wait, as far as they have none yet; results are the same without them.

        They wait for the answer to a keyframe event, or until later odometry shows whether that before was stale. Up to
        one further event is processed ahead.
        """
        if self._forks:
            self._pass_on()
        if self._front.is_awaiting_decision and self._may_fork:
            self._fork_front()
        early = [estimate for estimate in self._early if estimate.scan_index >= self._next_early]
        self._early = []
        self._note_early(early)
        tracked = self._track_waiting()
        self._note_early(tracked)
        return early + tracked

    def _note_early(self, estimates: Sequence[EarlyEstimate]) -> None:
        self._next_early = max([self._next_early, *(estimate.scan_index + 1 for estimate in estimates)])

    def _track_waiting(self) -> list[EarlyEstimate]:
        """Estimates of scans that no copy may process; where tracking begins, of the newest alone."""
        front, queue = self._front, self._front.intake.queue
        first, end = front.processed_scans, front.processed_scans + queue.ready_count()
        begin = max(first, self._next_early)
        if front.is_reset_pending or begin >= end:
            return []
        if self._look_ahead is None or not self._look_ahead.follow(front, self.processed_scans):
            self._look_ahead, begin = LookAhead(self._configuration, front), end - 1
        scans = queue.waiting_scans(begin - first, end - first)
        return list(self._look_ahead.estimate(scans, begin, self.keyframe_events - 1))

    def _pass_on(self) -> None:
        """Give the copies what has come."""
        for measurement in self._unseen:
            for fork in self._forks:
                fork.enqueue(measurement)
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
        if isinstance(message, Measurement):
            return self._handle_measurement(message)
        if self._look_ahead is not None:
            self._look_ahead.leave_map()
        if self._forks and (cause := self._contradiction(message)) is not None:
            self._drop_forks(cause)
        if self._forks and isinstance(message, ClosureDecision):
            return self._adopt_fork(message)
        return super().handle(message)

    def _handle_measurement(self, measurement: Measurement) -> list[Message]:
        if self._look_ahead is not None and isinstance(measurement, Odometry):
            self._look_ahead.add_odometry(measurement)
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
            return self._change_by(message)
        return "reset"

    def _change_by(self, answer: Hypotheses | ClosureDecision) -> str | None:
        """What an answer changes in the filters, or in what decides about them; None where nothing is changed.

        Areas and arcs may change all the same.
        """
        if isinstance(answer, ClosureDecision):
            is_unchanged = not answer.moved_keyframes and answer.hypothesis in (None, *self._only_hypothesis())
            return None if is_unchanged else "closure"
        hypotheses = answer.hypotheses
        if {hypothesis.id for hypothesis in hypotheses} != self._live_hypotheses.keys():
            return "hypotheses"
        if any(_changes_filter(hypothesis) for hypothesis in hypotheses):
            return "area"
        if answer.pruned_keyframes or answer.stale_beams:
            return "keyframes"
        if all(hypothesis.lost for hypothesis in hypotheses) != self._state.lost:
            return "lost"
        best = min(hypotheses, key=lambda hypothesis: (-hypothesis.probability, hypothesis.id))
        return None if best.id == self._replica.best_hypothesis else "hypotheses"

    def _only_hypothesis(self) -> list[int]:
        """The live hypothesis, where there is one."""
        return list(self._live_hypotheses) if len(self._live_hypotheses) == 1 else []

    def _reset_tracking(self) -> list[Message]:
        self._look_ahead, self._next_early = None, 0
        return super()._reset_tracking()

    def _adopt_fork(self, decision: ClosureDecision) -> list[Message]:
        """Go on as the copy that assumed this answer; returns what it has sent since."""
        self._pass_on()
        fork = self._forks.popleft()
        self._replica.apply_decision(decision)
        self.release()
        self.intake, self._live_hypotheses, self._state = fork.intake, fork._live_hypotheses, fork._state
        self.is_interrupted = fork.is_interrupted
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
            fork.release()
            self.record.repeated += _count_scans(fork.answers)
            self.record.dropped_seconds += fork.seconds
        self.record.refuted[cause] = self.record.refuted.get(cause, 0) + 1
        self.record.repeated += sum(_count_scans(step.answers) for step in self._steps)
        self._forks.clear()
        self._steps.clear()
        self._unseen, self._early = [], []


def _count_scans(answers: Sequence[Message]) -> int:
    return sum(isinstance(answer, LocalEstimate) for answer in answers)


def _changes_filter(hypothesis: Hypothesis) -> bool:
    """Whether a hypothesis begins, or gets another local map, or loses the robot."""
    return (
        hypothesis.id != hypothesis.parent
        or bool(hypothesis.local_areas)
        or hypothesis.area_merge is not None
        or hypothesis.tracking_reset
    )
