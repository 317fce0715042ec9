"""Where an area ends: what the AAM remembers of every hypothesis, and its criteria of partition.

Blanco et al. say that their areas are no rooms; for Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, a place ends
at an opening. By ``both``, overlaps through an opening that the path passed count less in the normalized cut.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.area_abstraction.doors import OpeningDetector, OpeningView, Way
from hmt_slam_ros.area_abstraction.overlap_graph import OverlapGraph, Separation, least_cut, separation
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.common_map import Keyframes, Pair
from hmt_slam_ros.hybrid_map.shortest_path import beside
from hmt_slam_ros.messages.messages import Keyframe, LeafEstimate
from hmt_slam_ros.messages.replica import FIRST_AREA, FIRST_HYPOTHESIS, Replica, ReplicaState


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


# Keyframes in whose map an opening around the robot is looked for.
_AROUND = 10


class AreaPolicy:
    """Says what separates from an area, and sees the openings that this takes."""

    def __init__(self, configuration: Configuration, detector: OpeningDetector | None = None) -> None:
        """:param detector: sees openings; by policy ``both`` there has to be one.

        :raises HmtSlamError: where there is none then.
        """
        self._options, self._detector = configuration.aam, detector
        if configuration.aam.area_policy == "both" and detector is None:
            raise HmtSlamError("aam.area_policy = both needs landmarks, which see openings: give the AAM a detector")
        self._factor = self._options.portal_factor if self._options.area_policy == "both" else 1.0

    def seen(
        self, keyframe: Keyframe, leaves: Sequence[LeafEstimate], replica: Replica, watches: Mapping[int, Watch]
    ) -> dict[int, Watch]:
        """The watches over hypotheses after what a keyframe shows of openings; none by a policy that asks for none.

        All hypotheses see what the most probable one does: what is around the robot they have in common.
        """
        if self._detector is None or not keyframe.mapping or not leaves:
            return {}
        best = max(leaves, key=lambda leaf: (replica.probabilities[leaf.hypothesis], -leaf.hypothesis))
        around = self._around(self._detector, keyframe, best, replica)
        found = {}
        for leaf in leaves:
            watch = watches[leaf.hypothesis]
            way = watch.way.interrupted() if keyframe.carried else watch.way
            pose = PoseGaussian(leaf.pose.mean, around.pose.covariance)
            way = way.seen(keyframe.sequence, pose, around)
            found[leaf.hypothesis] = replace(watch, way=way)
        return found

    def _around(
        self, detector: OpeningDetector, keyframe: Keyframe, leaf: LeafEstimate, replica: Replica
    ) -> OpeningView:
        """What is around a keyframe, by the keyframes of its area and those beside it that were taken nearest."""
        hybrid_map, here = replica.maps[leaf.hypothesis], leaf.area
        placed: list[tuple[int, Float64]] = []
        for area in () if detector.sees_around(keyframe.scan) else (here, *beside(hybrid_map, here)):
            arc = hybrid_map.arc(here, area) if area != here else None
            frame = np.zeros(3) if arc is None else arc.mean
            placed += [(k, se2.compose(frame, at)) for k, at in hybrid_map.keyframes(area).items()]
        placed = [(k, at) for k, at in placed if k != keyframe.sequence]
        away = [float(np.hypot(*(at[:2] - leaf.pose.mean[:2]))) for _, at in placed]
        nearest = sorted(np.argsort(away, kind="stable")[:_AROUND].tolist())
        scans = [replica.scans[placed[i][0]] for i in nearest]
        poses = np.array([placed[i][1] for i in nearest]).reshape(-1, 3)
        return detector.view(keyframe.scan, leaf.pose.mean, scans, poses)

    def separation(self, graph: OverlapGraph, own: Collection[int], newest: int, way: Way) -> Separation | None:
        """The part of the robot's own keyframes, the newest among them, that separates from its area.

        :param graph: of the area.
        :param own: the keyframes stored since the robot entered the area.
        :param newest: the newest keyframe, one of ``own``.
        :param way: of the robot.
        """
        if self._options.area_policy == "both":
            graph = graph.weakened(way.chambers(own), self._factor)
        return separation(graph, own, newest, self._options.ncut_threshold, self._options.min_cluster)

    def least_cut(self, joint: Joint) -> float:
        """The least NCut of two areas as one between which the path went through an opening."""
        graph = joint.graph.weakened(dict.fromkeys(joint.part, 1), self._factor)
        return least_cut(graph, joint.part, self._options.min_cluster)
