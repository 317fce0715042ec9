"""The observation function OS(o, s): the likelihood of an observation graph in a state.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3, Eq. (1), do not define OS. Here o is a finite set of landmarks,
and OS its density under this model. The tracks (observation_graph.py) are independent:

- The position along the axis has an error delta ~ N(0, tau^2).
- Landmark i of the map, at x_i - delta, is extracted with probability q_i = p_lmap p_det P(within reach). A convex
  corner is within reach only on the side that it faces, from which both of its walls are visible. Its measurement is
  N(x_i - delta, .), with a form (heading or width) of N(f_i, .): together g_ij.
- Landmarks that the map lacks are a Poisson process over the reach, of density lambda_new for true landmarks and of
  lambda_false for false ones. Their forms are uniform, of density u.
- Confidences p_l are calibrated: their density h over all extracted landmarks has the mean pi. By Bayes, true
  landmarks have the density h p_l / pi, and false ones h (1 - p_l) / (1 - pi).

So an unmatched landmark has e_j = u [lambda_false (1 - p_l,j) / (1 - pi) + lambda_new p_l,j / pi], and

    OS(o, s) = h's exp(-Lambda) prod_j e_j  E_delta[ sum_A prod_missed (1 - q_i) prod_matched q_i g_ij p_l,j / (pi e_j)]

over all pairings A of expected with observed landmarks that do not cross. The factor before E, the density of o where
the map expects nothing, is the same in all states. It is left out: the functions here return the logarithm of the
*ratio* E. The sum is a forward algorithm in O(n m), exact for each track. E over delta is a sum over a grid.

Integrated over all o, OS is the probability that the landmarks of a track are measured in their order. It is 1 where
they are several deviations apart, as two jambs of a door are.

In unknown ground landmarks are a Poisson process of density lambda_usual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.landmarks import FeatureParameters, PlaceParameters
from hmt_slam_ros.geometry.se2 import wrap_by_modulus
from hmt_slam_ros.places.observation_graph import (
    CONVEX,
    OPENINGS,
    TRACKS,
    LandmarkSequence,
    concatenate_sequences,
    select_landmarks,
)

_MAX_DEVIATIONS = 9.0
"""Deviations beyond which no pair is matched, and no landmark is within reach."""

_SIDES = 4.0
"""Half width of the grid over the position error, in deviations of that error."""

_STEP = 0.5
"""Largest step of that grid, in deviations of a landmark's position."""


class ObservationModel(NamedTuple):
    """Parameters of the observation function.

    :ivar reach: m.
    :ivar detection: p_det.
    :ivar position_variance: of a position along the axis, beyond those of map and measurement, m^2.
    :ivar heading_variance: of a corner's heading, likewise, rad^2.
    :ivar width_variance: of an opening's width, likewise, m^2.
    :ivar false_density: lambda_false, 1/m.
    :ivar new_density: lambda_new, 1/m.
    :ivar usual_density: lambda_usual, 1/m.
    :ivar true_share: pi.
    :ivar corner_form: u of corners, 1/rad.
    :ivar opening_form: u of openings, 1/m.
    """

    reach: float
    detection: float
    position_variance: float
    heading_variance: float
    width_variance: float
    false_density: float
    new_density: float
    usual_density: float
    true_share: float
    corner_form: float
    opening_form: float


class ExpectedLandmarks(NamedTuple):
    """The expected landmarks of every state.

    :ivar starts: shape (states + 1,), the first row of each state.
    :ivar landmarks: of all states, one after the other, each as from the state's node.
    """

    starts: Int64
    landmarks: LandmarkSequence

    def of_state(self, state: int) -> LandmarkSequence:
        """The expected landmarks of one state."""
        return select_landmarks(self.landmarks, slice(*self.starts[state : state + 2].tolist()))


def stack_expected_landmarks(sequences: Sequence[LandmarkSequence]) -> ExpectedLandmarks:
    """The expected landmarks of states, of one sequence for each."""
    starts = np.cumsum([0, *(len(sequence.tracks) for sequence in sequences)])
    return ExpectedLandmarks(starts, concatenate_sequences(sequences))


