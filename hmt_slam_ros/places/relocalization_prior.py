"""Relocalization prior: the weight of pose candidates in a map by landmarks.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3. The observation graph of the newest keyframes is compared with
that of the map around each candidate, by the observation function OS, relative to unmapped ground.

Landmarks come from the same scans as the matches that found a candidate. So agreement adds nothing: only what speaks
against a candidate counts, with an exponent. Both were chosen by log score on training worlds
(docs/reports/2026-11-24-prior.md). Places of one building resemble each other more than a Poisson process does.
So unmapped ground mostly looks like some place of the map, which is measured at keyframes of the map.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.hybrid_map.surroundings import Neighborhood, areas_around, stack_poses
from hmt_slam_ros.landmarks.area_landmarks import LandmarkObservation
from hmt_slam_ros.landmarks.landmarks import should_be_visible
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.floor import wall_axis
from hmt_slam_ros.places.observation import (
    log_observation_ratios,
    log_unknown_ground_ratio,
    observation_model,
    stack_expected_landmarks,
)
from hmt_slam_ros.places.observation_graph import LandmarkSequence, select_landmarks
from hmt_slam_ros.places.wall_landmarks import KnownLandmarks, known_landmarks_around, wall_landmark_sequence
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution

Pose = Float64

_NEIGHBORHOOD = Neighborhood(1.0, 16.0)
"""Areas around a candidate: deviation of their position, m, and distance of their keyframes, m, at most."""

_MIN_CANDIDATE_PROBABILITY = 1e-3
"""Candidates of a lower probability are not compared, as their landmarks would have to be extracted."""

_SAME_LANDMARK_DISTANCE = 0.4
"""Landmarks of one kind nearer than this, m, may be one."""

_REFERENCE_PLACEMENTS = 24
"""Keyframes of the map at which the likelihood of unmapped ground is measured."""

_FAMILIARITY = 0.9
"""Probability that unmapped ground looks like one of these; docs/reports/2026-11-24-prior.md has the alternatives."""


class ReferencePlacement(NamedTuple):
    """A pose of the newest keyframes' reference in the map.

    :ivar area: of the map.
    :ivar pose: ``area_T_reference``, shape (3,), m and rad.
    """

    area: int
    pose: Pose


class RelocalizationPrior:
    """Weighs pose candidates by the landmarks of the newest keyframes."""

    def __init__(self, configuration: Configuration, views: AreaViewCache) -> None:
        self._features, self._places = configuration.features, configuration.places
        self._model = observation_model(configuration.places, configuration.features)
        self._views = views
        self._keyframes_between_searches = max(1, configuration.tsbi.recheck_keyframes - 1)

    def reweight(
        self, where: PoseDistribution, hybrid_map: HybridMap, poses: Mapping[int, Pose], before: int
    ) -> PoseDistribution:
        """A distribution over poses, reweighted by landmarks.

        :param poses: {keyframe: ``reference_T_base`` (3,)} of the newest keyframes, m and rad.
        :param before: the first keyframe that is not part of the map.
        """
        probable = np.flatnonzero(where.probabilities >= _MIN_CANDIDATE_PROBABILITY)
        ratios = self.log_ratios(hybrid_map, poses, before, [where.candidates[n] for n in probable])
        log_weights = np.zeros(len(where.candidates))
        if ratios is not None:
            log_weights[probable] = temper_log_ratios(ratios, self._places.prior_temper)
        return where.reweight(log_weights)

    def prefetch(self, maps: Iterable[tuple[HybridMap, int]]) -> None:
        """Extract a share of the landmarks of maps, so that all are there at the next search.

        :param maps: each with the first keyframe that is not part of it.
        """
        pairs = ((area, _keyframes_before(each, area, before)) for each, before in maps for area in each.area_ids())
        # Areas that several hypotheses share count once.
        areas = {(area, *keyframes): (area, keyframes) for area, keyframes in pairs}
        count = sum(len(keyframes) for _, keyframes in areas.values())
        self._views.prefetch(areas.values(), math.ceil(count / self._keyframes_between_searches))

    def log_ratios(
        self, hybrid_map: HybridMap, poses: Mapping[int, Pose], before: int, candidates: Sequence[PoseCandidate]
    ) -> Float64 | None:
        """log OS(o, s) of candidates against unmapped ground, shape (len(candidates),), nats; None without landmarks.

        :param poses: {keyframe: ``reference_T_base`` (3,)} of the newest keyframes, m and rad.
        :param before: the first keyframe that is not part of the map.
        """
        if not candidates:
            return None
        extractor, scans = self._views.area_landmarks, self._views.scans
        observations = list(extractor.observations([scans[k] for k in poses], stack_poses(poses)))
        landmarks = extractor.fuse_observations(observations)
        axis = wall_axis((landmark, 0.0) for landmark in landmarks)
        if axis is None:
            return None
        newest = poses[max(poses)]
        frame = np.array([*newest[:2], axis])
        observed = self._observation_graph(landmarks, np.array([each.pose.mean for each in landmarks]), frame)
        placements = [
            *(ReferencePlacement(each.area, each.mode.pose.mean) for each in candidates),
            *_reference_placements(hybrid_map, newest, before),
        ]
        around = self._landmarks_at(hybrid_map, before, placements, frame)
        expected = stack_expected_landmarks(self._expected_sequences(around, observations, landmarks, frame))
        unknown = log_unknown_ground_ratio(observed, self._model)
        ratios = log_observation_ratios(observed, expected, 0.0, 0.0, self._model) - unknown
        return ratios[: len(candidates)] - _log_unmapped_ground(ratios[len(candidates) :])

    def _landmarks_at(
        self, hybrid_map: HybridMap, before: int, placements: Sequence[ReferencePlacement], frame: Pose
    ) -> Iterator[tuple[list[Landmark], Float64]]:
        """The landmarks of the map around each of some placements, with their poses (n, 3) in the reference's frame.

        :param frame: shape (3,), the robot's position, with the heading of the axis.
        """
        known = {area: self._known_around(hybrid_map, area, before) for area in {each.area for each in placements}}
        for area, pose in placements:
            poses = se2.compose(se2.inverse(pose), known[area].poses)
            near = np.abs(se2.between(frame, poses)[:, 0]) <= self._places.reach
            yield [known[area].landmarks[k] for k in np.flatnonzero(near).tolist()], poses[near]

    def _known_around(self, hybrid_map: HybridMap, area: int, before: int) -> KnownLandmarks:
        """The landmarks of the map around an area, in its frame."""
        around = areas_around(hybrid_map, area, _NEIGHBORHOOD)
        keyframes = {other: _keyframes_before(hybrid_map, other, before) for other in around}
        landmarks = {other: self._views.area_view(other, own).landmarks for other, own in keyframes.items()}
        return known_landmarks_around(around, landmarks)

    def _expected_sequences(
        self,
        around: Iterable[tuple[list[Landmark], Float64]],
        observations: Sequence[LandmarkObservation],
        observed: Sequence[Landmark],
        frame: Pose,
    ) -> list[LandmarkSequence]:
        """The landmarks around each placement that are visible from keyframes, or near an observed one.

        The latter count although a small error of the placement, or a wall, may hide them.
        """
        landmarks, poses = zip(*around, strict=True)
        # All placements at once: a call costs more than a landmark.
        all_landmarks, all_poses = list(chain(*landmarks)), np.concatenate(poses)
        visible = self._is_visible(all_landmarks, all_poses, observations)
        visible |= _is_near_observed(all_landmarks, all_poses, observed)
        ends = np.cumsum([len(own) for own in landmarks])[:-1]
        return [
            self._observation_graph([own[k] for k in np.flatnonzero(chosen).tolist()], own_poses[chosen], frame)
            for own, own_poses, chosen in zip(landmarks, poses, np.split(visible, ends), strict=True)
        ]

    def _is_visible(
        self, landmarks: Sequence[Landmark], poses: Float64, observations: Sequence[LandmarkObservation]
    ) -> Bool:
        """Whether landmarks (n,) at poses (n, 3) should be visible from any of the keyframes."""
        kinds = np.array([landmark.kind for landmark in landmarks], dtype=np.int64)
        widths = np.array([landmark.width for landmark in landmarks])
        visible = np.zeros(len(landmarks), np.bool_)
        for observation in observations:
            rest = np.flatnonzero(~visible)
            local = se2.between(observation.pose.mean, poses[rest])
            visible[rest] = should_be_visible(kinds[rest], local, widths[rest], observation.rays, self._features)
        return visible

    def _observation_graph(self, landmarks: Sequence[Landmark], poses: Float64, frame: Pose) -> LandmarkSequence:
        """The observation graph of landmarks within reach along an axis.

        :param frame: shape (3,), the robot's position, with the heading of the axis.
        """
        graph = wall_landmark_sequence(landmarks, se2.between(frame, poses.reshape(-1, 3)))
        return select_landmarks(graph, np.abs(graph.positions) <= self._places.reach)


def temper_log_ratios(ratios: Float64, temper: float) -> Float64:
    """Log-weights of candidates, nats, shape as ``ratios``.

    :param ratios: log OS(o, s) of candidates against unmapped ground.
    """
    return temper * np.minimum(ratios, 0.0)


def _keyframes_before(hybrid_map: HybridMap, area: int, keyframe: int) -> dict[int, Pose]:
    """{keyframe: ``area_T_base`` (3,)} of an area's keyframes before a keyframe."""
    return {k: pose for k, pose in hybrid_map.keyframes(area).items() if k < keyframe}


