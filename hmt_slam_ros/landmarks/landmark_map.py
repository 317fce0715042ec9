"""The landmarks of one area in its frame, gathered over many scans, and whether each is still there.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: a landmark that a scan shows is one of the map where the distance
of the two is within chi-square's gate and they are of one kind, else it is new. Poses that a scan's landmarks have in
common, as its own error, and the errors of the map that virtual scans are cast in make observations of one landmark
depend on each other, in a way that nobody knows. So they are fused by covariance intersection (Julier and Uhlmann,
1997), with a weight of 1/n for the n-th: what is known of a landmark is what its observations say on average.
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

# Beyond this distance, m, nothing is compared.
_MAX_PAIR_DISTANCE = 2.0


def scatter_ratio(landmarks: Iterable[Landmark]) -> Float64:
    """Birge's ratio of an area's openings, for all axes together: by how much what is stated of a sighting is too large
    or too small, as sightings of one opening are apart. Shape (3, 3), in deviations; one more sighting is as stated.
    """
    openings = [one for one in landmarks if one.kind == OPENING]
    again = sum(one.existence.detections - 1 for one in openings)
    return np.asarray((np.eye(3) + sum(one.scatter for one in openings)) / (1 + again))


class LandmarkMap:
    """The landmarks of an area.

    :ivar landmarks: all, in the order in which they were found.
    """

    def __init__(self, features: FeatureParameters, begin: Callable[[float], Existence] = Existence) -> None:
        """:param begin: what is known of a landmark's existence at first, by its extraction confidence."""
        self._features, self._initial_existence = features, begin
        self._gate = chi_square_gate(features.pair_probability)
        self.landmarks: list[Landmark] = []

    def observe(self, pose: PoseGaussian, landmarks: ScanLandmarks, rays: Rays, *, is_virtual: bool = False) -> None:
        """Learn what a scan shows, and what it does not show though it should.

        :param pose: the belief over ``area_T_base``.
        :param landmarks: the landmarks of the scan, in the frame of the base.
        :param rays: its beams, likewise.
        :param is_virtual: whether the scan is a virtual one.
        """
        features = self._features
        if is_virtual:
            features = replace(features, landmark_detected=features.landmark_detected_in_map)
        expected = self._should_be_visible(pose.mean, rays)
        placed = [
            pose.compose(PoseGaussian(*each)) for each in zip(landmarks.poses, landmarks.covariances, strict=True)
        ]
        pairs = dict(self._associate(placed, landmarks))
        known = len(self.landmarks)
        for k, landmark in enumerate(self.landmarks):
            if k in pairs:
                self.landmarks[k] = _update_landmark(landmark, placed[pairs[k]], landmarks, pairs[k], features)
            elif expected[k]:
                existence = landmark.existence.update_on_miss(features)
                self.landmarks[k] = replace(landmark, existence=existence)
        for i in sorted(set(range(len(placed))).difference(pairs.values())):
            if not self._is_near_known(placed[i], int(landmarks.kinds[i]), known):
                self.landmarks.append(self._new_landmark(placed[i], landmarks, i))
        least = self._features.landmark_least
        self.landmarks = [one for one in self.landmarks if one.existence.probability >= least]

    def begin_visit(self) -> None:
        """The robot comes back after a while."""
        self.landmarks = [replace(one, existence=one.existence.mark_absence()) for one in self.landmarks]

    def _should_be_visible(self, pose: Float64, rays: Rays) -> Bool:
        """Which landmarks the scan from a pose should show."""
        kinds = np.array([landmark.kind for landmark in self.landmarks], dtype=np.int64)
        poses = np.array([landmark.pose.mean for landmark in self.landmarks]).reshape(-1, 3)
        widths = np.array([landmark.width for landmark in self.landmarks])
        return should_be_visible(kinds, se2.between(pose, poses), widths, rays, self._features)

    def _associate(self, placed: list[PoseGaussian], seen: ScanLandmarks) -> Iterator[tuple[int, int]]:
        """Landmarks of the map and of the scan that are one, the nearest first."""
        near = sorted(
            (distance2, k, i)
            for i, pose in enumerate(placed)
            for k, landmark in enumerate(self.landmarks)
            if landmark.kind == seen.kinds[i] and _distance(landmark.pose, pose) < _MAX_PAIR_DISTANCE
            if (distance2 := landmark.pose.mahalanobis2(pose)) <= self._gate
        )
        taken: tuple[set[int], set[int]] = set(), set()
        for _, k, i in near:
            if k not in taken[0] and i not in taken[1]:
                taken[0].add(k)
                taken[1].add(i)
                yield k, i

    def _new_landmark(self, pose: PoseGaussian, seen: ScanLandmarks, i: int) -> Landmark:
        into = np.linalg.inv(np.linalg.cholesky(pose.covariance))
        return Landmark(
            int(seen.kinds[i]),
            pose,
            float(seen.widths[i]),
            float(seen.width_deviations[i]),
            self._initial_existence(float(seen.confidences[i])),
            scan_covariance_share=into @ seen.covariances[i] @ into.T,
        )

    def _is_near_known(self, pose: PoseGaussian, kind: int, known: int) -> bool:
        """Whether a landmark is so near to a known one of its kind that it is no other one."""
        return any(
            landmark.kind == kind
            and _distance(landmark.pose, pose) < self._features.landmark_apart
            and abs(float(se2.wrap(landmark.pose.mean[2] - pose.mean[2]))) < 0.5
            for landmark in self.landmarks[:known]
        )


def _update_landmark(
    landmark: Landmark, pose: PoseGaussian, seen: ScanLandmarks, i: int, features: FeatureParameters
) -> Landmark:
    """A landmark after one more observation of it."""
    n = landmark.existence.detections + 1
    width, deviation = seen.widths[i], seen.width_deviations[i]
    into = np.linalg.inv(np.linalg.cholesky(pose.covariance))
    # Welford's update: by what a sighting and the mean of those before it may be apart.
    spread = np.linalg.cholesky(pose.covariance + landmark.pose.covariance / (n - 1))
    off = np.linalg.solve(spread, se2.log(se2.between(pose.mean, landmark.pose.mean)))
    return replace(
        landmark,
        pose=_intersect_covariances(landmark.pose, pose, 1.0 / n),
        scatter=landmark.scatter + np.outer(off, off),
        scan_covariance_share=landmark.scan_covariance_share
        + (into @ seen.covariances[i] @ into.T - landmark.scan_covariance_share) / n,
        width=landmark.width + float(width - landmark.width) / n,
        width_deviation=landmark.width_deviation + float(deviation - landmark.width_deviation) / n,
        existence=landmark.existence.update_on_detection(float(seen.confidences[i]), features),
    )


def _distance(one: PoseGaussian, other: PoseGaussian) -> float:
    return float(np.hypot(*(one.mean[:2] - other.mean[:2])))


def _intersect_covariances(known: PoseGaussian, seen: PoseGaussian, weight: float) -> PoseGaussian:
    """Covariance intersection of two beliefs over one pose, the second with a weight."""
    parts = ((known, 1.0 - weight), (seen, weight))
    return fuse([PoseGaussian(part.mean, part.covariance / share) for part, share in parts])
