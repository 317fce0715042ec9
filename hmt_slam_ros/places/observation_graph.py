"""The observation graph: landmarks around the robot in their order along the direction of travel.

Tomatis, Nourbakhsh and Siegwart (2003), sections 2.1 and 3.3, Fig. 3. Landmarks are told apart by their *track*: a
corner is to the left or the right and convex or concave, an opening leads ahead, left, back or right. Within a track
they follow each other along the axis of travel. How far they are aside does not count, since the robot's own place
across the hallway is no part of a state. A list of the map is of the same type as one that was observed.
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
"""Corners: 0 left and concave, 1 right and concave, 2 left and convex, 3 right and convex; openings that lead 4 ahead,
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
"""What the tracks are called."""

CONVEX = 2
"""The first track of convex corners."""

OPENINGS = 4
"""The first track of openings."""

QUARTERS = 4
"""Directions of travel: north, east, south, west."""


class LandmarkSequence(NamedTuple):
    """Landmarks, ordered by their track and within it along the axis.

    :ivar tracks: shape (n,).
    :ivar positions: shape (n,), how far ahead they are, m.
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
    """An empty list."""
    return LandmarkSequence(np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty((0, 2)), np.empty(0))


def observation_graph(corners: Corners, openings: Openings, axis: float, places: PlaceParameters) -> LandmarkSequence:
    """The landmarks around a robot that travels along an axis.

    :param corners: in the robot's frame.
    :param openings: likewise.
    :param axis: direction of the hallway in the robot's frame, rad.
    """
    of_corners = _corner_sequence(corners, axis, places)
    return merge_sequences((of_corners, _opening_sequence(openings, axis, places)))


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
    """Positions (n, 2) ahead and to the left, m, and headings (n,), rad, of poses (n, 3) as seen along the axis."""
    seen = se2.compose(np.array((0.0, 0.0, -axis)), poses)
    return seen[:, :2], seen[:, 2]


def _along_variances(covariances: Float64, headings: Float64) -> Float64:
    """Variances (n,) along the axis, from covariances (n, 3, 3) in the landmarks' own frames."""
    axes = np.stack((np.cos(headings), -np.sin(headings)), axis=1)
    return np.einsum("ni,nij,nj->n", axes, covariances[:, :2, :2], axes)


def _within_reach(landmarks: LandmarkSequence, positions: Float64, places: PlaceParameters) -> LandmarkSequence:
    near = (np.abs(positions[:, 0]) <= places.reach) & (np.abs(positions[:, 1]) <= places.aside)
    return select_landmarks(landmarks, near)


def select_landmarks(landmarks: LandmarkSequence, which: Bool | Int64 | slice) -> LandmarkSequence:
    """Some of a list."""
    return LandmarkSequence(
        landmarks.tracks[which],
        landmarks.positions[which],
        landmarks.forms[which],
        landmarks.variances[which],
        landmarks.probabilities[which],
    )


def concatenate_sequences(lists: Sequence[LandmarkSequence]) -> LandmarkSequence:
    """Several lists, each in its own order."""
    return LandmarkSequence(
        np.concatenate([each.tracks for each in lists]),
        np.concatenate([each.positions for each in lists]),
        np.concatenate([each.forms for each in lists]),
        np.concatenate([each.variances for each in lists]),
        np.concatenate([each.probabilities for each in lists]),
    )


def merge_sequences(lists: Sequence[LandmarkSequence]) -> LandmarkSequence:
    """Several lists as one, in its order."""
    every = concatenate_sequences(lists)
    return select_landmarks(every, np.lexsort((every.positions, every.tracks)))


def select_wall_landmarks(landmarks: LandmarkSequence) -> LandmarkSequence:
    """Those of a hallway's walls to both sides: corners that look at its middle, and openings that lead to a side.

    Corners of rooms are seen through doors alone, and openings along the hallway, as one sees them at a crossing, come
    and go.
    """
    left = np.where(landmarks.tracks % 2 == 0, 1.0, -1.0)
    looks_in = left * np.sin(landmarks.forms) < 0.0
    sideways = (landmarks.tracks == OPENINGS + 1) | (landmarks.tracks == OPENINGS + 3)
    return select_landmarks(landmarks, np.where(landmarks.tracks < OPENINGS, looks_in, sideways))


def shift_ahead(landmarks: LandmarkSequence, distance: float) -> LandmarkSequence:
    """The same list so much farther ahead, m."""
    return landmarks._replace(positions=landmarks.positions + distance)


def reverse_direction(landmarks: LandmarkSequence) -> LandmarkSequence:
    """What a robot at the same place sees that travels the other way."""
    corner = landmarks.tracks < OPENINGS
    tracks = np.where(corner, landmarks.tracks ^ 1, OPENINGS + (landmarks.tracks - OPENINGS + 2) % QUARTERS)
    forms = np.where(corner, se2.wrap(landmarks.forms + math.pi), landmarks.forms)
    return merge_sequences((landmarks._replace(tracks=tracks, positions=-landmarks.positions, forms=forms),))