def observation_model(places: PlaceParameters, features: FeatureParameters) -> ObservationModel:
    """The model of the parameters."""
    return ObservationModel(
        places.reach,
        places.detection,
        places.position_deviation**2,
        math.radians(places.heading_deviation) ** 2,
        places.width_deviation**2,
        places.false_density,
        places.new_density,
        places.usual_density,
        places.true_share,
        0.5 / math.pi,
        1.0 / (features.opening_max - features.opening_min),
    )


def log_observation_ratios(
    observed: LandmarkSequence,
    expected: ExpectedLandmarks,
    distance_past_node: float,
    variance: float,
    model: ObservationModel,
) -> Float64:
    """Log-likelihood ratios log OS(o, s) of all states against an empty map, shape (states,).

    :param distance_past_node: from the state's node to the robot, m.
    :param variance: of that, m^2.
    """
    shifts, weights = _offset_grid(variance, model)
    tracks = np.searchsorted(observed.tracks, np.arange(TRACKS + 1))
    return _log_ratios(
        observed, tracks, _match_factors(observed, model), expected, distance_past_node + shifts, weights, model
    )


def estimate_distance_past_node(
    observed: LandmarkSequence,
    expected: ExpectedLandmarks,
    state: int,
    distance_past_node: float,
    variance: float,
    model: ObservationModel,
) -> tuple[float, float]:
    """Distance from a state's node to the robot, given its observation, m, and the variance of that, m^2."""
    shifts, weights = _offset_grid(variance, model)
    tracks = np.searchsorted(observed.tracks, np.arange(TRACKS + 1))
    alone = stack_expected_landmarks([expected.of_state(state)])
    matched = _match_factors(observed, model)
    logs = np.array(
        [
            _log_ratios(
                observed, tracks, matched, alone, np.array([distance_past_node + shift]), np.array([weight]), model
            )[0]
            for shift, weight in zip(shifts.tolist(), weights.tolist(), strict=True)
        ]
    )
    shares = np.exp(logs - logs.max())
    shares /= shares.sum()
    mean = float(shares @ shifts)
    return distance_past_node + mean, float(shares @ (shifts - mean) ** 2)


def log_unknown_ground_ratio(observed: LandmarkSequence, model: ObservationModel) -> float:
    """Log-likelihood ratio of unknown ground against an empty map: of two Poisson processes."""
    true = observed.probabilities / model.true_share
    false = model.false_density * (1.0 - observed.probabilities) / (1.0 - model.true_share)
    more = (model.usual_density - model.new_density) * 2.0 * model.reach * TRACKS
    return float(np.log((model.usual_density * true + false) / (model.new_density * true + false)).sum() - more)


def _match_factors(observed: LandmarkSequence, model: ObservationModel) -> Float64:
    """Factor of a matched landmark, p_l / (pi e), shape (m,)."""
    form = np.where(observed.tracks < OPENINGS, model.corner_form, model.opening_form)
    true = observed.probabilities / model.true_share
    false = model.false_density * (1.0 - observed.probabilities) / (1.0 - model.true_share)
    return true / (form * (false + model.new_density * true))


def _offset_grid(variance: float, model: ObservationModel) -> tuple[Float64, Float64]:
    """Grid over delta, m, and the weights of its points."""
    deviation = math.sqrt(variance)
    count = math.ceil(_SIDES * deviation / (_STEP * math.sqrt(model.position_variance)))
    if not count:
        return np.zeros(1), np.ones(1)
    points = np.linspace(-_SIDES, _SIDES, 2 * count + 1)
    weights = np.exp(-0.5 * points**2)
    return deviation * points, weights / weights.sum()


@njit(cache=True)
def _log_ratios(
    observed: LandmarkSequence,
    tracks: Int64,
    matched: Float64,
    expected: ExpectedLandmarks,
    offsets: Float64,
    weights: Float64,
    model: ObservationModel,
) -> Float64:
    states = len(expected.starts) - 1
    logs, found = np.empty(len(offsets)), np.empty(states)
    row = np.empty(len(observed.positions) + 1)
    for state in range(states):
        begin, end = expected.starts[state], expected.starts[state + 1]
        for k in range(len(offsets)):
            logs[k] = math.log(weights[k])
            logs[k] += _log_pairings(observed, tracks, matched, expected.landmarks, begin, end, offsets[k], model, row)
        top = logs.max()
        found[state] = top + math.log(np.exp(logs - top).sum()) if top > -np.inf else -np.inf
    return found


