"""Questions that a run leaves open: the first event at which a true and a false hypothesis are probable."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from benchmark.kidnapping import is_jump
from benchmark.simulated.loops import OLD
from benchmark.simulated.truth import NEAR, RADIUS, TURN
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import Neighborhood, areas_around, keyframes_before
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.messages.ambiguity import Ambiguity
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.simulation import SimulatedLog

Verdict = Literal["right", "wrong", "open"]

OPEN, SURE = 0.2, 0.95
"""Probability of a true and of a false hypothesis that make a question, and from which on one is sure."""

_RECENT = 5.0
"""Path before the question whose keyframes identify a hypothesis's place, m."""

_AROUND = Neighborhood(max_sigma=0.5, max_distance=12.0)
"""The areas of a hypothesis whose keyframes count as around its place."""


@dataclass(frozen=True)
class PlaceTruth:
    """Where the robot truly was before a question.

    :ivar poses: {keyframe: ``world_T_base``, shape (3,)}, of all keyframes before it.
    :ivar old: keyframes of before the robot came there.
    :ivar recent: the last keyframes before the question, those first that are nearest to old ones.
    :ivar known: those of the recent ones that truly are in the place of an old one.
    """

    poses: Mapping[int, Float64]
    old: frozenset[int]
    recent: Sequence[int]
    known: frozenset[int]

    def is_right(self, hybrid_map: HybridMap) -> bool:
        """Whether a hypothesis has the robot's path where it was: at the right pose in old ground, or on new ground."""
        areas = {k: area for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area)}
        keyframe = next((k for k in self.recent if k in areas), None)
        if keyframe is None:
            return False
        around = areas_around(hybrid_map, areas[keyframe], _AROUND)
        poses, _ = keyframes_before(hybrid_map, {area: belief.mean for area, belief in around.items()}, math.inf)
        distances = {k: math.dist(poses[k][:2], poses[keyframe][:2]) for k in poses if k in self.old}
        nearest = min(distances, key=lambda k: (distances[k], k), default=keyframe)
        if distances.get(nearest, math.inf) > RADIUS:
            return keyframe not in self.known
        estimated = se2.between(poses[nearest], poses[keyframe])
        error = se2.between(estimated, se2.between(self.poses[nearest], self.poses[keyframe]))
        return bool(math.hypot(error[0], error[1]) <= NEAR and abs(error[2]) <= math.radians(TURN))

    def shares(self, replica: Replica) -> tuple[float, float]:
        """The probability of all true hypotheses, and the largest of a false one."""
        right, wrong = 0.0, 0.0
        for hypothesis, probability in replica.probabilities.items():
            if self.is_right(replica.maps[hypothesis]):
                right += probability
            else:
                wrong = max(wrong, probability)
        return right, wrong

    def verdict(self, replica: Replica) -> Verdict:
        """Which hypothesis is sure."""
        right, wrong = self.shares(replica)
        return "right" if right >= SURE else "wrong" if wrong >= SURE else "open"


@dataclass(frozen=True)
class OpenQuestion:
    """A run at its question.

    :ivar event: the last keyframe event.
    :ivar at: path before it, m.
    :ivar stamp: of the last record, ns.
    :ivar pose: shape (3,), ``world_T_base`` then.
    :ivar odometry: shape (3,), ``odom_T_base`` then.
    :ivar state: of the run.
    :ivar ambiguity: the last one, None before the first.
    :ivar truth: of the place.
    """

    event: int
    at: float
    stamp: int
    pose: Float64
    odometry: Float64
    state: RunState
    ambiguity: Ambiguity | None
    truth: PlaceTruth


class _AmbiguityKeeper:
    """Keeps the last ambiguity, in the place of an explorer."""

    def __init__(self) -> None:
        self.ambiguity: Ambiguity | None = None

    def handle(self, message: Message) -> list[Message]:
        """Handle one message."""
        if isinstance(message, Ambiguity):
            self.ambiguity = message
        return []


def slam_replica(processes: Mapping[str, Any]) -> Replica:
    """The maps of the live hypotheses of a run."""
    slam = processes["slam"]
    assert isinstance(slam, MetricSlam)
    return slam.replica


class QuestionFinder:
    """Runs a simulated log until its first question.

    :ivar run: the processes.
    """

    def __init__(self, configuration: Configuration, log: SimulatedLog) -> None:
        """:param log: if the robot is kidnapped there, only questions after that count."""
        self._keeper = _AmbiguityKeeper()
        self.run = LockStepRun(configuration, observers={"explorer": self._keeper})
        self._log = log
        self._poses: dict[int, Float64] = {}
        self._stamps: dict[int, int] = {}
        self._last_pose: Float64 | None = None
        self._odometry = np.zeros(3)
        self._displaced_at = -1

    @property
    def replica(self) -> Replica:
        """The maps of the live hypotheses."""
        return slam_replica(self.run.lock_step.processes)

    def process(self, record: LogRecord) -> OpenQuestion | None:
        """Process a record; the question after it, None where nothing is open."""
        assert record.true_pose is not None
        if isinstance(record.measurement, Odometry):
            self._odometry = record.measurement.pose
        elif isinstance(record.measurement, Scan):
            if self._last_pose is not None and is_jump(self._last_pose, record.true_pose):
                self._displaced_at = len(self._poses)
            self._last_pose = record.true_pose
        self.run.process_record(record)
        events = self.run.recorder.keyframes
        new = range(len(self._poses), len(events))
        for event in new:
            self._stamps[event] = events[event].scan.stamp
            self._poses[event] = self._log.true_poses(np.array([self._stamps[event]]))[0]
        probable = [p for p in self.replica.probabilities.values() if p >= OPEN]
        is_waiting = self._log.scenario.settings.carried > 0.0 and self._displaced_at < 0
        if not new or len(probable) < 2 or is_waiting:
            return None
        truth = self._place_truth()
        right, wrong = truth.shares(self.replica)
        if min(right, wrong) < OPEN:
            return None
        event = len(events) - 1
        at = events[event].path_length
        state, ambiguity = self.run.state, self._keeper.ambiguity
        return OpenQuestion(event, at, record.source_stamp, record.true_pose, self._odometry, state, ambiguity, truth)

    def _place_truth(self) -> PlaceTruth:
        events = self.run.recorder.keyframes
        now = max(events)
        traveled = {k: events[k].path_length for k in events}
        since = max(self._displaced_at, 0)
        recent = [k for k in events if k >= since and traveled[k] >= traveled[now] - _RECENT]
        is_displaced = self._displaced_at >= 0 and traveled[now] - traveled[since] < OLD
        old = [k for k in events if (k < since if is_displaced else traveled[k] <= traveled[now] - _RECENT - OLD)]
        if not old:
            return PlaceTruth(dict(self._poses), frozenset(), recent[::-1], frozenset())
        stamps, others = (np.array([self._stamps[k] for k in ks], dtype=np.int64) for ks in (recent, old))
        same = self._log.same_place(stamps, others, RADIUS)
        known = {k for row, k in enumerate(recent) if same[row].any()}
        old_positions = np.array([self._poses[k][:2] for k in old])
        nearest = {k: float(np.hypot(*(old_positions - self._poses[k][:2]).T).min()) for k in recent}
        ordered = sorted(recent, key=lambda k: (k not in known, nearest[k], -k))
        return PlaceTruth(dict(self._poses), frozenset(old), ordered, frozenset(known))
