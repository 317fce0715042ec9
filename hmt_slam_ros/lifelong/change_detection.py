"""Change detection: what a scan shows that the map lacks, and what the map holds that is gone.

A surface point is *static* if one of the recent scans, a second or more apart, saw a surface there and none saw through
it. People who walk by are not static. A beam of a keyframe is *stale* if the scan and the recent scans together
contradict it. It is *removed* if they see through its end point. It is *occluded* if it passes a surface that stands
there now; only its part before that surface is stale, since the room behind a closed door is still there. The
thresholds are those of docs/decisions/0029-change-detection.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.metric_slam import FilterParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.map_changes import StaleBeams
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.polar_scan import FREE, SURFACE, classify_points, occlusion_starts, to_polar_scan
from hmt_slam_ros.submap.local_filter import PlacedKeyframe

Points = Float64

_RECENT_SCANS = 3
"""Number of recent scans."""

_MIN_INTERVAL = 1_000_000_000
"""Shortest time between two of them, ns: within a second a person walks more than half a meter."""

_REACH = 8.0
"""Largest distance from the robot at which changes are detected, m; farther ones are seen better from nearer."""

MAX_AREA_SIGMA = 0.3
"""Largest deviation of the position of an area whose keyframes are compared, m; refined areas are better than that."""

MAX_KEYFRAME_DISTANCE = 18.0
"""Largest distance of keyframes that can see something within that reach, m."""

_SAMPLE = 0.1
"""Edge of the cells in which lengths of surface are counted, m."""

_MIN_EXPLAINED_FRACTION = 0.5
"""Smallest share of the scan on known surfaces; else the robot's pose may be wrong rather than the map."""

_MIN_PROBABILITY = 0.9
"""Smallest probability of the hypotheses that agree on a stale beam."""


@dataclass(frozen=True, eq=False)
class RecentScan:
    """A scan of the last meters.

    :ivar scan: the scan.
    :ivar pose: its ``area_T_base``, shape (3,), m and rad.
    """

    scan: Scan
    pose: Float64


class Changes(NamedTuple):
    """The result of comparing a scan with the map.

    :ivar has_new_surface: whether it shows enough surface on unmapped ground.
    :ivar has_changed_surface: whether it shows enough surface in free space.
    :ivar stale_beams: {keyframe: its stale beams}.
    """

    has_new_surface: bool
    has_changed_surface: bool
    stale_beams: Mapping[int, BeamStaleness]


class BeamStaleness(NamedTuple):
    """The stale ones among the n beams of a keyframe.

    :ivar seen_through: shape (n,), whether the end point is seen through.
    :ivar starts: shape (n,), range beyond which the beam is occluded, m; 0 if it is not.
    """

    seen_through: Bool
    starts: Points


class _PointVisibility(NamedTuple):
    """Visibility of points in scans.

    :ivar surface: shape (n,), whether any scan saw a surface there.
    :ivar free: shape (n,), whether any scan saw through.
    """

    surface: Bool
    free: Bool


def append_recent_scan(recent: tuple[RecentScan, ...], newest: RecentScan) -> tuple[RecentScan, ...]:
    """The recent scans with one more, unless it is too soon after the last of them."""
    if recent and newest.scan.stamp - recent[-1].scan.stamp < _MIN_INTERVAL:
        return recent
    return (*recent, newest)[-_RECENT_SCANS:]


