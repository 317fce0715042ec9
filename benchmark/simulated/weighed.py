"""Maps a log with other weights of a scan's evidence for a topology, and compares the live hypotheses with the truth.

``python -m benchmark.simulated.weighed WEIGHTS LOG SEED FILE [REFERENCE]`` maps a simulated log, or a recorded one. The
truth of a recorded log is the trajectory REFERENCE. WEIGHTS are those of :class:`Weighing`, such as ``1,0,1`` for the
package as it is. FILE becomes a JSON document.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmark.runs import PARAMETERS
from benchmark.simulated.closures import Paths, live_answers
from benchmark.simulated.examinations import Examination, ExaminationListener, ObservedBranching
from benchmark.simulated.records import code_hash
from benchmark.simulated.truth import RADIUS, Truth
from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import read_tum
from hmt_slam_ros.logs.records import Log
from hmt_slam_ros.messages.messages import ClosureDecision, EndOfLog, Hypotheses, Keyframe, Message
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.lock_step import LockStep
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.process_table import PROCESSES
from hmt_slam_ros.registration.consistency import MapAgreement
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.submap.local_filter import FilterStep, LocalFilter
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter, ParticleFilters, _GroupProposals
from hmt_slam_ros.submap.pose_modes import log_sum
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

Entry = dict[str, Any]


class Weighing(NamedTuple):
    """Weights of the parts of a scan's log evidence for a topology; or these parts, nats.

    :ivar contradictions: with the submap.
    :ivar filter: mean of the particles' incremental weights, relative to unknown space, Eq. (14).
    :ivar known_ground: contradictions with older scans of the same ground.
    """

    contradictions: float = 0.0
    filter: float = 0.0
    known_ground: float = 0.0

    def weigh(self, evidence: Weighing) -> float:
        """The weighed sum of log evidences, nats."""
        return sum(weight * part for weight, part in zip(self, evidence, strict=True))

    def plus(self, other: Weighing) -> Weighing:
        """The sum, part by part."""
        return Weighing(*(one + another for one, another in zip(self, other, strict=True)))


@dataclass(frozen=True)
class FilterNotes:
    """What the filters of all hypotheses found at the newest keyframe.

    :ivar evidences: {hypothesis: log p(z | earlier scans), nats}.
    :ivar matched_shares: {hypothesis: share of the beams that end on known surfaces}.
    """

    evidences: dict[int, float] = field(default_factory=dict)
    matched_shares: dict[int, float] = field(default_factory=dict)


class _NotingFilter(ParticleFilter):
    """A particle filter that notes the evidence of every step."""

    notes: FilterNotes

    def update(self, prepared: PreparedScan, step: int) -> FilterStep:
        """As of the base class."""
        self.notes.evidences[self.hypothesis] = -np.inf
        return super().update(prepared, step)

    def _propose(self, number: int, points: Float64) -> _GroupProposals:
        group, noted = super()._propose(number, points), self.notes.evidences
        log_weights = self.log_weights[group.rows] - log_sum(self.log_weights)
        log_evidence = log_sum(log_weights + group.proposals.evidences)
        noted[self.hypothesis] = float(np.logaddexp(noted[self.hypothesis], log_evidence))
        return group

    def compare_scan(self, prepared: PreparedScan) -> MapAgreement:
        """As of the base class."""
        agreement = super().compare_scan(prepared)
        self.notes.matched_shares[self.hypothesis] = agreement.ends.matched_share
        return agreement

    def branch(self, hypothesis: int) -> ParticleFilter:
        """As of the base class, with a filter of this class."""
        branched = self.from_state(self.mapping, super().branch(hypothesis).state)
        assert isinstance(branched, _NotingFilter)
        branched.notes = self.notes
        return branched


class NotingFilters(ParticleFilters):
    """The factory of these filters."""

    def __init__(self, mapping: LocalMapping, notes: FilterNotes) -> None:
        super().__init__(mapping)
        self._notes = notes

    def new(self, hypothesis: int, area: int) -> LocalFilter:
        """A filter with an empty map."""
        made = _NotingFilter(self._mapping, hypothesis, area)
        made.notes = self._notes
        return made


class _WeighedSlam:
    """Metric SLAM with other log evidences in its estimates.

    :ivar evidences: {hypothesis: those of the newest keyframe, without known ground}.
    :ivar notes: of the filters.
    """

    def __init__(self, configuration: Configuration, weighing: Weighing) -> None:
        self.evidences: dict[int, Weighing] = {}
        self._weighing = weighing
        self.notes = FilterNotes()
        self._slam = MetricSlam(configuration, None, lambda mapping: NotingFilters(mapping, self.notes))

    def handle(self, message: Message) -> list[Message]:
        """As of metric SLAM."""
        self.notes.evidences.clear()
        answers = self._slam.handle(message)
        return [self._weigh(answer) if isinstance(answer, Keyframe) else answer for answer in answers]

    def _weigh(self, keyframe: Keyframe) -> Keyframe:
        # Without an update after a reset, there is no evidence.
        self.evidences = {
            estimate.hypothesis: Weighing(estimate.log_evidence, self.notes.evidences.get(estimate.hypothesis, 0.0))
            for estimate in keyframe.estimates
        }
        weighed = (
            replace(estimate, log_evidence=self._weighing.weigh(self.evidences[estimate.hypothesis]))
            for estimate in keyframe.estimates
        )
        return replace(keyframe, estimates=tuple(weighed))


class _WeighedBranching(ObservedBranching):
    """A branching that weighs known ground, and notes its evidence.

    :ivar known_ground: {hypothesis: log evidence of the newest keyframe for its known ground, nats}, if several live.
    """

    def __init__(
        self, configuration: Configuration, replica: Replica, listener: ExaminationListener, weight: float
    ) -> None:
        super().__init__(configuration, replica, listener)
        self.known_ground: dict[int, float] = {}
        self._weight = weight

    def begin_event(self) -> None:
        """As of the base class."""
        super().begin_event()
        self.known_ground = {}

    def reweight_by_known_ground(
        self, parent: Parent, pose: Float64, points: Float64, keyframe: int, kidnapped: int | None = None
    ) -> Parent:
        """As of the base class, weighed."""
        log_weight = super().reweight_by_known_ground(parent, pose, points, keyframe, kidnapped).log_weight
        self.known_ground[parent.hypothesis] = log_evidence = log_weight - parent.log_weight
        return replace(parent, log_weight=parent.log_weight + self._weight * log_evidence)


class _ReferenceTruth(Truth):
    """The truth of a recorded log by the trajectory of a run."""

    def __init__(self, log: Log, reference: Path) -> None:
        """:param reference: the trajectory, with source stamps."""
        self.stamps: dict[int, int] = {}
        self.poses: dict[int, Float64] = {}
        trajectory = read_tum(reference)
        scans = [record for record in log.records() if isinstance(record.measurement, Scan)]
        rows = trajectory.nearest_indices(np.array([scan.source_stamp for scan in scans]))
        stamps = (scan.measurement.stamp for scan in scans)
        self._trajectory = dict(zip(stamps, trajectory.poses[rows], strict=True))

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Add a keyframe event."""
        self.poses[keyframe.sequence] = self._trajectory[keyframe.scan.stamp]

    def same_place(self, keyframes: Sequence[int], others: Sequence[int], radius: float = RADIUS) -> Bool:
        """Which of n keyframes are within a radius of which of m others, shape (n, m); walls are not known."""
        ours, theirs = (np.array([self.poses[k][:2] for k in some]).reshape(-1, 2) for some in (keyframes, others))
        return np.asarray(np.hypot(*(ours[:, None] - theirs[None]).transpose(2, 0, 1)) <= radius)


