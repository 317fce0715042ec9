"""The extended Kalman filter of one hypothesis in its current area, whose local map is one of lines.

A map of lines does not know where space is free. What contradicts it is that a beam passes a wall where it was seen:
it ends behind it.

The stochastic map of Tomatis, Nourbakhsh and Siegwart (2003), section 3.6, in the place of the particles and grids of
Blanco et al. (2008). Every scan corrects robot and lines; of a keyframe is noted where it was taken, and corrected
too: along a hallway whose end people hide the robot drifts, and so do its keyframes, until the end is seen again. The
lines of an area that is entered come from the scans of its keyframes.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.covariance import carried, inverse
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_for_map
from hmt_slam_ros.landmarks.stochastic_map import LineMap, Observed
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.registration.match_covariance import MatchError
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import NO_STEP, Prediction, Step
from hmt_slam_ros.submap.line_map_state import Marks
from hmt_slam_ros.submap.local_filter import FilterStep, LineFilterState, PlacedKeyframe, Tracked
from hmt_slam_ros.submap.local_mapping import LocalMapping, Sighting
from hmt_slam_ros.submap.scan_evidence import Compared, Experience


def lines_of_scan(scan: Scan, configuration: Configuration) -> Lines:
    """The lines of a scan that a map of lines is compared with."""
    return extract_for_map(scan, configuration.features)


# A beam passes a wall if it does so at least so far from where the wall was seen to end, m.
_INSIDE = 0.2
# It ends at least so far behind it, m.
_BEHIND = 0.4
# Of walls, one sample every so many m counts.
_APART = 0.2
# A wall was passed where samples of it are so near to each other, m.
_TOGETHER = 0.6


class Met(NamedTuple):
    """What the beams of a scan say of walls.

    :ivar ending: beams that end on one.
    :ivar passing: beams that pass one.
    :ivar met: samples of walls that beams end on.
    :ivar passed: samples that beams pass.
    """

    ending: int
    passing: int
    met: int
    passed: int


def met_and_passed(ends: Float64, laser: Float64, room: LineMap, near: float) -> Met:
    """Lay beams into a map of lines.

    :param ends: of the beams in their order, shape (n, 2), m, frame of the map.
    :param laser: where they begin, shape (2,), likewise.
    :param near: distance, m, from a wall below which a beam ends on it.
    """
    stretches = [(*room.lines[line], *piece) for line, wall in enumerate(room.walls) for piece in wall.pieces]
    return Met(*_compared(ends, laser, _array(stretches), near))


def _array(stretches: Sequence[tuple[float, ...]]) -> Float64:
    return np.array(stretches, dtype=np.float64).reshape(-1, 4)


@njit(cache=True)
def _compared(ends: Float64, laser: Float64, stretches: Float64, near: float) -> tuple[int, int, int, int]:
    """:param stretches: alpha, r, begin and end of each, (m, 4)."""
    ending = passing = met = passed = 0
    met_at, passed_at = np.full(2, np.inf), np.full(2, np.inf)
    at = np.empty(2)
    for i in range(len(ends)):
        if _on(ends[i], stretches, near):
            ending += 1
            if math.hypot(ends[i, 0] - met_at[0], ends[i, 1] - met_at[1]) >= _APART:
                met += 1
                met_at[:] = ends[i, :2]
        elif _through(ends[i], laser, stretches, at):
            passing += 1
            between = math.hypot(at[0] - passed_at[0], at[1] - passed_at[1])
            if between >= _APART:
                passed += between <= _TOGETHER
                passed_at[:] = at
    return ending, passing, met, passed


@njit(cache=True)
def _on(end: Float64, stretches: Float64, near: float) -> bool:
    for k in range(len(stretches)):
        cos, sin = math.cos(stretches[k, 0]), math.sin(stretches[k, 0])
        along = cos * end[1] - sin * end[0]
        off = cos * end[0] + sin * end[1] - stretches[k, 1]
        if abs(off) < near and stretches[k, 2] - near < along < stretches[k, 3] + near:
            return True
    return False


@njit(cache=True)
def _through(end: Float64, laser: Float64, stretches: Float64, at: Float64) -> bool:
    """Whether a beam passes a wall from the side from which it was seen; where it does first is written to ``at``."""
    first = np.inf
    for k in range(len(stretches)):
        cos, sin = math.cos(stretches[k, 0]), math.sin(stretches[k, 0])
        before = stretches[k, 1] - cos * laser[0] - sin * laser[1]
        behind = cos * end[0] + sin * end[1] - stretches[k, 1]
        if before <= 0.0 or behind < _BEHIND:
            continue
        share = before / (before + behind)
        x, y = laser[0] + share * (end[0] - laser[0]), laser[1] + share * (end[1] - laser[1])
        along = cos * y - sin * x
        if share < first and stretches[k, 2] + _INSIDE < along < stretches[k, 3] - _INSIDE:
            first, at[0], at[1] = share, x, y
    return first < np.inf


# How well keyframes lie in the frame of an area that is loaded: they err independently, m and rad.
_KEYFRAME = np.diag([0.01, 0.01, math.radians(0.3)]) ** 2
# Keyframes that were corrected by more than this, m, are told anew.
_CORRECTED = 0.01
# Odometry of which more than this share of a scan's lines knows nothing in the map may be wrong.
_UNKNOWN = 0.5


class _Believed(NamedTuple):
    """A map after a scan, under one prediction of the motion."""

    room: LineMap
    step: Step
    observed: Observed


class LineFilter:
    """One Gaussian over the robot's pose and the lines around it.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area; the map frame is its frame.
    :ivar room: the belief.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar tracking_covariance: of the motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar experience: of the scans so far.
    """

    def __init__(self, mapping: LocalMapping, hypothesis: int, area: int) -> None:
        self.mapping = mapping
        self.hypothesis = hypothesis
        self.area = area
        self.room = LineMap(mapping.configuration.features)
        self.keyframes: list[int] = []
        self.keyframe_areas: list[int] = []
        self.room.mark()
        self._told = np.zeros((0, 3))
        self.tracking_covariance = np.zeros((3, 3))
        self.experience = Experience()
        self._information = np.zeros((3, 3))
        self._last_covariance, self._since_update = np.zeros((3, 3)), NO_STEP

    @classmethod
    def of(cls, mapping: LocalMapping, state: LineFilterState) -> LineFilter:
        """The filter of a state."""
        found = cls(mapping, state.hypothesis, state.area)
        found.room = LineMap.of(mapping.configuration.features, state.room)
        found.keyframes, found.keyframe_areas = list(state.keyframes), list(state.keyframe_areas)
        found._told, found.tracking_covariance = state.told, state.tracking_covariance
        found._information, found.experience = state.information, state.experience
        found._last_covariance, found._since_update = state.last_covariance, state.since_update
        return found

    @property
    def state(self) -> LineFilterState:
        """All that is remembered."""
        return LineFilterState(
            self.hypothesis,
            self.area,
            self.room.state,
            tuple(self.keyframes),
            tuple(self.keyframe_areas),
            self._told,
            self._last_covariance,
            self._since_update,
            self._information,
            self.tracking_covariance,
            self.experience,
        )

    @property
    def pose(self) -> Float64:
        """``area_T_base``, shape (3,)."""
        return self.room.pose.mean

    @property
    def poses(self) -> Float64:
        """The mean alone, shape (1, 3)."""
        return self.pose[None]

    def leading_keyframe_poses(self) -> Float64:
        """``map_T_base`` of the local map's keyframes, shape (K, 3)."""
        return self.room.marks.poses[1:]

    def branch(self, hypothesis: int) -> LineFilter:
        """A filter of the same state for a child hypothesis."""
        child = LineFilter.of(self.mapping, self.state)
        child.hypothesis = hypothesis
        return child

    def release(self) -> None:
        """There is nothing to give back."""

    def stand(self, pose: PoseGaussian) -> None:
        """The robot stands at ``map_T_base``, known so well, and is predicted from there."""
        self.room.put(pose)
        self.tracking_covariance = np.zeros((3, 3))
        self._restart()

    def track(self, sighting: Sighting, prediction: Prediction) -> Tracked:
        """Predict and correct by the scan's lines."""
        before, lines = self.pose, sighting.derived(lines_of_scan)
        believed, contradicted = self._believed(lines, prediction)
        self.room = believed.room
        self._since_update = self._since_update.then(believed.step)
        self._information = _told(lines, believed.observed)
        self.tracking_covariance = inverse(inverse(self._since_update.covariance) + self._information)
        return Tracked(se2.between(before, self.pose), self._information, contradicted)

    def _believed(self, lines: Lines, prediction: Prediction) -> tuple[_Believed, bool]:
        """After the scan, and whether odometry is not believed: by inertia more of the scan's lines are known."""
        if prediction.odometry is None:
            return self._after(lines, prediction.inertia), False
        by_odometry = self._after(lines, prediction.together)
        known = len(by_odometry.observed.known)
        if known >= _UNKNOWN * len(lines):
            return by_odometry, False
        by_inertia = self._after(lines, prediction.inertia)
        contradicted = len(by_inertia.observed.known) > known
        return (by_inertia if contradicted else by_odometry), contradicted

    def _after(self, lines: Lines, step: Step) -> _Believed:
        room = LineMap.of(self.mapping.configuration.features, self.room.state)
        room.predict(step)
        return _Believed(room, step, room.observe(lines))

    def update(self, sighting: Sighting, step: int) -> FilterStep:  # noqa: ARG002  it was tracked; nothing is drawn
        """What the scans since the last keyframe came to."""
        here = self.room.pose
        moved = se2.between(self.room.marks.poses[0], here.mean)
        matched = inverse(inverse(self._since_update.covariance) + self._information)
        # What the pose in the area's frame became less certain by.
        lasting = _positive(here.covariance - carried(self._last_covariance, moved))
        error = MatchError(matched, lasting, matched @ self._information)
        self._restart()
        corrected = bool(np.any(np.hypot(*(self.leading_keyframe_poses() - self._told)[:, :2].T) > _CORRECTED))
        if corrected:
            self._told = self.leading_keyframe_poses()
        return FilterStep(moved, error, self._information, 1.0, corrected)

    def _restart(self) -> None:
        self._last_covariance, self._since_update = self.room.pose.covariance, NO_STEP
        self.room.mark()
        count = len(self.room.marks.poses)
        self.room.marks = self.room.marks.only([count - 1, *range(1, count - 1)])

    def compared(self, sighting: Sighting) -> Compared:
        """A scan in the map: what passes walls contradicts it."""
        near = self.mapping.configuration.matching.matched_distance
        ends = se2.transform(self.pose, sighting.surfels[:, :2])
        found = met_and_passed(ends, se2.transform(self.pose, sighting.laser[None])[0], self.room, near)
        walls = Agreement(found.met + found.passed, found.met, found.passed)
        return Compared(Agreement(len(ends), found.ending, found.passing), walls)

    def add_keyframe(self, keyframe: int, scan: Scan) -> None:
        """Note where a scan was taken; with the first one the map begins."""
        if not self.keyframes:
            self.room.observe(extract_for_map(scan, self.mapping.configuration.features), surely=True)
        self.keyframes.append(keyframe)
        self.keyframe_areas.append(self.area)
        self.room.mark()
        self._told = np.concatenate((self._told, self.poses))

    def drop(self, keyframes: Collection[int]) -> None:
        """Forget keyframes, but not what the map holds of them."""
        kept = [k for k, keyframe in enumerate(self.keyframes) if keyframe not in keyframes]
        self.keyframes = [self.keyframes[k] for k in kept]
        self.keyframe_areas = [self.keyframe_areas[k] for k in kept]
        self.room.marks = self.room.marks.only([0, *(1 + k for k in kept)])
        self._told = self._told[kept]

    def change_area(self, area: int, area_T_previous: Float64, content: Sequence[PlacedKeyframe]) -> None:
        """Go over to the frame of another area and load its local map.

        :param area: the area now.
        :param area_T_previous: shape (3,).
        :param content: all keyframes of the local map, in the new frame.
        """
        self.area = area
        self._load(content, area_T_previous)

    def reload(self, content: Sequence[PlacedKeyframe], anchor: int) -> None:
        """Build the local map anew after its keyframes moved; the robot stays where it is from one of them.

        :param content: all keyframes of the local map.
        :param anchor: the keyframe by which the robot's place is known.
        """
        before = self.leading_keyframe_poses()[self.keyframes.index(anchor)]
        after = next(placed.pose for placed in content if placed.keyframe == anchor)
        self._load(content, se2.compose(after, se2.inverse(before)))

    def _load(self, content: Sequence[PlacedKeyframe], moved: Float64) -> None:
        """Make the map of the lines that keyframes show, and put the robot into it.

        :param moved: ``new_T_old`` of the map frame, shape (3,).
        """
        here, last = (se2.compose(moved, pose) for pose in (self.pose, self.room.marks.poses[0]))
        features = self.mapping.configuration.features
        self.room = LineMap(features)
        for placed in content:
            self.room.put(PoseGaussian(placed.pose, _KEYFRAME))
            self.room.observe(extract_for_map(placed.scan, features), surely=True)
        self.room.put(PoseGaussian(here, _KEYFRAME))
        self._last_covariance = _KEYFRAME
        self.keyframes = [placed.keyframe for placed in content]
        self.keyframe_areas = [placed.area for placed in content]
        self._told = np.array([placed.pose for placed in content]).reshape(-1, 3)
        self.room.marks = Marks.fixed(np.concatenate((last[None], self._told)), self.room.mean.size)


def _told(lines: Lines, observed: Observed) -> Float64:
    """Information of the lines that were known about the motion to their scan, in the robot's frame, shape (3, 3)."""
    told = np.zeros((3, 3))
    for k, _ in observed.known:
        alpha = float(lines.parameters[k, 0])
        slopes = np.array([[0.0, 0.0, -1.0], [-math.cos(alpha), -math.sin(alpha), 0.0]])
        told += slopes.T @ np.linalg.solve(lines.covariances[k], slopes)
    return told


def _positive(matrix: Float64) -> Float64:
    """The part of a symmetric matrix that is a covariance."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    found: Float64 = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return found
