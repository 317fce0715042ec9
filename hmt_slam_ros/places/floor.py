"""What the keyframes around an area show of a building's floor, and which openings lead off a hallway.

Tomatis, Nourbakhsh and Siegwart (2003), sections 2.1 and 3.3: a building is rectilinear, and four directions of travel
are told apart, N, E, S, W. North is the same one in all areas: that which is next to the north of a neighboring area.
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
from hmt_slam_ros.hybrid_map.surroundings import Neighborhood, areas_around
from hmt_slam_ros.landmarks.area_classes import sector_indices
from hmt_slam_ros.landmarks.landmark_map import scatter_ratio
from hmt_slam_ros.landmarks.landmarks import OPENING
from hmt_slam_ros.places.area_views import AreaView
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import opposite_direction

# Areas whose place is known this well, m, and whose keyframes are this near, m, are put into one frame.
_NEARNESS = Neighborhood(1.0, 25.0)
# A chord along an axis that is this share of the longest one is as long as the hallway.
_LONG = 0.5
# A place lies between the walls of a hallway, m, where so many places of that at least are so near, m.
_SAME_WALL, _BESIDE, _MIN_NEIGHBORS = 0.2, 4.0, 2

_QUARTER = 0.5 * math.pi

DIRECTIONS: Float64 = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
"""Unit vectors of the directions of travel, north, east, south and west, in a frame whose x is east."""


class AlignedNeighborhood(NamedTuple):
    """What is around an area, in the frame at its origin whose x is east.

    :ivar area: it.
    :ivar origin: shape (3,), pose of that frame in the area's.
    :ivar areas: {other area: the belief over its pose in the frame}.
    :ivar keyframe_areas: shape (n,), the area of every keyframe.
    :ivar keyframes: shape (n,), its number, which grows with time.
    :ivar positions: shape (n, 2), where they were taken, m.
    :ivar free_distances: shape (n, 4), how far one sees from there to the north, east, south and west, m.
    :ivar in_hallway: shape (n, 2), whether they were taken in a hallway from south to north, and from west to east.
    """

    area: int
    origin: Float64
    areas: dict[int, PoseGaussian]
    keyframe_areas: Int64
    keyframes: Int64
    positions: Float64
    free_distances: Float64
    in_hallway: Bool


def aligned_neighborhoods(hybrid_map: HybridMap, views: Mapping[int, AreaView]) -> dict[int, AlignedNeighborhood]:
    """{area: what is around it}, of all areas around which landmarks tell the building's axes."""
    around = {area: areas_around(hybrid_map, area, _NEARNESS) for area in hybrid_map.area_ids()}
    norths = _north_headings(around, views)
    return {area: _aligned_neighborhood(area, north, around[area], views) for area, north in norths.items()}


def nearest_direction(headings: Float64) -> Int64:
    """The directions of travel that headings (n,), rad, in a frame whose x is east are next to."""
    return np.round(1.0 - headings / _QUARTER).astype(np.int64) % QUARTERS


def deviation_from_axes(headings: Float64) -> Float64:
    """How far headings, rad, are from the next one of four axes."""
    return np.abs((headings + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER)


def _north_headings(
    around: Mapping[int, Mapping[int, PoseGaussian]], views: Mapping[int, AreaView]
) -> dict[int, float]:
    """{area: direction of north in its frame, rad}, one after the other from neighbor to neighbor."""
    found: dict[int, float] = {}
    for begin in around:
        pending = [] if begin in found else [(begin, 0.0)]
        while pending:
            area, guess = pending.pop()
            axis = None if area in found else _wall_axis_around(around[area], views)
            if axis is None:
                continue
            found[area] = guess + (axis - guess + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER
            others = ((other, found[area] - float(pose.mean[2])) for other, pose in around[area].items())
            pending += [each for each in others if each[0] not in found]
    return found


def _wall_axis_around(areas: Mapping[int, PoseGaussian], views: Mapping[int, AreaView]) -> float | None:
    """The direction of the walls around an area, in its frame, up to quarters of a turn; None where none is known."""
    return wall_axis((one, pose.mean[2]) for area, pose in areas.items() for one in views[area].landmarks)


def wall_axis(landmarks: Iterable[tuple[Landmark, float]]) -> float | None:
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


def _aligned_neighborhood(
    area: int, north: float, around: Mapping[int, PoseGaussian], views: Mapping[int, AreaView]
) -> AlignedNeighborhood:
    origin = np.array([0.0, 0.0, north - _QUARTER])
    into = PoseGaussian.from_pose(se2.inverse(origin))
    areas = {other: into.compose(pose) for other, pose in around.items()}
    poses = np.concatenate([se2.compose(pose.mean, views[other].poses) for other, pose in areas.items()])
    owners = np.concatenate([np.full(len(views[other].poses), other) for other in areas])
    numbers = np.concatenate([views[other].keyframes for other in areas])
    around_each = np.concatenate([views[other].sector_distances for other in areas])
    bearings = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]) - poses[:, 2:]
    clear = np.take_along_axis(around_each, sector_indices(bearings), axis=1)
    hallways = np.concatenate([views[other].hallway_lengths for other in areas])
    shortest = np.concatenate([views[other].min_hallway_lengths for other in areas])
    along = _is_in_hallway(poses[:, :2], clear, hallways, shortest)
    return AlignedNeighborhood(area, origin, areas, owners, numbers, poses[:, :2], clear, along)


