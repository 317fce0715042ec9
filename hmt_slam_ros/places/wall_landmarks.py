"""Landmarks on the walls of a segment of hallway, in the frame of a robot that travels along it.

Landmarks behind the walls are visible through openings alone, and are left out. So are those that face a room: its
openings and the corners of its walls.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.landmarks import PlaceParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.landmarks.landmarks import CONVEX_CORNER, OPENING, Corners
from hmt_slam_ros.landmarks.openings import Openings
from hmt_slam_ros.places.floor import DIRECTIONS, AlignedNeighborhood, ahead_and_beside
from hmt_slam_ros.places.observation_graph import (
    OPENINGS,
    QUARTERS,
    LandmarkSequence,
    merge_sequences,
    observation_graph,
    select_landmarks,
    select_wall_landmarks,
)

_SAME_DISTANCE, _SAME_HEADING = 0.4, 0.5
"""Landmarks of one kind nearer than this, m and rad, are one landmark of several areas."""

_MAX_DISTANCE_BEHIND_WALL = 0.4
"""Largest distance of a wall's landmarks behind it, m."""

_MAX_LATERAL_OFFSET, _MAX_DISTANCE_ALONG = 0.9, 2.0
"""Keyframes that measure a hallway's width: largest distance from its middle and from the segment, m."""

_WIDTH_QUANTILE = 0.25
"""Quantile of these widths, so that openings to the sides do not count."""

_DEFAULT_HALF_WIDTH = 1.2
"""Half the width of a hallway without such keyframes, m."""

_MAX_OPEN_LENGTH = 10.0
"""Length of a segment without an end, m."""

_SAME_OPENING_DISTANCE = 0.6
"""Largest distance of the opening of a hallway from its node along another one, m."""

_MIN_EXISTENCE = 0.9
"""Existence of such an opening, at least."""

_UNSEEN_DEVIATIONS = (0.1, 0.2)
"""Deviations of position and width of such an opening that is no landmark, m."""

_WIDTH_INTERVAL = (1.5, 6.0)
"""Segment of that hallway behind its node over which its width is measured, m."""

_UNLIMITED = replace(PlaceParameters(), reach=100.0, aside=100.0)
"""Parameters by which all landmarks of a segment are within reach."""


class HallwaySegment(NamedTuple):
    """A segment of hallway, in the frame of a neighborhood.

    :ivar origin: shape (2,), a point in its middle, m.
    :ivar direction: of travel.
    :ivar begin: along that direction from the origin, m.
    :ivar end: likewise.
    """

    origin: Float64
    direction: int
    begin: float
    end: float


class KnownLandmarks(NamedTuple):
    """Landmarks around an area, each once.

    :ivar landmarks: each as in the area with the highest existence.
    :ivar poses: shape (n, 3), in one frame, m and rad.
    :ivar members: the landmarks (area, number) that each one is.
    """

    landmarks: list[Landmark]
    poses: Float64
    members: list[set[tuple[int, int]]]


def known_landmarks_around(
    areas: Mapping[int, PoseGaussian], landmarks: Mapping[int, Sequence[Landmark]]
) -> KnownLandmarks:
    """The landmarks of some areas in one frame.

    :param areas: {area: belief over its pose in the frame}.
    :param landmarks: {area: its landmarks}.
    """
    candidates = [
        (landmark, se2.compose(pose.mean, landmark.pose.mean), (area, number))
        for area, pose in areas.items()
        for number, landmark in enumerate(landmarks[area])
    ]
    known = KnownLandmarks([], np.empty((len(candidates), 3)), [])
    for landmark, pose, member in sorted(candidates, key=lambda each: (-each[0].existence.probability, each[2])):
        same = [k for k in range(len(known.landmarks)) if _is_same_landmark(known, k, landmark, pose)]
        if same:
            known.members[same[0]].add(member)
        else:
            known.poses[len(known.landmarks)] = pose
            known.landmarks.append(landmark)
            known.members.append({member})
    return known._replace(poses=known.poses[: len(known.landmarks)])


def segment_landmarks(
    known: KnownLandmarks,
    floor: AlignedNeighborhood,
    segment: HallwaySegment,
    excluded: Collection[tuple[int, int]],
    always_included: Collection[tuple[int, int]] = (),
) -> LandmarkSequence:
    """The landmarks of a segment, as from its origin.

    :param excluded: landmarks (area, number) that are left out,
    :param always_included: except for these, at any position.
    """
    along = DIRECTIONS[segment.direction]
    frame = np.array((*segment.origin, math.atan2(along[1], along[0])))
    local = se2.between(frame, known.poses)
    begin = max(segment.begin, -_MAX_OPEN_LENGTH)
    end = _MAX_OPEN_LENGTH if segment.end == math.inf else segment.end
    at_walls = np.abs(local[:, 1]) <= _half_width(floor, segment, begin, end) + _MAX_DISTANCE_BEHIND_WALL
    chosen = (begin <= local[:, 0]) & (local[:, 0] < end) & at_walls
    chosen &= np.array([members.isdisjoint(excluded) for members in known.members], dtype=np.bool_)
    chosen |= np.array([not members.isdisjoint(always_included) for members in known.members], dtype=np.bool_)
    chosen &= _belongs_to_hallway(known, local, segment)
    return wall_landmark_sequence([known.landmarks[k] for k in np.flatnonzero(chosen).tolist()], local[chosen])


