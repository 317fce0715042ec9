"""The observation graph: landmarks around the robot in their order along the direction of travel.

Tomatis, Nourbakhsh and Siegwart (2003), sections 2.1 and 3.3, Fig. 3. Each landmark is on a *track*: a corner is left
or right and convex or concave, an opening leads ahead, left, back or right. Within a track landmarks are ordered along
the axis of travel. Their lateral position does not count, since that of the robot is no part of a state. Expected and
observed landmarks have the same type.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.configuration.landmarks import PlaceParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.landmarks import Corners
from hmt_slam_ros.landmarks.openings import Openings

TRACKS = 8
"""Number of tracks; corners are 0 left concave, 1 right concave, 2 left convex, 3 right convex, and openings 4 ahead,
5 left, 6 back, 7 right."""

TRACK_NAMES = (
    "left corner",
    "right corner",
    "left convex corner",
    "right convex corner",
    "opening ahead",
    "opening left",
    "opening back",
    "opening right",
)
"""Names of the tracks."""

CONVEX = 2
"""The first track of convex corners."""

OPENINGS = 4
"""The first track of openings."""

QUARTERS = 4
"""Number of directions of travel: north, east, south, west."""

QUARTER_TURN = 0.5 * math.pi
"""Angle between two directions of travel, rad."""


class LandmarkSequence(NamedTuple):
    """Landmarks, ordered by track and within it along the axis.

    :ivar tracks: shape (n,).
    :ivar positions: shape (n,), along the axis, m.
    :ivar forms: shape (n,), a corner's heading against the axis, rad; an opening's width, m.
    :ivar variances: shape (n, 2), of both.
    :ivar probabilities: shape (n,), confidence p_l of what was observed, existence p_lmap of what is in the map.
    """

    tracks: Int64
    positions: Float64
    forms: Float64
    variances: Float64
    probabilities: Float64


def empty_sequence() -> LandmarkSequence:
    """A sequence of no landmarks."""
    return LandmarkSequence(np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty((0, 2)), np.empty(0))


def observation_graph(corners: Corners, openings: Openings, axis: float, places: PlaceParameters) -> LandmarkSequence:
    """The landmarks around a robot that travels along an axis.

    :param corners: in the robot's frame.
    :param openings: likewise.
    :param axis: direction of the hallway in the robot's frame, rad.
    """
    return merge_sequences((_corner_sequence(corners, axis, places), _opening_sequence(openings, axis, places)))


def _corner_sequence(corners: Corners, axis: float, places: PlaceParameters) -> LandmarkSequence:
    positions, headings = _project_on_axis(corners.poses, axis)
    variances = np.stack((_along_variances(corners.covariances, headings), corners.covariances[:, 2, 2]), axis=1)
    tracks = (positions[:, 1] < 0.0) + 2 * corners.convex.astype(np.int64)
    found = LandmarkSequence(tracks, positions[:, 0], headings, variances, corners.confidences)
    return _within_reach(found, positions, places)


def _opening_sequence(openings: Openings, axis: float, places: PlaceParameters) -> LandmarkSequence:
    positions, headings = _project_on_axis(openings.poses, axis)
    variances = np.stack((_along_variances(openings.covariances, headings), openings.width_deviations**2), axis=1)
    tracks = OPENINGS + np.round(headings / (0.5 * math.pi)).astype(np.int64) % QUARTERS
    found = LandmarkSequence(tracks, positions[:, 0], openings.widths, variances, openings.confidences)
    return _within_reach(found, positions, places)


def _project_on_axis(poses: Float64, axis: float) -> tuple[Float64, Float64]:
    """Positions (n, 2) ahead and to the left, m, and headings (n,), rad, of poses (n, 3) relative to the axis."""
    rotated = se2.compose(np.array((0.0, 0.0, -axis)), poses)
    return rotated[:, :2], rotated[:, 2]


def _along_variances(covariances: Float64, headings: Float64) -> Float64:
    """Variances (n,) along the axis, of covariances (n, 3, 3) in the frames of the landmarks, m^2."""
    axes = np.stack((np.cos(headings), -np.sin(headings)), axis=1)
    return np.einsum("ni,nij,nj->n", axes, covariances[:, :2, :2], axes)


def _within_reach(landmarks: LandmarkSequence, positions: Float64, places: PlaceParameters) -> LandmarkSequence:
    within = (np.abs(positions[:, 0]) <= places.reach) & (np.abs(positions[:, 1]) <= places.aside)
    return select_landmarks(landmarks, within)


def select_landmarks(landmarks: LandmarkSequence, rows: Bool | Int64 | slice) -> LandmarkSequence:
    """The landmarks of some rows."""
    return LandmarkSequence._make(column[rows] for column in landmarks)


def concatenate_sequences(sequences: Sequence[LandmarkSequence]) -> LandmarkSequence:
    """Several sequences one after the other, each in its own order."""
    return LandmarkSequence._make(np.concatenate(columns) for columns in zip(*sequences, strict=True))


def merge_sequences(sequences: Sequence[LandmarkSequence]) -> LandmarkSequence:
    """Several sequences as one, in the order of a sequence."""
    landmarks = concatenate_sequences(sequences)
    return select_landmarks(landmarks, np.lexsort((landmarks.positions, landmarks.tracks)))


def select_wall_landmarks(landmarks: LandmarkSequence) -> LandmarkSequence:
    """The landmarks of a hallway's two walls: corners that face its middle, and openings that lead to a side.

    Corners of rooms are visible through doors alone, and openings along the hallway only near a crossing.
    """
    side = np.where(landmarks.tracks % 2 == 0, 1.0, -1.0)
    faces_middle = side * np.sin(landmarks.forms) < 0.0
    sideways = (landmarks.tracks == OPENINGS + 1) | (landmarks.tracks == OPENINGS + 3)
    return select_landmarks(landmarks, np.where(landmarks.tracks < OPENINGS, faces_middle, sideways))


def shift_ahead(landmarks: LandmarkSequence, distance: float) -> LandmarkSequence:
    """The landmarks moved ahead by a distance, m."""
    return landmarks._replace(positions=landmarks.positions + distance)


def reverse_direction(landmarks: LandmarkSequence) -> LandmarkSequence:
    """The landmarks as observed at the same position in the opposite direction of travel."""
    corner = landmarks.tracks < OPENINGS
    tracks = np.where(corner, landmarks.tracks ^ 1, OPENINGS + (landmarks.tracks - OPENINGS + 2) % QUARTERS)
    forms = np.where(corner, se2.wrap(landmarks.forms + math.pi), landmarks.forms)
    return merge_sequences((landmarks._replace(tracks=tracks, positions=-landmarks.positions, forms=forms),))
