"""The line filter: an extended Kalman filter over lines as local filter, and the choice of a filter by area class.

It is the stochastic map of Tomatis, Nourbakhsh and Siegwart (2003), section 3.6, in the place of the particles and
grids of Blanco et al. (2008). Each scan corrects robot, lines and the poses of keyframes: along a hallway all of these
drift until its end is visible again. The lines of an area that is entered come from the scans of its keyframes.

A map of lines has no free space. A scan contradicts it where a beam passes a known wall and ends behind it.


Which kind of filter an area has: one with a grid, one with lines, or by what the area is."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, matrix_inverse, propagate_covariance
from hmt_slam_ros.geometry.se2 import rotate_back
from hmt_slam_ros.landmarks.area_classes import AreaClassifier
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_for_map
from hmt_slam_ros.landmarks.stochastic_map import LineAssociations, LineMap
from hmt_slam_ros.registration.consistency import (
    BEHIND,
    MAX_SAMPLE_GAP,
    NO_SAMPLES,
    SAMPLE_SPACING,
    Agreement,
    ClutterEstimate,
    MapAgreement,
    add_wall_hit,
    add_wall_passed,
)
from hmt_slam_ros.registration.match_covariance import MatchError
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion
from hmt_slam_ros.submap.line_map_state import PoseClones
from hmt_slam_ros.submap.local_filter import (
    FilterStep,
    LineFilterState,
    LocalFilter,
    ParticleFilterState,
    PlacedKeyframe,
    TrackedMotion,
)
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter

_END_MARGIN = 0.2
"""Distance from the visible ends of a wall within which no beam counts as passing it, m."""

_KEYFRAME_COVARIANCE = np.diag([0.01, 0.01, math.radians(0.3)]) ** 2
"""Covariance of the independent errors of keyframes in a loaded area, m and rad."""

_MIN_CORRECTION = 0.01
"""Corrections of keyframes from which on they are reported, m."""

_MIN_MATCHED_SHARE = 0.5
"""Smallest share of a scan's lines that match by odometry; below, odometry is compared with inertia."""


def lines_of_scan(scan: Scan, configuration: Configuration) -> Lines:
    """The lines of a scan for the stochastic map."""
    return extract_for_map(scan, configuration.features)


@njit(cache=True)
def _count_beams(ends: Float64, laser: Float64, segments: Float64, near: float) -> tuple[int, int, int, int]:
    """Numbers of beams that end on a wall and that pass one, and of samples of walls that are hit and passed.

    :param ends: of the beams, in their order, shape (n, 2), m, frame of the map.
    :param laser: its position, shape (2,), m, frame of the map.
    :param segments: alpha, r, begin and end of each, shape (m, 4).
    :param near: distance from a wall below which a beam ends on it, m.
    """
    ending = passing = 0
    met, passed = NO_SAMPLES, NO_SAMPLES
    at = np.empty(2)
    for i in range(len(ends)):
        if _ends_on_wall(ends[i], segments, near):
            ending += 1
            met = add_wall_hit(met, ends[i, 0], ends[i, 1], SAMPLE_SPACING)
        elif _passes_wall(ends[i], laser, segments, at):
            passing += 1
            passed = add_wall_passed(passed, at[0], at[1], SAMPLE_SPACING, MAX_SAMPLE_GAP)
    return ending, passing, met.total, passed.total


@njit(cache=True)
def _ends_on_wall(end: Float64, segments: Float64, near: float) -> bool:
    for k in range(len(segments)):
        cos, sin = math.cos(segments[k, 0]), math.sin(segments[k, 0])
        across, along = rotate_back(cos, sin, end[0], end[1])
        if abs(across - segments[k, 1]) < near and segments[k, 2] - near < along < segments[k, 3] + near:
            return True
    return False


@njit(cache=True)
def _passes_wall(end: Float64, laser: Float64, segments: Float64, at: Float64) -> bool:
    """Whether a beam passes a wall from its visible side; writes the first point where it does to ``at``."""
    first = np.inf
    for k in range(len(segments)):
        cos, sin = math.cos(segments[k, 0]), math.sin(segments[k, 0])
        before = segments[k, 1] - cos * laser[0] - sin * laser[1]
        behind = cos * end[0] + sin * end[1] - segments[k, 1]
        if before <= 0.0 or behind < BEHIND:
            continue
        share = before / (before + behind)
        x, y = laser[0] + share * (end[0] - laser[0]), laser[1] + share * (end[1] - laser[1])
        along = cos * y - sin * x
        if share < first and segments[k, 2] + _END_MARGIN < along < segments[k, 3] - _END_MARGIN:
            first, at[0], at[1] = share, x, y
    return first < np.inf


