"""For tests of TSBI: a ring of corridors, the drive along it, and a stand-in for the processes around TSBI."""

import math

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.messages import (
    AreaEvent,
    AreaEvents,
    ClosureDecision,
    Hypotheses,
    HypothesisEstimate,
    Keyframe,
)
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.topological_inference.tsbi import Tsbi

# A ring of corridors, 2 m wide, with niches and pillars that differ from side to side.
RING = np.concatenate(
    (
        box(0.0, 0.0, 18.0, 12.0),
        box(2.0, 2.0, 16.0, 10.0),
        box(5.0, 0.0, 6.0, 0.4),
        box(11.0, 1.7, 11.6, 2.0),
        box(17.6, 4.0, 18.0, 5.5),
        box(16.0, 7.0, 16.3, 7.5),
        box(8.0, 11.5, 10.0, 12.0),
        box(4.0, 10.0, 4.4, 10.5),
        box(0.0, 6.0, 0.5, 6.6),
        box(1.6, 3.0, 2.0, 4.4),
    )
)
STEP = np.diag([0.02, 0.02, math.radians(0.25)]) ** 2  # covariance of the odometry between keyframes


def ring_drive(length):
    """``length`` poses half a meter apart, counter-clockwise along the middle of the corridors from (3, 1)."""
    corners = np.array([[17.0, 1.0], [17.0, 11.0], [1.0, 11.0], [1.0, 1.0]])
    poses, here, corner = [], np.array([3.0, 1.0]), 0
    while len(poses) < length:
        leg = corners[corner % 4] - here
        distance = math.hypot(*leg)
        if distance < 0.5:
            corner += 1
            continue
        poses.append([*here, math.atan2(leg[1], leg[0])])
        here = here + 0.5 * leg / distance
    return np.array(poses)


class Run:
    """A stand-in for metric SLAM, AAM and TLCA around a TSBI: dead reckoning with drift, cuts at given keyframes."""

    def __init__(self, walls, drift=(0.0, 0.0, 0.0), configuration=None, **laser):
        self.walls, self.laser = walls, laser
        self.drift = np.array(drift)
        self.tsbi = Tsbi(configuration or Configuration())
        self.replica = Replica()
        self.poses = {0: np.zeros(3)}
        self.covariances = {0: np.diag([1e-8, 1e-8, 1e-8])}
        self.true_pose = None
        self.answers, self.notices = [], []
        self.evidence = {}
        self.stored = True
        self.stale_beams = ()
        self.marks = ()

    def keyframe(self, true_pose, cut=0, moved=None, merged=None, mapping=True, motion_condition="ordinary"):
        """One keyframe event; ``cut`` is how many of the newest keyframes leave the area, in every hypothesis.

        :param merged: an area, and the one that it becomes part of.
        """
        sequence = len(self.answers)
        if self.true_pose is not None:
            step = se2.compose(se2.between(self.true_pose, true_pose), self.drift)
            for h in self.poses:
                self.poses[h] = se2.compose(self.poses[h], step)
                ad = se2.adjoint(se2.inverse(step))
                self.covariances[h] = ad @ self.covariances[h] @ ad.T + STEP
        self.true_pose = true_pose
        scan = scan_in(self.walls, true_pose, stamp=sequence, noise=0.01, seed=sequence, **self.laser)
        hypotheses = tuple(
            HypothesisEstimate(
                h,
                self.replica.robot_areas[h],
                PoseGaussian(self.poses[h], self.covariances[h]),
                self.stored,
                self.evidence.get(h, 0.0),
                -self.evidence.get(h, 0.0),
                Clutter(),
                12.0,
            )
            for h in sorted(self.poses)
        )
        message = Keyframe(
            sequence,
            scan,
            0.5 * sequence,
            hypotheses,
            mapping=mapping,
            stale_beams=self.stale_beams,
            motion_condition=motion_condition,
            marks=self.marks,
        )
        assert self.tsbi.handle(message) == []
        self.replica.add_keyframe(message)
        return self._answer(sequence, self._events(sequence, cut, moved, merged))

    def _events(self, sequence, cut, moved, merged):
        if merged is not None:
            return tuple(AreaEvent(h, "merged", (), merged[0], 0.9, merged[1]) for h in sorted(self.poses))
        if moved is not None:
            return tuple(AreaEvent(h, "moved", (), moved, 0.5) for h in sorted(self.poses))
        newest = tuple(range(sequence - cut + 1, sequence + 1))
        return tuple(AreaEvent(h, "cut", newest, self.replica.robot_areas[h], 0.2) for h in sorted(self.poses) if cut)

    def _answer(self, sequence, events):
        *notices, answer = self.tsbi.handle(AreaEvents(sequence, events))
        self.notices += [notice.text for notice in notices]
        assert isinstance(answer, Hypotheses)
        assert answer.sequence == sequence
        assert sum(hypothesis.probability for hypothesis in answer.hypotheses) + answer.unexamined == pytest.approx(1.0)
        assert [hypothesis.id for hypothesis in answer.hypotheses] == sorted(
            {hypothesis.id for hypothesis in answer.hypotheses}
        )
        self.replica.apply_hypotheses(answer)
        rebased = {
            hypothesis.id: self.poses[hypothesis.parent]
            if hypothesis.frame_change is None
            else se2.compose(hypothesis.frame_change.mean, self.poses[hypothesis.parent])
            for hypothesis in answer.hypotheses
        }
        self.covariances = {
            hypothesis.id: self.covariances[hypothesis.parent]
            if hypothesis.frame_change is None
            else len(hypothesis.moved_keyframes) * STEP
            for hypothesis in answer.hypotheses
        }
        self.poses = rebased
        self.answers.append(answer)
        return answer

    def accept(self, hypothesis, **more):
        message = ClosureDecision(len(self.answers) - 1, hypothesis, **more)
        assert self.tsbi.handle(message) == []
        self.replica.apply_decision(message)
        self.poses = {hypothesis: self.poses[hypothesis]}
        self.covariances = {hypothesis: self.covariances[hypothesis]}
