"""Windows: stretches of a component's path, each of which is searched in another component."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs

Pose = Float64

MAX_LENGTH = 8.0
"""Length of the path in a window, m: with more the map may bend, with less places look alike."""

GROUND_RADIUS = 4.0
"""Distance from a keyframe in sight within which another component's window is on its ground, m.

Robots keep to different sides of a hall (docs/decisions/0096-sides-of-a-hall.md).
"""

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
    :ivar reference: shape (3,), ``area_T_reference``, the pose of the first keyframe; of the robot in a rendezvous.
    :ivar poses: {keyframe: ``reference_T_base``, shape (3,)}, ascending.
    """

    area: int
    reference: Pose
    poses: Mapping[int, Pose]


def find_windows(hybrid_map: HybridMap, areas: Sequence[int], earlier: Sequence[Window] = ()) -> list[Window]:
    """The windows of a component in the order of its path; none overlaps another.

    :param areas: of the component.
    :param earlier: windows when the component had fewer keyframes. They remain while theirs are there, but for the
        last, which may have grown.
    """
    area_of = {k: area for area in areas for k in hybrid_map.keyframes(area)}
    windows: list[Window] = []
    for window in earlier[:-1]:
        if all(k in area_of for k in window.poses):
            keyframes = [(k, area_of[k]) for k in window.poses]
            found, count = _window_from(hybrid_map, keyframes)
            if count == len(keyframes):
                windows.append(found)
    covered = {k for window in windows for k in window.poses}
    for run in _runs(sorted(area_of), covered):
        windows += _windows_in(hybrid_map, [(k, area_of[k]) for k in run])
    return sorted(windows, key=lambda window: next(iter(window.poses)))


def _runs(keyframes: Sequence[int], covered: Collection[int]) -> list[list[int]]:
    """The stretches of keyframes between those that are covered."""
    runs: list[list[int]] = [[]]
    for keyframe in keyframes:
        if keyframe not in covered:
            runs[-1].append(keyframe)
        elif runs[-1]:
            runs.append([])
    return runs


def _windows_in(hybrid_map: HybridMap, keyframes: Sequence[tuple[int, int]]) -> list[Window]:
    """The windows of a stretch of (keyframe, area)."""
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
        if step > _MAX_STEP or length + step > MAX_LENGTH:
            break
        poses[keyframe] = pose
        last, length = pose, length + step
    return Window(area, start, poses), len(poses)
