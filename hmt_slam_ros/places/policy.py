"""What the robot does next: the most likely state policy of Tomatis et al. (2003), section 3.3, and its end at a door.

A confident robot does what is best in the most likely state: it follows the shortest way to its goal. One that is not
follows the hallway and, where that ends, goes where it expects to find more information: where less entropy would be
left after the next opening, if it saw there what each of its likely states has it expect.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.4: only a robot that is confident switches, since in the frame of a
wrong place all that follows is wrong. The first two moments of the door as the robot measures it, and of the same
door in the map, are those of the robot's pose with which the filter starts,

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

# A quarter of a turn costs as much as so many metres, and so does a way that is closed: where no other leads to the
# goal, that one may be open again.
_TURN, _CLOSED = 1.0, 1e6
# States of which it is worked out what the robot would see.
_LIKELY = 8
# Instead of a probability of 0.
_MIN_PROBABILITY = 1e-300


def next_turn(
    belief: PositionBelief, goal: int | None, model: ObservationModel, *, ahead: bool, closed: Collection[int] = ()
) -> int | None:
    """Quarters to the right that the robot has to turn before it goes on.

    :param belief: at a node.
    :param goal: node; None where the robot only wants to know where it is.
    :param ahead: whether the hallway leads on, as the robot sees it.
    :param closed: states whose edges are not to be gone where others lead to the goal.
    :returns: None at the goal, where no way is known to lead there, and in unknown ground.
    """
    if goal is None or not belief.is_confident:
        return 0 if ahead else most_informative_turn(belief, model)
    state = belief.most_likely_state
    return None if state is None else turn_towards(belief.graph, state, goal, closed)


def turn_towards(graph: PlaceGraph, state: int, goal: int, closed: Collection[int] = ()) -> int | None:
    """The same for a robot that is in a state for certain, on the shortest way."""
    ways = networkx.DiGraph()
    for source in range(graph.state_count):
        if graph.successors[source] >= 0:
            length = float(graph.lengths[source]) + (_CLOSED if source in closed else 0.0)
            ways.add_edge(source, int(graph.successors[source]), length=length)
        for quarters in (1, QUARTERS - 1):
            ways.add_edge(source, state_after_turn(source, quarters), length=_TURN)
    lengths, paths = networkx.single_source_dijkstra(ways, state, weight="length")
    ends = [end for end in range(QUARTERS * goal, QUARTERS * (goal + 1)) if end in lengths]
    if node_of(state) == goal or not ends:
        return None
    path = paths[min(ends, key=lambda end: lengths[end])]
    leaving = next(before for before, after in pairwise(path) if node_of(after) != node_of(before))
    return (leaving - state) % QUARTERS


def most_informative_turn(belief: PositionBelief, model: ObservationModel) -> int | None:
    """The direction after which least entropy is to be expected; None in unknown ground.

    Only such as lead on in the most likely state; of equal ones the first to the right from straight on.
    """
    state = belief.most_likely_state
    if state is None:
        return None
    leading = [k for k in range(QUARTERS) if belief.graph.successors[state_after_turn(state, k)] >= 0]
    return min(leading, key=lambda quarters: _expected_entropy(belief, quarters, model), default=None)


def _expected_entropy(belief: PositionBelief, quarters: int, model: ObservationModel) -> float:
    """Mean entropy after a turn, the way to the next opening, and what is to be seen there."""
    there = _predict_next_opening(belief.predict_turn(quarters))
    shares = there.probabilities[:-1]
    likely = np.argsort(-shares, kind="stable")[:_LIKELY]
    left = [there.update(_ideal_observation(belief.graph, int(state), model), model).entropy for state in likely]
    return float(shares[likely] @ left / shares[likely].sum())


def _predict_next_opening(belief: PositionBelief) -> PositionBelief:
    """The belief at the next opening, however far that is."""
    arcs, there = belief.graph.transitions, np.zeros(belief.graph.state_count + 1)
    np.add.at(there, arcs.targets, arcs.probabilities * belief.probabilities[arcs.sources])
    there[-1] = max(0.0, 1.0 - float(there.sum()))
    return replace(belief, log_probabilities=np.log(np.maximum(there, _MIN_PROBABILITY)))


def _ideal_observation(graph: PlaceGraph, state: int, model: ObservationModel) -> LandmarkSequence:
    """What would be seen in a state if nothing was missed, off, or extra."""
    every = select_landmarks(
        graph.expected_landmarks.landmarks, slice(*graph.expected_landmarks.starts[state : state + 2].tolist())
    )
    near = select_landmarks(every, np.abs(every.positions) <= model.reach)
    sure = np.full(len(near.tracks), model.true_share)
    return near._replace(variances=np.zeros_like(near.variances), probabilities=sure)


class MetricInitialPose(NamedTuple):
    """What a metric filter starts with.

    :ivar node: the robot is before its opening.
    :ivar area: in which the opening is known.
    :ivar pose: the belief over ``area_T_base``.
    """

    node: int
    area: int
    pose: PoseGaussian


def metric_initial_pose(estimator: PlaceEstimator, chart: Chart) -> MetricInitialPose | None:
    """What the opening before the robot tells of its pose; None where it is not confident, or before no opening."""
    facing, seen = estimator.node_and_direction, estimator.openings.door_ahead()
    if facing is None or seen is None or not estimator.is_at_node:
        return None
    if estimator.belief is None or not estimator.belief.is_confident:
        return None
    node, direction = facing
    for opening in chart.nodes[node].openings:
        if opening.direction == direction:
            return MetricInitialPose(node, opening.area, opening.pose.compose(seen.inverse()))
    return None
