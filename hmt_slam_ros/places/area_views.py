"""What the keyframes of a map's areas show, each area looked up once as long as its keyframes stay where they are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import islice
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration.features import Features
from hmt_slam_ros.features.hallway import distances_around, shortest_hallway, space_within
from hmt_slam_ros.features.landmark_map import Landmark, LandmarkMap
from hmt_slam_ros.local_map.area_landmarks import AreaLandmarks, Growing
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.surroundings import same_poses, stacked


class AreaView(NamedTuple):
    """What an area's keyframes show, in its frame.

    :ivar landmarks: of the area.
    :ivar keyframes: shape (n,), numbers of its keyframes.
    :ivar poses: shape (n, 3), their ``area_T_base``.
    :ivar around: shape (n, 72), how far one sees around each, m, in the frame of the base.
    :ivar hallways: shape (n,), how long the hallway is that each was taken in, m; nan in none.
    :ivar shortest: shape (n,), how long a hallway as wide as there would be at least, m; nan where that is not known.
    """

    landmarks: tuple[Landmark, ...]
    keyframes: Int64
    poses: Float64
    around: Float64
    hallways: Float64
    shortest: Float64


class _GrowingView:
    """What an area shows to which keyframes are added."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._features, self._area = mapping.configuration.features, Growing(mapping)
        self._found, self._around = LandmarkMap(self._features), list[Float64]()
        self._keyframes: dict[int, Float64] = {}

    def release(self) -> None:
        """The area does not grow any more."""
        self._area.release()

    def is_begin_of(self, keyframes: Mapping[int, Float64]) -> bool:
        """Whether an area of keyframes was this one before some were added."""
        first = dict(islice(keyframes.items(), len(self._keyframes)))
        return list(first) == list(self._keyframes) and same_poses(first, self._keyframes)

    def grown(self, keyframes: Mapping[int, Float64], scans: Mapping[int, Scan]) -> AreaView:
        """What the area shows after what it lacks of keyframes was added."""
        for keyframe, pose in islice(keyframes.items(), len(self._keyframes), None):
            sighting = self._area.sighting(scans[keyframe], pose)
            sighting.add_to(self._found)
            self._around.append(distances_around(sighting.rays))
            self._keyframes[keyframe] = pose
        around, numbers = np.array(self._around), np.array(list(keyframes), dtype=np.int64)
        lengths = np.array([_hallway(away, self._features) for away in around]).reshape(-1, 2)
        return AreaView(tuple(self._found.landmarks), numbers, stacked(keyframes), around, *lengths.T)


class AreaViews:
    """Looks up what areas show, and keeps it; of the area that was looked up last also what that takes to grow.

    :ivar scans: {keyframe: scan}, which may grow.
    :ivar known: gathers landmarks.
    """

    def __init__(self, mapping: LocalMapping, scans: Mapping[int, Scan]) -> None:
        self.scans, self.known, self._mapping = scans, AreaLandmarks(mapping), mapping
        self._views: dict[int, tuple[dict[int, Float64], AreaView]] = {}
        self._newest = _GrowingView(mapping)

    def forget(self) -> None:
        """Forget what areas show, which is looked up again where it is asked for."""
        if self._views:
            self._views.clear()
            self._begin()

    def _begin(self) -> None:
        self._newest.release()
        self._newest = _GrowingView(self._mapping)

    def of_map(self, hybrid_map: HybridMap) -> dict[int, AreaView]:
        """{area: what it shows}, of all areas of a map."""
        return {area: self.of(area, hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()}

    def of(self, area: int, keyframes: Mapping[int, Float64]) -> AreaView:
        """What an area shows.

        :param keyframes: {keyframe: ``area_T_base`` (3,)}.
        """
        held = self._held(area, keyframes)
        if held is None:
            if not self._newest.is_begin_of(keyframes):
                self._begin()
            held = self._newest.grown(keyframes, self.scans)
            self._views[area] = dict(keyframes), held
        return held

    def look_up_one(self, hybrid_map: HybridMap) -> None:
        """Look up what one more area of a map shows, if there is one of which that is not kept."""
        for area in hybrid_map.area_ids():
            keyframes = hybrid_map.keyframes(area)
            if self._held(area, keyframes) is None:
                self.of(area, keyframes)
                return

    def _held(self, area: int, keyframes: Mapping[int, Float64]) -> AreaView | None:
        """What an area shows, if it is kept and its keyframes are where they were."""
        held = self._views.get(area)
        return held[1] if held is not None and same_poses(held[0], keyframes) else None


def _hallway(away: Float64, features: Features) -> tuple[float, float]:
    """The length of the hallway in which one sees so far around, nan in none, and the least of one as wide, m."""
    space = space_within(away)
    if space is None:
        return math.nan, math.nan
    shortest = shortest_hallway(space.width, features)
    return space.length if space.length > shortest else math.nan, shortest
