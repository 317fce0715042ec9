"""The belief over places: a probability for each state of a map, updated as in a POMDP.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3, Eq. (1), in log space:
``SE_s'(k+1) = OS(o, s', a) sum_s T(s, a, s') SE_s(k) / P(o | a, SE(k))``. The action a is to go on, to turn at a node,
or to arrive at the next opening. The paper's T has 0.99 for the state that the action leads to, and 0.01 (``slip``) for
all others. Here these share it evenly, so that T is a probability. For an arrival, the traveled distance d and the turn
are observed, too: with N(d; d_arc, sigma_arc^2 + sigma_d^2) for an arc of the map, and with the usual distribution of
buildings for other transitions.

One more state is unknown ground: where hallways lead that the map lacks, and where landmarks are as anywhere
(observation.py). So the belief stays valid in an incomplete map.

A belief is a value. An update costs O(states + arcs), plus OS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.landmarks import PlaceParameters
from hmt_slam_ros.geometry.se2 import wrap_by_modulus
from hmt_slam_ros.places.observation import ObservationModel, log_observation_ratios, log_unknown_ground_ratio
from hmt_slam_ros.places.observation_graph import QUARTERS, LandmarkSequence
from hmt_slam_ros.places.place_graph import PlaceGraph, StateTransitions


class Travel(NamedTuple):
    """Odometry from one opening to the next.

    :ivar distance: m.
    :ivar turn: rotation, counterclockwise, rad.
    :ivar variances: of both, m^2 and rad^2.
    """

    distance: float
    turn: float
    variances: tuple[float, float]


@dataclass(frozen=True, eq=False)
class PositionBelief:
    """A belief over the states of a map and unknown ground.

    :ivar graph: the map.
    :ivar places: parameters.
    :ivar log_probabilities: shape (states + 1,), of each state, and of unknown ground at the end.
    """

    graph: PlaceGraph
    places: PlaceParameters
    log_probabilities: Float64

    @property
    def probabilities(self) -> Float64:
        """SE, shape (states + 1,); the sum is 1."""
        return np.exp(self.log_probabilities)

    @property
    def entropy(self) -> float:
        """The unconfidence U(SE), Eq. (3), nats."""
        return float(-(self.probabilities * np.maximum(self.log_probabilities, -1e300)).sum())

    @property
    def is_confident(self) -> bool:
        """Whether U(SE) < U_max, Eq. (3)."""
        return self.entropy < self.places.max_entropy

    @property
    def room_probability(self) -> float:
        """Probability that the robot faces where the map has no hallway but, for example, a room."""
        return float(self.probabilities[:-1][~self.graph.has_hallway].sum())

    @property
    def most_likely_state(self) -> int | None:
        """The most likely state; None for unknown ground."""
        best = int(np.argmax(self.log_probabilities))
        return best if best < self.graph.state_count else None

    def predict_travel(self, distance: float) -> PositionBelief:
        """The belief after a distance without a noticed opening, m.

        T(s, a, s) = 1 - slip over the usual distance of two places, for any number of updates.
        """
        slip = 1.0 - (1.0 - self.places.slip) ** (distance / self.places.spacing)
        return self._predict_with_slip(self.log_probabilities, slip)

    def is_mapped_opening(self, travel: Travel) -> bool:
        """Whether a noticed opening is more probably one of the map or unknown ground than one that the map lacks.

        One that the map lacks is a landmark, and no arrival. It is noticed before any of the map, so it is the less
        probable the longer the distance is.
        """
        transitions, shares = self.graph.transitions, self.probabilities
        way, noise = np.array((travel.distance, travel.turn)), np.array(travel.variances)
        weights = shares[transitions.sources] * transitions.probabilities
        densities = np.exp(_log_densities(transitions, way, noise))
        mapped = float(weights @ densities) + shares[-1] * math.exp(self._log_unmapped_density(travel))
        ahead = transitions.means[:, 0] - travel.distance
        deviations = ahead / np.sqrt(2.0 * (transitions.variances[:, 0] + travel.variances[0]))
        passed = float(weights @ [0.5 * math.erfc(each) for each in deviations.tolist()])
        turn = math.exp(-0.5 * (travel.turn**2 / travel.variances[1])) / math.sqrt(2.0 * math.pi * travel.variances[1])
        return mapped >= self.places.unlisted * turn * max(0.0, float(shares[:-1].sum()) - passed)

    def predict_turn(self, quarters: int) -> PositionBelief:
        """The belief after a turn by some quarters to the right at a node."""
        by_node = self.log_probabilities[:-1].reshape(-1, QUARTERS)
        turned_logs = np.append(np.roll(by_node, quarters, axis=1).ravel(), self.log_probabilities[-1])
        return self._predict_with_slip(turned_logs, self.places.slip)

    def _predict_with_slip(self, logs: Float64, slip: float) -> PositionBelief:
        """The belief after each state passed ``slip`` of its probability to all others, evenly."""
        others = len(logs) - 1
        probabilities = np.exp(logs)
        predicted = (1.0 - slip) * probabilities + slip / others * (probabilities.sum() - probabilities)
        return replace(self, log_probabilities=_normalize(_safe_log(predicted)))

    def predict_arrival(self, travel: Travel) -> PositionBelief:
        """The belief after an arrival at the next opening, Eq. (1) with d as a part of o."""
        way, noise = np.array((travel.distance, travel.turn)), np.array(travel.variances)
        densities = np.exp(_log_densities(self.graph.transitions, way, noise) - self._log_unmapped_density(travel))
        predicted = _arrival_prediction(
            self.probabilities, self.graph.transitions, densities, self.places.slip, self.places.discovery
        )
        return replace(self, log_probabilities=_normalize(_safe_log(predicted)))

    def _log_unmapped_density(self, travel: Travel) -> float:
        """Log-density of a travel that no arc of the map explains."""
        return -math.log(2.0 * math.pi * self.places.spacing) - travel.distance / self.places.spacing

    def update(
        self, graph: LandmarkSequence, model: ObservationModel, distance_past_node: float = 0.0, variance: float = 0.0
    ) -> PositionBelief:
        """The belief after an observation graph, Eq. (1).

        :param distance_past_node: from the node of its state to the robot, m.
        :param variance: of that, m^2.
        """
        ratios = log_observation_ratios(graph, self.graph.expected_landmarks, distance_past_node, variance, model)
        log_likelihoods = np.append(ratios, log_unknown_ground_ratio(graph, model))
        return replace(self, log_probabilities=_normalize(self.log_probabilities + log_likelihoods))


def uniform_belief(graph: PlaceGraph, places: PlaceParameters) -> PositionBelief:
    """The uniform belief over all states in hallways, with ``places.unmapped`` for unknown ground.

    :raises ValueError: for a map without a hallway.
    """
    if not graph.has_hallway.any():
        raise ValueError("a map without a stretch of hallway holds no place to be at")
    logs = np.full(graph.state_count + 1, -np.inf)
    logs[:-1][graph.has_hallway] = math.log1p(-places.unmapped) - math.log(graph.has_hallway.sum())
    logs[-1] = math.log(places.unmapped)
    return PositionBelief(graph, places, logs)


def certain_belief(graph: PlaceGraph, places: PlaceParameters, state: int) -> PositionBelief:
    """The belief of a robot that is in a state for certain."""
    logs = np.full(graph.state_count + 1, -np.inf)
    logs[state] = 0.0
    return PositionBelief(graph, places, logs)


def _safe_log(probabilities: Float64) -> Float64:
    """Logarithms of probabilities, -inf for 0."""
    return np.log(probabilities, out=np.full(len(probabilities), -np.inf), where=probabilities > 0.0)


def _normalize(logs: Float64) -> Float64:
    """Normalized log-probabilities.

    :raises ValueError: where all states are impossible.
    """
    top = logs.max()
    if not top > -np.inf:
        raise ValueError("what was observed is impossible in every state: no probability of the model may be 0")
    return logs - top - math.log(np.exp(logs - top).sum())


@njit(cache=True)
def _log_densities(transitions: StateTransitions, way: Float64, noise: Float64) -> Float64:
    """Log-densities of a distance, m, and a turn, rad, for all transitions, shape (k,)."""
    found = np.zeros(len(transitions.sources))
    for k in range(len(transitions.sources)):
        for axis in range(2):
            variance = transitions.variances[k, axis] + noise[axis]
            difference = way[axis] - transitions.means[k, axis]
            if axis == 1:
                difference = wrap_by_modulus(difference)
            found[k] -= 0.5 * (difference * difference / variance + math.log(2.0 * math.pi * variance))
    return found


@njit(cache=True)
def _arrival_prediction(
    belief: Float64, transitions: StateTransitions, densities: Float64, slip: float, discovery: float
) -> Float64:
    """sum_s T(s, a, s') p(d | s, s') SE_s up to a factor; the rest of each state leads to unknown ground.

    :param densities: shape (k,), p(d | s, s') of the transitions against that of unmapped ones.
    """
    states = len(belief) - 1
    mapped, unmapped = belief[:states].sum(), belief[states]
    predicted = slip / states * (mapped - belief) + discovery / states * unmapped
    predicted[states] = slip / states * mapped + (1.0 - discovery) * unmapped + (1.0 - slip) * mapped
    for k in range(len(transitions.sources)):
        share = (1.0 - slip) * transitions.probabilities[k] * belief[transitions.sources[k]]
        predicted[states] -= share
        predicted[transitions.targets[k]] += share * densities[k]
    predicted[states] = max(predicted[states], slip / states * mapped + (1.0 - discovery) * unmapped)
    return predicted
