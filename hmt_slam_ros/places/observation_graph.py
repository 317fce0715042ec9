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
from hmt_slam_ros.configuration.landmarks import Places
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.corners import Corners
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


class Landmarks(NamedTuple):
    """Landmarks, ordered by their track and within it along the axis.

    :ivar tracks: shape (n,).
    :ivar along: shape (n,), how far ahead they are, m.
    :ivar forms: shape (n,), a corner's heading against the axis, rad; an opening's width, m.
    :ivar variances: shape (n, 2), of both.
    :ivar probabilities: shape (n,), confidence p_l of what was observed, existence p_lmap of what is in the map.
    """

    tracks: Int64
    along: Float64
    forms: Float64
    variances: Float64
    probabilities: Float64


def no_landmarks() -> Landmarks:
    """An empty list."""
    return Landmarks(np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty((0, 2)), np.empty(0))


def observation_graph(corners: Corners, openings: Openings, axis: float, places: Places) -> Landmarks:
    """The landmarks around a robot that travels along an axis.

    :param corners: in the robot's frame.
    :param openings: likewise.
    :param axis: direction of the hallway in the robot's frame, rad.
    """
    of_corners = _of_corners(corners, axis, places)
    return joined((of_corners, _of_openings(openings, axis, places)))


def _of_corners(corners: Corners, axis: float, places: Places) -> Landmarks:
    positions, headings = _projected(corners.poses, axis)
    variances = np.stack((_along_variances(corners.covariances, headings), corners.covariances[:, 2, 2]), axis=1)
    tracks = (positions[:, 1] < 0.0) + 2 * corners.convex.astype(np.int64)
    found = Landmarks(tracks, positions[:, 0], headings, variances, corners.confidences)
    return _within(found, positions, places)


def _of_openings(openings: Openings, axis: float, places: Places) -> Landmarks:
    positions, headings = _projected(openings.poses, axis)
    variances = np.stack((_along_variances(openings.covariances, headings), openings.width_deviations**2), axis=1)
    tracks = OPENINGS + np.round(headings / (0.5 * math.pi)).astype(np.int64) % QUARTERS
    found = Landmarks(tracks, positions[:, 0], openings.widths, variances, openings.confidences)
    return _within(found, positions, places)


def _projected(poses: Float64, axis: float) -> tuple[Float64, Float64]:
    """Positions (n, 2) ahead and to the left, m, and headings (n,), rad, of poses (n, 3) as seen along the axis."""
    seen = se2.compose(np.array((0.0, 0.0, -axis)), poses)
    return seen[:, :2], seen[:, 2]


def _along_variances(covariances: Float64, headings: Float64) -> Float64:
    """Variances (n,) along the axis, from covariances (n, 3, 3) in the landmarks' own frames."""
    axes = np.stack((np.cos(headings), -np.sin(headings)), axis=1)
    return np.einsum("ni,nij,nj->n", axes, covariances[:, :2, :2], axes)


def _within(landmarks: Landmarks, positions: Float64, places: Places) -> Landmarks:
    near = (np.abs(positions[:, 0]) <= places.reach) & (np.abs(positions[:, 1]) <= places.aside)
    return chosen(landmarks, near)


def chosen(landmarks: Landmarks, which: Bool | Int64 | slice) -> Landmarks:
    """Some of a list."""
    return Landmarks(
        landmarks.tracks[which],
        landmarks.along[which],
        landmarks.forms[which],
        landmarks.variances[which],
        landmarks.probabilities[which],
    )


def one_after_the_other(lists: Sequence[Landmarks]) -> Landmarks:
    """Several lists, each in its own order."""
    return Landmarks(
        np.concatenate([each.tracks for each in lists]),
        np.concatenate([each.along for each in lists]),
        np.concatenate([each.forms for each in lists]),
        np.concatenate([each.variances for each in lists]),
        np.concatenate([each.probabilities for each in lists]),
    )


def joined(lists: Sequence[Landmarks]) -> Landmarks:
    """Several lists as one, in its order."""
    every = one_after_the_other(lists)
    return chosen(every, np.lexsort((every.along, every.tracks)))


def of_walls(landmarks: Landmarks) -> Landmarks:
    """Those of a hallway's walls to both sides: corners that look at its middle, and openings that lead to a side.

    Corners of rooms are seen through doors alone, and openings along the hallway, as one sees them at a crossing, come
    and go.
    """
    left = np.where(landmarks.tracks % 2 == 0, 1.0, -1.0)
    looks_in = left * np.sin(landmarks.forms) < 0.0
    sideways = (landmarks.tracks == OPENINGS + 1) | (landmarks.tracks == OPENINGS + 3)
    return chosen(landmarks, np.where(landmarks.tracks < OPENINGS, looks_in, sideways))


def moved(landmarks: Landmarks, distance: float) -> Landmarks:
    """The same list so much farther ahead, m."""
    return landmarks._replace(along=landmarks.along + distance)


def turned_back(landmarks: Landmarks) -> Landmarks:
    """What a robot at the same place sees that travels the other way."""
    corner = landmarks.tracks < OPENINGS
    tracks = np.where(corner, landmarks.tracks ^ 1, OPENINGS + (landmarks.tracks - OPENINGS + 2) % QUARTERS)
    forms = np.where(corner, se2.wrap(landmarks.forms + math.pi), landmarks.forms)
    return joined((landmarks._replace(tracks=tracks, along=-landmarks.along, forms=forms),))
