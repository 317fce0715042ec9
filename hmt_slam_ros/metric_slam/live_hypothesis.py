"""One live hypothesis inside metric SLAM: its filter, its keyframes, and the poses of its scans."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration.metric_slam import FilterParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.keyframe_pruning import (
    ReplacementKeyframe,
    is_same_viewpoint,
    looks_alike,
    nearest_replacement,
)
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
"""Covariance of the first pose in an area, m^2 and rad^2."""

_IDENTITY = PoseGaussian.from_pose(np.zeros(3))
_NO_ERROR = MatchError(_INITIAL_COVARIANCE, _INITIAL_COVARIANCE, np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class KeyframeCovariances:
    """Covariances of keyframes, in order of time: the saved form of a dictionary, in two arrays.

    :ivar keyframes: shape (n,).
    :ivar covariances: shape (n, 3, 3), right tangent frame.
    """

    keyframes: Int64
    covariances: Float64

    @classmethod
    def from_dict(cls, covariances: Mapping[int, Float64]) -> KeyframeCovariances:
        """The saved form of {keyframe: covariance}."""
        rows = np.array(list(covariances.values())).reshape(-1, 3, 3)
        return cls(np.array(list(covariances), dtype=np.int64), rows)

    def to_dict(self) -> dict[int, Float64]:
        """{keyframe: covariance}."""
        return dict(zip(self.keyframes.tolist(), self.covariances, strict=True))


_MAX_LASERS = 8
"""Lasers that look into different directions."""


@dataclass(frozen=True, eq=False)
class LaserEvent:
    """The last keyframe event with the scan of a laser.

    :ivar laser_pose: ``base_T_laser``, shape (3,), m and rad.
    :ivar pose: ``area_T_base`` at the event, shape (3,), m and rad.
    """

    laser_pose: Float64
    pose: Float64


@dataclass(frozen=True, eq=False)
class LastEvent:
    """The last keyframe event of a hypothesis.

    :ivar pose: ``area_T_base`` at the event, shape (3,), m and rad.
    :ivar motion: the matched motion between the last two keyframe events, shape (3,).
    :ivar match_information: of the event's match alone, in the frame of its pose, shape (3, 3).
    :ivar motion_error: covariances of that motion.
    :ivar anchor: the stored keyframe to which the poses of later scans are relative.
    :ivar pose_covariance: covariance of the pose in the area's frame, right tangent, shape (3, 3).
    :ivar blind_drift: drift since the newest keyframe over scans that showed nothing, likewise.
    :ivar contradicted: whether the scan contradicted the submap.
    :ivar recent_scans: scans with which that of the next keyframe is compared, in mode lifelong.
    :ivar lasers: the last event of each laser, that of this event at the end.
    """

    pose: Float64 = field(default_factory=lambda: np.zeros(3))
    motion: Float64 = field(default_factory=lambda: np.zeros(3))
    match_information: Float64 = field(default_factory=lambda: np.zeros((3, 3)))
    motion_error: MatchError = _NO_ERROR
    anchor: int = 0
    pose_covariance: Float64 = field(default_factory=_INITIAL_COVARIANCE.copy)
    blind_drift: Float64 = field(default_factory=lambda: np.zeros((3, 3)))
    contradicted: bool = False
    recent_scans: tuple[RecentScan, ...] = ()
    lasers: tuple[LaserEvent, ...] = ()


@dataclass(frozen=True, eq=False)
class LiveHypothesisState:
    """One live hypothesis inside metric SLAM, in its saved form.

    :ivar particle_filter: its filter, where its local map is a grid.
    :ivar line_filter: its filter, where its local map has lines.
    :ivar event: the last keyframe event.
    :ivar step_covariances: drift of the step to each keyframe that was stored since the robot entered the area.
    :ivar keyframe_covariances: covariance of each keyframe's pose in its area, where it is known.
    :ivar scan_poses: (stamp, anchor, ``keyframe_T_base``) of the scans since the last keyframe event.
    """

    particle_filter: ParticleFilterState | None
    line_filter: LineFilterState | None
    event: LastEvent
    step_covariances: KeyframeCovariances
    keyframe_covariances: KeyframeCovariances
    scan_poses: tuple[tuple[int, int, Float64], ...]


@dataclass
class LiveHypothesis:
    """One live hypothesis inside metric SLAM; attributes as in :class:`LiveHypothesisState`.

    :ivar settings: when keyframes are taken.
    """

    filter: LocalFilter
    settings: FilterParameters
    event: LastEvent = field(default_factory=LastEvent)
    step_covariances: dict[int, Float64] = field(default_factory=dict)
    keyframe_covariances: dict[int, Float64] = field(default_factory=dict)
    scan_poses: list[tuple[int, int, Float64]] = field(default_factory=list)

    @classmethod
    def from_state(
        cls, filters: FilterFactory, settings: FilterParameters, state: LiveHypothesisState
    ) -> LiveHypothesis:
        """The hypothesis of a state; its patches are in the pool."""
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
        """The whole state, as a value; tables of grids have the numbers of patches in the pool."""
        own = self.filter.state
        return LiveHypothesisState(
            own if isinstance(own, ParticleFilterState) else None,
            own if isinstance(own, LineFilterState) else None,
            self.event,
            KeyframeCovariances.from_dict(self.step_covariances),
            KeyframeCovariances.from_dict(self.keyframe_covariances),
            tuple(self.scan_poses),
        )

    def branch(self, hypothesis: int) -> LiveHypothesis:
        """A child with its own filter, in the same state."""
        return replace(
            self,
            filter=self.filter.branch(hypothesis),
            step_covariances=dict(self.step_covariances),
            keyframe_covariances=dict(self.keyframe_covariances),
            scan_poses=list(self.scan_poses),
        )

    def is_event_due(self, prepared: PreparedScan) -> bool:
        """Whether the robot moved far enough since the laser's last keyframe event, or the scan first contradicts.

        :param prepared: the newest scan.
        """
        own, _ = self._split_lasers(prepared.scan)
        if own is None:
            return True
        motion = se2.between(own.pose, self.filter.pose)
        is_far = math.hypot(motion[0], motion[1]) >= self.settings.keyframe_distance
        if is_far or abs(motion[2]) >= math.radians(self.settings.keyframe_angle):
            return True
        if self.event.contradicted:
            return False
        evidence = self.filter.clutter_estimate.evaluate(self.filter.compare_scan(prepared))
        return evidence.log_kidnapping_ratio > self.settings.contradiction_evidence

    def _split_lasers(self, scan: Scan) -> tuple[LaserEvent | None, tuple[LaserEvent, ...]]:
        """The last event of a laser that looks like that of a scan, None without, and those of all others."""
        lasers = self.event.lasers
        if not lasers:
            return None, ()
        mountings = np.array([laser.laser_pose for laser in lasers])
        alike = looks_alike(scan.laser_pose, mountings, self.settings).tolist()
        own = next((laser for laser, is_alike in zip(lasers, alike, strict=True) if is_alike), None)
        return own, tuple(laser for laser, is_alike in zip(lasers, alike, strict=True) if not is_alike)

    def process_keyframe(
        self,
        sequence: int,
        prepared: PreparedScan,
        *,
        after_reset: bool = False,
        may_store: bool = True,
        is_informative: Callable[[], bool],
    ) -> HypothesisEstimate:
        """One filter step with the scan of a keyframe, which enters the map if it is informative.

        :param sequence: number of the keyframe event.
        :param prepared: the scan.
        :param after_reset: whether tracking was reset: the scan is not matched.
        :param may_store: whether the hypothesis's map may change.
        :param is_informative: whether the scan is, called after the filter step; such as :meth:`is_new_viewpoint`.
        """
        if after_reset:
            step = FilterStep(np.zeros(3), _NO_ERROR, np.zeros((3, 3)), float(len(self.filter.poses)), False)
            evidence = NO_EVIDENCE
        else:
            step = self.filter.update(prepared, sequence)
            evidence = self._scan_evidence(prepared)
        self.event = replace(
            self.event,
            motion=step.increment,
            match_information=step.information,
            motion_error=step.match_error,
            contradicted=evidence.log_kidnapping_ratio > self.settings.contradiction_evidence,
            recent_scans=() if after_reset else self.event.recent_scans,
        )
        is_first, is_blind = after_reset or not self.filter.keyframes, prepared.is_blind
        may_enter = may_store and not is_blind
        # A scan that contradicts may be the first after a displacement.
        stored = is_first or (may_enter and (is_informative() or self.event.contradicted))
        self._propagate_covariance(sequence if stored else None, is_blind=is_blind)
        if stored:
            self.filter.add_keyframe(sequence, prepared.scan)
        _, others = self._split_lasers(prepared.scan)
        lasers = (*others, LaserEvent(prepared.scan.laser_pose, self.filter.pose))[-_MAX_LASERS:]
        self.event = replace(self.event, pose=self.filter.pose, anchor=self._nearest_keyframe(), lasers=lasers)
        return HypothesisEstimate(
            self.filter.hypothesis,
            self.filter.area,
            PoseGaussian(self.filter.pose, self.event.pose_covariance),
            stored,
            evidence.log_evidence,
            evidence.log_kidnapping_ratio,
            self.filter.clutter_estimate.clutter,
            step.effective_samples,
            self._revised_keyframes(sequence) if step.keyframes_moved and may_store else (),
            step.mode_count,
        )

    def _scan_evidence(self, prepared: PreparedScan) -> ScanEvidence:
        """Evidence of a scan for the pose of the filter; updates the clutter estimate."""
        agreement = self.filter.compare_scan(prepared)
        evidence = self.filter.clutter_estimate.evaluate(agreement)
        self.filter.clutter_estimate = self.filter.clutter_estimate.update(agreement)
        return evidence

    def add_recent_scan(self, scan: Scan) -> None:
        """Add a scan at the current pose to the recent scans."""
        recent = append_recent_scan(self.event.recent_scans, RecentScan(scan, self.filter.pose.copy()))
        self.event = replace(self.event, recent_scans=recent)

    def is_new_viewpoint(self, scan: Scan, scans: Mapping[int, Scan]) -> bool:
        """Whether no keyframe of the local map has a similar position and heading, by a laser that looks alike.

        :param scan: taken at the current pose.
        :param scans: {keyframe: its scan}.
        """
        if not self.filter.keyframes:
            return True
        relative = se2.between(self.filter.leading_keyframe_poses(), self.filter.pose)
        mountings = np.array([scans[keyframe].laser_pose for keyframe in self.filter.keyframes])
        alike = looks_alike(scan.laser_pose, mountings, self.settings)
        return not bool(np.any(is_same_viewpoint(relative, self.settings) & alike))

    def _propagate_covariance(self, keyframe: int | None, *, is_blind: bool) -> None:
        """Propagate the drift to the current pose: that of a stored keyframe, or on mapped ground if None.

        :param is_blind: whether the scan shows nothing. Unless it is stored, the next stored step has its drift, too.
        """
        covariance, step = self._transported_covariance(), self.event.motion_error.drift_covariance
        blind = PoseGaussian(self.event.pose, self.event.blind_drift).covariance_at(self.filter.pose) + step
        if keyframe is None:
            covariance = self._map_bounded_covariance(covariance)
        else:
            covariance = covariance + step
            self.step_covariances[keyframe], self.keyframe_covariances[keyframe] = blind, covariance
        blind_drift = blind if is_blind and keyframe is None else np.zeros((3, 3))
        self.event = replace(self.event, pose_covariance=covariance, blind_drift=blind_drift)

    def _transported_covariance(self) -> Float64:
        """The covariance of the last event's pose, shape (3, 3), in the tangent space of the current pose."""
        return PoseGaussian(self.event.pose, self.event.pose_covariance).covariance_at(self.filter.pose)

    def _map_bounded_covariance(self, covariance: Float64) -> Float64:
        """The drift, shape (3, 3), bounded by the error of the map in the directions that the match determines."""
        gain = self.event.motion_error.gain
        free = np.eye(3) - gain
        bounded = gain @ self._map_covariance() @ gain.T + free @ covariance @ free.T
        return bounded + self.event.motion_error.pose_covariance

    def _map_covariance(self) -> Float64:
        """The error of the map here: the covariance of the area's nearest keyframe, shape (3, 3); 0 where unknown."""
        rows = self.filter.keyframes, self.filter.keyframe_areas, self.filter.leading_keyframe_poses()
        known = [
            (k, pose)
            for k, area, pose in zip(*rows, strict=True)
            if area == self.filter.area and k in self.keyframe_covariances
        ]
        if not known:
            return np.zeros((3, 3))
        relative = se2.between(self.filter.pose, np.array([pose for _, pose in known]))
        nearest = int(np.argmin(np.hypot(relative[:, 0], relative[:, 1])))
        ad = se2.adjoint(relative[nearest])
        covariance: Float64 = ad @ self.keyframe_covariances[known[nearest][0]] @ ad.T
        return covariance

    def _nearest_keyframe(self) -> int:
        """The keyframe nearest to the current pose, with a radian counted as a meter."""
        relative = se2.between(self.filter.leading_keyframe_poses(), self.filter.pose)
        cost = np.hypot(relative[:, 0], relative[:, 1]) + np.abs(relative[:, 2])
        return self.filter.keyframes[int(np.argmin(cost))]

    def prune(self, keyframes: Collection[int]) -> None:
        """Remove keyframes; poses relative to them become relative to those that remain.

        Their scans stay in the local map until it is reloaded.
        """
        if not keyframes:
            return
        for keyframe in keyframes:
            self.step_covariances.pop(keyframe, None)
            self.keyframe_covariances.pop(keyframe, None)
        names = list(self.filter.keyframes)
        areas = dict(zip(names, self.filter.keyframe_areas, strict=True))
        poses = dict(zip(names, self.filter.leading_keyframe_poses(), strict=True))
        for pruned in ({self.event.anchor} | {anchor for _, anchor, _ in self.scan_poses}) & set(keyframes):
            remaining = {k: pose for k, pose in poses.items() if k not in keyframes and areas[k] == areas[pruned]}
            self._replace_anchor(pruned, nearest_replacement(poses[pruned], remaining))
        self.filter.drop_keyframes(keyframes)

    def _replace_anchor(self, pruned: int, replacement: ReplacementKeyframe) -> None:
        """Make poses relative to a pruned keyframe relative to its replacement."""
        self.scan_poses = [
            (stamp, replacement.keyframe, se2.compose(replacement.pose, pose))
            if anchor == pruned
            else (stamp, anchor, pose)
            for stamp, anchor, pose in self.scan_poses
        ]
        if self.event.anchor == pruned:
            self.event = replace(self.event, anchor=replacement.keyframe)

    def _revised_keyframes(self, newest: int) -> tuple[MovedKeyframe, ...]:
        # A copy, so that messages do not keep the poses under all particles in memory.
        poses = self.filter.leading_keyframe_poses().copy()
        return tuple(
            MovedKeyframe(keyframe, self.filter.area, self.filter.area, poses[self.filter.keyframes.index(keyframe)])
            for keyframe in self.step_covariances
            if keyframe != newest
        )

    def add_scan_pose(self, stamp: int) -> None:
        """Append the pose of the scan just processed."""
        anchor = self.event.anchor
        anchor_pose = self.filter.leading_keyframe_poses()[self.filter.keyframes.index(anchor)]
        self.scan_poses.append((stamp, anchor, se2.between(anchor_pose, self.filter.pose)))

    def take_scan_poses(self, first_scan: int) -> list[ScanPoses]:
        """The poses of the scans since the last event as a message, if there are any; clears them."""
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
        """The current belief over ``area_T_base``."""
        return PoseGaussian(self.filter.pose, self._transported_covariance() + self.filter.tracking_covariance)

    def change_area(self, hypothesis: Hypothesis, content: Sequence[PlacedKeyframe], filters: FilterFactory) -> None:
        """Change the reference frame and load the local map, as TSBI decided.

        :param content: the keyframes of the hypothesis's local areas, in the frame of the robot's area.
        :param filters: selects the kind of local map of a new area.
        """
        is_entered = hypothesis.area != self.filter.area
        if is_entered:
            self.filter = filters.select(self.filter, hypothesis.area, content)
        area_T_previous = np.zeros(3) if hypothesis.frame_change is None else hypothesis.frame_change.mean
        self.filter.change_area(hypothesis.area, area_T_previous, content)
        self._move_event(partial(se2.compose, area_T_previous))
        if is_entered and hypothesis.area_merge is None:
            moved = {change.keyframe for change in hypothesis.moved_keyframes}
            self.step_covariances = {k: step for k, step in self.step_covariances.items() if k in moved}
            covariance = self._rebase_covariances(hypothesis.frame_change or _IDENTITY)
            self.event = replace(self.event, pose_covariance=covariance)
        self.event = replace(self.event, anchor=self._nearest_keyframe())

    def _move_event(self, move: Callable[[Float64], Float64]) -> None:
        """Move the poses of the last event, each shape (3,)."""
        recent = tuple(RecentScan(recent.scan, move(recent.pose)) for recent in self.event.recent_scans)
        lasers = tuple(LaserEvent(laser.laser_pose, move(laser.pose)) for laser in self.event.lasers)
        self.event = replace(self.event, pose=move(self.event.pose), recent_scans=recent, lasers=lasers)

    def merge(self, merged: AreaMerge, keyframes: Mapping[int, Float64]) -> None:
        """Add the uncertainty of an area's pose to covariances of what becomes part of another area with it.

        :param keyframes: {keyframe: ``area_T_base``, shape (3,)} of the merged area.
        """
        for keyframe, pose in keyframes.items():
            if keyframe in self.keyframe_covariances:
                known = PoseGaussian(pose, self.keyframe_covariances[keyframe])
                self.keyframe_covariances[keyframe] = merged.pose.compose(known).covariance
        if self.filter.area == merged.area:
            belief = merged.pose.compose(PoseGaussian(self.event.pose, self.event.pose_covariance))
            self.event = replace(self.event, pose_covariance=belief.covariance)

    def _rebase_covariances(self, rebase: PoseGaussian) -> Float64:
        """The drift in the entered area, shape (3, 3); sets that of the keyframes that moved with the robot.

        It accumulates along these keyframes; without them, the map bounds it.

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
            last = PoseGaussian(poses[previous], self.keyframe_covariances[previous])
            self.keyframe_covariances[keyframe] = last.covariance_at(poses[keyframe]) + self.step_covariances[keyframe]
        # TSBI has their poses in the area, and counts the drift from there on.
        return _propagated_covariance(rebase, self.event.pose) + _INITIAL_COVARIANCE

    def reload(self, content: Sequence[PlacedKeyframe]) -> None:
        """Rebuild the local map after TLCA refined its keyframes; the pose of the robot in its anchor stays.

        :param content: all keyframes of the local map, in the frame of the robot's area.
        """
        before = self.filter.pose
        self.filter.reload(content, self.event.anchor)
        after = self.filter.pose
        self._move_event(lambda pose: se2.compose(after, se2.between(before, pose)))


def _propagated_covariance(rebase: PoseGaussian, pose: Float64) -> Float64:
    """The covariance (3, 3) that the uncertainty of ``area_T_previous`` adds to a pose in the area, (3,)."""
    known = PoseGaussian.from_pose(se2.between(rebase.mean, pose))
    return rebase.compose(known).covariance
