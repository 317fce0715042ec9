"""The floor around an area: keyframes in a frame along the building's axes, and the openings beside hallways.

Tomatis, Nourbakhsh and Siegwart (2003), sections 2.1 and 3.3: buildings are rectilinear, with four directions of
travel, N, E, S, W. North is passed on from area to neighboring area. The areas around one, whose poses are certain, are
put into one frame, in which x is east and y is north. Areas far from each other are not compared.

An opening leads to another hallway where the robot drove along one behind it. Where the robot did not drive through,
it is as wide as a hallway, and the free space behind it is long.
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
from hmt_slam_ros.places.observation_graph import QUARTER_TURN, QUARTERS
from hmt_slam_ros.places.place_graph import opposite_direction

_NEIGHBORHOOD = Neighborhood(1.0, 25.0)
"""Areas in one frame: deviation of their position, m, and distance of their keyframes, m, at most."""

_MIN_CHORD_SHARE = 0.5
"""Smallest share of the hallway's length that a chord along its axis has."""

_MAX_WALL_DIFFERENCE = 0.2
"""Keyframes that see the walls on both sides of them within this difference, m, are between the same walls."""

_MAX_NEIGHBOR_DISTANCE = 4.0
"""Largest distance along the axis between such keyframes, m."""

_MIN_NEIGHBORS = 2
"""Keyframes in a hallway between the same walls from which on a keyframe is in that hallway, too."""

_MIN_EXISTENCE = 0.5
"""Openings of a lower probability are ignored."""

_MAX_MISALIGNMENT = math.radians(20.0)
"""Largest angle between an opening and the building's axes, rad."""

_MAX_DISTANCE_ALONG = 3.0
"""Keyframes before an opening are this near to it along the hallway, m."""

_WALL_DISTANCES = (0.2, 2.5)
"""Smallest and largest distance of keyframes in a hallway from its wall, m."""

_MAX_WALL_OFFSET = 0.5
"""Largest distance between an opening and the wall that keyframes before it see, m."""

_MIN_KEYFRAMES = 2
"""Keyframes before an opening in a hallway, at least."""

_DISTANCES_BEHIND = (1.5, 5.0)
"""Smallest and largest distance of keyframes behind an opening from it, m: nearer ones see back into the hallway."""

_MAX_LATERAL_OFFSET = 1.0
"""Largest distance of keyframes behind an opening from its middle line, m."""

_MIN_HALLWAY_WIDTH = 1.7
"""Smallest width of an opening to a hallway that was not driven along, m."""

_MIN_HALLWAY_DEPTH = 7.0
"""Smallest free distance behind such an opening, m."""

DIRECTIONS: Float64 = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
"""Unit vectors of the directions of travel, north, east, south and west, in a frame whose x is east."""


class AlignedNeighborhood(NamedTuple):
    """The keyframes around an area, in the frame at its origin whose x is east.

    :ivar area: the area.
    :ivar origin: shape (3,), pose of that frame in the area's, m and rad.
    :ivar areas: {area: belief over its pose in the frame}.
    :ivar keyframe_areas: shape (n,), the area of each keyframe.
    :ivar keyframes: shape (n,), their ids, in the order of time.
    :ivar positions: shape (n, 2), m.
    :ivar free_distances: shape (n, 4), to the north, east, south and west of them, m.
    :ivar in_hallway: shape (n, 2), whether they are in a hallway from south to north, and from west to east.
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
    """{area: its neighborhood} of all areas with landmarks around them, which give the building's axes."""
    around = {area: areas_around(hybrid_map, area, _NEIGHBORHOOD) for area in hybrid_map.area_ids()}
    norths = _north_headings(around, views)
    return {area: _aligned_neighborhood(area, north, around[area], views) for area, north in norths.items()}


def nearest_direction(headings: Float64) -> Int64:
    """The directions of travel nearest to headings (n,), rad, in a frame whose x is east."""
    return np.round(1.0 - headings / QUARTER_TURN).astype(np.int64) % QUARTERS


def deviation_from_axes(headings: Float64) -> Float64:
    """Angles between headings and the nearest of four axes, rad."""
    return np.abs((headings + 0.5 * QUARTER_TURN) % QUARTER_TURN - 0.5 * QUARTER_TURN)


def ahead_and_beside(offsets: Float64, direction: int) -> tuple[Float64, Float64]:
    """Components of offsets (..., 2) ahead and to the right in a direction of travel, m, shape (...) each."""
    return offsets @ DIRECTIONS[direction], offsets @ DIRECTIONS[(direction + 1) % QUARTERS]


