"""The position estimator of Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: a belief over the states of a map.

Eq. (1), in log space: ``SE_s'(k+1) = OS(o, s', a) sum_s T(s, a, s') SE_s(k) / P(o | a, SE(k))``, where the action a is
to go on, to turn at a node, or to arrive at the next opening. The paper's T has 0.99 for the state that the action
leads to, and 0.01 (``slip``) for all others; here these share it evenly, so that T is a probability. Which state an
arrival leads to is no yes or no: the traveled distance d and the turn on the way are observed too, with
N(d; d_arc, sigma_arc^2 + sigma_d^2) for an arc of the map, and with what is usual in buildings for other transitions.

One more state is ground that the map does not hold. It is where hallways lead that the map does not follow, and where
landmarks come as they do anywhere (observation.py). So the belief stays true in a map that is known in part.

A belief is a value; an update costs O(states + arcs), and what OS costs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import PlaceParameters
from hmt_slam_ros.geometry.se2 import wrap_by_modulus
from hmt_slam_ros.places.observation import ObservationModel, log_observation_ratios, log_unknown_ground_ratio
from hmt_slam_ros.places.observation_graph import QUARTERS, LandmarkSequence
from hmt_slam_ros.places.place_graph import PlaceGraph, StateTransitions


class Travel(NamedTuple):
    """The way to an opening, from the last one.

    :ivar distance: m, by odometry.
    :ivar turn: how far the robot turned on the way, counterclockwise, rad.
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
    :ivar log_probabilities: shape (states + 1,), the log of each state's probability, of unknown ground the last.
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
        """Probability that the robot's direction is one in which the map has no hallway, but, for example, a room."""
        return float(self.probabilities[:-1][~self.graph.has_hallway].sum())

    @property
    def most_likely_state(self) -> int | None:
        """The most likely state; None for unknown ground."""
        best = int(np.argmax(self.log_probabilities))
        return best if best < self.graph.state_count else None

    def predict_travel(self, distance: float) -> PositionBelief:
        """After a stretch on which no opening was noticed, m.

        T(s, a, s) = 1 - slip over a way as long as that between two places, however often one looks meanwhile.
        """
        return self._predict_with_slip(
            self.log_probabilities, 1.0 - (1.0 - self.places.slip) ** (distance / self.places.spacing)
        )

    def is_mapped_opening(self, travel: Travel) -> bool:
        """Whether an opening that was noticed is more probably one of the map, or of unknown ground, than one that the
        map lacks in known ground. One that it lacks is a landmark, and no arrival.

        Such a one is noticed only as long as none of the map is, so it is the less probable the farther the way is.
        """
        logs = _log_densities(
            self.graph.transitions, np.array((travel.distance, travel.turn)), np.array(travel.variances)
        )
        arcs, shares = self.graph.transitions, self.probabilities
        ways = shares[arcs.sources] * arcs.probabilities
        listed = float(ways @ np.exp(logs)) + shares[-1] * math.exp(self._log_unmapped_density(travel))
        ahead = arcs.means[:, 0] - travel.distance
        still = ahead / np.sqrt(2.0 * (arcs.variances[:, 0] + travel.variances[0]))
        passed = float(ways @ [0.5 * math.erfc(each) for each in still.tolist()])
        off = travel.turn**2 / travel.variances[1]
        turn = math.exp(-0.5 * off) / math.sqrt(2.0 * math.pi * travel.variances[1])
        return listed >= self.places.unlisted * turn * max(0.0, float(shares[:-1].sum()) - passed)

    def predict_turn(self, quarters: int) -> PositionBelief:
        """After so many quarters of a turn to the right at a node."""
        by_node = self.log_probabilities[:-1].reshape(-1, QUARTERS)
        turned_logs = np.append(np.roll(by_node, quarters, axis=1).ravel(), self.log_probabilities[-1])
        return self._predict_with_slip(turned_logs, self.places.slip)

    def _predict_with_slip(self, logs: Float64, slip: float) -> PositionBelief:
        """Each state keeps all but ``slip``, of which every other one gets its share."""
        others = len(logs) - 1
        probabilities = np.exp(logs)
        predicted = (1.0 - slip) * probabilities + slip / others * (probabilities.sum() - probabilities)
        return replace(self, log_probabilities=_normalize(_safe_log(predicted)))

    def predict_arrival(self, travel: Travel) -> PositionBelief:
        """After the next opening was noticed, Eq. (1) with d as a part of o."""
        way, noise = np.array((travel.distance, travel.turn)), np.array(travel.variances)
        densities = np.exp(_log_densities(self.graph.transitions, way, noise) - self._log_unmapped_density(travel))
        predicted = _arrival_prediction(
            self.probabilities, self.graph.transitions, densities, self.places.slip, self.places.discovery
        )
        return replace(self, log_probabilities=_normalize(_safe_log(predicted)))

    def _log_unmapped_density(self, travel: Travel) -> float:
        """Log-density of a way that the map does not tell."""
        return -math.log(2.0 * math.pi * self.places.spacing) - travel.distance / self.places.spacing

    def update(
        self, graph: LandmarkSequence, model: ObservationModel, distance_past_node: float = 0.0, variance: float = 0.0
    ) -> PositionBelief:
        """After an observation graph was seen, Eq. (1).

        :param distance_past_node: how far the robot is beyond the node of its state, m.
        :param variance: of that, m^2.
        """
        told = log_observation_ratios(graph, self.graph.expected_landmarks, distance_past_node, variance, model)
        return replace(
            self,
            log_probabilities=_normalize(
                self.log_probabilities + np.append(told, log_unknown_ground_ratio(graph, model))
            ),
        )


