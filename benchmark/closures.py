"""Whether the arcs that closed a loop join what really is joined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.common_map import ArcValue
from hmt_slam_ros.results.hmt_map import SavedMap


@dataclass(frozen=True)
class ClosureError:
    """How far an arc that closed a loop is from the truth.

    :ivar areas: that it joins.
    :ivar translation: m.
    :ivar rotation: degrees.
    """

    areas: tuple[int, int]
    translation: float
    rotation: float


def closure_errors(saved: SavedMap, truth: Mapping[int, NDArray[np.float64]]) -> list[ClosureError]:
    """Errors of all arcs of the most probable map that closed a loop.

    An arc is judged where it matters, between the two keyframes of its areas that truly are nearest to each other.

    :param truth: {running stamp of a scan, ns: ``map_T_base`` (3,)}, of all scans of the log, in any one frame.
    """
    arcs = saved.replica.maps[saved.replica.best].all_arcs()
    return [_error(saved, a, b, arc, truth) for a, b, arc in arcs if arc.closure]


def _error(saved: SavedMap, a: int, b: int, arc: ArcValue, truth: Mapping[int, NDArray[np.float64]]) -> ClosureError:
    (a_T_keyframes, true_in_a), (b_T_keyframes, true_in_b) = (_keyframes(saved, area, truth) for area in (a, b))
    distances = np.hypot(*(true_in_a[:, None, :2] - true_in_b[None, :, :2]).transpose(2, 0, 1))
    k, m = np.unravel_index(np.argmin(distances), distances.shape)
    through_arc = se2.between(a_T_keyframes[k], se2.compose(arc.pose.mean, b_T_keyframes[m]))
    error = se2.between(se2.between(true_in_a[k], true_in_b[m]), through_arc)
    return ClosureError((a, b), float(np.hypot(error[0], error[1])), float(np.degrees(abs(error[2]))))


def _keyframes(
    saved: SavedMap, area: int, truth: Mapping[int, NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (n, 3) of an area's keyframes in the area, and in truth."""
    keyframes = saved.replica.maps[saved.replica.best].keyframes(area)
    poses = np.array(list(keyframes.values())).reshape(-1, 3)
    return poses, np.array([truth[saved.replica.scans[keyframe].stamp] for keyframe in keyframes]).reshape(-1, 3)
