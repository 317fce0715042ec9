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
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.map_changes import Outdated
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.polar_scan import FREE, SURFACE, behind, seen, view_of
from hmt_slam_ros.submap.local_filter import PlacedKeyframe

Points = NDArray[np.float64]

# The last looks: how many, and ns from one to the next; within a second a person goes on by more than half a metre.
_LOOKS, _APART = 3, 1_000_000_000
# What is farther from the robot than this, m, is seen better when it has come nearer.
_REACH = 8.0
CERTAIN = 0.3
"""Deviation of an area's position, m, up to which its keyframes are asked; refined areas lie better than arcs say."""

AROUND = 18.0
"""Keyframes farther away than this, m, say nothing within that reach."""
# Surface that has to be new, m: where nothing was known, and where free space was. A person is 0.4 m wide, so is a box.
_NEW, _CHANGED = 0.5, 0.3
# Samples of surface, m.
_SAMPLE = 0.1
# Share of the scan that has to lie on known surfaces, for the map and not the robot to be elsewhere than thought.
_AGREEING = 0.5
# Probability of the hypotheses that agree on what is no more.
_SURE = 0.9


@dataclass(frozen=True, eq=False)
class Look:
    """A scan of the last metres.

    :ivar scan: the scan.
    :ivar pose: ``area_T_base`` when it was taken, shape (3,), m and rad.
    """

    scan: Scan
    pose: NDArray[np.float64]


class News(NamedTuple):
    """What came of comparing a scan with the map.

    :ivar new: whether it shows enough that was never seen.
    :ivar changed: whether it shows enough that stands where free space was.
    :ivar outdated: {keyframe: what its beams say that is so no more}.
    """

    new: bool
    changed: bool
    outdated: Mapping[int, Late]


class Late(NamedTuple):
    """What the beams of a keyframe, n of them, say that is so no more.

    :ivar gone: shape (n,), whether their end is seen through.
    :ivar starts: shape (n,), m from the laser, from where on they are behind what stands in their way; 0 for nothing.
    """

    gone: Bool
    starts: Points


class _Told(NamedTuple):
    """What scans say of places, shape (n,): whether any saw a surface there, whether any saw through.

    :ivar surface: the former.
    :ivar free: the latter.
    """

    surface: Bool
    free: Bool


def looked(looks: tuple[Look, ...], look: Look) -> tuple[Look, ...]:
    """The last looks with one more, if it is not too soon after the last of them."""
    if looks and look.scan.stamp - looks[-1].scan.stamp < _APART:
        return looks
    return (*looks, look)[-_LOOKS:]


def news_of(now: Look, looks: Sequence[Look], known: Sequence[PlacedKeyframe]) -> News:
    """Compare a scan with a hypothesis's map around the robot.

    :param looks: the last ones before it.
    :param known: the keyframes of the map.
    """
    around = [one for one in known if np.hypot(*(one.pose - now.pose)[:2]) <= AROUND]
    here = _near(se2.transform(now.pose, now.scan.points), now.pose)
    held = _told(here, [Look(one.scan, one.pose) for one in around])
    before = _told(here, looks)
    stays = before.surface & ~before.free
    new = _length(here[stays & ~held.surface & ~held.free]) >= _NEW
    if held.surface.sum() < _AGREEING * len(here):
        return News(new, False, {})
    changed = _length(here[stays & ~held.surface & held.free]) >= _CHANGED
    against = here[stays & held.free]
    against = against[: len(against) if _length(against) >= _CHANGED else 0]
    return News(new, changed, {one.keyframe: Late(_gone(one, now, looks), _behind(one, against)) for one in around})


def outdated(found: Sequence[tuple[News, float]]) -> tuple[Outdated, ...]:
    """What is out of date in all probability.

    :param found: of every hypothesis, and its probability.
    """
    said: dict[int, list[tuple[Late, float]]] = {}
    for news, probability in found:
        for keyframe, late in news.outdated.items():
            said.setdefault(keyframe, []).append((late, probability))
    all_late = (_agreed(keyframe, said[keyframe]) for keyframe in sorted(said))
    return tuple(one for one in all_late if one.beams or one.cut)


def _agreed(keyframe: int, said: Sequence[tuple[Late, float]]) -> Outdated:
    """What hypotheses say of a keyframe, of each that names it with its probability."""
    gone = sum(probability * late.gone for late, probability in said) >= _SURE
    cut = np.flatnonzero((sum(probability * (late.starts > 0.0) for late, probability in said) >= _SURE) & ~gone)
    starts = np.max([late.starts for late, _ in said], axis=0)[cut]
    return Outdated(keyframe, tuple(np.flatnonzero(gone).tolist()), tuple(cut.tolist()), tuple(starts.tolist()))


def _near(points: Points, pose: NDArray[np.float64]) -> Points:
    near: Points = points[np.hypot(*(points - pose[:2]).T) <= _REACH]
    return near


def _told(points: Points, looks: Sequence[Look]) -> _Told:
    said = [seen(view_of(look.scan), se2.transform(se2.inverse(look.pose), points)) for look in looks]
    codes = np.array(said, dtype=np.int8).reshape(len(looks), len(points))
    return _Told((codes == SURFACE).any(axis=0), (codes == FREE).any(axis=0))


def _length(points: Points) -> float:
    """How much surface some of its points are, m."""
    return _SAMPLE * len(np.unique(np.floor(points / _SAMPLE), axis=0))


def _gone(one: PlacedKeyframe, now: Look, looks: Sequence[Look]) -> Bool:
    """The beams of a keyframe whose ends are seen through, shape (number of beams,); nobody makes walls transparent."""
    gone, ends = np.zeros(one.scan.ranges.size, np.bool_), se2.transform(one.pose, one.scan.points)
    near = np.hypot(*(ends - now.pose[:2]).T) <= _REACH
    free = near & _told(ends, [now]).free
    gone[np.flatnonzero(one.scan.valid)[free]] = ~_told(ends[free], looks).surface
    return gone


def _behind(one: PlacedKeyframe, points: Points) -> Points:
    """From where on the beams of a keyframe are behind the places that they pass, shape (number of beams,), m."""
    return behind(view_of(one.scan), se2.transform(se2.inverse(one.pose), points))
