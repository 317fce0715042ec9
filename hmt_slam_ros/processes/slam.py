"""Metric SLAM: localisation and mapping within the current area, for every live hypothesis.

Section V of Blanco et al. 2008; the second step of Eq. (6). Scans wait in a queue while the topological processes
answer a keyframe event.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.local_map.area_filter import AreaFilter, FilterStep, LocalMapping, PlacedKeyframe
from hmt_slam_ros.processes.messages import (
    Accepted,
    EndOfLog,
    Finished,
    Hypotheses,
    Keyframe,
    Leaf,
    LeafEstimate,
    LocalEstimate,
    Message,
    Notice,
    Relabelled,
    Trail,
)
from hmt_slam_ros.processes.replica import FIRST_AREA, FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.sensing import Odometry, Scan
from hmt_slam_ros.sensing.motion import OdometryBuffer, increment_covariance

_FIRST_COVARIANCE = np.diag([1e-8, 1e-8, 1e-8])
# Below 1, since the filter step at a keyframe may move the robot a little back towards the last one.
_SAME_PLACE = 0.8


@dataclass
class _LiveHypothesis:
    """A filter and what metric SLAM remembers beside it.

    :ivar event_pose: ``area_T_base`` at the last keyframe event, shape (3,).
    :ivar anchor: the stored keyframe to which scans are now related.
    :ivar fresh: {keyframe: covariance (3, 3) of the step that led to it}, of those stored since the area was entered.
    :ivar drift: covariance of the last keyframe's pose in the area's frame, right tangent.
    :ivar trail: (stamp, anchor, ``anchor_T_base``) of the scans since the last keyframe event.
    """

    filter: AreaFilter
    event_pose: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    anchor: int = 0
    fresh: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    drift: NDArray[np.float64] = field(default_factory=_FIRST_COVARIANCE.copy)
    trail: list[tuple[int, int, NDArray[np.float64]]] = field(default_factory=list)

    def branch(self, hypothesis: int) -> _LiveHypothesis:
        return _LiveHypothesis(
            self.filter.branch(hypothesis), self.event_pose, self.anchor, dict(self.fresh), self.drift, list(self.trail)
        )


class MetricSlam:
    """The metric SLAM process.

    Consumes Scan, Odometry, Hypotheses, Accepted, EndOfLog; produces Keyframe, Trail, LocalEstimate, Finished.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._configuration = configuration
        self._mapping = LocalMapping(configuration)
        self._replica = Replica()
        self._odometry = OdometryBuffer()
        self._queue: deque[Scan] = deque()
        self._last_stamp = -1
        self._noticed: set[str] = set()
        self._live = {FIRST_HYPOTHESIS: _LiveHypothesis(AreaFilter(self._mapping, FIRST_HYPOTHESIS, FIRST_AREA))}
        self._events = 0
        self._waiting = False
        self._last_odometry: NDArray[np.float64] | None = None
        self._travelled = 0.0
        self._scans = 0
        self._dropped = 0
        self._first_of_trail = 0
        self._ended = False

    @property
    def waiting_scans(self) -> int:
        """Scans in the queue."""
        return len(self._queue)

    @property
    def particles(self) -> tuple[int, NDArray[np.float64]]:
        """Area of the most probable hypothesis and the poses of its particles, ``area_T_base``, shape (M, 3)."""
        best = self._live[self._replica.best].filter
        return best.area, best.poses

    def handle(self, message: Message) -> list[Message]:
        """Take in one message, work off what can be worked off, return what there is to say."""
        if isinstance(message, Odometry):
            self._odometry.add(message)
        elif isinstance(message, Scan):
            return self._receive(message) + self._work()
        elif isinstance(message, Hypotheses):
            self._change_hypotheses(message)
        elif isinstance(message, Accepted):
            self._accept(message)
        elif isinstance(message, EndOfLog):
            self._ended = True
        return self._work()

    def _work(self) -> list[Message]:
        said: list[Message] = []
        while self._queue and not self._waiting and self._odometry_known():
            said += self._process(self._queue.popleft())
        if self._ended and not self._queue and not self._waiting:
            said += self._finish()
        return said

    def _receive(self, scan: Scan) -> list[Message]:
        """Put a scan into the queue; say, once for each fault, what is wrong with it."""
        said: list[Message] = []
        if scan.stamp <= self._last_stamp:
            said += self._notice(
                "order",
                f"A scan is stamped {scan.stamp / 1e9:.6f} s, not after its predecessor "
                f"({self._last_stamp / 1e9:.6f} s); scans are taken in the order of their arrival: check the clocks or "
                "the order of the log.",
            )
        if not scan.valid.any():
            said += self._notice(
                "empty",
                f"The scan at {scan.stamp / 1e9:.6f} s has no return between {scan.range_min:g} and {scan.range_max:g} "
                "m; such scans are placed by odometry alone: check the laser and its range limits.",
            )
        self._queue.append(scan)
        self._last_stamp = scan.stamp
        if self._out_of_patience():
            said += self._notice(
                "odometry",
                f"{len(self._queue)} scans wait for odometry at {self._queue[0].stamp / 1e9:.6f} s and are now matched "
                "from the last reading: check the odometry topic and its stamps.",
            )
        return said

    def _notice(self, fault: str, text: str) -> list[Message]:
        if fault in self._noticed:
            return []
        self._noticed.add(fault)
        return [Notice("slam", text)]

    def _out_of_patience(self) -> bool:
        return len(self._queue) > self._configuration.filter.patience and not self._odometry.covers(
            self._queue[0].stamp
        )

    def _odometry_known(self) -> bool:
        return (
            self._ended
            or self._odometry.covers(self._queue[0].stamp)
            or self._out_of_patience()
        )

    def _process(self, scan: Scan) -> list[Message]:
        odometry = self._odometry.at(scan.stamp)
        odometry = np.zeros(3) if odometry is None else odometry
        increment = np.zeros(3) if self._last_odometry is None else se2.between(self._last_odometry, odometry)
        self._last_odometry = odometry
        points = self._mapping.matching_points(scan)
        if self._events:
            covariance = increment_covariance(increment, self._configuration.motion)
            for live in self._live.values():
                live.filter.track(points, increment, covariance)
        self._travelled += math.hypot(increment[0], increment[1])
        said = self._keyframe_event(scan, points) if self._event_due() else []
        self._note_trail(scan.stamp)
        self._scans += 1
        return [*said, self._estimate(scan.stamp, odometry)]

    def _event_due(self) -> bool:
        """Whether the robot moved or turned far enough, under the most probable hypothesis."""
        if not self._events:
            return True
        live = self._live[self._replica.best]
        moved = se2.between(live.event_pose, live.filter.pose)
        settings = self._configuration.filter
        return (
            math.hypot(moved[0], moved[1]) >= settings.keyframe_distance
            or abs(moved[2]) >= math.radians(settings.keyframe_angle)
        )

    def _keyframe_event(self, scan: Scan, points: NDArray[np.float64]) -> list[Message]:
        sequence = self._events
        trails: list[Message] = self._trails()
        leaves = tuple(self._leaf_event(live, sequence, scan, points) for live in self._live.values())
        keyframe = Keyframe(sequence, scan, self._travelled, leaves)
        self._replica.add(keyframe)
        self._events += 1
        self._waiting = True
        return [*trails, keyframe]

    def _leaf_event(
        self, live: _LiveHypothesis, sequence: int, scan: Scan, points: NDArray[np.float64]
    ) -> LeafEstimate:
        """One filter step; the keyframe enters the map where it adds something new."""
        area_filter = live.filter
        if sequence == 0:
            step = FilterStep(_FIRST_COVARIANCE, 0.0, float(len(area_filter.poses)), False)
        else:
            step = area_filter.update(points, sequence)
        inflated = self._configuration.filter.covariance_inflation * step.covariance
        stored = self._is_new(live)
        if stored:
            moved = se2.between(live.event_pose, area_filter.pose)
            ad = se2.adjoint(se2.inverse(moved))
            live.drift = ad @ live.drift @ ad.T + inflated
            live.fresh[sequence] = inflated
            area_filter.add_keyframe(sequence, scan)
        else:
            live.drift = inflated
        live.event_pose = area_filter.pose
        live.anchor = self._nearest_keyframe(live)
        return LeafEstimate(
            area_filter.hypothesis,
            area_filter.area,
            PoseGaussian(area_filter.pose, live.drift),
            stored,
            step.log_evidence,
            step.effective_samples,
            self._revised(live, sequence) if step.history_changed else (),
        )

    def _is_new(self, live: _LiveHypothesis) -> bool:
        """Whether no keyframe of the local map was taken from nearby with a like heading."""
        if not live.filter.keyframes:
            return True
        settings = self._configuration.filter
        relative = se2.between(live.filter.leading_keyframe_poses(), live.filter.pose)
        near = np.hypot(relative[:, 0], relative[:, 1]) < _SAME_PLACE * settings.keyframe_distance
        alike = np.abs(relative[:, 2]) < _SAME_PLACE * math.radians(settings.keyframe_angle)
        return not bool(np.any(near & alike))

    @staticmethod
    def _nearest_keyframe(live: _LiveHypothesis) -> int:
        relative = se2.between(live.filter.leading_keyframe_poses(), live.filter.pose)
        cost = np.hypot(relative[:, 0], relative[:, 1]) + np.abs(relative[:, 2])
        return live.filter.keyframes[int(np.argmin(cost))]

    @staticmethod
    def _revised(live: _LiveHypothesis, newest: int) -> tuple[Relabelled, ...]:
        area_filter = live.filter
        poses = area_filter.leading_keyframe_poses()
        return tuple(
            Relabelled(keyframe, area_filter.area, area_filter.area, poses[area_filter.keyframes.index(keyframe)])
            for keyframe in live.fresh
            if keyframe != newest
        )

    def _note_trail(self, stamp: int) -> None:
        for live in self._live.values():
            row = live.filter.keyframes.index(live.anchor)
            anchor_pose = live.filter.leading_keyframe_poses()[row]
            live.trail.append((stamp, live.anchor, se2.between(anchor_pose, live.filter.pose)))

    def _trails(self) -> list[Message]:
        """The trails since the last event, of every hypothesis."""
        said: list[Message] = []
        for live in self._live.values():
            if live.trail:
                stamps, anchors, poses = zip(*live.trail, strict=True)
                said.append(
                    Trail(
                        live.filter.hypothesis,
                        self._first_of_trail,
                        np.array(stamps, dtype=np.int64),
                        np.array(anchors, dtype=np.int64),
                        np.array(poses),
                    )
                )
            live.trail = []
        self._first_of_trail = self._scans
        return said

    def _estimate(self, stamp: int, odometry: NDArray[np.float64]) -> LocalEstimate:
        live = self._live[self._replica.best]
        ad = se2.adjoint(se2.inverse(se2.between(live.event_pose, live.filter.pose)))
        covariance = ad @ live.drift @ ad.T + live.filter.tracking_covariance
        belief = PoseGaussian(live.filter.pose, covariance)
        return LocalEstimate(stamp, self._scans - 1, live.filter.area, belief, odometry, self._dropped)

    def _change_hypotheses(self, hypotheses: Hypotheses) -> None:
        """Branch, re-base and drop filters as TSBI decided."""
        self._replica.apply(hypotheses)
        children = {}
        for leaf in hypotheses.leaves:
            parent = self._live[leaf.parent]
            live = parent if leaf.hypothesis == leaf.parent else parent.branch(leaf.hypothesis)
            self._change_area(live, leaf)
            children[leaf.hypothesis] = live
        self._replace_live(children)

    def _accept(self, accepted: Accepted) -> None:
        self._replica.accept(accepted)
        if accepted.hypothesis is not None:
            live = self._live[accepted.hypothesis]
            self._replace_live({accepted.hypothesis: live})
            for refined in accepted.relabelled:
                if refined.area == live.filter.area:
                    live.filter.move_keyframe(refined.keyframe, refined.pose)
        self._waiting = False

    def _replace_live(self, live: dict[int, _LiveHypothesis]) -> None:
        for hypothesis, old in self._live.items():
            if live.get(hypothesis) is not old:
                old.filter.release()
        self._live = live

    def _change_area(self, live: _LiveHypothesis, leaf: Leaf) -> None:
        """Change the reference frame and load the local map: the keyframes of the areas that TSBI names."""
        if not leaf.local:
            return
        hybrid_map = self._replica.maps[leaf.hypothesis]
        area_T_previous = np.zeros(3) if leaf.rebase is None else leaf.rebase.mean
        content = [
            PlacedKeyframe(keyframe, local.area, self._replica.scans[keyframe], se2.compose(local.pose, pose))
            for local in leaf.local
            for keyframe, pose in hybrid_map.keyframes(local.area).items()
        ]
        live.filter.change_area(leaf.area, area_T_previous, content)
        live.event_pose = se2.compose(area_T_previous, live.event_pose)
        if leaf.rebase is not None:
            moved = {relabelled.keyframe for relabelled in leaf.relabelled}
            live.fresh = {keyframe: step for keyframe, step in live.fresh.items() if keyframe in moved}
            live.drift = self._drift_from_reference(live)
        live.anchor = self._nearest_keyframe(live)

    @staticmethod
    def _drift_from_reference(live: _LiveHypothesis) -> NDArray[np.float64]:
        """Covariance of the last keyframe relative to the area's reference keyframe, the first that moved with it."""
        drift = _FIRST_COVARIANCE
        poses = dict(zip(live.filter.keyframes, live.filter.leading_keyframe_poses(), strict=True))
        ordered = sorted(live.fresh)
        for previous, keyframe in pairwise(ordered):
            ad = se2.adjoint(se2.between(poses[keyframe], poses[previous]))
            drift = ad @ drift @ ad.T + live.fresh[keyframe]
        return drift

    def _finish(self) -> list[Message]:
        self._ended = False
        return [*self._trails(), Finished(self._scans + self._dropped, self._scans, self._dropped)]