class WeighedRun:
    """A run with other weights.

    :ivar events: keyframe events with a fit in a known area, as of calibration.
    :ivar steps: keyframe events with several live hypotheses, with the evidence of each.
    :ivar accepted: whether each closure that became definite is true, with the probability of its hypothesis.
    """

    def __init__(self, log: Log, truth: Truth, configuration: Configuration, weighing: Weighing) -> None:
        self.events: list[Entry] = []
        self.steps: list[Entry] = []
        self.accepted: list[Entry] = []
        self._log, self._configuration, self._weighing = log, configuration, weighing
        self._truth = truth
        self._paths = Paths(truth)
        self._replica = Replica()
        self._examinations: dict[int, Examination] = {}
        self._collected: dict[int, Weighing] = {}
        self._slam = _WeighedSlam(configuration, weighing)
        self._branching: _WeighedBranching

    def run(self) -> None:
        """Map the whole log."""
        processes: dict[str, Process] = {row.name: row.make(self._configuration) for row in PROCESSES}
        processes |= {"slam": self._slam, "tsbi": Tsbi(self._configuration, self._make_branching)}
        processes |= {"recorder": self}
        lock_step = LockStep(processes)
        for record in self._log.records():
            lock_step.feed(record.measurement)
        lock_step.feed(EndOfLog())

    def _make_branching(self, configuration: Configuration, replica: Replica) -> Branching:
        weight = self._weighing.known_ground
        self._branching = _WeighedBranching(configuration, replica, self._add_examination, weight)
        return self._branching

    def _add_examination(self, examination: Examination) -> None:
        self._examinations[examination.parent.hypothesis] = examination

    def handle(self, message: Message) -> list[Message]:
        """Learn from the messages of the chain."""
        match message:
            case Keyframe():
                self._truth.add_keyframe(message)
                self._replica.add_keyframe(message)
                self._examinations = {}
            case Hypotheses():
                self._add_hypotheses(message)
            case ClosureDecision():
                self._add_decision(message)
        return []

    def _add_hypotheses(self, hypotheses: Hypotheses) -> None:
        self._collect(hypotheses.sequence)
        self._paths.follow(hypotheses, self._replica, self._examinations)
        if any(examination.found.fits for examination in self._examinations.values()):
            answers = live_answers(hypotheses, self._replica, self._examinations, self._paths.paths)
            self.events.append({"event": hypotheses.sequence, "answers": [asdict(answer) for answer in answers]})
        self._collected = {h.id: self._collected[h.parent] for h in hypotheses.hypotheses}
        self._replica.apply_hypotheses(hypotheses)

    def _collect(self, event: int) -> None:
        """Add the evidence of the newest keyframe to that of the live hypotheses."""
        entries, probabilities = [], self._replica.probabilities
        for hypothesis, evidence in self._slam.evidences.items():
            ground = self._branching.known_ground.get(hypothesis, 0.0)
            newest = evidence._replace(known_ground=ground)
            before = self._collected.get(hypothesis, Weighing())
            self._collected[hypothesis] = before.plus(newest)
            path = self._paths.paths[hypothesis]
            entries.append(
                {
                    "probability": probabilities[hypothesis],
                    "before": before,
                    "newest": newest,
                    "right": path.right,
                    "closures": len(path.closures),
                    "matched_share": self._slam.notes.matched_shares.get(hypothesis, 0.0),
                }
            )
        if len(entries) > 1:
            self.steps.append({"event": event, "hypotheses": entries})

    def _add_decision(self, decision: ClosureDecision) -> None:
        probabilities = dict(self._replica.probabilities)
        self._replica.apply_decision(decision)
        if decision.hypothesis is None:
            return
        chosen = self._replica.maps[decision.hypothesis]
        for closure in self._paths.take_accepted(decision.hypothesis, chosen):
            entry = {"probability": probabilities[decision.hypothesis], "right": closure.assessment.true}
            self.accepted.append(entry)
        self._collected = {decision.hypothesis: Weighing()}


