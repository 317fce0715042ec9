"""What the AAM remembers of every hypothesis, and the same as a value that can be saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.processes.replica import FIRST_AREA, FIRST_HYPOTHESIS, ReplicaState
from hmt_slam_ros.topology.common_map import Keyframes, Pair
from hmt_slam_ros.topology.overlap_graph import OverlapGraph
from hmt_slam_ros.topology.passages import Way


class Joint(NamedTuple):
    """Two areas that a closure joins, as one.

    :ivar arc: ``a_T_b``, shape (3,), by which overlaps between the two were measured.
    :ivar graph: of the keyframes of both.
    :ivar part: keyframes of area b.
    :ivar least: least normalised cut of the graph.
    """

    arc: NDArray[np.float64]
    graph: OverlapGraph
    part: frozenset[int]
    least: float

    def moved(self, arc: NDArray[np.float64], placed: Keyframes) -> float:
        """How far at most another arc has the keyframes of area b, {keyframe: pose in b}, from where they were, m."""
        points = np.array([pose[:2] for pose in placed.values()]).reshape(-1, 2)
        return float(np.hypot(*(se2.transform(arc, points) - se2.transform(self.arc, points)).T).max(initial=0.0))


@dataclass(frozen=True)
class Watch:
    """What the AAM remembers of one hypothesis; a value, so that the children of a hypothesis inherit it.

    :ivar area: the robot's area.
    :ivar graphs: {area: overlap graph of its keyframes} of the areas that the robot was in.
    :ivar own: keyframes stored since the robot entered ``area``, and those that came over with it.
    :ivar separate: at how many of the latest evaluations in a row the newest keyframes separated.
    :ivar beyond: the known area that the robot seems to be in, and for how many keyframes in a row.
    :ivar joints: {pair of areas: what was found when it was last asked whether they are one}.
    :ivar way: the openings that the robot passes, where the policy asks for them.
    :ivar parted: areas, the smaller first, between which the path went through an opening, likewise.
    """

    area: int
    graphs: dict[int, OverlapGraph] = field(default_factory=dict)
    own: frozenset[int] = frozenset()
    separate: int = 0
    beyond: tuple[int, int] | None = None
    joints: dict[Pair, Joint] = field(default_factory=dict)
    way: Way = field(default_factory=Way)
    parted: frozenset[Pair] = frozenset()


@dataclass(frozen=True, eq=False)
class JointState:
    """Two areas a and b that a closure joins, as one.

    :ivar arc: ``a_T_b``, shape (3,), by which overlaps between the two were measured, m and rad.
    :ivar graph: number of the overlap graph of the keyframes of both in ``AamState.graphs``.
    :ivar part: keyframes of area b.
    :ivar least: least normalised cut of the graph.
    """

    arc: NDArray[np.float64]
    graph: int
    part: frozenset[int]
    least: float


@dataclass(frozen=True, eq=False)
class WatchState:
    """What the AAM remembers of one hypothesis.

    :ivar area: the robot's area.
    :ivar graphs: {area: number of the overlap graph of its keyframes in ``AamState.graphs``}.
    :ivar own: keyframes stored since the robot entered ``area``, and those that came over with it.
    :ivar separate: at how many of the latest evaluations in a row the newest keyframes separated.
    :ivar beyond: the known area that the robot seems to be in, and for how many keyframes in a row.
    :ivar joints: {pair of areas: what was found when it was last asked whether they are one}.
    :ivar way: the openings that the robot passes, where the policy asks for them.
    :ivar parted: areas, the smaller first, between which the path went through an opening, likewise.
    """

    area: int
    graphs: Mapping[int, int] = field(default_factory=dict)
    own: frozenset[int] = frozenset()
    separate: int = 0
    beyond: tuple[int, int] | None = None
    joints: Mapping[Pair, JointState] = field(default_factory=dict)
    way: Way = field(default_factory=Way)
    parted: frozenset[Pair] = frozenset()


@dataclass(frozen=True, eq=False)
class AamState:
    """The AAM between two keyframe events, at first before the first one.

    :ivar replica: the maps of the live hypotheses.
    :ivar graphs: overlap graphs; hypotheses share them.
    :ivar watches: {hypothesis: what is remembered of it}.
    :ivar asked: areas, the smaller first, of which is still to be asked whether they are one.
    :ivar left: areas that the robot left, of which is still to be asked whether they hold too much.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    graphs: tuple[OverlapGraph, ...] = ()
    watches: Mapping[int, WatchState] = field(default_factory=lambda: {FIRST_HYPOTHESIS: WatchState(FIRST_AREA)})
    asked: frozenset[Pair] = frozenset()
    left: frozenset[int] = frozenset()


def numbered(watch: Watch, numbers: Mapping[int, int]) -> WatchState:
    """A watch as a value, where its graphs have numbers by their identities."""
    joints = {
        pair: JointState(joint.arc, numbers[id(joint.graph)], joint.part, joint.least)
        for pair, joint in watch.joints.items()
    }
    graphs = {area: numbers[id(graph)] for area, graph in watch.graphs.items()}
    return WatchState(watch.area, graphs, watch.own, watch.separate, watch.beyond, joints, watch.way, watch.parted)


def watch_of(state: WatchState, graphs: Sequence[OverlapGraph]) -> Watch:
    """The watch of a value, whose graphs have numbers in ``graphs``."""
    joints = {
        pair: Joint(joint.arc, graphs[joint.graph], joint.part, joint.least) for pair, joint in state.joints.items()
    }
    own = {area: graphs[number] for area, number in state.graphs.items()}
    return Watch(state.area, own, state.own, state.separate, state.beyond, joints, state.way, state.parted)
