"""Landmarks of stored areas, and openings around single keyframes for the area abstraction."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.virtual_scan import cast_virtual_scan
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.landmarks.landmark_map import LandmarkMap
from hmt_slam_ros.landmarks.landmarks import OPENING, ScanLandmarks, extract_landmarks
from hmt_slam_ros.landmarks.line_extraction import extract_lines, extract_map_lines
from hmt_slam_ros.landmarks.rays import Rays, rays_from_scan, rays_from_virtual_scan
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_mapping import LocalMapping

_BEAMS, _REACH = 720, 10.0
"""Beams of the virtual scans, and their reach, m."""

_MIN_FULL_VIEW = math.radians(330.0)
"""Smallest field of view of a scan that is used without a virtual one, rad."""

_VISIT_GAP = 60_000_000_000
"""Time between keyframes of different visits, at least, ns."""


def has_full_view(scan: Scan) -> bool:
    """Whether a scan sees all around, so that no virtual scan is needed."""
    return scan.angle_increment * (scan.ranges.size - 1) >= _MIN_FULL_VIEW


class LandmarkObservation(NamedTuple):
    """The landmarks and beams of a keyframe.

    :ivar pose: belief over ``area_T_base``.
    :ivar landmarks: in the frame of the base.
    :ivar rays: in the frame of the base.
    :ivar is_virtual: whether they come from a virtual scan.
    :ivar begins_visit: whether it is the first one of another visit.
    """

    pose: PoseGaussian
    landmarks: ScanLandmarks
    rays: Rays
    is_virtual: bool
    begins_visit: bool

    def update_map(self, found: LandmarkMap) -> None:
        """Add the observation to a landmark map."""
        if self.begins_visit:
            found.begin_visit()
        found.observe(self.pose, self.landmarks, self.rays, is_virtual=self.is_virtual)


class AreaLandmarkExtractor:
    """Extracts the landmarks of areas and keyframes."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping, self._features = mapping, mapping.configuration.features

    def extract(self, scans: Iterable[Scan], poses: Float64) -> tuple[Landmark, ...]:
        """The landmarks of an area.

        :param scans: of its keyframes, in the order of time.
        :param poses: shape (n, 3), their ``area_T_base``, m and rad.
        """
        return self.fuse_observations(self.observations(scans, poses))

    def fuse_observations(self, observations: Iterable[LandmarkObservation]) -> tuple[Landmark, ...]:
        """The landmarks of an area by the observations of its keyframes."""
        landmark_map = LandmarkMap(self._features)
        for observation in observations:
            observation.update_map(landmark_map)
        return tuple(landmark_map.landmarks)

    def observations(self, scans: Iterable[Scan], poses: Float64) -> Iterator[LandmarkObservation]:
        """The landmark observations of an area's keyframes, which are those of `extract`.

        A keyframe without a full view is observed by a virtual scan in the grid of the keyframes of its visit so far:
        what earlier visits saw may have changed.
        """
        area = GrowingArea(self._mapping)
        for scan, pose in zip(scans, poses, strict=True):
            yield area.observe_keyframe(scan, pose)
        area.release()

    def observe_keyframe(
        self, scan: Scan, pose: Float64, around: Iterable[Scan], poses: Float64
    ) -> LandmarkObservation:
        """The landmark observation of one keyframe, without a full view in the grid of it and of others around it.

        :param pose: its ``area_T_base``, shape (3,), m and rad.
        :param around: scans of the others.
        :param poses: shape (n, 3), theirs.
        """
        table = self._mapping.pool.empty_table()
        if not has_full_view(scan):
            for other, at in zip((*around, scan), np.concatenate((poses, pose[None])), strict=True):
                self._mapping.insert_scan(table[None], at[None], other)
        observation = _observe_landmarks(self._mapping, table, scan, pose, begins_visit=False)
        self._mapping.pool.release(table)
        return observation