class _MapPosterior(NamedTuple):
    """The map after a scan, for one prediction of the motion."""

    line_map: LineMap
    motion: RelativeMotion
    associations: LineAssociations


class LineFilter:
    """A local filter over the robot's pose and the lines around it.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area, whose frame is that of the map.
    :ivar line_map: the belief.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar tracking_covariance: of the motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar clutter_estimate: of the scans so far.
    """

    def __init__(self, mapping: LocalMapping, hypothesis: int, area: int) -> None:
        self.mapping = mapping
        self.hypothesis = hypothesis
        self.area = area
        self.line_map = LineMap(mapping.configuration.features)
        self.keyframes: list[int] = []
        self.keyframe_areas: list[int] = []
        self.line_map.clone_pose()
        self._reported_poses = np.zeros((0, 3))
        self.tracking_covariance = np.zeros((3, 3))
        self.clutter_estimate = ClutterEstimate()
        self._information = np.zeros((3, 3))
        self._last_covariance, self._motion_since_update = np.zeros((3, 3)), NO_MOTION

    @classmethod
    def from_state(cls, mapping: LocalMapping, state: LineFilterState) -> LineFilter:
        """The filter of a state."""
        found = cls(mapping, state.hypothesis, state.area)
        found.line_map = LineMap.from_state(mapping.configuration.features, state.line_map)
        found.keyframes, found.keyframe_areas = list(state.keyframes), list(state.keyframe_areas)
        found._reported_poses, found.tracking_covariance = state.reported_poses, state.tracking_covariance
        found._information, found.clutter_estimate = state.information, state.clutter_estimate
        found._last_covariance, found._motion_since_update = state.last_covariance, state.motion_since_update
        return found

    @property
    def state(self) -> LineFilterState:
        """The state of the filter."""
        return LineFilterState(
            self.hypothesis,
            self.area,
            self.line_map.state,
            tuple(self.keyframes),
            tuple(self.keyframe_areas),
            self._reported_poses,
            self._last_covariance,
            self._motion_since_update,
            self._information,
            self.tracking_covariance,
            self.clutter_estimate,
        )

    @property
    def pose(self) -> Float64:
        """``area_T_base``, shape (3,)."""
        return self.line_map.pose.mean

    @property
    def poses(self) -> Float64:
        """The mean pose as a single particle, shape (1, 3)."""
        return self.pose[None]

    def leading_keyframe_poses(self) -> Float64:
        """``map_T_base`` of the local map's keyframes, shape (K, 3)."""
        return self.line_map.clones.poses[1:]

    def branch(self, hypothesis: int) -> LineFilter:
        """A filter of the same state for a child hypothesis."""
        child = LineFilter.from_state(self.mapping, self.state)
        child.hypothesis = hypothesis
        return child

    def release(self) -> None:
        """Do nothing: a line filter holds no shared resources."""

    def initialize(self, pose: PoseGaussian) -> None:
        """Set the belief over ``map_T_base``, and restart the prediction."""
        self.line_map.reset_pose(pose)
        self.tracking_covariance = np.zeros((3, 3))
        self._restart_prediction()

    def track(self, prepared: PreparedScan, prediction: Prediction) -> TrackedMotion:
        """Predict and correct by the scan's lines."""
        before, lines = self.pose, prepared.derive(lines_of_scan)
        posterior, contradicted = self._most_likely_posterior(lines, prediction)
        self.line_map = posterior.line_map
        self._motion_since_update = self._motion_since_update.compose(posterior.motion)
        self._information = _line_information(lines, posterior.associations)
        self.tracking_covariance = matrix_inverse(
            matrix_inverse(self._motion_since_update.covariance) + self._information
        )
        return TrackedMotion(se2.between(before, self.pose), self._information, contradicted)

    def _most_likely_posterior(self, lines: Lines, prediction: Prediction) -> tuple[_MapPosterior, bool]:
        """The map after the scan, and whether odometry is rejected: whether more lines match by inertia."""
        if prediction.odometry is None:
            return self._posterior(lines, prediction.inertia), False
        by_odometry = self._posterior(lines, prediction.fused)
        matched = len(by_odometry.associations.matched)
        if matched >= _MIN_MATCHED_SHARE * len(lines):
            return by_odometry, False
        by_inertia = self._posterior(lines, prediction.inertia)
        contradicted = len(by_inertia.associations.matched) > matched
        return (by_inertia if contradicted else by_odometry), contradicted

    def _posterior(self, lines: Lines, step: RelativeMotion) -> _MapPosterior:
        line_map = LineMap.from_state(self.mapping.configuration.features, self.line_map.state)
        line_map.predict(step)
        return _MapPosterior(line_map, step, line_map.observe(lines))

    def update(self, prepared: PreparedScan, step: int) -> FilterStep:  # noqa: ARG002  tracked already; nothing is drawn
        """The motion since the last keyframe, with its error."""
        pose = self.line_map.pose
        moved = se2.between(self.line_map.clones.poses[0], pose.mean)
        matched = matrix_inverse(matrix_inverse(self._motion_since_update.covariance) + self._information)
        # The growth of the pose's covariance in the area's frame.
        lasting = _positive_part(pose.covariance - propagate_covariance(self._last_covariance, moved))
        error = MatchError(matched, lasting, matched @ self._information)
        self._restart_prediction()
        corrections = np.hypot(*(self.leading_keyframe_poses() - self._reported_poses)[:, :2].T)
        corrected = bool(np.any(corrections > _MIN_CORRECTION))
        if corrected:
            self._reported_poses = self.leading_keyframe_poses()
        return FilterStep(moved, error, self._information, 1.0, corrected)

    def _restart_prediction(self) -> None:
        self._last_covariance, self._motion_since_update = self.line_map.pose.covariance, NO_MOTION
        self.line_map.clone_pose()
        count = len(self.line_map.clones.poses)
        self.line_map.clones = self.line_map.clones.select([count - 1, *range(1, count - 1)])

    def compare_scan(self, prepared: PreparedScan) -> MapAgreement:
        """Agreement of a scan with the map: beams that pass walls contradict it."""
        near = self.mapping.configuration.matching.matched_distance
        ends = se2.transform(self.pose, prepared.surfels[:, :2])
        laser = se2.transform(self.pose, prepared.laser_position[None])[0]
        lines = zip(self.line_map.lines, self.line_map.walls, strict=True)
        rows = [(*line, *segment) for line, wall in lines for segment in wall.segments]
        segments = np.array(rows, dtype=np.float64).reshape(-1, 4)
        ending, passing, hit, passed = _count_beams(ends, laser, segments, near)
        return MapAgreement(Agreement(len(ends), ending, passing), Agreement(hit + passed, hit, passed))

    def add_keyframe(self, keyframe: int, scan: Scan) -> None:
        """Add a keyframe at the robot's pose; the first one begins the map."""
        if not self.keyframes:
            self.line_map.observe(extract_for_map(scan, self.mapping.configuration.features), keep_new=True)
        self.keyframes.append(keyframe)
        self.keyframe_areas.append(self.area)
        self.line_map.clone_pose()
        self._reported_poses = np.concatenate((self._reported_poses, self.poses))

    def drop_keyframes(self, keyframes: Collection[int]) -> None:
        """Remove keyframes, but not their lines."""
        kept = [k for k, keyframe in enumerate(self.keyframes) if keyframe not in keyframes]
        self.keyframes = [self.keyframes[k] for k in kept]
        self.keyframe_areas = [self.keyframe_areas[k] for k in kept]
        self.line_map.clones = self.line_map.clones.select([0, *(1 + k for k in kept)])
        self._reported_poses = self._reported_poses[kept]

    def change_area(self, area: int, area_T_previous: Float64, content: Sequence[PlacedKeyframe]) -> None:
        """Change to the frame of another area, and load its local map.

        :param area: the new area.
        :param area_T_previous: shape (3,).
        :param content: all keyframes of the local map, in the new frame.
        """
        self.area = area
        self._load_submap(content, area_T_previous)

    def reload(self, content: Sequence[PlacedKeyframe], anchor: int) -> None:
        """Rebuild the local map after its keyframes moved; the robot keeps its pose relative to one of them.

        :param content: all keyframes of the local map.
        :param anchor: the keyframe relative to which the robot's pose is known.
        """
        before = self.leading_keyframe_poses()[self.keyframes.index(anchor)]
        after = next(placed.pose for placed in content if placed.keyframe == anchor)
        self._load_submap(content, se2.compose(after, se2.inverse(before)))

    def _load_submap(self, content: Sequence[PlacedKeyframe], moved: Float64) -> None:
        """Build the map of keyframes, and put the robot into it.

        :param moved: ``new_T_old`` of the map frame, shape (3,).
        """
        pose, last = (se2.compose(moved, old) for old in (self.pose, self.line_map.clones.poses[0]))
        features = self.mapping.configuration.features
        self.line_map = LineMap(features)
        for placed in content:
            self.line_map.reset_pose(PoseGaussian(placed.pose, _KEYFRAME_COVARIANCE))
            self.line_map.observe(extract_for_map(placed.scan, features), keep_new=True)
        self.line_map.reset_pose(PoseGaussian(pose, _KEYFRAME_COVARIANCE))
        self._last_covariance = _KEYFRAME_COVARIANCE
        self.keyframes = [placed.keyframe for placed in content]
        self.keyframe_areas = [placed.area for placed in content]
        self._reported_poses = np.array([placed.pose for placed in content]).reshape(-1, 3)
        self.line_map.clones = PoseClones.from_fixed_poses(
            np.concatenate((last[None], self._reported_poses)), self.line_map.mean.size
        )


