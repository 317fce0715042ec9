"""Landmark map of one area: poses and existence of its landmarks, over many scans.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: an observed landmark is one of the map if both are of one kind and
their distance is within a chi-square gate; else it is new. Observations of one landmark are correlated by the error of
a scan's pose, and by that of the grid of virtual scans, in an unknown way. So they are fused by covariance intersection
(Julier and Uhlmann 1997), with a weight of 1/n for the n-th.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, fuse
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark
from hmt_slam_ros.landmarks.landmarks import OPENING, ScanLandmarks, should_be_visible
from hmt_slam_ros.landmarks.rays import Rays

_MAX_PAIR_DISTANCE = 2.0
"""Largest distance between landmarks that are compared, m."""

_MAX_SAME_HEADING = 0.5
"""Largest difference in heading of a new landmark from a known one that it duplicates, rad."""


def scatter_ratio(landmarks: Iterable[Landmark]) -> Float64:
    """Birge's ratio of an area's openings: the scatter of their observations against its covariance, shape (3, 3).

    It is in deviations, with one observation of ratio 1 added.
    """
    openings = [landmark for landmark in landmarks if landmark.kind == OPENING]
    repeated = sum(opening.existence.detections - 1 for opening in openings)
    return np.asarray((np.eye(3) + sum(opening.scatter for opening in openings)) / (1 + repeated))


class LandmarkMap:
    """The landmarks of an area.

    :ivar landmarks: all, in the order in which they were found.
    """

    def __init__(self, features: FeatureParameters, begin: Callable[[float], Existence] = Existence) -> None:
        """:param begin: existence of a new landmark, by its extraction confidence."""
        self._features, self._initial_existence = features, begin
        self._gate = chi_square_gate(features.pair_probability)
        self.landmarks: list[Landmark] = []

    def observe(self, pose: PoseGaussian, landmarks: ScanLandmarks, rays: Rays, *, is_virtual: bool = False) -> None:
        """Update poses and existence by a scan: by its landmarks, and by those that it misses.

        :param pose: belief over ``area_T_base``.
        :param landmarks: of the scan, in the frame of the base.
        :param rays: of the scan, in the frame of the base.
        :param is_virtual: whether the scan is a virtual one.
        """
        features = self._features
        if is_virtual:
            features = replace(features, landmark_detected=features.landmark_detected_in_map)
        expected = self._should_be_visible(pose.mean, rays)
        observed_poses = [
            pose.compose(PoseGaussian(*each)) for each in zip(landmarks.poses, landmarks.covariances, strict=True)
        ]
        matches = dict(self._associate(observed_poses, landmarks))
        known = len(self.landmarks)
        for k, landmark in enumerate(self.landmarks):
            i = matches.get(k)
            if i is not None:
                self.landmarks[k] = _update_landmark(landmark, observed_poses[i], landmarks, i, features)
            elif expected[k]:
                existence = landmark.existence.update_on_miss(features)
                self.landmarks[k] = replace(landmark, existence=existence)
        for i in sorted(set(range(len(observed_poses))).difference(matches.values())):
            if not self._is_near_known(observed_poses[i], int(landmarks.kinds[i]), known):
                self.landmarks.append(self._new_landmark(observed_poses[i], landmarks, i))
        least = self._features.landmark_least
        self.landmarks = [landmark for landmark in self.landmarks if landmark.existence.probability >= least]

    def begin_visit(self) -> None:
        """Note that the robot was away since the last scan."""
        self.landmarks = [replace(each, existence=each.existence.mark_absence()) for each in self.landmarks]

    def _should_be_visible(self, pose: Float64, rays: Rays) -> Bool:
        """Whether landmarks should be visible from a pose, shape (n,)."""
        kinds = np.array([landmark.kind for landmark in self.landmarks], dtype=np.int64)
        poses = np.array([landmark.pose.mean for landmark in self.landmarks]).reshape(-1, 3)
        widths = np.array([landmark.width for landmark in self.landmarks])
        return should_be_visible(kinds, se2.between(pose, poses), widths, rays, self._features)

    def _associate(self, observed_poses: list[PoseGaussian], observed: ScanLandmarks) -> Iterator[tuple[int, int]]:
        """Pairs of numbers of landmarks in the map and in the scan that are one, the nearest first."""
        near = sorted(
            (distance2, k, i)
            for i, pose in enumerate(observed_poses)
            for k, landmark in enumerate(self.landmarks)
            if landmark.kind == observed.kinds[i] and _distance(landmark.pose, pose) < _MAX_PAIR_DISTANCE
            if (distance2 := landmark.pose.mahalanobis2(pose)) <= self._gate
        )
        taken: tuple[set[int], set[int]] = set(), set()
        for _, k, i in near:
            if k not in taken[0] and i not in taken[1]:
                taken[0].add(k)
                taken[1].add(i)
                yield k, i

    def _new_landmark(self, pose: PoseGaussian, observed: ScanLandmarks, i: int) -> Landmark:
        into = np.linalg.inv(np.linalg.cholesky(pose.covariance))
        return Landmark(
            int(observed.kinds[i]),
            pose,
            float(observed.widths[i]),
            float(observed.width_deviations[i]),
            self._initial_existence(float(observed.confidences[i])),
            scan_covariance_share=into @ observed.covariances[i] @ into.T,
        )

    def _is_near_known(self, pose: PoseGaussian, kind: int, known: int) -> bool:
        """Whether a landmark duplicates one of the first ``known`` of the map."""
        return any(
            landmark.kind == kind
            and _distance(landmark.pose, pose) < self._features.landmark_apart
            and abs(float(se2.wrap(landmark.pose.mean[2] - pose.mean[2]))) < _MAX_SAME_HEADING
            for landmark in self.landmarks[:known]
        )


def _update_landmark(
    landmark: Landmark, pose: PoseGaussian, observed: ScanLandmarks, i: int, features: FeatureParameters
) -> Landmark:
    """A landmark after one more observation of it."""
    n = landmark.existence.detections + 1
    width, deviation = observed.widths[i], observed.width_deviations[i]
    into = np.linalg.inv(np.linalg.cholesky(pose.covariance))
    # Welford's update, in deviations of the difference between an observation and the mean before it.
    spread = np.linalg.cholesky(pose.covariance + landmark.pose.covariance / (n - 1))
    off = np.linalg.solve(spread, se2.log(se2.between(pose.mean, landmark.pose.mean)))
    return replace(
        landmark,
        pose=_intersect_covariances(landmark.pose, pose, 1.0 / n),
        scatter=landmark.scatter + np.outer(off, off),
        scan_covariance_share=landmark.scan_covariance_share
        + (into @ observed.covariances[i] @ into.T - landmark.scan_covariance_share) / n,
        width=landmark.width + float(width - landmark.width) / n,
        width_deviation=landmark.width_deviation + float(deviation - landmark.width_deviation) / n,
        existence=landmark.existence.update_on_detection(float(observed.confidences[i]), features),
    )


def _distance(first: PoseGaussian, second: PoseGaussian) -> float:
    return float(np.hypot(*(first.mean[:2] - second.mean[:2])))


def _intersect_covariances(known: PoseGaussian, seen: PoseGaussian, weight: float) -> PoseGaussian:
    """Covariance intersection of two beliefs over one pose, the second with a weight."""
    parts = ((known, 1.0 - weight), (seen, weight))
    return fuse([PoseGaussian(part.mean, part.covariance / share) for part, share in parts])