class GrowingArea:
    """Grid of an area to which keyframes are added."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping, self._table = mapping, mapping.pool.empty_table()
        self._last_stamp: int | None = None

    def release(self) -> None:
        """Give the grid back."""
        self._mapping.pool.release(self._table)

    def observe_keyframe(self, scan: Scan, pose: Float64) -> LandmarkObservation:
        """The observation of one more keyframe, as of `AreaLandmarkExtractor.observations`.

        :param pose: its ``area_T_base``, shape (3,), m and rad.
        """
        begins_visit = self._last_stamp is not None and not 0 <= scan.stamp - self._last_stamp <= _VISIT_GAP
        if begins_visit:
            self._mapping.pool.release(self._table)
            self._table = self._mapping.pool.empty_table()
        self._last_stamp, pose = scan.stamp, np.ascontiguousarray(pose)
        self._mapping.insert_scan(self._table[None], pose[None], scan)
        return _observe_landmarks(self._mapping, self._table, scan, pose, begins_visit=begins_visit)


def _observe_landmarks(
    mapping: LocalMapping, table: Int32, scan: Scan, pose: Float64, *, begins_visit: bool
) -> LandmarkObservation:
    """The landmark observation of a scan with a full view, or else of a virtual scan in the grid of a table."""
    features, is_virtual = mapping.configuration.features, not has_full_view(scan)
    if is_virtual:
        virtual = cast_virtual_scan(mapping.pool.view(table), pose, _BEAMS, _REACH)
        lines, rays = extract_map_lines(virtual, features), rays_from_virtual_scan(virtual, features)
    else:
        lines, rays = extract_lines(scan, features), rays_from_scan(scan, features)
    landmarks = extract_landmarks(lines, rays, features)
    return LandmarkObservation(_keyframe_belief(pose, features), landmarks, rays, is_virtual, begins_visit)


def _keyframe_belief(pose: Float64, features: FeatureParameters) -> PoseGaussian:
    """Belief over the pose of a keyframe; the grid there, which is made of keyframes, has the same error."""
    deviation = features.map_deviation
    return PoseGaussian(pose, np.diag([deviation, deviation, math.radians(features.square_deviation)]) ** 2)


class LandmarkOpenings:
    """The openings among the landmarks of one keyframe.

    :ivar pose: belief over ``area_T_base``.
    """

    def __init__(self, observation: LandmarkObservation, features: FeatureParameters) -> None:
        chosen = observation.landmarks.kinds == OPENING
        self._observed = ScanLandmarks(*(column[chosen] for column in observation.landmarks))
        self._rays, self._features = observation.rays, features
        self.pose = observation.pose

    def openings(self, known: Sequence[Landmark], pose: PoseGaussian) -> tuple[Landmark, ...]:
        """The openings around the robot after this observation.

        :param known: openings so far, in the frame of the area.
        :param pose: belief over ``area_T_base`` for the observation.
        """
        landmark_map = LandmarkMap(self._features)
        landmark_map.landmarks = list(known)
        landmark_map.observe(pose, self._observed, self._rays)
        reach = self._features.landmark_reach
        offsets = [landmark.pose.mean[:2] - pose.mean[:2] for landmark in landmark_map.landmarks]
        pairs = zip(landmark_map.landmarks, offsets, strict=True)
        return tuple(landmark for landmark, offset in pairs if np.hypot(*offset) <= reach)


class LandmarkOpeningDetector:
    """Detects openings as landmarks, by the scan of a keyframe or by a virtual scan in the grid around it."""

    def __init__(self, configuration: Configuration) -> None:
        self._landmarks, self._features = AreaLandmarkExtractor(LocalMapping(configuration)), configuration.features

    def sees_around(self, scan: Scan) -> bool:
        """Whether a scan sees all around, so that no other keyframes are needed."""
        return has_full_view(scan)

    def view(self, scan: Scan, pose: Float64, around: Iterable[Scan], poses: Float64) -> LandmarkOpenings:
        """The openings of one keyframe, as of `AreaLandmarkExtractor.observe_keyframe`."""
        return LandmarkOpenings(self._landmarks.observe_keyframe(scan, pose, around, poses), self._features)
