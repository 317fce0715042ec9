"""What the keyframes around an area show of a building's floor, and which openings lead off a hallway.

Tomatis, Nourbakhsh and Siegwart (2003), sections 2.1 and 3.3: a building is rectilinear, and four directions of travel
are told apart, N, E, S, W. North is the same one in all areas: that which is next to the north of a neighbouring area.
Areas that lie for certain beside each other are put into one frame, in which x is east and y is north; nothing is
asked of how areas lie that are far from each other.

An opening leads to another hallway where the robot drove along one behind it; where it did not drive through, where it
is as wide as a hallway and one sees far behind it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.hybrid_map.surroundings import Nearness, areas_around
from hmt_slam_ros.landmarks.area_classes import sector_of
from hmt_slam_ros.landmarks.landmark_map import scatter_ratio
from hmt_slam_ros.landmarks.landmarks import OPENING
from hmt_slam_ros.places.area_views import AreaView
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import opposite

# Areas whose place is known this well, m, and whose keyframes are this near, m, are put into one frame.
_NEARNESS = Nearness(1.0, 25.0)
# A chord along an axis that is this share of the longest one is as long as the hallway.
_LONG = 0.5
# A place lies between the walls of a hallway, m, where so many places of that at least are so near, m.
_SAME_WALL, _BESIDE, _FEW = 0.2, 4.0, 2

_QUARTER = 0.5 * math.pi

DIRECTIONS: Float64 = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
"""Unit vectors of the directions of travel, north, east, south and west, in a frame whose x is east."""


class Floor(NamedTuple):
    """What is around an area, in the frame at its origin whose x is east.

    :ivar area: it.
    :ivar origin: shape (3,), pose of that frame in the area's.
    :ivar areas: {other area: the belief over its pose in the frame}.
    :ivar owners: shape (n,), the area of every keyframe.
    :ivar keyframes: shape (n,), its number, which grows with time.
    :ivar places: shape (n, 2), where they were taken, m.
    :ivar clear: shape (n, 4), how far one sees from there to the north, east, south and west, m.
    :ivar along: shape (n, 2), whether they were taken in a hallway from south to north, and from west to east.
    """

    area: int
    origin: Float64
    areas: dict[int, PoseGaussian]
    owners: Int64
    keyframes: Int64
    places: Float64
    clear: Float64
    along: Bool


def floors(hybrid_map: HybridMap, views: Mapping[int, AreaView]) -> dict[int, Floor]:
    """{area: what is around it}, of all areas around which landmarks tell the building's axes."""
    around = {area: areas_around(hybrid_map, area, _NEARNESS) for area in hybrid_map.area_ids()}
    norths = _norths(around, views)
    return {area: _floor(area, north, around[area], views) for area, north in norths.items()}


def quarter_of(headings: Float64) -> Int64:
    """The directions of travel that headings (n,), rad, in a frame whose x is east are next to."""
    return np.round(1.0 - headings / _QUARTER).astype(np.int64) % QUARTERS