def uniform_belief(graph: PlaceGraph, places: PlaceParameters) -> PositionBelief:
    """Nothing is known of where the robot is, but that it is in a hallway that it can go along.

    :raises ValueError: where the map has none.
    """
    if not graph.has_hallway.any():
        raise ValueError("a map without a stretch of hallway holds no place to be at")
    logs = np.full(graph.state_count + 1, -np.inf)
    logs[:-1][graph.has_hallway] = math.log1p(-places.unmapped) - math.log(graph.has_hallway.sum())
    logs[-1] = math.log(places.unmapped)
    return PositionBelief(graph, places, logs)


def certain_belief(graph: PlaceGraph, places: PlaceParameters, state: int) -> PositionBelief:
    """The robot is in a state for certain."""
    logs = np.full(graph.state_count + 1, -np.inf)
    logs[state] = 0.0
    return PositionBelief(graph, places, logs)


def _safe_log(probabilities: Float64) -> Float64:
    """With -inf for 0."""
    return np.log(probabilities, out=np.full(len(probabilities), -np.inf), where=probabilities > 0.0)


def _normalize(logs: Float64) -> Float64:
    """:raises ValueError: where no state can be."""
    top = logs.max()
    if not top > -np.inf:
        raise ValueError("what was observed is impossible in every state: no probability of the model may be 0")
    return logs - top - math.log(np.exp(logs - top).sum())


@njit(cache=True)
def _log_densities(arcs: StateTransitions, way: Float64, noise: Float64) -> Float64:
    """Log-densities of a distance, m, and a turn, rad, of all arcs, shape (k,)."""
    found = np.zeros(len(arcs.sources))
    for k in range(len(arcs.sources)):
        for axis in range(2):
            variance = arcs.variances[k, axis] + noise[axis]
            off = way[axis] - arcs.means[k, axis]
            if axis == 1:
                off = wrap_by_modulus(off)
            found[k] -= 0.5 * (off * off / variance + math.log(2.0 * math.pi * variance))
    return found


@njit(cache=True)
def _arrival_prediction(
    belief: Float64, arcs: StateTransitions, densities: Float64, slip: float, discovery: float
) -> Float64:
    """sum_s T(s, a, s') p(d | s, s') SE_s up to a factor.

    :param densities: shape (k,), p(d | s, s') of the arcs against that of what is usual.

    What no arc of a state accounts for leads to unknown ground.
    """
    states = len(belief) - 1
    mapped, unmapped = belief[:states].sum(), belief[states]
    predicted = slip / states * (mapped - belief) + discovery / states * unmapped
    predicted[states] = slip / states * mapped + (1.0 - discovery) * unmapped + (1.0 - slip) * mapped
    for k in range(len(arcs.sources)):
        share = (1.0 - slip) * arcs.probabilities[k] * belief[arcs.sources[k]]
        predicted[states] -= share
        predicted[arcs.targets[k]] += share * densities[k]
    predicted[states] = max(predicted[states], slip / states * mapped + (1.0 - discovery) * unmapped)
    return predicted
