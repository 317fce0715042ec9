"""What the keyframes of a map's areas show, each area looked up once as long as its keyframes stay where they are."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.hybrid_map.surroundings import has_same_poses, stack_poses
from hmt_slam_ros.landmarks.area_classes import distances_around, min_hallway_length, space_from_distances
from hmt_slam_ros.landmarks.area_landmarks import AreaLandmarkExtractor, GrowingArea
from hmt_slam_ros.landmarks.landmark_map import LandmarkMap
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_mapping import LocalMapping

# Of an area that differs from hypothesis to hypothesis so many are kept.
_VERSIONS = 4


class AreaView(NamedTuple):
    """What an area's keyframes show, in its frame.

    :ivar landmarks: of the area.
    :ivar keyframes: shape (n,), numbers of its keyframes.
    :ivar poses: shape (n, 3), their ``area_T_base``.
    :ivar sector_distances: shape (n, 72), how far one sees around each, m, in the frame of the base.
    :ivar hallway_lengths: shape (n,), how long the hallway is that each was taken in, m; nan in none.
    :ivar min_hallway_lengths: shape (n,), how long a hallway as wide as there would be at least, m; nan where that is
        not known.
    """

    landmarks: tuple[Landmark, ...]
    keyframes: Int64
    poses: Float64
    sector_distances: Float64
    hallway_lengths: Float64
    min_hallway_lengths: Float64


class _AreaViewBuilder:
    """What an area shows to which keyframes are added.

    :ivar keyframes: {keyframe: ``area_T_base`` (3,)} of those that were.
    """

    def __init__(self, mapping: LocalMapping) -> None:
        self._features, self._area = mapping.configuration.features, GrowingArea(mapping)
        self._landmark_map, self._sector_distances = LandmarkMap(self._features), list[Float64]()
        self.keyframes: dict[int, Float64] = {}

    def release(self) -> None:
        """The area does not grow any more."""
        self._area.release()

    def is_prefix_of(self, keyframes: Mapping[int, Float64]) -> bool:
        """Whether an area of keyframes was this one before some were added."""
        first = dict(islice(keyframes.items(), len(self.keyframes)))
        return list(first) == list(self.keyframes) and has_same_poses(first, self.keyframes)

    def add(self, keyframes: Mapping[int, Float64], scans: Mapping[int, Scan], max_keyframes: int) -> int:
        """Add so many at most of the keyframes that it lacks; how many these were."""
        before = len(self.keyframes)
        for keyframe, pose in islice(keyframes.items(), before, before + max_keyframes):
            sighting = self._area.observe_keyframe(scans[keyframe], pose)
            sighting.update_map(self._landmark_map)
            self._sector_distances.append(distances_around(sighting.rays))
            self.keyframes[keyframe] = pose
        return len(self.keyframes) - before

    @property
    def view(self) -> AreaView:
        """What the area shows."""
        keyframes = self.keyframes
        around, numbers = np.array(self._sector_distances), np.array(list(keyframes), dtype=np.int64)
        lengths = np.array([_hallway_lengths(away, self._features) for away in around]).reshape(-1, 2)
        return AreaView(tuple(self._landmark_map.landmarks), numbers, stack_poses(keyframes), around, *lengths.T)


class AreaViewCache:
    """Looks up what areas show, and keeps it; of the area that was looked up last also what that takes to grow.

    :ivar scans: {keyframe: scan}, which may grow.
    :ivar area_landmarks: gathers landmarks.
    """

    def __init__(self, mapping: LocalMapping, scans: Mapping[int, Scan]) -> None:
        self.scans, self.area_landmarks, self._mapping = scans, AreaLandmarkExtractor(mapping), mapping
        self._views: dict[int, OrderedDict[bytes, AreaView]] = {}
        self._builder = _AreaViewBuilder(mapping)

    def clear(self) -> None:
        """Forget what areas show, which is looked up again where it is asked for."""
        if self._views or self._builder.keyframes:
            self._views.clear()
            self._reset_builder()

    def _reset_builder(self) -> None:
        self._builder.release()
        self._builder = _AreaViewBuilder(self._mapping)

    def views_of_map(self, hybrid_map: HybridMap) -> dict[int, AreaView]:
        """{area: what it shows}, of all areas of a map."""
        return {area: self.area_view(area, hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()}

    def area_view(self, area: int, keyframes: Mapping[int, Float64]) -> AreaView:
        """What an area shows.

        :param keyframes: {keyframe: ``area_T_base`` (3,)}.
        """
        held = self._cached_view(area, keyframes)
        if held is None:
            self._add_keyframes(area, keyframes, len(keyframes))
            held = self._views[area][_cache_key(keyframes)]
        return held

    def prefetch(self, areas: Iterable[tuple[int, Mapping[int, Float64]]], max_keyframes: int) -> None:
        """Look at so many keyframes at most of areas of which it is not kept what they show.

        :param areas: with their keyframes as in `of`, in the order in which they are looked up.
        """
        for area, keyframes in areas:
            if max_keyframes <= 0:
                return
            if keyframes and self._cached_view(area, keyframes) is None:
                max_keyframes -= self._add_keyframes(area, keyframes, max_keyframes)

    def _add_keyframes(self, area: int, keyframes: Mapping[int, Float64], max_keyframes: int) -> int:
        """Look at so many keyframes at most of an area, and keep what it shows after the last; how many these were."""
        if not self._builder.is_prefix_of(keyframes):
            self._reset_builder()
        count = self._builder.add(keyframes, self.scans, max_keyframes)
        if len(self._builder.keyframes) == len(keyframes):
            kept = self._views.setdefault(area, OrderedDict())
            kept[_cache_key(keyframes)] = self._builder.view
            if len(kept) > _VERSIONS:
                kept.popitem(last=False)
        return count

    def _cached_view(self, area: int, keyframes: Mapping[int, Float64]) -> AreaView | None:
        """What an area shows, if it is kept and its keyframes are where they were."""
        kept, key = self._views.get(area), _cache_key(keyframes)
        if kept is None or key not in kept:
            return None
        kept.move_to_end(key)
        return kept[key]


def _cache_key(keyframes: Mapping[int, Float64]) -> bytes:
    """What differs where other keyframes are in an area, or elsewhere in it."""
    return np.array(list(keyframes), dtype=np.int64).tobytes() + stack_poses(keyframes).tobytes()


def _hallway_lengths(away: Float64, features: FeatureParameters) -> tuple[float, float]:
    """The length of the hallway in which one sees so far around, nan in none, and the least of one as wide, m."""
    space = space_from_distances(away)
    if space is None:
        return math.nan, math.nan
    shortest = min_hallway_length(space.width, features)
    return space.length if space.length > shortest else math.nan, shortest