def off_axes(headings: Float64) -> Float64:
    """How far headings, rad, are from the next one of four axes."""
    return np.abs((headings + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER)


def _norths(around: Mapping[int, Mapping[int, PoseGaussian]], views: Mapping[int, AreaView]) -> dict[int, float]:
    """{area: direction of north in its frame, rad}, one after the other from neighbour to neighbour."""
    found: dict[int, float] = {}
    for begin in around:
        pending = [] if begin in found else [(begin, 0.0)]
        while pending:
            area, guess = pending.pop()
            axis = None if area in found else _axis(around[area], views)
            if axis is None:
                continue
            found[area] = guess + (axis - guess + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER
            others = ((other, found[area] - float(pose.mean[2])) for other, pose in around[area].items())
            pending += [each for each in others if each[0] not in found]
    return found


def _axis(areas: Mapping[int, PoseGaussian], views: Mapping[int, AreaView]) -> float | None:
    """The direction of the walls around an area, in its frame, up to quarters of a turn; None where none is known."""
    return axis_of((one, pose.mean[2]) for area, pose in areas.items() for one in views[area].landmarks)


def axis_of(landmarks: Iterable[tuple[Landmark, float]]) -> float | None:
    """The direction of walls, rad, up to quarters of a turn; None where none is known.

    :param landmarks: of the walls, each with the heading of the frame that it is in, rad.
    """
    total = 0.0j
    for landmark, frame in landmarks:
        # A corner looks between its two walls.
        off = 0.0 if landmark.kind == OPENING else 0.5 * _QUARTER
        heading = float(frame + landmark.pose.mean[2]) + off
        weight = landmark.existence.probability / float(landmark.pose.covariance[2, 2])
        total += weight * complex(math.cos(QUARTERS * heading), math.sin(QUARTERS * heading))
    return math.atan2(total.imag, total.real) / QUARTERS if total else None


def _floor(area: int, north: float, around: Mapping[int, PoseGaussian], views: Mapping[int, AreaView]) -> Floor:
    origin = np.array([0.0, 0.0, north - _QUARTER])
    into = PoseGaussian.exactly(se2.inverse(origin))
    areas = {other: into.compose(pose) for other, pose in around.items()}
    poses = np.concatenate([se2.compose(pose.mean, views[other].poses) for other, pose in areas.items()])
    owners = np.concatenate([np.full(len(views[other].poses), other) for other in areas])
    numbers = np.concatenate([views[other].keyframes for other in areas])
    around_each = np.concatenate([views[other].around for other in areas])
    bearings = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]) - poses[:, 2:]
    clear = np.take_along_axis(around_each, sector_of(bearings), axis=1)
    hallways = np.concatenate([views[other].hallways for other in areas])
    shortest = np.concatenate([views[other].shortest for other in areas])
    along = _along(poses[:, :2], clear, hallways, shortest)
    return Floor(area, origin, areas, owners, numbers, poses[:, :2], clear, along)


def _along(places: Float64, clear: Float64, hallways: Float64, shortest: Float64) -> Bool:
    """Along which axes places lie in a hallway, shape (n, 2).

    At the end of a hallway, and where people stand about, one sees no farther than in a room. So a place between the
    walls of a hallway counts as long as that is where others are, on the median.

    :param hallways: shape (n,), as of `AreaView`; ``shortest`` likewise.
    """
    found = clear[:, :2] + clear[:, 2:] >= _LONG * hallways[:, None]
    within = found.copy()
    for axis in (0, 1):
        there, here = np.flatnonzero(found[:, axis]), np.flatnonzero(~found[:, axis])
        same = _between_same_walls(places, clear, axis, here, there)
        enough = same.sum(axis=1) >= _FEW
        here, same = here[enough], same[enough]
        if len(here):
            within[here, axis] = np.nanmedian(np.where(same, hallways[there], np.nan), axis=1) > shortest[here]
    return within


def _between_same_walls(places: Float64, clear: Float64, axis: int, here: Int64, there: Int64) -> Bool:
    """Which pairs of places, one of each group, are near along an axis and see the same walls beside it, (n, m)."""
    side = axis + 1
    ahead, beside = places @ DIRECTIONS[axis], places @ DIRECTIONS[side]
    told = (beside - clear[:, (side + 2) % QUARTERS], beside + clear[:, side], ahead)
    apart = [np.abs(one[here][:, None] - one[there][None]) for one in told]
    return np.asarray((apart[0] <= _SAME_WALL) & (apart[1] <= _SAME_WALL) & (apart[2] <= _BESIDE))