def detect_changes(
    now: RecentScan, recent: Sequence[RecentScan], known: Sequence[PlacedKeyframe], settings: FilterParameters
) -> Changes:
    """Compare a scan with a hypothesis's map around the robot.

    :param recent: the recent scans before it.
    :param known: the keyframes of the map.
    :param settings: smallest lengths of new and of changed surface.
    """
    around = [keyframe for keyframe in known if np.hypot(*(keyframe.pose - now.pose)[:2]) <= MAX_KEYFRAME_DISTANCE]
    points = _points_in_reach(se2.transform(now.pose, now.scan.points), now.pose)
    in_map = _point_visibility(points, [RecentScan(keyframe.scan, keyframe.pose) for keyframe in around])
    in_recent = _point_visibility(points, recent)
    is_static = in_recent.surface & ~in_recent.free
    has_new = _surface_length(points[is_static & ~in_map.surface & ~in_map.free]) >= settings.new_surface
    if in_map.surface.sum() < _MIN_EXPLAINED_FRACTION * len(points):
        return Changes(has_new, False, {})
    has_changed = _surface_length(points[is_static & ~in_map.surface & in_map.free]) >= settings.changed_surface
    occluding = points[is_static & in_map.free]
    occluding = occluding[: len(occluding) if _surface_length(occluding) >= settings.changed_surface else 0]
    stale_beams = {
        keyframe.keyframe: BeamStaleness(
            _beams_seen_through(keyframe, now, recent), _occlusion_ranges(keyframe, occluding)
        )
        for keyframe in around
    }
    return Changes(has_new, has_changed, stale_beams)


def combine_stale_beams(changes: Sequence[tuple[Changes, float]]) -> tuple[StaleBeams, ...]:
    """The beams that are stale with enough probability.

    :param changes: of every hypothesis, with its probability.
    """
    by_keyframe: dict[int, list[tuple[BeamStaleness, float]]] = {}
    for change, probability in changes:
        for keyframe, staleness in change.stale_beams.items():
            by_keyframe.setdefault(keyframe, []).append((staleness, probability))
    combined = (_combine_keyframe(keyframe, by_keyframe[keyframe]) for keyframe in sorted(by_keyframe))
    return tuple(beams for beams in combined if beams.removed or beams.occluded)


def _combine_keyframe(keyframe: int, staleness: Sequence[tuple[BeamStaleness, float]]) -> StaleBeams:
    """The stale beams of a keyframe, from those of hypotheses with their probabilities."""
    is_removed = sum(probability * beams.seen_through for beams, probability in staleness) >= _MIN_PROBABILITY
    is_occluded = sum(probability * (beams.starts > 0.0) for beams, probability in staleness) >= _MIN_PROBABILITY
    removed, occluded = np.flatnonzero(is_removed), np.flatnonzero(is_occluded & ~is_removed)
    starts = np.max([beams.starts for beams, _ in staleness], axis=0)[occluded]
    return StaleBeams(keyframe, tuple(removed.tolist()), tuple(occluded.tolist()), tuple(starts.tolist()))


def _points_in_reach(points: Points, pose: Float64) -> Points:
    near: Points = points[np.hypot(*(points - pose[:2]).T) <= _REACH]
    return near


def _point_visibility(points: Points, scans: Sequence[RecentScan]) -> _PointVisibility:
    classes = [classify_points(to_polar_scan(s.scan), se2.transform(se2.inverse(s.pose), points)) for s in scans]
    codes = np.array(classes, dtype=np.int8).reshape(len(scans), len(points))
    return _PointVisibility((codes == SURFACE).any(axis=0), (codes == FREE).any(axis=0))


def _surface_length(points: Points) -> float:
    """Length of the surface that points sample, m."""
    return _SAMPLE * len(np.unique(np.floor(points / _SAMPLE), axis=0))


def _beams_seen_through(keyframe: PlacedKeyframe, now: RecentScan, recent: Sequence[RecentScan]) -> Bool:
    """The beams of a keyframe whose end points are seen through, shape (number of beams,)."""
    seen_through = np.zeros(keyframe.scan.ranges.size, np.bool_)
    ends = se2.transform(keyframe.pose, keyframe.scan.points)
    is_near = np.hypot(*(ends - now.pose[:2]).T) <= _REACH
    is_free = is_near & _point_visibility(ends, [now]).free
    seen_through[np.flatnonzero(keyframe.scan.valid)[is_free]] = ~_point_visibility(ends[is_free], recent).surface
    return seen_through


def _occlusion_ranges(keyframe: PlacedKeyframe, points: Points) -> Points:
    """Ranges beyond which beams of a keyframe are occluded by points that they pass, shape (number of beams,), m."""
    return occlusion_starts(to_polar_scan(keyframe.scan), se2.transform(se2.inverse(keyframe.pose), points))
