"""Observations of landmarks, drawn from the model of the belief over places."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.places.observation import ObservationModel, visible_interval
from hmt_slam_ros.places.observation_graph import OPENINGS, TRACKS, LandmarkSequence, merge_sequences, select_landmarks

SURENESS = 2.0
"""Sum of the parameters of the beta distribution of confidences p_l; smaller values are wider."""

WIDTHS = (0.6, 3.0)
"""Of openings, m, evenly distributed."""


def draw_observation(
    random: np.random.Generator, landmarks: LandmarkSequence, offset: float, variance: float, model: ObservationModel
) -> LandmarkSequence:
    """A random observation of the landmarks of a state.

    :param offset: of the robot beyond the state's node, m.
    :param variance: of that, m^2.
    """
    there = random.random(len(landmarks.tracks)) < landmarks.probabilities
    return draw_of_present(random, landmarks, there, offset + random.normal(0.0, math.sqrt(variance)), model)


def draw_of_present(
    random: np.random.Generator, landmarks: LandmarkSequence, there: Bool, offset: float, model: ObservationModel
) -> LandmarkSequence:
    """A random observation of the present landmarks from a known position."""
    extracted = there & (random.random(len(there)) < model.detection)
    extracted_landmarks = select_landmarks(landmarks, extracted)
    corner = extracted_landmarks.tracks < OPENINGS
    form_variances = extracted_landmarks.variances[:, 1] + np.where(
        corner, model.heading_variance, model.width_variance
    )
    along = (
        extracted_landmarks.positions
        - offset
        + random.normal(0.0, np.sqrt(extracted_landmarks.variances[:, 0] + model.position_variance))
    )
    forms = extracted_landmarks.forms + random.normal(0.0, np.sqrt(form_variances))
    found = _make_sequence(
        extracted_landmarks.tracks,
        along,
        np.where(corner, se2.wrap(forms), forms),
        _draw_confidences(random, len(along), model),
    )
    sight = (
        visible_interval(track, form, model.reach)
        for track, form in zip(extracted_landmarks.tracks, extracted_landmarks.forms, strict=True)
    )
    low, high = np.array(list(sight)).reshape(-1, 2).T
    within = select_landmarks(found, (low <= found.positions) & (found.positions <= high))
    return merge_sequences((within, draw_clutter(random, model.new_density, model.false_density, model)))


def draw_clutter(
    random: np.random.Generator, present_density: float, absent_density: float, model: ObservationModel
) -> LandmarkSequence:
    """Random landmarks outside of the map, by the densities of true and of false ones, 1/m."""
    lists = []
    for density, is_present in ((present_density, True), (absent_density, False)):
        count = int(random.poisson(density * 2.0 * model.reach * TRACKS))
        tracks = random.integers(0, TRACKS, count)
        along = random.uniform(-model.reach, model.reach, count)
        forms = np.where(tracks < OPENINGS, random.uniform(-np.pi, np.pi, count), random.uniform(*WIDTHS, count))
        lists.append(_make_sequence(tracks, along, forms, _draw_confidences(random, count, model, is_present)))
    return merge_sequences(lists)


def _draw_confidences(random: np.random.Generator, count: int, model: ObservationModel, there: bool = True) -> Float64:
    """Random confidences of true or false landmarks; those of all landmarks are beta(a, b) with the mean pi."""
    a, b = SURENESS * model.true_share, SURENESS * (1.0 - model.true_share)
    return random.beta(a + there, b + (not there), count)


def _make_sequence(tracks: Int64, along: Float64, forms: Float64, confidences: Float64) -> LandmarkSequence:
    """Landmarks whose positions and forms have only the errors of the model."""
    return merge_sequences((LandmarkSequence(tracks, along, forms, np.zeros((len(tracks), 2)), confidences),))
