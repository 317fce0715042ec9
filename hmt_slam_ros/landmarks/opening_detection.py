"""Openings around the robot, for a partition of areas that asks for doors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.landmarks.area_landmarks import AreaLandmarkExtractor, LandmarkObservation, has_full_view
from hmt_slam_ros.landmarks.landmark_map import LandmarkMap
from hmt_slam_ros.landmarks.landmarks import OPENING, ScanLandmarks
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_mapping import LocalMapping


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
