"""Windows: stretches of a component's path, each of which is searched in the whole of another component."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.registration.consistency import NO_CLUTTER
from hmt_slam_ros.team.components import ComponentPair
from hmt_slam_ros.topological_inference.event_work import EventWork
from hmt_slam_ros.topological_inference.map_search import MapSearch
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution

Pose = Float64

_MAX_LENGTH = 8.0
"""Length of the path in a window, m: with more the map may bend, with less places look alike."""

_MAX_KEYFRAMES = 20
"""Most keyframes of a window."""

_MIN_KEYFRAMES = 5
"""Fewest keyframes of a window, as of an area."""

_MAX_STEP = 4.0
"""Largest distance between successive keyframes of a window, m: beyond, others of the path were pruned."""

_MAX_SIGMA = 0.5
"""Largest deviation of an area of a window as seen from its first, m."""


@dataclass(frozen=True, eq=False)
class Window:
    """Successive keyframes of a component in one frame.

    :ivar area: that of the first keyframe.
    :ivar reference: shape (3,), ``area_T_reference``, the pose of the first keyframe.
    :ivar poses: {keyframe: ``reference_T_base``, shape (3,)}, ascending.
    """

    area: int
    reference: Pose
    poses: Mapping[int, Pose]


def find_windows(hybrid_map: HybridMap, areas: Sequence[int]) -> list[Window]:
    """The windows of a component in the order of its path; none overlaps another.

    :param areas: of the component.
    """
    keyframes = sorted((k, area) for area in areas for k in hybrid_map.keyframes(area))
    windows: list[Window] = []
    first = 0
    while first < len(keyframes):
        window, count = _window_from(hybrid_map, keyframes[first : first + _MAX_KEYFRAMES])
        first += count
        if count >= _MIN_KEYFRAMES:
            windows.append(window)
    return windows


def _window_from(hybrid_map: HybridMap, keyframes: Sequence[tuple[int, int]]) -> tuple[Window, int]:
    """The longest window at the beginning of (keyframe, area), and the number of its keyframes."""
    reference, area = keyframes[0]
    frames = shortest_path_beliefs(hybrid_map, area, _MAX_SIGMA**2)
    start = hybrid_map.keyframes(area)[reference]
    poses = {reference: np.zeros(3)}
    last, length = np.zeros(3), 0.0
    for keyframe, own in keyframes[1:]:
        if own not in frames:
            break
        pose = se2.between(start, se2.compose(frames[own].mean, hybrid_map.keyframes(own)[keyframe]))
        step = float(np.hypot(*(pose - last)[:2]))
        if step > _MAX_STEP or length + step > _MAX_LENGTH:
            break
        poses[keyframe] = pose
        last, length = pose, length + step
    return Window(area, start, poses), len(poses)


class WindowSearch:
    """Searches windows of one component in the whole of the other one, with a flat prior."""

    def __init__(self, pair: ComponentPair, configuration: Configuration) -> None:
        self._pair, self._work = pair, EventWork()
        self._map_search = MapSearch(configuration, pair.scans, self._work)

    def localize(self, window: Window) -> PoseDistribution:
        """Where the window lies in the first component, or on ground that this does not have."""
        hybrid_map, search_map = self._pair.hybrid_map, self._map_search
        search = search_map.begin(hybrid_map, window.poses, self._pair.first_keyframe)
        while search.unexamined:
            self._work.begin_event()
            search = search_map.continue_search(hybrid_map, search)
        is_checked = False
        while not is_checked:
            self._work.begin_event()
            search, is_checked = search_map.check_candidates(hybrid_map, search, NO_CLUTTER)
        return search_map.localize(hybrid_map, search, NO_CLUTTER)