def _north_headings(
    around: Mapping[int, Mapping[int, PoseGaussian]], views: Mapping[int, AreaView]
) -> dict[int, float]:
    """{area: direction of north in its frame, rad}, passed on from neighbor to neighbor."""
    norths: dict[int, float] = {}
    for begin in around:
        pending = [] if begin in norths else [(begin, 0.0)]
        while pending:
            area, guess = pending.pop()
            axis = None if area in norths else _wall_axis_around(around[area], views)
            if axis is None:
                continue
            norths[area] = guess + (axis - guess + 0.5 * QUARTER_TURN) % QUARTER_TURN - 0.5 * QUARTER_TURN
            others = ((other, norths[area] - float(pose.mean[2])) for other, pose in around[area].items())
            pending += [each for each in others if each[0] not in norths]
    return norths


def _wall_axis_around(areas: Mapping[int, PoseGaussian], views: Mapping[int, AreaView]) -> float | None:
    """Direction of the walls around an area, as of `wall_axis`, in the area's frame."""
    return wall_axis((landmark, pose.mean[2]) for area, pose in areas.items() for landmark in views[area].landmarks)


def wall_axis(landmarks: Iterable[tuple[Landmark, float]]) -> float | None:
    """Direction of walls up to quarters of a turn, rad; None without landmarks.

    :param landmarks: of the walls, each with the heading of its frame, rad.
    """
    total = 0.0j
    for landmark, frame in landmarks:
        # A corner's heading bisects its two walls.
        off = 0.0 if landmark.kind == OPENING else 0.5 * QUARTER_TURN
        heading = float(frame + landmark.pose.mean[2]) + off
        weight = landmark.existence.probability / float(landmark.pose.covariance[2, 2])
        total += weight * complex(math.cos(QUARTERS * heading), math.sin(QUARTERS * heading))
    return math.atan2(total.imag, total.real) / QUARTERS if total else None


def _aligned_neighborhood(
    area: int, north: float, around: Mapping[int, PoseGaussian], views: Mapping[int, AreaView]
) -> AlignedNeighborhood:
    origin = np.array([0.0, 0.0, north - QUARTER_TURN])
    into = PoseGaussian.from_pose(se2.inverse(origin))
    areas = {other: into.compose(pose) for other, pose in around.items()}
    poses = np.concatenate([se2.compose(pose.mean, views[other].poses) for other, pose in areas.items()])
    keyframe_areas = np.concatenate([np.full(len(views[other].poses), other) for other in areas])
    keyframes = np.concatenate([views[other].keyframes for other in areas])
    sector_distances = np.concatenate([views[other].sector_distances for other in areas])
    bearings = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]) - poses[:, 2:]
    free = np.take_along_axis(sector_distances, sector_indices(bearings), axis=1)
    lengths = np.concatenate([views[other].hallway_lengths for other in areas])
    min_lengths = np.concatenate([views[other].min_hallway_lengths for other in areas])
    in_hallway = _is_in_hallway(poses[:, :2], free, lengths, min_lengths)
    return AlignedNeighborhood(area, origin, areas, keyframe_areas, keyframes, poses[:, :2], free, in_hallway)


def _is_in_hallway(positions: Float64, free: Float64, lengths: Float64, min_lengths: Float64) -> Bool:
    """Whether positions are in a hallway along each of two axes, shape (n, 2).

    At the end of a hallway, and near people, the free space is as short as in a room. So a position between the walls
    of a hallway counts if the median hallway length of its neighbors is that of a hallway.

    :param free: shape (n, 4), free distances, m.
    :param lengths: shape (n,), ``hallway_lengths`` of `AreaView`; ``min_lengths`` likewise.
    """
    by_chord = free[:, :2] + free[:, 2:] >= _MIN_CHORD_SHARE * lengths[:, None]
    result = by_chord.copy()
    for axis in (0, 1):
        inside, outside = np.flatnonzero(by_chord[:, axis]), np.flatnonzero(~by_chord[:, axis])
        same = _is_between_same_walls(positions, free, axis, outside, inside)
        enough = same.sum(axis=1) >= _MIN_NEIGHBORS
        outside, same = outside[enough], same[enough]
        if len(outside):
            medians = np.nanmedian(np.where(same, lengths[inside], np.nan), axis=1)
            result[outside, axis] = medians > min_lengths[outside]
    return result