@njit(cache=True)
def _log_pairings(
    observed: LandmarkSequence,
    tracks: Int64,
    matched: Float64,
    landmarks: LandmarkSequence,
    begin: int,
    end: int,
    offset: float,
    model: ObservationModel,
    row: Float64,
) -> float:
    """Log of the sum over all pairings of a state, (1,)."""
    total, own = 0.0, begin
    for track in range(TRACKS):
        first, count = tracks[track], tracks[track + 1] - tracks[track]
        row[: count + 1] = 1.0
        while own < end and landmarks.tracks[own] == track:
            total += _forward_step(observed, matched, landmarks, own, first, count, offset, model, row)
            own += 1
        total += math.log(row[count]) if row[count] > 0.0 else -np.inf
    return total


@njit(cache=True)
def _forward_step(
    observed: LandmarkSequence,
    matched: Float64,
    landmarks: LandmarkSequence,
    own: int,
    first: int,
    count: int,
    offset: float,
    model: ObservationModel,
    row: Float64,
) -> float:
    """Add one expected landmark to the sums over pairings, and return the log of the scale taken from them.

    ``row[j]`` is the sum over the pairings with the first j observed landmarks of the track. The added one is missed,
    or matched with any of them.
    """
    place, variance = landmarks.positions[own] - offset, landmarks.variances[own, 0] + model.position_variance
    form_variance = landmarks.variances[own, 1] + (
        model.heading_variance if landmarks.tracks[own] < OPENINGS else model.width_variance
    )
    seen = landmarks.probabilities[own] * model.detection
    low, high = visible_interval(landmarks.tracks[own], landmarks.forms[own], model.reach)
    missed = 1.0 - seen * _probability_between(place, math.sqrt(variance), low, high)
    before, paired = row[0], 0.0
    row[0] *= missed
    for j in range(count):
        k = first + j
        here = _gaussian_density(observed.positions[k] - place, variance + observed.variances[k, 0])
        here = here if low <= observed.positions[k] <= high else 0.0
        if here > 0.0:
            off = observed.forms[k] - landmarks.forms[own]
            if landmarks.tracks[own] < OPENINGS:
                off = wrap_by_modulus(off)
            here *= _gaussian_density(off, form_variance + observed.variances[k, 1])
        paired += before * seen * here * matched[k]
        before = row[j + 1]
        row[j + 1] = missed * before + paired
    top = row[: count + 1].max()
    if not top > 0.0:
        return 0.0
    row[: count + 1] /= top
    return math.log(top)


@njit(cache=True)
def _gaussian_density(difference: float, variance: float) -> float:
    """Gaussian density of a difference, 0 beyond `_MAX_DEVIATIONS`."""
    if difference * difference > _MAX_DEVIATIONS * _MAX_DEVIATIONS * variance:
        return 0.0
    return math.exp(-0.5 * difference * difference / variance) / math.sqrt(2.0 * math.pi * variance)


@njit(cache=True)
def visible_interval(track: int, form: float, reach: float) -> tuple[float, float]:
    """Smallest and largest position ahead of the robot at which a landmark is visible, m.

    :param form: as of `LandmarkSequence`.
    """
    if track not in {CONVEX, CONVEX + 1}:
        return -reach, reach
    return (-reach, 0.0) if math.cos(form) > 0.0 else (0.0, reach)


@njit(cache=True)
def _probability_between(place: float, deviation: float, low: float, high: float) -> float:
    """Probability that a landmark is measured between two positions."""
    if low + _MAX_DEVIATIONS * deviation < place < high - _MAX_DEVIATIONS * deviation:
        return 1.0
    if not low - _MAX_DEVIATIONS * deviation <= place <= high + _MAX_DEVIATIONS * deviation:
        return 0.0
    scale = 1.0 / (math.sqrt(2.0) * deviation)
    return 0.5 * (math.erf((high - place) * scale) - math.erf((low - place) * scale))