def add_hallway_openings(
    landmarks: LandmarkSequence, floor: AlignedNeighborhood, position: Float64, direction: int, sides: Sequence[int]
) -> LandmarkSequence:
    """The landmarks of a node, with the hallways to its sides as openings.

    These exist, even where no scan showed both of their jambs.

    :param landmarks: as from the node.
    :param position: shape (2,), of the node, m.
    :param direction: of travel.
    :param sides: directions of the hallways to the left and the right.
    """
    openings = []
    for side in sides:
        track = OPENINGS + (direction - side) % QUARTERS
        at_node = (landmarks.tracks == track) & (np.abs(landmarks.positions) < _SAME_OPENING_DISTANCE)
        order = np.argsort(-landmarks.probabilities[at_node], kind="stable")
        opening = select_landmarks(landmarks, np.flatnonzero(at_node)[order[:1]])
        if not len(opening.tracks):
            hallway = HallwaySegment(position, side % QUARTERS, *_WIDTH_INTERVAL)
            opening = _unseen_opening(track, 2.0 * _half_width(floor, hallway, *_WIDTH_INTERVAL))
        landmarks = select_landmarks(landmarks, ~at_node)
        openings.append(opening._replace(probabilities=np.maximum(opening.probabilities, _MIN_EXISTENCE)))
    return merge_sequences([landmarks, *openings])


def _unseen_opening(track: int, width: float) -> LandmarkSequence:
    """An opening at a node that is no landmark."""
    variances = np.array([_UNSEEN_DEVIATIONS]) ** 2
    return LandmarkSequence(np.array([track]), np.zeros(1), np.array([width]), variances, np.zeros(1))


def _is_same_landmark(known: KnownLandmarks, k: int, landmark: Landmark, pose: Float64) -> bool:
    difference = known.poses[k] - pose
    near = math.hypot(difference[0], difference[1]) < _SAME_DISTANCE
    parallel = abs(float(se2.wrap(difference[2]))) < _SAME_HEADING
    return near and parallel and known.landmarks[k].kind == landmark.kind


def _half_width(floor: AlignedNeighborhood, segment: HallwaySegment, begin: float, end: float) -> float:
    """Half the width of the hallway, m, at its narrower positions, where no other one leads off."""
    side = (segment.direction + 1) % QUARTERS
    ahead, beside = ahead_and_beside(floor.positions - segment.origin, segment.direction)
    rows = floor.in_hallway[:, segment.direction % 2] & (np.abs(beside) <= _MAX_LATERAL_OFFSET)
    rows &= (begin - _MAX_DISTANCE_ALONG <= ahead) & (ahead <= end + _MAX_DISTANCE_ALONG)
    widths = floor.free_distances[rows, side] + floor.free_distances[rows, (side + 2) % QUARTERS]
    return 0.5 * float(np.nanquantile(widths, _WIDTH_QUANTILE)) if np.isfinite(widths).any() else _DEFAULT_HALF_WIDTH


def _belongs_to_hallway(known: KnownLandmarks, local: Float64, segment: HallwaySegment) -> Bool:
    """Whether landmarks are none of other walls: openings lead off the hallway, and corners beyond its end face it."""
    opening = np.array([landmark.kind == OPENING for landmark in known.landmarks], dtype=np.bool_)
    ahead, aside = np.cos(local[:, 2]), np.sin(local[:, 2])
    beyond = np.where(local[:, 0] < 0.0, math.isinf(segment.begin), math.isinf(segment.end))
    return np.where(opening, aside * local[:, 1] > 0.0, ~(beyond & (ahead * local[:, 0] > 0.0)))


def wall_landmark_sequence(landmarks: Sequence[Landmark], poses: Float64) -> LandmarkSequence:
    """The wall landmarks among landmarks at poses (n, 3) in the frame of a robot that faces along the hallway."""
    opening = np.array([landmark.kind == OPENING for landmark in landmarks], dtype=np.bool_)
    convex = np.array([landmark.kind == CONVEX_CORNER for landmark in landmarks], dtype=np.bool_)
    covariances = np.array([landmark.pose.covariance for landmark in landmarks]).reshape(-1, 3, 3)
    existence = np.array([landmark.existence.probability for landmark in landmarks])
    widths = np.array([(landmark.width, landmark.width_deviation) for landmark in landmarks]).reshape(-1, 2)[opening]
    corners = Corners(poses[~opening], covariances[~opening], convex[~opening], existence[~opening])
    openings = Openings(poses[opening], covariances[opening], widths[:, 0], widths[:, 1], existence[opening])
    return select_wall_landmarks(observation_graph(corners, openings, 0.0, _UNLIMITED))