def _line_information(lines: Lines, associations: LineAssociations) -> Float64:
    """Information of the matched lines about the motion to their scan, in the robot's frame, shape (3, 3)."""
    information = np.zeros((3, 3))
    for k, _ in associations.matched:
        alpha = float(lines.parameters[k, 0])
        jacobian = np.array([[0.0, 0.0, -1.0], [-math.cos(alpha), -math.sin(alpha), 0.0]])
        information += jacobian.T @ np.linalg.solve(lines.covariances[k], jacobian)
    return information


def _positive_part(matrix: Float64) -> Float64:
    """The positive semidefinite part of a symmetric matrix."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    found: Float64 = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return found


class FilterSelector:
    """Filter factory for ``local_map.kind``; "by_class" is after Tomatis et al. (2003), section 3.1."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping = mapping
        self._kind = mapping.configuration.local_map.kind
        self._classifier = AreaClassifier(mapping)

    def new(self, hypothesis: int, area: int) -> LocalFilter:
        """An empty filter; by class, one with a grid."""
        kind = LineFilter if self._kind == "lines" else ParticleFilter
        return kind(self._mapping, hypothesis, area)

    def restore(self, state: ParticleFilterState | LineFilterState) -> LocalFilter:
        """The filter of a state; patches of grids are in the pool."""
        if isinstance(state, LineFilterState):
            return LineFilter.from_state(self._mapping, state)
        return ParticleFilter.from_state(self._mapping, state)

    def select(self, own: LocalFilter, area: int, content: Sequence[PlacedKeyframe]) -> LocalFilter:
        """The filter for an area: ``own``, or an empty one of another kind with the same pose.

        ``own`` is released in the latter case.

        :param area: the entered one.
        :param content: keyframes in its frame; those of the area determine its class.
        """
        if self._kind != "by_class":
            return own
        kind = self._filter_type(area, content)
        if kind is None or isinstance(own, kind):
            return own
        other = kind(self._mapping, own.hypothesis, own.area)
        other.initialize(PoseGaussian.from_pose(own.pose))
        other.tracking_covariance, other.clutter_estimate = own.tracking_covariance, own.clutter_estimate
        own.release()
        return other

    def _filter_type(
        self, area: int, content: Sequence[PlacedKeyframe]
    ) -> type[ParticleFilter] | type[LineFilter] | None:
        """The filter type for the class of an area; None where too little is known."""
        keyframes = [placed for placed in content if placed.area == area]
        poses = np.array([placed.pose for placed in keyframes]).reshape(-1, 3)
        area_class = self._classifier.classify([placed.scan for placed in keyframes], poses)
        if area_class is None:
            return None
        return ParticleFilter if area_class.is_hallway else LineFilter
