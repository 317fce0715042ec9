"""What landmarks say of the places in a map where a robot may be that woke up somewhere, or was carried.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: the observation graph of what the robot saw since, against that of
the map around a place, by the observation function OS of the belief over places. It is the prior of the places that
surfaces find, relative to new ground.

Landmarks are made of the same scans as surfaces are. That they agree in a place that surfaces have found says no more
than that; only what speaks against a place counts, as with walls that beams pass, and with an exponent. Both were
chosen by log score on training worlds, where looks from where the map does not reach weigh a fifth (`python -m
benchmark prior --training`). And a building's places look more like each other than like ground of which nothing is
known, whose landmarks are strewn: new ground is mostly like some place of the map, and that is measured at places where
the robot has been.
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
    ExpectedLandmarks,
    log_observation_ratios,
    log_unknown_ground_ratio,
    observation_model,
)
from hmt_slam_ros.places.observation_graph import LandmarkSequence, concatenate_sequences, select_landmarks
from hmt_slam_ros.places.wall_landmarks import KnownLandmarks, known_landmarks_around, wall_landmark_sequence
from hmt_slam_ros.topological_inference.global_localization import PoseDistribution
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate

Pose = Float64

# Areas whose place is known this well, m, and whose keyframes are this near, m, are what is around one.
_NEARNESS = Neighborhood(1.0, 16.0)
# Places that are less probable by their surfaces stay as they are: their landmarks would have to be gathered.
_PROBABLE = 1e-3
# Landmarks of one kind that are so near to each other may be one, m.
_BESIDE = 0.4
# At so many places of the map it is asked how new ground may look; with this probability it looks like one of them.
_REFERENCE_PLACEMENTS, _FAMILIARITY = 24, 0.9


class ReferencePlacement(NamedTuple):
    """Where what the robot saw may lie.

    :ivar area: of the map.
    :ivar pose: ``area_T_reference``, shape (3,).
    """

    area: int
    pose: Pose


class RelocalizationPrior:
    """Compares what a robot saw with what the map has at places where it may be."""

    def __init__(self, configuration: Configuration, views: AreaViewCache) -> None:
        """:param views: what areas show."""
        self._features, self._places = configuration.features, configuration.places
        self._model = observation_model(configuration.places, configuration.features)
        self._views = views
        self._keyframes_between_searches = max(1, configuration.tsbi.recheck_keyframes - 1)

    def reweight(
        self, where: PoseDistribution, hybrid_map: HybridMap, poses: Mapping[int, Pose], before: int
    ) -> PoseDistribution:
        """Places with what landmarks say of them.

        :param poses: {keyframe: ``reference_T_base``} of what the robot saw.
        :param before: the map is that of the keyframes before this one.
        """
        probable = np.flatnonzero(where.probabilities >= _PROBABLE)
        ratios = self.log_ratios(hybrid_map, poses, before, [where.candidates[n] for n in probable])
        log_weights = np.zeros(len(where.candidates))
        if ratios is not None:
            log_weights[probable] = temper_log_ratios(ratios, self._places.prior_temper)
        return where.reweight(log_weights)

    def prefetch(self, maps: Iterable[tuple[HybridMap, int]]) -> None:
        """At a keyframe event between looks, gather a share of the landmarks of maps, so that all are there soon.

        :param maps: each with the keyframe before which it is.
        """
        every = ((area, _keyframes_before(one, area, before)) for one, before in maps for area in one.area_ids())
        # What hypotheses have in common once.
        areas = {(area, *keyframes): (area, keyframes) for area, keyframes in every}
        count = sum(len(keyframes) for _, keyframes in areas.values())
        self._views.prefetch(areas.values(), math.ceil(count / self._keyframes_between_searches))

    def log_ratios(
        self, hybrid_map: HybridMap, poses: Mapping[int, Pose], before: int, found: Sequence[PoseCandidate]
    ) -> Float64 | None:
        """log OS(o, s) of places against new ground, shape (len(found),), nats; None where no landmark tells anything.

        :param poses: {keyframe: ``reference_T_base``} of what the robot saw.
        :param before: the map is that of the keyframes before this one.
        """
        if not found:
            return None
        sightings = list(
            self._views.area_landmarks.observations([self._views.scans[k] for k in poses], stack_poses(poses))
        )
        seen = self._views.area_landmarks.fuse_observations(sightings)
        axis = wall_axis((landmark, 0.0) for landmark in seen)
        if axis is None:
            return None
        newest = poses[max(poses)]
        frame = np.array([*newest[:2], axis])
        observed = self._observation_graph(seen, np.array([one.pose.mean for one in seen]), frame)
        places = [
            *(ReferencePlacement(one.area, one.mode.pose.mean) for one in found),
            *_reference_placements(hybrid_map, newest, before),
        ]
        lists = self._expected_sequences(self._landmarks_at(hybrid_map, before, places, frame), sightings, seen, frame)
        starts = np.cumsum([0, *(len(each.tracks) for each in lists)])
        expected = ExpectedLandmarks(starts, concatenate_sequences(lists))
        strewn = log_unknown_ground_ratio(observed, self._model)
        ratios = log_observation_ratios(observed, expected, 0.0, 0.0, self._model) - strewn
        return ratios[: len(found)] - _log_new_ground(ratios[len(found) :])

    def _landmarks_at(
        self, hybrid_map: HybridMap, before: int, places: Sequence[ReferencePlacement], frame: Pose
    ) -> Iterator[tuple[list[Landmark], Float64]]:
        """The landmarks of the map around a robot that is at each of some places, and their poses (n, 3).

        :param frame: shape (3,), the robot's place, with the heading of the axis.
        :returns: poses in the frame of the keyframes' reference.
        """
        known = {area: self._known_around(hybrid_map, area, before) for area in {place.area for place in places}}
        for area, pose in places:
            poses = se2.compose(se2.inverse(pose), known[area].poses)
            near = np.abs(se2.between(frame, poses)[:, 0]) <= self._places.reach
            yield [known[area].landmarks[k] for k in np.flatnonzero(near).tolist()], poses[near]

    def _known_around(self, hybrid_map: HybridMap, area: int, before: int) -> KnownLandmarks:
        """The landmarks of the map around an area, in its frame."""
        around = areas_around(hybrid_map, area, _NEARNESS)
        return known_landmarks_around(
            around, {other: self._area_landmarks(hybrid_map, other, before) for other in around}
        )

    def _expected_sequences(
        self,
        known: Iterable[tuple[list[Landmark], Float64]],
        sightings: Sequence[LandmarkObservation],
        seen: Sequence[Landmark],
        frame: Pose,
    ) -> list[LandmarkSequence]:
        """Of the landmarks of the map in each of some places those that keyframes should see there.

        What is where one was seen is in sight, too, although a place that is some centimetres off, or a wall, may hide
        it.
        """
        lists, poses = zip(*known, strict=True)
        every = list(chain(*lists))
        # All places at once: a call costs more than a landmark.
        shown = self._is_visible(every, np.concatenate(poses), sightings) | _is_near_observed(
            every, np.concatenate(poses), seen
        )
        ends = np.cumsum([len(own) for own in lists])[:-1]
        return [
            self._observation_graph([own[k] for k in np.flatnonzero(due_there).tolist()], at[due_there], frame)
            for own, at, due_there in zip(lists, poses, np.split(shown, ends), strict=True)
        ]

    def _is_visible(
        self, landmarks: Sequence[Landmark], poses: Float64, sightings: Sequence[LandmarkObservation]
    ) -> Bool:
        """Which landmarks (n,) at poses (n, 3) any of the keyframes should see."""
        kinds = np.array([one.kind for one in landmarks], dtype=np.int64)
        widths = np.array([one.width for one in landmarks])
        shown = np.zeros(len(landmarks), np.bool_)
        for sighting in sightings:
            left = np.flatnonzero(~shown)
            local = se2.between(sighting.pose.mean, poses[left])
            shown[left] = should_be_visible(kinds[left], local, widths[left], sighting.rays, self._features)
        return shown

    def _area_landmarks(self, hybrid_map: HybridMap, area: int, before: int) -> tuple[Landmark, ...]:
        """The landmarks of an area's keyframes before one of them."""
        return self._views.area_view(area, _keyframes_before(hybrid_map, area, before)).landmarks

    def _observation_graph(self, landmarks: Sequence[Landmark], poses: Float64, frame: Pose) -> LandmarkSequence:
        """The observation graph of landmarks within reach along an axis.

        :param frame: shape (3,), the robot's place, with the heading of the axis.
        """
        graph = wall_landmark_sequence(landmarks, se2.between(frame, poses.reshape(-1, 3)))
        return select_landmarks(graph, np.abs(graph.positions) <= self._places.reach)


