"""Publisher of the landmarks of all areas, which are extracted for subscribers, within a share of a core."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.kernel_thread import KernelThread
from hmt_slam_ros.ros.landmark_markers import landmark_lines, landmark_markers
from hmt_slam_ros.ros.map_publisher import MAX_SHARE
from hmt_slam_ros.ros.map_view import MapRenderer
from hmt_slam_ros.ros.topics import LANDMARKS

if TYPE_CHECKING:
    from hmt_slam_ros.hybrid_map.landmark import Landmark
    from hmt_slam_ros.sensors import Scan

_KEYFRAMES_AT_ONCE = 10
"""Keyframes whose landmarks are extracted at a time; each takes about 5 ms."""

_PERIOD = 2.9
"""Least time between two messages, s; just below whole checks."""


class LandmarkExtraction:
    """Landmarks of the areas of a map, some keyframes at a time.

    :ivar scans: {keyframe: scan} of the map.
    :ivar landmarks: {area: landmarks}, by those of its keyframes that were there when all of them were extracted.
    """

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        """:param scans: may grow."""
        from hmt_slam_ros.places.area_views import AreaViewCache  # noqa: PLC0415  only for subscribers
        from hmt_slam_ros.submap.local_mapping import LocalMapping  # noqa: PLC0415

        self.scans = scans
        self.landmarks: dict[int, tuple[Landmark, ...]] = {}
        self._cache = AreaViewCache(LocalMapping(configuration), scans)

    def advance(self, areas: Mapping[int, Mapping[int, Float64]]) -> bool:
        """Extract some landmarks, and say whether those of any area changed.

        :param areas: {area: {keyframe: ``area_T_base`` (3,)}}; that of the last goes on where the area grew.
        """
        self._cache.prefetch(areas.items(), _KEYFRAMES_AT_ONCE)
        views, before = self._cache.cached_views(areas), self.landmarks
        self.landmarks = {
            area: views[area].landmarks if area in views else before[area]
            for area in areas
            if area in views or area in before
        }
        return any(own is not before.get(area) for area, own in self.landmarks.items())


class LandmarkPublisher:
    """Publishes the landmarks of the most probable hypothesis as lines on a latched topic."""

    def __init__(self, node: Node, kernels: KernelThread, configuration: Configuration) -> None:
        """:param kernels: of the node."""
        self._publisher = node.create_publisher(MarkerArray, LANDMARKS, topics.LATCHED)
        self._configuration, self._kernels = configuration, kernels
        self._extraction: LandmarkExtraction | None = None
        self._published_version, self._is_outdated = 0, False
        self._next_extraction = self._next_message = 0.0

    def publish_if_due(self, renderer: MapRenderer) -> None:
        """Extract some landmarks while there are subscribers, and publish all where they changed and it is time."""
        now, has_map = time.monotonic(), self._is_outdated or renderer.version > 0
        if now < self._next_extraction or not self._publisher.get_subscription_count() or not has_map:
            return
        extraction = self._extraction_of(renderer)
        if not self._kernels.is_done:
            return
        begin = time.thread_time()
        self._is_outdated |= extraction.advance(renderer.area_keyframes())
        is_changed = self._is_outdated or (extraction.landmarks and renderer.version != self._published_version)
        if is_changed and now >= self._next_message:
            frames = renderer.known_area_poses()
            lines = landmark_lines((frames[a], own) for a, own in extraction.landmarks.items() if a in frames)
            self._publisher.publish(landmark_markers(lines, renderer.stamp, renderer.frame))
            self._published_version, self._is_outdated, self._next_message = renderer.version, False, now + _PERIOD
        self._next_extraction = now + (time.thread_time() - begin) / MAX_SHARE

    def _extraction_of(self, renderer: MapRenderer) -> LandmarkExtraction:
        """The extraction for a map; the first one also has the kernels loaded."""
        if self._extraction is None or self._extraction.scans is not renderer.scans:
            is_first = self._extraction is None
            self._extraction = LandmarkExtraction(self._configuration, renderer.scans)
            if is_first:
                self._kernels.start()
        return self._extraction

    def invalidate(self) -> None:
        """Publish the landmarks next time, also where they did not change."""
        self._is_outdated, self._next_extraction, self._next_message = True, 0.0, 0.0
