"""The most likely state policy, and the switch to the metric filter at a door.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: a confident robot follows the shortest path from the most likely
state to its goal. Another one follows the hallway, and at its end takes the direction with the least expected entropy
after the next opening, given what its likely states expect there.

Section 3.4: only a confident robot switches to the metric filter. The first two moments of the door, as measured and as
in the map, are those of the pose with which the filter starts,

    area_T_base = area_T_door (base_T_door)^-1.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import networkx
import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.places.chart import Chart
from hmt_slam_ros.places.estimator import PlaceEstimator
from hmt_slam_ros.places.observation import ObservationModel
from hmt_slam_ros.places.observation_graph import QUARTERS, LandmarkSequence, select_landmarks
from hmt_slam_ros.places.place_graph import PlaceGraph, node_of, state_after_turn
from hmt_slam_ros.places.position_belief import PositionBelief

_TURN_COST = 1.0
"""Cost of a quarter of a turn, m."""

_CLOSED_COST = 1e6
"""Cost of a closed edge, m: it is used only where no other path leads to the goal, as it may be open again."""

_MAX_EVALUATED_STATES = 8
"""Most likely states whose observation enters an expected entropy."""

_MIN_PROBABILITY = 1e-300
"""Probability of an impossible state, to keep its logarithm finite."""


def next_turn(
    belief: PositionBelief, goal: int | None, model: ObservationModel, *, ahead: bool, closed: Collection[int] = ()
) -> int | None:
    """Quarters to the right by which the robot has to turn.

    :param belief: at a node.
    :param goal: node; None for localization alone.
    :param ahead: whether the hallway goes on, by the scan.
    :param closed: states whose edges are avoided where other paths lead to the goal.
    :returns: None at the goal, without a path to it, and in unknown ground.
    """
    if goal is None or not belief.is_confident:
        return 0 if ahead else most_informative_turn(belief, model)
    state = belief.most_likely_state
    return None if state is None else turn_towards(belief.graph, state, goal, closed)


def turn_towards(graph: PlaceGraph, state: int, goal: int, closed: Collection[int] = ()) -> int | None:
    """Quarters to the right on the shortest path from a state to a goal; None as of `next_turn`."""
    moves = networkx.DiGraph()
    for source in range(graph.state_count):
        if graph.successors[source] >= 0:
            length = float(graph.lengths[source]) + (_CLOSED_COST if source in closed else 0.0)
            moves.add_edge(source, int(graph.successors[source]), length=length)
        for quarters in (1, QUARTERS - 1):
            moves.add_edge(source, state_after_turn(source, quarters), length=_TURN_COST)
    lengths, paths = networkx.single_source_dijkstra(moves, state, weight="length")
    ends = [end for end in range(QUARTERS * goal, QUARTERS * (goal + 1)) if end in lengths]
    if node_of(state) == goal or not ends:
        return None
    path = paths[min(ends, key=lambda end: lengths[end])]
    leaving = next(before for before, after in pairwise(path) if node_of(after) != node_of(before))
    return (leaving - state) % QUARTERS


def most_informative_turn(belief: PositionBelief, model: ObservationModel) -> int | None:
    """Quarters to the right with the least expected entropy; None in unknown ground.

    Only directions with an edge in the most likely state count; of equal ones the first to the right.
    """
    state = belief.most_likely_state
    if state is None:
        return None
    choices = [k for k in range(QUARTERS) if belief.graph.successors[state_after_turn(state, k)] >= 0]
    return min(choices, key=lambda quarters: _expected_entropy(belief, quarters, model), default=None)


def _expected_entropy(belief: PositionBelief, quarters: int, model: ObservationModel) -> float:
    """Mean entropy after a turn, the way to the next opening, and the observation there, nats."""
    predicted = _predict_next_opening(belief.predict_turn(quarters))
    shares = predicted.probabilities[:-1]
    likely = np.argsort(-shares, kind="stable")[:_MAX_EVALUATED_STATES]
    observations = [_ideal_observation(belief.graph, int(state), model) for state in likely]
    entropies = [predicted.update(observed, model).entropy for observed in observations]
    return float(shares[likely] @ entropies / shares[likely].sum())


def _predict_next_opening(belief: PositionBelief) -> PositionBelief:
    """The belief at the next opening, at any distance."""
    transitions, shares = belief.graph.transitions, np.zeros(belief.graph.state_count + 1)
    np.add.at(shares, transitions.targets, transitions.probabilities * belief.probabilities[transitions.sources])
    shares[-1] = max(0.0, 1.0 - float(shares.sum()))
    return replace(belief, log_probabilities=np.log(np.maximum(shares, _MIN_PROBABILITY)))


def _ideal_observation(graph: PlaceGraph, state: int, model: ObservationModel) -> LandmarkSequence:
    """The expected landmarks of a state within reach, observed without errors."""
    expected = graph.expected_landmarks.of_state(state)
    near = select_landmarks(expected, np.abs(expected.positions) <= model.reach)
    certain = np.full(len(near.tracks), model.true_share)
    return near._replace(variances=np.zeros_like(near.variances), probabilities=certain)


class MetricInitialPose(NamedTuple):
    """The pose with which a metric filter starts.

    :ivar node: before whose opening the robot is.
    :ivar area: in which the opening is known.
    :ivar pose: belief over ``area_T_base``.
    """

    node: int
    area: int
    pose: PoseGaussian


def metric_initial_pose(estimator: PlaceEstimator, chart: Chart) -> MetricInitialPose | None:
    """The pose by the opening ahead of the robot; None for a robot that is not confident, or before no opening."""
    facing, door = estimator.node_and_direction, estimator.openings.door_ahead()
    if facing is None or door is None or not estimator.is_at_node:
        return None
    if estimator.belief is None or not estimator.belief.is_confident:
        return None
    node, direction = facing
    for opening in chart.nodes[node].openings:
        if opening.direction == direction:
            return MetricInitialPose(node, opening.area, opening.pose.compose(door.inverse()))
    return None