def temper_log_ratios(ratios: Float64, temper: float) -> Float64:
    """What places weigh more by their landmarks, nats, shape as ``ratios``.

    :param ratios: log OS(o, s) of places against new ground.
    """
    return temper * np.minimum(ratios, 0.0)


def _keyframes_before(hybrid_map: HybridMap, area: int, keyframe: int) -> dict[int, Pose]:
    """{keyframe: ``area_T_base``} of an area's keyframes before one of them."""
    return {k: pose for k, pose in hybrid_map.keyframes(area).items() if k < keyframe}


def _reference_placements(hybrid_map: HybridMap, newest: Pose, before: int) -> Iterator[ReferencePlacement]:
    """Places where the robot has been, as many keyframes apart.

    :param newest: ``reference_T_base`` of the newest keyframe, with which it would stand there, shape (3,).
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


def _log_new_ground(ratios: Float64) -> float:
    """log OS(o, new ground) against unknown ground, nats, by that of places of the map, shape (n,)."""
    alike = float(np.logaddexp.reduce(ratios)) - math.log(len(ratios))
    return float(np.logaddexp(math.log(1.0 - _FAMILIARITY), math.log(_FAMILIARITY) + alike))


def _is_near_observed(landmarks: Sequence[Landmark], poses: Float64, seen: Sequence[Landmark]) -> Bool:
    """Which landmarks (n,) at poses (n, 3) are where one of their kind was seen."""
    kinds, others = (np.array([one.kind for one in each]) for each in (landmarks, seen))
    places = np.array([one.pose.mean[:2] for one in seen])
    away = np.hypot(*(poses[:, None, :2] - places).transpose(2, 0, 1))
    return np.asarray(((away <= _BESIDE) & (kinds[:, None] == others)).any(axis=1))
