"""What the keyframes around an area show of a building's floor, along the building's axes.

Tomatis, Nourbakhsh and Siegwart (2003), sections 2.1 and 3.3: a building is rectilinear, and four directions of travel
are told apart, N, E, S, W. North is the same one in all areas: that which is next to the north of a neighbouring area.
Areas that lie for certain beside each other are put into one frame, in which x is east and y is north; nothing is
asked of how areas lie that are far from each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.features.hallway import sector_of
from hmt_slam_ros.features.landmark_map import Landmark
from hmt_slam_ros.features.landmarks import OPENING
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.places.area_views import AreaView
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.surroundings import Nearness, areas_around

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
