"""The landmarks of a stored area, from its keyframes alone.

Openings around the robot, for a partition of areas that asks for doors."""

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

# Beams of the virtual scans, and how far they go, m.
_BEAMS, _REACH = 720, 10.0
# A scan from so much of a circle on shows what is all around.
_AROUND = math.radians(330.0)
# Keyframes that are farther apart in time, ns, are of different visits.
_VISIT_GAP = 60_000_000_000


def has_full_view(scan: Scan) -> bool:
    """Whether a scan shows what is all around by itself."""
    return scan.angle_increment * (scan.ranges.size - 1) >= _AROUND


class LandmarkObservation(NamedTuple):
    """What a keyframe shows.

    :ivar pose: the belief over ``area_T_base``.
    :ivar landmarks: its landmarks, in the frame of the base.
    :ivar rays: its beams, likewise.
    :ivar is_virtual: whether these are those of a virtual scan.
    :ivar begins_visit: whether it is the first one of another visit.
    """

    pose: PoseGaussian
    landmarks: ScanLandmarks
    rays: Rays
    is_virtual: bool
    begins_visit: bool

    def update_map(self, found: LandmarkMap) -> None:
        """Have a map of landmarks learn it."""
        if self.begins_visit:
            found.begin_visit()
        found.observe(self.pose, self.landmarks, self.rays, is_virtual=self.is_virtual)


class AreaLandmarkExtractor:
    """Gathers the landmarks of areas, one after the other; what it needs to do so is made once."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping, self._features = mapping, mapping.configuration.features

    def extract(self, scans: Iterable[Scan], poses: Float64) -> tuple[Landmark, ...]:
        """The landmarks of an area.

        :param scans: of its keyframes, in the order in which they were taken.
        :param poses: shape (n, 3), their ``area_T_base``, m and rad.
        """
        return self.fuse_observations(self.observations(scans, poses))

    def fuse_observations(self, sightings: Iterable[LandmarkObservation]) -> tuple[Landmark, ...]:
        """The landmarks that sightings of an area show."""
        found = LandmarkMap(self._features)
        for sighting in sightings:
            sighting.update_map(found)
        return tuple(found.landmarks)

    def observations(self, scans: Iterable[Scan], poses: Float64) -> Iterator[LandmarkObservation]:
        """What each of an area's keyframes, as in `extract`, shows of its landmarks.

        A keyframe whose laser sees all around shows that itself; else a virtual scan from its place does, in the map of
        the keyframes of the same visit up to there: what earlier visits saw may be gone.
        """
        area = GrowingArea(self._mapping)
        for scan, pose in zip(scans, poses, strict=True):
            yield area.observe_keyframe(scan, pose)
        area.release()

    def observe_keyframe(
        self, scan: Scan, pose: Float64, around: Iterable[Scan], poses: Float64
    ) -> LandmarkObservation:
        """What one keyframe shows, in the map of it and of others around it where its laser does not see all around.

        :param pose: its ``area_T_base``, shape (3,), m and rad.
        :param around: scans of the others.
        :param poses: shape (n, 3), theirs.
        """
        table = self._mapping.pool.empty_table()
        if not has_full_view(scan):
            for other, at in zip((*around, scan), np.concatenate((poses, pose[None])), strict=True):
                self._mapping.insert_scan(table[None], at[None], other)
        found = _observe_landmarks(self._mapping, table, scan, pose, back=False)
        self._mapping.pool.release(table)
        return found


class GrowingArea:
    """An area to which keyframes are added."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping, self._table = mapping, mapping.pool.empty_table()
        self._last_stamp: int | None = None

    def release(self) -> None:
        """Nothing will be added any more."""
        self._mapping.pool.release(self._table)

    def observe_keyframe(self, scan: Scan, pose: Float64) -> LandmarkObservation:
        """What one more keyframe shows, as of `AreaLandmarkExtractor.observations`.

        :param pose: its ``area_T_base``, shape (3,), m and rad.
        """
        back = self._last_stamp is not None and not 0 <= scan.stamp - self._last_stamp <= _VISIT_GAP
        if back:
            self._mapping.pool.release(self._table)
            self._table = self._mapping.pool.empty_table()
        self._last_stamp, pose = scan.stamp, np.ascontiguousarray(pose)
        self._mapping.insert_scan(self._table[None], pose[None], scan)
        return _observe_landmarks(self._mapping, self._table, scan, pose, back=back)


def _observe_landmarks(
    mapping: LocalMapping, table: Int32, scan: Scan, pose: Float64, *, back: bool
) -> LandmarkObservation:
    """What is around a keyframe, in its own scan or else in the map of a table."""
    features, in_map = mapping.configuration.features, not has_full_view(scan)
    if not in_map:
        lines, rays = extract_lines(scan, features), rays_from_scan(scan, features)
    else:
        virtual = cast_virtual_scan(mapping.pool.view(table), pose, _BEAMS, _REACH)
        lines, rays = extract_map_lines(virtual, features), rays_from_virtual_scan(virtual, features)
    return LandmarkObservation(
        _keyframe_belief(pose, features), extract_landmarks(lines, rays, features), rays, in_map, back
    )


def _keyframe_belief(pose: Float64, features: FeatureParameters) -> PoseGaussian:
    """Where a keyframe was taken; the map there, which is made of such keyframes, is as far off."""
    off = features.map_deviation
    return PoseGaussian(pose, np.diag([off, off, math.radians(features.square_deviation)]) ** 2)


class LandmarkOpenings:
    """The openings among the landmarks that one keyframe shows."""

    def __init__(self, sighting: LandmarkObservation, features: FeatureParameters) -> None:
        chosen = sighting.landmarks.kinds == OPENING
        self._seen = ScanLandmarks(*(column[chosen] for column in sighting.landmarks))
        self._sighting, self._features = sighting, features

    @property
    def pose(self) -> PoseGaussian:
        """The belief over ``area_T_base``."""
        return self._sighting.pose

    def openings(self, known: Sequence[Landmark], pose: PoseGaussian) -> tuple[Landmark, ...]:
        """The openings around the robot, after those that were known were observed again.

        :param known: openings in the frame of the area.
        :param pose: the belief over ``area_T_base`` by which they are observed.
        """
        found = LandmarkMap(self._features)
        found.landmarks = list(known)
        found.observe(pose, self._seen, self._sighting.rays)
        reach = self._features.landmark_reach
        return tuple(one for one in found.landmarks if np.hypot(*(one.pose.mean[:2] - pose.mean[:2])) <= reach)


class LandmarkOpeningDetector:
    """Sees openings as landmarks, by the scan of a keyframe or by a virtual one in the map around it."""

    def __init__(self, configuration: Configuration) -> None:
        self._landmarks, self._features = AreaLandmarkExtractor(LocalMapping(configuration)), configuration.features

    def sees_around(self, scan: Scan) -> bool:
        """Whether a scan shows what is all around by itself."""
        return has_full_view(scan)

    def view(self, scan: Scan, pose: Float64, around: Iterable[Scan], poses: Float64) -> LandmarkOpenings:
        """What one keyframe shows, in the map of it and of others around it.

        :param pose: its ``area_T_base``, shape (3,), m and rad.
        :param around: scans of the others.
        :param poses: shape (n, 3), theirs.
        """
        return LandmarkOpenings(self._landmarks.observe_keyframe(scan, pose, around, poses), self._features)