def _reference_placements(hybrid_map: HybridMap, newest: Pose, before: int) -> Iterator[ReferencePlacement]:
    """Placements at evenly spaced keyframes of the map.

    :param newest: ``reference_T_base`` of the newest keyframe, which is placed there, shape (3,).
    """
    known = [
        (area, pose)
        for area in hybrid_map.area_ids()
        for k, pose in sorted(_keyframes_before(hybrid_map, area, before).items())
    ]
    back = se2.inverse(newest)
    for n in np.unique(np.linspace(0, len(known) - 1, _REFERENCE_PLACEMENTS).round().astype(np.int64)).tolist():
        area, pose = known[n]
        yield ReferencePlacement(area, se2.compose(pose, back))


def _log_unmapped_ground(ratios: Float64) -> float:
    """log OS(o, unmapped ground) against unknown ground, nats, by that of placements in the map, shape (n,)."""
    alike = float(np.logaddexp.reduce(ratios)) - math.log(len(ratios))
    return float(np.logaddexp(math.log(1.0 - _FAMILIARITY), math.log(_FAMILIARITY) + alike))


def _is_near_observed(landmarks: Sequence[Landmark], poses: Float64, observed: Sequence[Landmark]) -> Bool:
    """Whether landmarks (n,) at poses (n, 3) are near an observed one of their kind."""
    kinds, observed_kinds = (np.array([landmark.kind for landmark in each]) for each in (landmarks, observed))
    positions = np.array([landmark.pose.mean[:2] for landmark in observed])
    distances = np.hypot(*(poses[:, None, :2] - positions).transpose(2, 0, 1))
    near = distances <= _SAME_LANDMARK_DISTANCE
    return np.asarray((near & (kinds[:, None] == observed_kinds)).any(axis=1))
