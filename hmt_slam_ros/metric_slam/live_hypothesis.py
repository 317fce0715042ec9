"""One live hypothesis inside metric SLAM: its filter, its keyframes, and what its scans are related to."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Int64
from hmt_slam_ros.configuration.metric_slam import FilterParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.keyframe_pruning import ReplacementKeyframe, is_same_viewpoint, nearest_replacement
from hmt_slam_ros.lifelong.change_detection import RecentScan, append_recent_scan
from hmt_slam_ros.messages.map_changes import AreaMerge, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis, HypothesisEstimate, ScanPoses
from hmt_slam_ros.registration.consistency import NO_EVIDENCE, ScanEvidence
from hmt_slam_ros.registration.match_covariance import MatchError
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_filter import (
    FilterFactory,
    FilterStep,
    LineFilterState,
    LocalFilter,
    ParticleFilterState,
    PlacedKeyframe,
)
from hmt_slam_ros.submap.local_mapping import PreparedScan

_INITIAL_COVARIANCE = np.diag([1e-8, 1e-8, 1e-8])
_IDENTITY = PoseGaussian.from_pose(np.zeros(3))
_NO_ERROR = MatchError(_INITIAL_COVARIANCE, _INITIAL_COVARIANCE, np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class KeyframeCovariances:
    """Covariances by keyframe, in the order in which these came.

    A hypothesis looks them up in a dictionary, of which this is the saved form: two arrays for thousands of keyframes.

    :ivar keyframes: shape (n,).
    :ivar covariances: shape (n, 3, 3), right tangent frame.
    """

    keyframes: Int64
    covariances: NDArray[np.float64]

    @classmethod
    def from_dict(cls, covariances: Mapping[int, NDArray[np.float64]]) -> KeyframeCovariances:
        """Of {keyframe: covariance}."""
        rows = np.array(list(covariances.values())).reshape(-1, 3, 3)
        return cls(np.array(list(covariances), dtype=np.int64), rows)

    def to_dict(self) -> dict[int, NDArray[np.float64]]:
        """{keyframe: covariance}."""
        return dict(zip(self.keyframes.tolist(), self.covariances, strict=True))


@dataclass(frozen=True, eq=False)
class LastEvent:
    """What is remembered of the last keyframe event of a hypothesis.

    :ivar pose: ``area_T_base`` then, shape (3,), m and rad.
    :ivar motion: the motion between the last two keyframe events, as matched, shape (3,).
    :ivar match_information: of the event's match alone, in the frame of its pose, shape (3, 3).
    :ivar motion_error: of that motion.
    :ivar anchor: the stored keyframe to which scans are now related.
    :ivar pose_covariance: covariance of the pose in the area's frame, right tangent, shape (3, 3).
    :ivar contradicted: whether the scan contradicted what the robot should have seen.
    :ivar recent_scans: the scans that the next keyframe's is compared with, in mode lifelong.
    """

    pose: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    motion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    match_information: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 3)))
    motion_error: MatchError = _NO_ERROR
    anchor: int = 0
    pose_covariance: NDArray[np.float64] = field(default_factory=_INITIAL_COVARIANCE.copy)
    contradicted: bool = False
    recent_scans: tuple[RecentScan, ...] = ()


@dataclass(frozen=True, eq=False)
class LiveHypothesisState:
    """One live hypothesis inside metric SLAM, as it is saved: what it holds in tables that grow is here as a value.

    :ivar particle_filter: its particles, where its local map is a grid.
    :ivar line_filter: its filter, where its local map is one of lines.
    :ivar event: what is remembered of the last keyframe event.
    :ivar step_covariances: what the step which led to a keyframe adds to the drift, of those stored since the area was
        entered.
    :ivar keyframe_covariances: of the poses of keyframes in their areas' frames, of all that are known.
    :ivar scan_poses: (stamp, anchor, ``keyframe_T_base``) of the scans since the last keyframe event.
    """

    particle_filter: ParticleFilterState | None
    line_filter: LineFilterState | None
    event: LastEvent
    step_covariances: KeyframeCovariances
    keyframe_covariances: KeyframeCovariances
    scan_poses: tuple[tuple[int, int, NDArray[np.float64]], ...]


@dataclass
class LiveHypothesis:
    """A filter and what metric SLAM remembers beside it; in its tables as :class:`LiveHypothesisState` tells.

    :ivar settings: when keyframes are taken, and how far their covariance is to be trusted.
    :ivar event: what is remembered of the last keyframe event.
    """

    filter: LocalFilter
    settings: FilterParameters
    event: LastEvent = field(default_factory=LastEvent)
    step_covariances: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    keyframe_covariances: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    scan_poses: list[tuple[int, int, NDArray[np.float64]]] = field(default_factory=list)

    @classmethod
    def from_state(
        cls, filters: FilterFactory, settings: FilterParameters, state: LiveHypothesisState
    ) -> LiveHypothesis:
        """The hypothesis of a state, whose patches are in the pool."""
        own = state.particle_filter or state.line_filter
        assert own is not None
        return cls(
            filters.restore(own),
            settings,
            state.event,
            state.step_covariances.to_dict(),
            state.keyframe_covariances.to_dict(),
            list(state.scan_poses),
        )

    def state(self) -> LiveHypothesisState:
        """All that is remembered; tables of grids name patches by their numbers in the pool."""
        own = self.filter.state
        return LiveHypothesisState(
            own if isinstance(own, ParticleFilterState) else None,
            None if isinstance(own, ParticleFilterState) else own,
            self.event,
            KeyframeCovariances.from_dict(self.step_covariances),
            KeyframeCovariances.from_dict(self.keyframe_covariances),
            tuple(self.scan_poses),
        )

    def branch(self, hypothesis: int) -> LiveHypothesis:
        """A child with its own filter, in the same state."""
        return LiveHypothesis(
            self.filter.branch(hypothesis),
            self.settings,
            self.event,
            dict(self.step_covariances),
            dict(self.keyframe_covariances),
            list(self.scan_poses),
        )

    def is_event_due(self, sighting: PreparedScan) -> bool:
        """Whether the robot moved or turned far enough since the last keyframe event, or may have been displaced.

        :param sighting: the newest one. Where it is the first that contradicts what the robot should see, it is where
            the robot is now.
        """
        moved = se2.between(self.event.pose, self.filter.pose)
        far = math.hypot(moved[0], moved[1]) >= self.settings.keyframe_distance
        if far or abs(moved[2]) >= math.radians(self.settings.keyframe_angle):
            return True
        if self.event.contradicted:
            return False
        return (
            self.filter.clutter_estimate.evaluate(self.filter.compare_scan(sighting)).log_kidnapping_ratio
            > self.settings.contradiction_evidence
        )

    def process_keyframe(
        self,
        sequence: int,
        sighting: PreparedScan,
        *,
        after_reset: bool = False,
        may_store: bool = True,
        is_informative: Callable[[], bool] | None = None,
    ) -> HypothesisEstimate:
        """One filter step with a keyframe's scan, which enters the map where it adds something new.

        :param sequence: number of the keyframe event.
        :param sighting: of the scan.
        :param after_reset: whether nothing tells how the robot came there: the scan is matched with nothing.
        :param may_store: whether the hypothesis's map may change.
        :param is_informative: asked after the filter step whether the scan adds something; a new place does if None.
        """
        if after_reset:
            unmoved, nothing = np.zeros(3), np.zeros((3, 3))
            step = FilterStep(unmoved, _NO_ERROR, nothing, float(len(self.filter.poses)), False)
        else:
            step = self.filter.update(sighting, sequence)
        judgement = NO_EVIDENCE if after_reset else self._scan_evidence(sighting)
        self.event = replace(
            self.event,
            motion=step.increment,
            match_information=step.information,
            motion_error=step.match_error,
            contradicted=judgement.log_kidnapping_ratio > self.settings.contradiction_evidence,
            recent_scans=() if after_reset else self.event.recent_scans,
        )
        # Of a displaced robot it is the first of where it is now.
        stored = after_reset or (may_store and ((is_informative or self.is_new_viewpoint)() or self.event.contradicted))
        self._propagate_covariance(sequence if stored else None)
        if stored:
            self.filter.add_keyframe(sequence, sighting.scan)
        self.event = replace(self.event, pose=self.filter.pose, anchor=self._nearest_keyframe())
        return HypothesisEstimate(
            self.filter.hypothesis,
            self.filter.area,
            PoseGaussian(self.filter.pose, self.event.pose_covariance),
            stored,
            judgement.log_evidence,
            judgement.log_kidnapping_ratio,
            self.filter.clutter_estimate.clutter,
            step.effective_samples,
            self._revised_keyframes(sequence) if step.keyframes_moved and may_store else (),
        )

    def _scan_evidence(self, sighting: PreparedScan) -> ScanEvidence:
        """What the scan says of whether the robot is where the filter has it; learns from it what is usual."""
        found = self.filter.compare_scan(sighting)
        judgement = self.filter.clutter_estimate.evaluate(found)
        self.filter.clutter_estimate = self.filter.clutter_estimate.update(found)
        return judgement

    def add_recent_scan(self, scan: Scan) -> None:
        """Compare what follows with a scan that was taken where the filter is."""
        recent = append_recent_scan(self.event.recent_scans, RecentScan(scan, self.filter.pose.copy()))
        self.event = replace(self.event, recent_scans=recent)

    def is_new_viewpoint(self) -> bool:
        """Whether no keyframe of the local map was taken from nearby with a like heading."""
        if not self.filter.keyframes:
            return True
        relative = se2.between(self.filter.leading_keyframe_poses(), self.filter.pose)
        return not bool(np.any(is_same_viewpoint(relative, self.settings)))

    def _propagate_covariance(self, keyframe: int | None) -> None:
        """Carry the drift on to the pose now, of a keyframe that is stored, or of none over ground that is mapped."""
        ad = se2.adjoint(se2.between(self.filter.pose, self.event.pose))
        covariance = ad @ self.event.pose_covariance @ ad.T
        if keyframe is None:
            covariance = self._map_bounded_covariance(covariance)
        else:
            step = self.event.motion_error.drift_covariance
            covariance = covariance + step
            self.step_covariances[keyframe], self.keyframe_covariances[keyframe] = step, covariance
        self.event = replace(self.event, pose_covariance=covariance)

    def _map_bounded_covariance(self, carried: NDArray[np.float64]) -> NDArray[np.float64]:
        """The drift where the map bounds it, as far as the match tells: the pose is as far off as the map is there."""
        gain = self.event.motion_error.gain
        free = np.eye(3) - gain
        return (
            gain @ self._map_covariance() @ gain.T + free @ carried @ free.T + self.event.motion_error.pose_covariance
        )

    def _map_covariance(self) -> NDArray[np.float64]:
        """How far off the map is here: covariance of the area's nearest keyframe, carried here; 0 where unknown."""
        kept = self.filter.keyframes, self.filter.keyframe_areas, self.filter.leading_keyframe_poses()
        own = [
            (k, pose)
            for k, area, pose in zip(*kept, strict=True)
            if area == self.filter.area and k in self.keyframe_covariances
        ]
        if not own:
            return np.zeros((3, 3))
        relative = se2.between(self.filter.pose, np.array([pose for _, pose in own]))
        nearest = int(np.argmin(np.hypot(relative[:, 0], relative[:, 1])))
        ad = se2.adjoint(relative[nearest])
        covariance: NDArray[np.float64] = ad @ self.keyframe_covariances[own[nearest][0]] @ ad.T
        return covariance

    def _nearest_keyframe(self) -> int:
        """The keyframe to which the scans to come are related."""
        relative = se2.between(self.filter.leading_keyframe_poses(), self.filter.pose)
        cost = np.hypot(relative[:, 0], relative[:, 1]) + np.abs(relative[:, 2])
        return self.filter.keyframes[int(np.argmin(cost))]

    def prune(self, keyframes: Collection[int]) -> None:
        """Go on without some keyframes of known ground; scans related to them are related to those that stay.

        What they added to the local map stays there until that is loaded anew.
        """
        if not keyframes:
            return
        for keyframe in keyframes:
            self.step_covariances.pop(keyframe, None)
            self.keyframe_covariances.pop(keyframe, None)
        names, poses = list(self.filter.keyframes), self.filter.leading_keyframe_poses()
        areas, placed = dict(zip(names, self.filter.keyframe_areas, strict=True)), dict(zip(names, poses, strict=True))
        for lost in ({self.event.anchor} | {anchor for _, anchor, _ in self.scan_poses}) & set(keyframes):
            staying = {k: at for k, at in placed.items() if k not in keyframes and areas[k] == areas[lost]}
            self._replace_anchor(lost, nearest_replacement(placed[lost], staying))
        self.filter.drop_keyframes(keyframes)

    def _replace_anchor(self, lost: int, held: ReplacementKeyframe) -> None:
        """Relate to another keyframe what is related to one that is forgotten."""
        self.scan_poses = [
            (stamp, held.keyframe, se2.compose(held.pose, pose)) if anchor == lost else (stamp, anchor, pose)
            for stamp, anchor, pose in self.scan_poses
        ]
        if self.event.anchor == lost:
            self.event = replace(self.event, anchor=held.keyframe)

    def _revised_keyframes(self, newest: int) -> tuple[MovedKeyframe, ...]:
        # The messages must not hold on to the poses under all particles.
        poses = self.filter.leading_keyframe_poses().copy()
        return tuple(
            MovedKeyframe(keyframe, self.filter.area, self.filter.area, poses[self.filter.keyframes.index(keyframe)])
            for keyframe in self.step_covariances
            if keyframe != newest
        )

    def add_scan_pose(self, stamp: int) -> None:
        """Append the scan just processed to the trail."""
        anchor = self.event.anchor
        anchor_pose = self.filter.leading_keyframe_poses()[self.filter.keyframes.index(anchor)]
        self.scan_poses.append((stamp, anchor, se2.between(anchor_pose, self.filter.pose)))

    def take_scan_poses(self, first_scan: int) -> list[ScanPoses]:
        """The trail as a message, if there is one, and begin it anew."""
        if not self.scan_poses:
            return []
        stamps, anchors, poses = zip(*self.scan_poses, strict=True)
        self.scan_poses = []
        return [
            ScanPoses(
                self.filter.hypothesis,
                first_scan,
                np.array(stamps, dtype=np.int64),
                np.array(anchors, dtype=np.int64),
                np.array(poses),
            )
        ]

    def pose_belief(self) -> PoseGaussian:
        """The belief over ``area_T_base`` now."""
        ad = se2.adjoint(se2.between(self.filter.pose, self.event.pose))
        return PoseGaussian(self.filter.pose, ad @ self.event.pose_covariance @ ad.T + self.filter.tracking_covariance)

    def change_area(self, leaf: Hypothesis, content: Sequence[PlacedKeyframe], filters: FilterFactory) -> None:
        """Change the reference frame and load the local map, as TSBI decided.

        :param content: the keyframes of the areas that it names, in the frame of the robot's area.
        :param filters: chooses the kind of local map of an area that is entered.
        """
        entered = leaf.area != self.filter.area
        if entered:
            self.filter = filters.select(self.filter, leaf.area, content)
        area_T_previous = np.zeros(3) if leaf.frame_change is None else leaf.frame_change.mean
        self.filter.change_area(leaf.area, area_T_previous, content)
        self._move_event(area_T_previous)
        if entered and leaf.area_merge is None:
            moved = {relabelled.keyframe for relabelled in leaf.moved_keyframes}
            self.step_covariances = {
                keyframe: step for keyframe, step in self.step_covariances.items() if keyframe in moved
            }
            covariance = self._rebase_covariances(leaf.frame_change or _IDENTITY)
            self.event = replace(self.event, pose_covariance=covariance)
        self.event = replace(self.event, anchor=self._nearest_keyframe())

    def _move_event(self, area_T_previous: NDArray[np.float64]) -> None:
        """Have the last event in another area's frame."""
        self.event = replace(
            self.event,
            pose=se2.compose(area_T_previous, self.event.pose),
            recent_scans=tuple(
                RecentScan(look.scan, se2.compose(area_T_previous, look.pose)) for look in self.event.recent_scans
            ),
        )

    def merge(self, merged: AreaMerge, keyframes: Mapping[int, NDArray[np.float64]]) -> None:
        """What is in an area is as uncertain in the one that it becomes part of as that is known relative to it.

        :param keyframes: {keyframe: ``area_T_base``, shape (3,)} of the area.
        """
        for keyframe, pose in keyframes.items():
            if keyframe in self.keyframe_covariances:
                known = PoseGaussian(pose, self.keyframe_covariances[keyframe])
                self.keyframe_covariances[keyframe] = merged.pose.compose(known).covariance
        if self.filter.area == merged.area:
            belief = merged.pose.compose(PoseGaussian(self.event.pose, self.event.pose_covariance))
            self.event = replace(self.event, pose_covariance=belief.covariance)

    def _rebase_covariances(self, rebase: PoseGaussian) -> NDArray[np.float64]:
        """The drift in the area that was entered, shape (3, 3); that of the keyframes that moved with the robot is set.

        It is along these keyframes, or else by the map.

        :param rebase: belief over ``area_T_previous``.
        """
        moved = sorted(self.step_covariances)
        if not moved:
            return self._map_bounded_covariance(
                self.event.pose_covariance + _propagated_covariance(rebase, self.event.pose)
            )
        poses = dict(zip(self.filter.keyframes, self.filter.leading_keyframe_poses(), strict=True))
        self.keyframe_covariances[moved[0]] = _INITIAL_COVARIANCE
        for previous, keyframe in pairwise(moved):
            ad = se2.adjoint(se2.between(poses[keyframe], poses[previous]))
            self.keyframe_covariances[keyframe] = (
                ad @ self.keyframe_covariances[previous] @ ad.T + self.step_covariances[keyframe]
            )
        # TSBI knows how they lie in the area, and takes the drift from there on for what is added to it.
        return _propagated_covariance(rebase, self.event.pose) + _INITIAL_COVARIANCE

    def reload(self, content: Sequence[PlacedKeyframe]) -> None:
        """Build the local map anew after TLCA refined its keyframes; the robot stays where it is from its anchor.

        :param content: all keyframes of the local map, in the frame of the robot's area.
        """
        before = self.filter.pose
        self.filter.reload(content, self.event.anchor)
        after = self.filter.pose
        self.event = replace(
            self.event,
            pose=se2.compose(after, se2.between(before, self.event.pose)),
            recent_scans=tuple(
                RecentScan(look.scan, se2.compose(after, se2.between(before, look.pose)))
                for look in self.event.recent_scans
            ),
        )


def _propagated_covariance(rebase: PoseGaussian, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the uncertainty of ``area_T_previous`` adds to the covariance (3, 3) of a pose in the area, (3,)."""
    known = PoseGaussian.from_pose(se2.between(rebase.mean, pose))
    return rebase.compose(known).covariance