# Openings that are less probable lead nowhere.
_LEAST = 0.5
# An opening is beside a hallway that was driven along so near to it, m, at so many keyframes, which are so far from its
# wall, m, and see that wall where the opening is to this, m. An opening askew from here on, rad, is in none.
_NEAR, _FEW_OPENINGS, _ASIDE, _OFF, _ASKEW = 3.0, 2, (0.2, 2.5), 0.5, math.radians(20.0)
# Keyframes behind an opening are so far behind it, m, and so far beside its middle at most, m; nearer to it one looks
# back into the hallway.
_BEHIND, _WITHIN = (1.5, 5.0), 1.0
# A hallway that nobody drove along is so wide, m, and one sees so far along it from its mouth, m, at least.
_WIDE, _FAR = 1.7, 7.0


class LeadingOff(NamedTuple):
    """An opening in the wall of a hallway.

    :ivar area: in which it is known.
    :ivar number: of the landmark in that area.
    :ivar landmark: as known there.
    :ivar located: the belief over its pose there, by how far its sightings are apart.
    :ivar direction: in which it leads off.
    :ivar hallway: whether to another hallway; else to a room.
    :ivar foot: shape (2,), the place before it in the hallway's middle, in the frame of the area's floor, m.
    """

    area: int
    number: int
    landmark: Landmark
    located: PoseGaussian
    direction: int
    hallway: bool
    foot: Float64


def leading_off(floor: Floor, landmarks: tuple[Landmark, ...]) -> Iterator[LeadingOff]:
    """The openings of an area that lead off hallways.

    :param floor: around the area.
    :param landmarks: of the area.
    """
    ratio = scatter_ratio(landmarks)
    for number, landmark in enumerate(landmarks):
        if landmark.kind != OPENING or landmark.existence.probability < _LEAST:
            continue
        pose = se2.compose(floor.areas[floor.area].mean, landmark.pose.mean)
        if off_axes(pose[2]) > _ASKEW:
            continue
        direction = int(quarter_of(pose[2]))
        foot = _foot(floor, pose[:2], direction)
        if foot is not None:
            hallway = _to_hallway(floor, pose[:2], direction, landmark.width)
            located = landmark.located(ratio)
            yield LeadingOff(floor.area, number, landmark, located, direction, hallway, foot)


def _foot(floor: Floor, place: Float64, direction: int) -> Float64 | None:
    """The place before an opening in the middle of the hallway that it leads off; None where it leads off none."""
    ahead, beside = _seen_from(floor, place, direction)
    wall, other = floor.clear[:, direction], floor.clear[:, opposite(direction)]
    before = (np.abs(beside) <= _NEAR) & (_ASIDE[0] <= ahead) & (ahead <= _ASIDE[1]) & (np.abs(wall - ahead) <= _OFF)
    own = before & floor.along[:, (direction + 1) % 2]
    # In a room, too, one may see into a hallway from some places.
    if own.sum() < max(_FEW_OPENINGS, 0.5 * before.sum()):
        return None
    between = own & (other <= _ASIDE[1])
    middle = np.where(between, 0.5 * (wall - other), np.nan) if between.any() else np.zeros(len(wall))
    return place - DIRECTIONS[direction] * float(np.nanmedian(ahead[own] - middle[own]))


def _to_hallway(floor: Floor, place: Float64, direction: int, width: float) -> bool:
    """Whether an opening leads to a hallway."""
    ahead, beside = _seen_from(floor, place, direction)
    behind = (-_BEHIND[1] <= ahead) & (ahead <= -_BEHIND[0]) & (np.abs(beside) <= _WITHIN)
    if behind.any():
        return bool(floor.along[behind, direction % 2].mean() >= 0.5)
    before = (ahead > 0.0) & (ahead <= _ASIDE[1]) & (np.abs(beside) <= 0.5 * width)
    deep = floor.clear[before, direction] - ahead[before]
    return width >= _WIDE and bool(np.any(deep >= _FAR))


def _seen_from(floor: Floor, place: Float64, direction: int) -> tuple[Float64, Float64]:
    """How far a place is ahead and beside of all keyframes that look in a direction, m, shape (n,) each."""
    away = place - floor.places
    return away @ DIRECTIONS[direction], away @ DIRECTIONS[(direction + 1) % QUARTERS]
