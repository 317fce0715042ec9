"""Views of areas: landmarks and free space of their keyframes, cached as long as the keyframes do not move."""

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

_VERSIONS = 4
"""Views of one area that are kept, as its keyframes differ between hypotheses."""


class AreaView(NamedTuple):
    """Landmarks and free space that an area's keyframes show, in its frame.

    :ivar landmarks: of the area.
    :ivar keyframes: shape (n,), ids of its keyframes.
    :ivar poses: shape (n, 3), their ``area_T_base``.
    :ivar sector_distances: shape (n, 72), free distances around each, m, in the frame of the base.
    :ivar hallway_lengths: shape (n,), length of the hallway around each, m; nan outside hallways.
    :ivar min_hallway_lengths: shape (n,), shortest hallway of the width there, m; nan where the width is unknown.
    """

    landmarks: tuple[Landmark, ...]
    keyframes: Int64
    poses: Float64
    sector_distances: Float64
    hallway_lengths: Float64
    min_hallway_lengths: Float64


class _AreaViewBuilder:
    """View of an area to which keyframes are added.

    :ivar keyframes: {keyframe: ``area_T_base`` (3,)} of those added so far.
    """

    def __init__(self, mapping: LocalMapping) -> None:
        self._features, self._area = mapping.configuration.features, GrowingArea(mapping)
        self._landmark_map, self._sector_distances = LandmarkMap(self._features), list[Float64]()
        self.keyframes: dict[int, Float64] = {}

    def release(self) -> None:
        """Give the grid of the area back."""
        self._area.release()

    def is_prefix_of(self, keyframes: Mapping[int, Float64]) -> bool:
        """Whether these keyframes are the ones added so far, with more behind them."""
        first = dict(islice(keyframes.items(), len(self.keyframes)))
        return list(first) == list(self.keyframes) and has_same_poses(first, self.keyframes)

    def add(self, keyframes: Mapping[int, Float64], scans: Mapping[int, Scan], max_keyframes: int) -> int:
        """Add up to ``max_keyframes`` of the missing keyframes, and return their number."""
        before = len(self.keyframes)
        for keyframe, pose in islice(keyframes.items(), before, before + max_keyframes):
            observation = self._area.observe_keyframe(scans[keyframe], pose)
            observation.update_map(self._landmark_map)
            self._sector_distances.append(distances_around(observation.rays))
            self.keyframes[keyframe] = pose
        return len(self.keyframes) - before

    @property
    def view(self) -> AreaView:
        """The view of the keyframes added so far."""
        distances, keyframes = np.array(self._sector_distances), np.array(list(self.keyframes), dtype=np.int64)
        lengths = np.array([_hallway_lengths(row, self._features) for row in distances]).reshape(-1, 2)
        landmarks = tuple(self._landmark_map.landmarks)
        return AreaView(landmarks, keyframes, stack_poses(self.keyframes), distances, *lengths.T)


class AreaViewCache:
    """Cache of area views; the area built last can grow without a rebuild.

    :ivar scans: {keyframe: scan}, which may grow.
    :ivar area_landmarks: extracts landmarks.
    """

    def __init__(self, mapping: LocalMapping, scans: Mapping[int, Scan]) -> None:
        self.scans, self.area_landmarks, self._mapping = scans, AreaLandmarkExtractor(mapping), mapping
        self._views: dict[int, OrderedDict[bytes, AreaView]] = {}
        self._builder = _AreaViewBuilder(mapping)

    def clear(self) -> None:
        """Remove all views, which are then rebuilt on demand."""
        if self._views or self._builder.keyframes:
            self._views.clear()
            self._reset_builder()

    def _reset_builder(self) -> None:
        self._builder.release()
        self._builder = _AreaViewBuilder(self._mapping)

    def views_of_map(self, hybrid_map: HybridMap) -> dict[int, AreaView]:
        """{area: view} of all areas of a map."""
        return {area: self.area_view(area, hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()}

    def area_view(self, area: int, keyframes: Mapping[int, Float64]) -> AreaView:
        """The view of an area.

        :param keyframes: {keyframe: ``area_T_base`` (3,)}.
        """
        view = self._cached_view(area, keyframes)
        if view is None:
            self._add_keyframes(area, keyframes, len(keyframes))
            view = self._views[area][_cache_key(keyframes)]
        return view

    def cached_views(self, areas: Mapping[int, Mapping[int, Float64]]) -> dict[int, AreaView]:
        """{area: view} of those areas whose view is cached.

        :param areas: {area: keyframes as in `area_view`}.
        """
        views = ((area, self._cached_view(area, keyframes)) for area, keyframes in areas.items())
        return {area: view for area, view in views if view is not None}

    def prefetch(self, areas: Iterable[tuple[int, Mapping[int, Float64]]], max_keyframes: int) -> None:
        """Process up to ``max_keyframes`` keyframes of areas without a cached view.

        :param areas: with their keyframes as in `area_view`, in the order of later use.
        """
        for area, keyframes in areas:
            if max_keyframes <= 0:
                return
            if keyframes and self._cached_view(area, keyframes) is None:
                max_keyframes -= self._add_keyframes(area, keyframes, max_keyframes)

    def _add_keyframes(self, area: int, keyframes: Mapping[int, Float64], max_keyframes: int) -> int:
        """Process up to ``max_keyframes`` keyframes of an area, and return the number; cache the view at the end."""
        if not self._builder.is_prefix_of(keyframes):
            self._reset_builder()
        count = self._builder.add(keyframes, self.scans, max_keyframes)
        if len(self._builder.keyframes) == len(keyframes):
            versions = self._views.setdefault(area, OrderedDict())
            versions[_cache_key(keyframes)] = self._builder.view
            if len(versions) > _VERSIONS:
                versions.popitem(last=False)
        return count

    def _cached_view(self, area: int, keyframes: Mapping[int, Float64]) -> AreaView | None:
        """The view of an area, if one of these keyframes and poses is cached."""
        versions, key = self._views.get(area), _cache_key(keyframes)
        if versions is None or key not in versions:
            return None
        versions.move_to_end(key)
        return versions[key]


def _cache_key(keyframes: Mapping[int, Float64]) -> bytes:
    """The ids and poses of an area's keyframes as bytes."""
    return np.array(list(keyframes), dtype=np.int64).tobytes() + stack_poses(keyframes).tobytes()


def _hallway_lengths(distances: Float64, features: FeatureParameters) -> tuple[float, float]:
    """Length of the hallway with these free distances, nan for none, and of the shortest of its width, m."""
    space = space_from_distances(distances)
    if space is None:
        return math.nan, math.nan
    shortest = min_hallway_length(space.width, features)
    return space.length if space.length > shortest else math.nan, shortest
