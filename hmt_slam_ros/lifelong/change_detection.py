"""Mode lifelong: what a keyframe's scan shows that the map does not hold, and what the map holds that is no more.

Whatever stays is seen again a second later from somewhere else, and whoever walks through is not. So of the scan only
surfaces count that one of the last looks saw too and none of them saw through; and of the map only those beams are out
of date that say something else than the scan and the last looks together: their end is seen through, or they pass what
stands there now, and hold from behind it on: the room behind a door that was closed is still there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool
from hmt_slam_ros.configuration.metric_slam import FilterParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.map_changes import StaleBeams
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.polar_scan import FREE, SURFACE, classify_points, occlusion_starts, to_polar_scan
from hmt_slam_ros.submap.local_filter import PlacedKeyframe

Points = NDArray[np.float64]

# The last looks: how many, and ns from one to the next; within a second a person goes on by more than half a meter.
_RECENT_SCANS, _MIN_INTERVAL = 3, 1_000_000_000
# What is farther from the robot than this, m, is seen better when it has come nearer.
_REACH = 8.0
MAX_AREA_SIGMA = 0.3
"""Deviation of an area's position, m, up to which its keyframes are asked; refined areas lie better than arcs say."""

MAX_KEYFRAME_DISTANCE = 18.0
"""Keyframes farther away than this, m, say nothing within that reach."""
# Samples of surface, m.
_SAMPLE = 0.1
# Share of the scan that has to lie on known surfaces, for the map and not the robot to be elsewhere than thought.
_MIN_EXPLAINED_FRACTION = 0.5
# Probability of the hypotheses that agree on what is no more.
_MIN_PROBABILITY = 0.9


@dataclass(frozen=True, eq=False)
class RecentScan:
    """A scan of the last meters.

    :ivar scan: the scan.
    :ivar pose: ``area_T_base`` when it was taken, shape (3,), m and rad.
    """

    scan: Scan
    pose: NDArray[np.float64]


class Changes(NamedTuple):
    """What came of comparing a scan with the map.

    :ivar has_new_surface: whether it shows enough that was never seen.
    :ivar has_changed_surface: whether it shows enough that stands where free space was.
    :ivar stale_beams: {keyframe: what its beams say that is so no more}.
    """

    has_new_surface: bool
    has_changed_surface: bool
    stale_beams: Mapping[int, BeamStaleness]


class BeamStaleness(NamedTuple):
    """What the beams of a keyframe, n of them, say that is so no more.

    :ivar seen_through: shape (n,), whether their end is seen through.
    :ivar starts: shape (n,), m from the laser, from where on they are behind what stands in their way; 0 for nothing.
    """

    seen_through: Bool
    starts: Points


class _PointVisibility(NamedTuple):
    """What scans say of places, shape (n,): whether any saw a surface there, whether any saw through.

    :ivar surface: the former.
    :ivar free: the latter.
    """

    surface: Bool
    free: Bool


def append_recent_scan(recent: tuple[RecentScan, ...], newest: RecentScan) -> tuple[RecentScan, ...]:
    """The last looks with one more, if it is not too soon after the last of them."""
    if recent and newest.scan.stamp - recent[-1].scan.stamp < _MIN_INTERVAL:
        return recent
    return (*recent, newest)[-_RECENT_SCANS:]


def detect_changes(
    now: RecentScan, recent: Sequence[RecentScan], known: Sequence[PlacedKeyframe], settings: FilterParameters
) -> Changes:
    """Compare a scan with a hypothesis's map around the robot.

    :param recent: the last ones before it.
    :param known: the keyframes of the map.
    :param settings: lengths of surface that have to be new or changed.
    """
    around = [one for one in known if np.hypot(*(one.pose - now.pose)[:2]) <= MAX_KEYFRAME_DISTANCE]
    here = _points_in_reach(se2.transform(now.pose, now.scan.points), now.pose)
    held = _point_visibility(here, [RecentScan(one.scan, one.pose) for one in around])
    before = _point_visibility(here, recent)
    stays = before.surface & ~before.free
    new = _surface_length(here[stays & ~held.surface & ~held.free]) >= settings.new_surface
    if held.surface.sum() < _MIN_EXPLAINED_FRACTION * len(here):
        return Changes(new, False, {})
    changed = _surface_length(here[stays & ~held.surface & held.free]) >= settings.changed_surface
    against = here[stays & held.free]
    against = against[: len(against) if _surface_length(against) >= settings.changed_surface else 0]
    return Changes(
        new,
        changed,
        {
            one.keyframe: BeamStaleness(_beams_seen_through(one, now, recent), _occlusion_ranges(one, against))
            for one in around
        },
    )


def combine_stale_beams(found: Sequence[tuple[Changes, float]]) -> tuple[StaleBeams, ...]:
    """What is out of date in all probability.

    :param found: of every hypothesis, and its probability.
    """
    said: dict[int, list[tuple[BeamStaleness, float]]] = {}
    for news, probability in found:
        for keyframe, late in news.stale_beams.items():
            said.setdefault(keyframe, []).append((late, probability))
    all_late = (_combine_keyframe(keyframe, said[keyframe]) for keyframe in sorted(said))
    return tuple(one for one in all_late if one.removed or one.occluded)


def _combine_keyframe(keyframe: int, said: Sequence[tuple[BeamStaleness, float]]) -> StaleBeams:
    """What hypotheses say of a keyframe, of each that names it with its probability."""
    gone = sum(probability * late.seen_through for late, probability in said) >= _MIN_PROBABILITY
    cut = np.flatnonzero(
        (sum(probability * (late.starts > 0.0) for late, probability in said) >= _MIN_PROBABILITY) & ~gone
    )
    starts = np.max([late.starts for late, _ in said], axis=0)[cut]
    return StaleBeams(keyframe, tuple(np.flatnonzero(gone).tolist()), tuple(cut.tolist()), tuple(starts.tolist()))


def _points_in_reach(points: Points, pose: NDArray[np.float64]) -> Points:
    near: Points = points[np.hypot(*(points - pose[:2]).T) <= _REACH]
    return near


def _point_visibility(points: Points, recent: Sequence[RecentScan]) -> _PointVisibility:
    said = [classify_points(to_polar_scan(look.scan), se2.transform(se2.inverse(look.pose), points)) for look in recent]
    codes = np.array(said, dtype=np.int8).reshape(len(recent), len(points))
    return _PointVisibility((codes == SURFACE).any(axis=0), (codes == FREE).any(axis=0))


def _surface_length(points: Points) -> float:
    """How much surface some of its points are, m."""
    return _SAMPLE * len(np.unique(np.floor(points / _SAMPLE), axis=0))


def _beams_seen_through(keyframe: PlacedKeyframe, now: RecentScan, recent: Sequence[RecentScan]) -> Bool:
    """The beams of a keyframe whose ends are seen through, shape (number of beams,); nobody makes walls transparent."""
    gone, ends = np.zeros(keyframe.scan.ranges.size, np.bool_), se2.transform(keyframe.pose, keyframe.scan.points)
    near = np.hypot(*(ends - now.pose[:2]).T) <= _REACH
    free = near & _point_visibility(ends, [now]).free
    gone[np.flatnonzero(keyframe.scan.valid)[free]] = ~_point_visibility(ends[free], recent).surface
    return gone


def _occlusion_ranges(keyframe: PlacedKeyframe, points: Points) -> Points:
    """From where on the beams of a keyframe are behind the places that they pass, shape (number of beams,), m."""
    return occlusion_starts(to_polar_scan(keyframe.scan), se2.transform(se2.inverse(keyframe.pose), points))
