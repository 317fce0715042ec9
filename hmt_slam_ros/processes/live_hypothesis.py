"""One live hypothesis inside metric SLAM: its filter, its keyframes, and what its scans are related to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.metric import Filter
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.local_map.area_filter import AreaFilter, FilterStep, PlacedKeyframe
from hmt_slam_ros.processes.messages import Leaf, LeafEstimate, Relabelled, Trail
from hmt_slam_ros.sensing import Scan

_FIRST_COVARIANCE = np.diag([1e-8, 1e-8, 1e-8])
# Below 1, since the filter step at a keyframe may move the robot a little back towards the last one.
_SAME_PLACE = 0.8


@dataclass
class LiveHypothesis:
    """A filter and what metric SLAM remembers beside it.

    :ivar settings: when keyframes are taken, and how far their covariance is to be trusted.
    :ivar moved: the motion between the last two keyframe events, as matched, shape (3,).
    :ivar information: of the last keyframe event's match alone, in the frame of its pose, shape (3, 3).
    :ivar event_pose: ``area_T_base`` at the last keyframe event, shape (3,).
    :ivar anchor: the stored keyframe to which scans are now related.
    :ivar fresh: {keyframe: covariance (3, 3) of the step that led to it}, of those stored since the area was entered.
    :ivar drift: covariance of the last keyframe's pose in the area's frame, right tangent.
    :ivar trail: (stamp, anchor, ``anchor_T_base``) of the scans since the last keyframe event.
    """

    filter: AreaFilter
    settings: Filter
    event_pose: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    moved: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    information: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 3)))
    anchor: int = 0
    fresh: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    drift: NDArray[np.float64] = field(default_factory=_FIRST_COVARIANCE.copy)
    trail: list[tuple[int, int, NDArray[np.float64]]] = field(default_factory=list)

    def branch(self, hypothesis: int) -> LiveHypothesis:
        """A child with its own filter, in the same state."""
        return LiveHypothesis(
            self.filter.branch(hypothesis),
            self.settings,
            self.event_pose,
            self.moved,
            self.information,
            self.anchor,
            dict(self.fresh),
            self.drift,
            list(self.trail),
        )

    def event_due(self) -> bool:
        """Whether the robot moved or turned far enough since the last keyframe event."""
        moved = se2.between(self.event_pose, self.filter.pose)
        far = math.hypot(moved[0], moved[1]) >= self.settings.keyframe_distance
        return far or abs(moved[2]) >= math.radians(self.settings.keyframe_angle)

    def event(self, sequence: int, scan: Scan, points: NDArray[np.float64]) -> LeafEstimate:
        """One filter step with a keyframe's scan, which enters the map where it adds something new.

        :param sequence: number of the keyframe event; the first one finds the robot at the origin of its area.
        :param points: surfels of the scan, to be matched, shape (n, 4), base frame.
        """
        if sequence == 0:
            unmoved, nothing = np.zeros(3), np.zeros((3, 3))
            step = FilterStep(unmoved, _FIRST_COVARIANCE, nothing, 0.0, float(len(self.filter.poses)), False)
        else:
            step = self.filter.update(points, sequence)
        stored = self._is_new()
        self._drift_on(step.covariance, sequence if stored else None)
        if stored:
            self.filter.add_keyframe(sequence, scan)
        self.moved, self.information = step.moved, step.information
        self.event_pose = self.filter.pose
        self._relate()
        return LeafEstimate(
            self.filter.hypothesis,
            self.filter.area,
            PoseGaussian(self.filter.pose, self.drift),
            stored,
            step.log_evidence,
            step.effective_samples,
            self._revised(sequence) if step.history_changed else (),
        )

    def _is_new(self) -> bool:
        """Whether no keyframe of the local map was taken from nearby with a like heading."""
        if not self.filter.keyframes:
            return True
        relative = se2.between(self.filter.leading_keyframe_poses(), self.filter.pose)
        near = np.hypot(relative[:, 0], relative[:, 1]) < _SAME_PLACE * self.settings.keyframe_distance
        alike = np.abs(relative[:, 2]) < _SAME_PLACE * math.radians(self.settings.keyframe_angle)
        return not bool(np.any(near & alike))

    def _drift_on(self, step: NDArray[np.float64], keyframe: int | None) -> None:
        """Add a step's covariance (3, 3) to the drift; over ground that is mapped the map bounds it."""
        if keyframe is None:
            self.drift = step
            return
        ad = se2.adjoint(se2.between(self.filter.pose, self.event_pose))
        self.drift = ad @ self.drift @ ad.T + step
        self.fresh[keyframe] = step

    def _relate(self) -> None:
        """Relate the scans to come to the nearest keyframe."""
        relative = se2.between(self.filter.leading_keyframe_poses(), self.filter.pose)
        cost = np.hypot(relative[:, 0], relative[:, 1]) + np.abs(relative[:, 2])
        self.anchor = self.filter.keyframes[int(np.argmin(cost))]

    def _revised(self, newest: int) -> tuple[Relabelled, ...]:
        # The messages must not hold on to the poses under all particles.
        poses = self.filter.leading_keyframe_poses().copy()
        return tuple(
            Relabelled(keyframe, self.filter.area, self.filter.area, poses[self.filter.keyframes.index(keyframe)])
            for keyframe in self.fresh
            if keyframe != newest
        )

    def note_scan(self, stamp: int) -> None:
        """Append the scan just processed to the trail."""
        anchor_pose = self.filter.leading_keyframe_poses()[self.filter.keyframes.index(self.anchor)]
        self.trail.append((stamp, self.anchor, se2.between(anchor_pose, self.filter.pose)))

    def take_trail(self, first_scan: int) -> list[Trail]:
        """The trail as a message, if there is one, and begin it anew."""
        if not self.trail:
            return []
        stamps, anchors, poses = zip(*self.trail, strict=True)
        self.trail = []
        return [
            Trail(
                self.filter.hypothesis,
                first_scan,
                np.array(stamps, dtype=np.int64),
                np.array(anchors, dtype=np.int64),
                np.array(poses),
            )
        ]

    def belief(self) -> PoseGaussian:
        """The belief over ``area_T_base`` now."""
        ad = se2.adjoint(se2.between(self.filter.pose, self.event_pose))
        return PoseGaussian(self.filter.pose, ad @ self.drift @ ad.T + self.filter.tracking_covariance)

    def change_area(self, leaf: Leaf, content: Sequence[PlacedKeyframe]) -> None:
        """Change the reference frame and load the local map, as TSBI decided.

        :param content: the keyframes of the areas that it names, in the frame of the robot's area.
        """
        entered = leaf.area != self.filter.area
        area_T_previous = np.zeros(3) if leaf.rebase is None else leaf.rebase.mean
        self.filter.change_area(leaf.area, area_T_previous, content)
        self.event_pose = se2.compose(area_T_previous, self.event_pose)
        if entered:
            moved = {relabelled.keyframe for relabelled in leaf.relabelled}
            self.fresh = {keyframe: step for keyframe, step in self.fresh.items() if keyframe in moved}
            self.drift = self._drift_from_reference()
        self._relate()

    def _drift_from_reference(self) -> NDArray[np.float64]:
        """Covariance of the last keyframe relative to the area's reference keyframe, the first that moved with it."""
        drift = _FIRST_COVARIANCE
        poses = dict(zip(self.filter.keyframes, self.filter.leading_keyframe_poses(), strict=True))
        for previous, keyframe in pairwise(sorted(self.fresh)):
            ad = se2.adjoint(se2.between(poses[keyframe], poses[previous]))
            drift = ad @ drift @ ad.T + self.fresh[keyframe]
        return drift

    def reload(self, content: Sequence[PlacedKeyframe]) -> None:
        """Build the local map anew after TLCA refined its keyframes; the robot stays where it is from its anchor.

        :param content: all keyframes of the local map, in the frame of the robot's area.
        """
        before = self.filter.pose
        self.filter.reload(content, self.anchor)
        self.event_pose = se2.compose(self.filter.pose, se2.between(before, self.event_pose))
