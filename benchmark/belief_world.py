"""Observations of landmarks, drawn from the model of the belief over places."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.places.observation import ObservationModel, visible_interval
from hmt_slam_ros.places.observation_graph import OPENINGS, TRACKS, LandmarkSequence, merge_sequences, select_landmarks

SURENESS = 2.0
"""Confidences p_l of all that is extracted are drawn from a beta distribution; the smaller this, the wider."""

WIDTHS = (0.6, 3.0)
"""Of openings, m, evenly distributed."""


def drawn_observation(
    random: np.random.Generator, landmarks: LandmarkSequence, away: float, variance: float, model: ObservationModel
) -> LandmarkSequence:
    """What is seen of the landmarks of a state.

    :param away: how far the robot is beyond the state's node, m.
    :param variance: of that, m^2.
    """
    there = random.random(len(landmarks.tracks)) < landmarks.probabilities
    return drawn_of_present(random, landmarks, there, away + random.normal(0.0, math.sqrt(variance)), model)


def drawn_of_present(
    random: np.random.Generator, landmarks: LandmarkSequence, there: Bool, away: float, model: ObservationModel
) -> LandmarkSequence:
    """The same where it is known which landmarks are there, and where the robot is."""
    extracted = there & (random.random(len(there)) < model.detection)
    seen = select_landmarks(landmarks, extracted)
    corner = seen.tracks < OPENINGS
    form_variances = seen.variances[:, 1] + np.where(corner, model.heading_variance, model.width_variance)
    along = seen.positions - away + random.normal(0.0, np.sqrt(seen.variances[:, 0] + model.position_variance))
    forms = seen.forms + random.normal(0.0, np.sqrt(form_variances))
    found = _observed(seen.tracks, along, np.where(corner, se2.wrap(forms), forms), _true(random, len(along), model))
    sight = (visible_interval(track, form, model.reach) for track, form in zip(seen.tracks, seen.forms, strict=True))
    low, high = np.array(list(sight)).reshape(-1, 2).T
    within = select_landmarks(found, (low <= found.positions) & (found.positions <= high))
    return merge_sequences((within, drawn_anywhere(random, model.new_density, model.false_density, model)))


def drawn_anywhere(random: np.random.Generator, there: float, none: float, model: ObservationModel) -> LandmarkSequence:
    """Landmarks of no map, of two densities, 1/m: of those that are there, and those that are not."""
    lists = []
    for density, is_there in ((there, True), (none, False)):
        count = int(random.poisson(density * 2.0 * model.reach * TRACKS))
        tracks = random.integers(0, TRACKS, count)
        along = random.uniform(-model.reach, model.reach, count)
        forms = np.where(tracks < OPENINGS, random.uniform(-np.pi, np.pi, count), random.uniform(*WIDTHS, count))
        lists.append(_observed(tracks, along, forms, _true(random, count, model, is_there)))
    return merge_sequences(lists)


def _true(random: np.random.Generator, count: int, model: ObservationModel, there: bool = True) -> Float64:
    """Confidences of landmarks that are there, or not: of all, they would be beta(a, b) with the mean pi."""
    a, b = SURENESS * model.true_share, SURENESS * (1.0 - model.true_share)
    return random.beta(a + there, b + (not there), count)


def _observed(tracks: Int64, along: Float64, forms: Float64, confidences: Float64) -> LandmarkSequence:
    """Landmarks whose places and forms were measured without more error than the model's own."""
    return merge_sequences((LandmarkSequence(tracks, along, forms, np.zeros((len(tracks), 2)), confidences),))
