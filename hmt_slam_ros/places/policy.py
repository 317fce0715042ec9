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
from hmt_slam_ros.places.observation_graph import QUARTERS, Landmarks, chosen
from hmt_slam_ros.places.place_graph import PlaceGraph, node_of, turned
from hmt_slam_ros.places.position_belief import PositionBelief

# A quarter of a turn costs as much as so many metres, and so does a way that is closed: where no other leads to the
# goal, that one may be open again.
_TURN, _CLOSED = 1.0, 1e6
# States of which it is worked out what the robot would see.
_LIKELY = 8
# Instead of a probability of 0.
_NEVER = 1e-300


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
    if goal is None or not belief.confident:
        return 0 if ahead else most_informative_turn(belief, model)
    state = belief.most_likely
    return None if state is None else turn_towards(belief.graph, state, goal, closed)


def turn_towards(graph: PlaceGraph, state: int, goal: int, closed: Collection[int] = ()) -> int | None:
    """The same for a robot that is in a state for certain, on the shortest way."""
    ways = networkx.DiGraph()
    for source in range(graph.states):
        if graph.following[source] >= 0:
            length = float(graph.lengths[source]) + (_CLOSED if source in closed else 0.0)
            ways.add_edge(source, int(graph.following[source]), length=length)
        for quarters in (1, QUARTERS - 1):
            ways.add_edge(source, turned(source, quarters), length=_TURN)
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
    state = belief.most_likely
    if state is None:
        return None
    leading = [k for k in range(QUARTERS) if belief.graph.following[turned(state, k)] >= 0]
    return min(leading, key=lambda quarters: _entropy_after(belief, quarters, model), default=None)


def _entropy_after(belief: PositionBelief, quarters: int, model: ObservationModel) -> float:
    """Mean entropy after a turn, the way to the next opening, and what is to be seen there."""
    there = _led_on(belief.turned(quarters))
    shares = there.probabilities[:-1]
    likely = np.argsort(-shares, kind="stable")[:_LIKELY]
    left = [there.observed(_most_expected(belief.graph, int(state), model), model).entropy for state in likely]
    return float(shares[likely] @ left / shares[likely].sum())


def _led_on(belief: PositionBelief) -> PositionBelief:
    """The belief at the next opening, however far that is."""
    arcs, there = belief.graph.arcs, np.zeros(belief.graph.states + 1)
    np.add.at(there, arcs.targets, arcs.probabilities * belief.probabilities[arcs.sources])
    there[-1] = max(0.0, 1.0 - float(there.sum()))
    return replace(belief, logs=np.log(np.maximum(there, _NEVER)))


def _most_expected(graph: PlaceGraph, state: int, model: ObservationModel) -> Landmarks:
    """What would be seen in a state if nothing was missed, off, or extra."""
    every = chosen(graph.expected.landmarks, slice(*graph.expected.starts[state : state + 2].tolist()))
    near = chosen(every, np.abs(every.along) <= model.reach)
    sure = np.full(len(near.tracks), model.true_share)
    return near._replace(variances=np.zeros_like(near.variances), probabilities=sure)


class MetricStart(NamedTuple):
    """What a metric filter starts with.

    :ivar node: the robot is before its opening.
    :ivar area: in which the opening is known.
    :ivar pose: the belief over ``area_T_base``.
    """

    node: int
    area: int
    pose: PoseGaussian


def metric_start(estimator: PlaceEstimator, chart: Chart) -> MetricStart | None:
    """What the opening before the robot tells of its pose; None where it is not confident, or before no opening."""
    facing, seen = estimator.facing, estimator.openings.door_ahead()
    if facing is None or seen is None or not estimator.at_node:
        return None
    if estimator.belief is None or not estimator.belief.confident:
        return None
    node, direction = facing
    for opening in chart.nodes[node].openings:
        if opening.direction == direction:
            return MetricStart(node, opening.area, opening.located.compose(seen.inverse()))
    return None