def run_weighed(log: str, seed: int, weighing: Weighing, reference: Path | None) -> Entry:
    """Map a log; return its record.

    :param log: name of a simulated log, or path of a recorded one.
    :param reference: trajectory that is the truth of a recorded log.
    """
    begin, configuration = time.process_time(), load_configuration(PARAMETERS, [], seed)
    if reference is None:
        simulated = open_simulated(log)
        run = WeighedRun(simulated, Truth(simulated), configuration, weighing)
    else:
        recorded = open_log(Path(log))
        run = WeighedRun(recorded, _ReferenceTruth(recorded, reference), configuration, weighing)
    run.run()
    record = {"events": run.events, "steps": run.steps, "accepted": run.accepted}
    return record | {"code": code_hash(), "cpu_s": time.process_time() - begin}


def main(arguments: Sequence[str]) -> int:
    """Run; return the exit status."""
    weights, log, seed, file, *reference = arguments
    weighing = Weighing(*map(float, weights.split(",")))
    try:
        record = run_weighed(log, int(seed), weighing, Path(reference[0]) if reference else None)
    except HmtSlamError as fault:
        print(f"weighed: {fault}", file=sys.stderr)
        return 2
    # The file is renamed when it is complete, so that an interrupted run leaves no record.
    part = Path(f"{file}.part")
    part.write_text(json.dumps(record), encoding="utf-8")
    part.replace(file)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