def _is_between_same_walls(positions: Float64, free: Float64, axis: int, rows: Int64, others: Int64) -> Bool:
    """Whether pairs of positions, one of each group, are near along an axis and between the same walls, (n, m)."""
    side = axis + 1
    ahead, beside = positions @ DIRECTIONS[axis], positions @ DIRECTIONS[side]
    coordinates = (beside - free[:, (side + 2) % QUARTERS], beside + free[:, side], ahead)
    left, right, along = (np.abs(values[rows][:, None] - values[others][None]) for values in coordinates)
    same_walls = (left <= _MAX_WALL_DIFFERENCE) & (right <= _MAX_WALL_DIFFERENCE)
    return np.asarray(same_walls & (along <= _MAX_NEIGHBOR_DISTANCE))


class SideOpening(NamedTuple):
    """An opening in the wall of a hallway.

    :ivar area: in which it is known.
    :ivar number: of the landmark in that area.
    :ivar landmark: as known there.
    :ivar pose: belief over its pose there, with the scatter of its observations.
    :ivar direction: of travel through it, away from the hallway.
    :ivar leads_to_hallway: whether to another hallway; else to a room.
    :ivar junction_point: shape (2,), the point before it in the hallway's middle, in the area's neighborhood, m.
    """

    area: int
    number: int
    landmark: Landmark
    pose: PoseGaussian
    direction: int
    leads_to_hallway: bool
    junction_point: Float64


def find_side_openings(floor: AlignedNeighborhood, landmarks: tuple[Landmark, ...]) -> Iterator[SideOpening]:
    """The openings of an area in the walls of hallways.

    :param floor: the area's neighborhood.
    :param landmarks: of the area.
    """
    ratio = scatter_ratio(landmarks)
    for number, landmark in enumerate(landmarks):
        if landmark.kind != OPENING or landmark.existence.probability < _MIN_EXISTENCE:
            continue
        pose = se2.compose(floor.areas[floor.area].mean, landmark.pose.mean)
        if deviation_from_axes(pose[2]) > _MAX_MISALIGNMENT:
            continue
        direction = int(nearest_direction(pose[2]))
        point = _junction_point(floor, pose[:2], direction)
        if point is not None:
            to_hallway = _leads_to_hallway(floor, pose[:2], direction, landmark.width)
            belief = landmark.pose_from_scatter(ratio)
            yield SideOpening(floor.area, number, landmark, belief, direction, to_hallway, point)


def _junction_point(floor: AlignedNeighborhood, position: Float64, direction: int) -> Float64 | None:
    """The point before an opening in the middle of its hallway, m, shape (2,); None where it is beside none."""
    nearest, farthest = _WALL_DISTANCES
    ahead, beside = ahead_and_beside(position - floor.positions, direction)
    wall, opposite = floor.free_distances[:, direction], floor.free_distances[:, opposite_direction(direction)]
    before = (np.abs(beside) <= _MAX_DISTANCE_ALONG) & (nearest <= ahead) & (ahead <= farthest)
    before &= np.abs(wall - ahead) <= _MAX_WALL_OFFSET
    in_hallway = before & floor.in_hallway[:, (direction + 1) % 2]
    # From some positions in a room a hallway is visible, too.
    if in_hallway.sum() < max(_MIN_KEYFRAMES, 0.5 * before.sum()):
        return None
    between = in_hallway & (opposite <= farthest)
    middle = np.where(between, 0.5 * (wall - opposite), np.nan) if between.any() else np.zeros(len(wall))
    return position - DIRECTIONS[direction] * float(np.nanmedian(ahead[in_hallway] - middle[in_hallway]))


def _leads_to_hallway(floor: AlignedNeighborhood, position: Float64, direction: int, width: float) -> bool:
    """Whether an opening leads to a hallway."""
    nearest, farthest = _DISTANCES_BEHIND
    ahead, beside = ahead_and_beside(position - floor.positions, direction)
    behind = (-farthest <= ahead) & (ahead <= -nearest) & (np.abs(beside) <= _MAX_LATERAL_OFFSET)
    if behind.any():
        return bool(floor.in_hallway[behind, direction % 2].mean() >= 0.5)
    before = (ahead > 0.0) & (ahead <= _WALL_DISTANCES[1]) & (np.abs(beside) <= 0.5 * width)
    depths = floor.free_distances[before, direction] - ahead[before]
    return width >= _MIN_HALLWAY_WIDTH and bool(np.any(depths >= _MIN_HALLWAY_DEPTH))