def _is_in_hallway(places: Float64, clear: Float64, hallways: Float64, shortest: Float64) -> Bool:
    """Along which axes places lie in a hallway, shape (n, 2).

    At the end of a hallway, and where people stand about, one sees no farther than in a room. So a place between the
    walls of a hallway counts as long as that is where others are, on the median.

    :param hallways: shape (n,), as of `AreaView`; ``shortest`` likewise.
    """
    found = clear[:, :2] + clear[:, 2:] >= _LONG * hallways[:, None]
    within = found.copy()
    for axis in (0, 1):
        there, here = np.flatnonzero(found[:, axis]), np.flatnonzero(~found[:, axis])
        same = _is_between_same_walls(places, clear, axis, here, there)
        enough = same.sum(axis=1) >= _MIN_NEIGHBORS
        here, same = here[enough], same[enough]
        if len(here):
            within[here, axis] = np.nanmedian(np.where(same, hallways[there], np.nan), axis=1) > shortest[here]
    return within


def _is_between_same_walls(places: Float64, clear: Float64, axis: int, here: Int64, there: Int64) -> Bool:
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
_NEAR, _MIN_KEYFRAMES, _ASIDE, _OFF, _ASKEW = 3.0, 2, (0.2, 2.5), 0.5, math.radians(20.0)
# Keyframes behind an opening are so far behind it, m, and so far beside its middle at most, m; nearer to it one looks
# back into the hallway.
_BEHIND, _MAX_LATERAL_OFFSET = (1.5, 5.0), 1.0
# A hallway that nobody drove along is so wide, m, and one sees so far along it from its mouth, m, at least.
_MIN_HALLWAY_WIDTH, _FAR = 1.7, 7.0


class SideOpening(NamedTuple):
    """An opening in the wall of a hallway.

    :ivar area: in which it is known.
    :ivar number: of the landmark in that area.
    :ivar landmark: as known there.
    :ivar pose: the belief over its pose there, by how far its sightings are apart.
    :ivar direction: in which it leads off.
    :ivar leads_to_hallway: whether to another hallway; else to a room.
    :ivar junction_point: shape (2,), the place before it in the hallway's middle, in the frame of the area's floor, m.
    """

    area: int
    number: int
    landmark: Landmark
    pose: PoseGaussian
    direction: int
    leads_to_hallway: bool
    junction_point: Float64


def find_side_openings(floor: AlignedNeighborhood, landmarks: tuple[Landmark, ...]) -> Iterator[SideOpening]:
    """The openings of an area that lead off hallways.

    :param floor: around the area.
    :param landmarks: of the area.
    """
    ratio = scatter_ratio(landmarks)
    for number, landmark in enumerate(landmarks):
        if landmark.kind != OPENING or landmark.existence.probability < _LEAST:
            continue
        pose = se2.compose(floor.areas[floor.area].mean, landmark.pose.mean)
        if deviation_from_axes(pose[2]) > _ASKEW:
            continue
        direction = int(nearest_direction(pose[2]))
        foot = _junction_point(floor, pose[:2], direction)
        if foot is not None:
            hallway = _leads_to_hallway(floor, pose[:2], direction, landmark.width)
            located = landmark.pose_from_scatter(ratio)
            yield SideOpening(floor.area, number, landmark, located, direction, hallway, foot)


def _junction_point(floor: AlignedNeighborhood, place: Float64, direction: int) -> Float64 | None:
    """The place before an opening in the middle of the hallway that it leads off; None where it leads off none."""
    ahead, beside = _relative_to_keyframes(floor, place, direction)
    wall, other = floor.free_distances[:, direction], floor.free_distances[:, opposite_direction(direction)]
    before = (np.abs(beside) <= _NEAR) & (_ASIDE[0] <= ahead) & (ahead <= _ASIDE[1]) & (np.abs(wall - ahead) <= _OFF)
    own = before & floor.in_hallway[:, (direction + 1) % 2]
    # In a room, too, one may see into a hallway from some places.
    if own.sum() < max(_MIN_KEYFRAMES, 0.5 * before.sum()):
        return None
    between = own & (other <= _ASIDE[1])
    middle = np.where(between, 0.5 * (wall - other), np.nan) if between.any() else np.zeros(len(wall))
    return place - DIRECTIONS[direction] * float(np.nanmedian(ahead[own] - middle[own]))


def _leads_to_hallway(floor: AlignedNeighborhood, place: Float64, direction: int, width: float) -> bool:
    """Whether an opening leads to a hallway."""
    ahead, beside = _relative_to_keyframes(floor, place, direction)
    behind = (-_BEHIND[1] <= ahead) & (ahead <= -_BEHIND[0]) & (np.abs(beside) <= _MAX_LATERAL_OFFSET)
    if behind.any():
        return bool(floor.in_hallway[behind, direction % 2].mean() >= 0.5)
    before = (ahead > 0.0) & (ahead <= _ASIDE[1]) & (np.abs(beside) <= 0.5 * width)
    deep = floor.free_distances[before, direction] - ahead[before]
    return width >= _MIN_HALLWAY_WIDTH and bool(np.any(deep >= _FAR))


def _relative_to_keyframes(floor: AlignedNeighborhood, place: Float64, direction: int) -> tuple[Float64, Float64]:
    """How far a place is ahead and beside of all keyframes that look in a direction, m, shape (n,) each."""
    away = place - floor.positions
    return away @ DIRECTIONS[direction], away @ DIRECTIONS[(direction + 1) % QUARTERS]
