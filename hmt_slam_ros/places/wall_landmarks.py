"""The landmarks of a hallway's walls, along a stretch of it, as a robot sees them that travels there.

What is behind the walls, in rooms and in other hallways, is seen through openings alone, and is left out; so is what
looks into a room, as an opening and the corners of a room's wall do.
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
from hmt_slam_ros.places.floor import DIRECTIONS, AlignedNeighborhood
from hmt_slam_ros.places.observation_graph import (
    OPENINGS,
    QUARTERS,
    LandmarkSequence,
    merge_sequences,
    observation_graph,
    select_landmarks,
    select_wall_landmarks,
)

# Landmarks of one kind that are so near to each other, m and rad, are one that several areas know.
_SAME_DISTANCE, _SAME_HEADING = 0.4, 0.5
# A landmark so far behind a hallway's wall, m, is of the wall; the hallway is as wide as seen from keyframes so near to
# its middle and to the stretch, m, or, where there are none, half as wide as this, m.
_WALL, _MIDDLE, _BESIDE, _DEFAULT_HALF_WIDTH, _NARROW = 0.4, 0.9, 2.0, 1.2, 0.25
# A stretch without an end is this long, m.
_FAR = 10.0

# The opening of a hallway is so near to its node along another one, m, and believed in so much at least; of one that
# is no landmark place and width are known so well, m, the width from so far into it, m.
_SAME, _MIN_EXISTENCE, _UNSEEN_DEVIATIONS, _WIDTH_INTERVAL = 0.6, 0.9, (0.1, 0.2), (1.5, 6.0)

# All that is on the stretch counts, however far away.
_UNLIMITED = replace(PlaceParameters(), reach=100.0, aside=100.0)


class HallwaySegment(NamedTuple):
    """Of a hallway, in the frame of a floor.

    :ivar origin: shape (2,), a place in its middle, m.
    :ivar direction: of travel.
    :ivar begin: from there, m.
    :ivar end: likewise.
    """

    origin: Float64
    direction: int
    begin: float
    end: float


class KnownLandmarks(NamedTuple):
    """The landmarks of a floor, each once.

    :ivar landmarks: as the area knows them in which they are believed in most.
    :ivar poses: shape (n, 3), in the frame of the floor.
    :ivar members: which landmarks (area, number) each is.
    """

    landmarks: list[Landmark]
    poses: Float64
    members: list[set[tuple[int, int]]]


def known_landmarks_around(
    areas: Mapping[int, PoseGaussian], views: Mapping[int, Sequence[Landmark]]
) -> KnownLandmarks:
    """The landmarks of some areas in one frame, such as that of a floor.

    :param areas: {area: the belief over its pose in the frame}.
    :param views: {area: its landmarks}.
    """
    every = [
        (landmark, se2.compose(pose.mean, landmark.pose.mean), (area, number))
        for area, pose in areas.items()
        for number, landmark in enumerate(views[area])
    ]
    known = KnownLandmarks([], np.empty((len(every), 3)), [])
    for landmark, pose, member in sorted(every, key=lambda each: (-each[0].existence.probability, each[2])):
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
    stretch: HallwaySegment,
    excluded: Collection[tuple[int, int]],
    always_included: Collection[tuple[int, int]] = (),
) -> LandmarkSequence:
    """The landmarks of a stretch, as seen from its place.

    :param excluded: landmarks (area, number) that are left out,
    :param always_included: but for these, wherever they are.
    """
    lead = DIRECTIONS[stretch.direction]
    frame = np.array((*stretch.origin, math.atan2(lead[1], lead[0])))
    local = se2.between(frame, known.poses)
    begin, end = max(stretch.begin, -_FAR), min(stretch.end, _FAR) if math.isinf(stretch.end) else stretch.end
    walls = np.abs(local[:, 1]) <= _half_width(floor, stretch, begin, end) + _WALL
    on = (begin <= local[:, 0]) & (local[:, 0] < end) & walls
    on &= np.array([not own.intersection(excluded) for own in known.members], dtype=np.bool_)
    on |= np.array([bool(own.intersection(always_included)) for own in known.members], dtype=np.bool_)
    on &= _belongs_to_hallway(known, local, stretch)
    return wall_landmark_sequence([known.landmarks[k] for k in np.flatnonzero(on).tolist()], local[on])


def add_hallway_openings(
    landmarks: LandmarkSequence, floor: AlignedNeighborhood, at: Float64, direction: int, sides: Sequence[int]
) -> LandmarkSequence:
    """The landmarks of a node with the hallways that lead on from it to the sides as openings.

    Those are there, whether or not many scans showed both of their jambs.

    :param landmarks: as seen from the node.
    :param at: shape (2,), the node.
    :param direction: of travel.
    :param sides: directions to the left and the right in which hallways lead on.
    """
    lists = [landmarks]
    for side in sides:
        track = OPENINGS + (direction - side) % QUARTERS
        own = (lists[0].tracks == track) & (np.abs(lists[0].positions) < _SAME)
        best = select_landmarks(
            lists[0], np.flatnonzero(own)[np.argsort(-lists[0].probabilities[own], kind="stable")[:1]]
        )
        if not len(best.tracks):
            hallway = HallwaySegment(at, side % QUARTERS, *_WIDTH_INTERVAL)
            best = _unseen_opening(track, 2.0 * _half_width(floor, hallway, *_WIDTH_INTERVAL))
        lists = [
            select_landmarks(lists[0], ~own),
            *lists[1:],
            best._replace(probabilities=np.maximum(best.probabilities, _MIN_EXISTENCE)),
        ]
    return merge_sequences(lists)


def _unseen_opening(track: int, width: float) -> LandmarkSequence:
    """An opening at a node that no scan showed as one."""
    variances = np.array([_UNSEEN_DEVIATIONS]) ** 2
    return LandmarkSequence(np.array([track]), np.zeros(1), np.array([width]), variances, np.zeros(1))


def _is_same_landmark(known: KnownLandmarks, k: int, landmark: Landmark, pose: Float64) -> bool:
    away = known.poses[k] - pose
    near = math.hypot(away[0], away[1]) < _SAME_DISTANCE and abs(float(se2.wrap(away[2]))) < _SAME_HEADING
    return near and known.landmarks[k].kind == landmark.kind


def _half_width(floor: AlignedNeighborhood, stretch: HallwaySegment, begin: float, end: float) -> float:
    """Half the width of the hallway, m: that at its narrower places, where no other one leads off."""
    away = floor.positions - stretch.origin
    side = (stretch.direction + 1) % QUARTERS
    ahead, beside = away @ DIRECTIONS[stretch.direction], away @ DIRECTIONS[side]
    own = floor.in_hallway[:, stretch.direction % 2] & (np.abs(beside) <= _MIDDLE)
    own &= (begin - _BESIDE <= ahead) & (ahead <= end + _BESIDE)
    widths = floor.free_distances[own, side] + floor.free_distances[own, (side + 2) % QUARTERS]
    return 0.5 * float(np.nanquantile(widths, _NARROW)) if np.isfinite(widths).any() else _DEFAULT_HALF_WIDTH


def _belongs_to_hallway(known: KnownLandmarks, local: Float64, stretch: HallwaySegment) -> Bool:
    """Which landmarks are not those of other walls: openings lead away from the hallway, and beyond where it ends
    corners look back at it.
    """
    opening = np.array([landmark.kind == OPENING for landmark in known.landmarks], dtype=np.bool_)
    ahead, aside = np.cos(local[:, 2]), np.sin(local[:, 2])
    beyond = np.where(local[:, 0] < 0.0, math.isinf(stretch.begin), math.isinf(stretch.end))
    return np.where(opening, aside * local[:, 1] > 0.0, ~(beyond & (ahead * local[:, 0] > 0.0)))


def wall_landmark_sequence(landmarks: Sequence[Landmark], poses: Float64) -> LandmarkSequence:
    """Landmarks at poses in the frame of a robot that looks along the hallway."""
    opening = np.array([landmark.kind == OPENING for landmark in landmarks], dtype=np.bool_)
    convex = np.array([landmark.kind == CONVEX_CORNER for landmark in landmarks], dtype=np.bool_)
    covariances = np.array([landmark.pose.covariance for landmark in landmarks]).reshape(-1, 3, 3)
    existence = np.array([landmark.existence.probability for landmark in landmarks])
    widths = np.array([(landmark.width, landmark.width_deviation) for landmark in landmarks]).reshape(-1, 2)[opening]
    corners = Corners(poses[~opening], covariances[~opening], convex[~opening], existence[~opening])
    openings = Openings(poses[opening], covariances[opening], widths[:, 0], widths[:, 1], existence[opening])
    return select_wall_landmarks(observation_graph(corners, openings, 0.0, _UNLIMITED))
