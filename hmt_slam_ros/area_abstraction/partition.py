"""Where an area ends: what the AAM remembers of every hypothesis, and its criteria of partition.

Blanco et al. say that their areas are no rooms; for Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, a place ends
at an opening. By ``both``, overlaps through an opening that the path passed count less in the normalized cut.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.area_abstraction.doors import DoorTracker, OpeningDetector, OpeningView
from hmt_slam_ros.area_abstraction.overlap_graph import OverlapGraph, Separation, find_separation, min_ncut
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import AreaPair, KeyframePoses
from hmt_slam_ros.hybrid_map.shortest_path import connected_neighbors
from hmt_slam_ros.messages.messages import HypothesisEstimate, Keyframe
from hmt_slam_ros.messages.replica import FIRST_AREA, FIRST_HYPOTHESIS, Replica, ReplicaState


@dataclass(frozen=True, eq=False)
class JoinedGraph:
    """Two areas a and b that a closure joins, as one.

    :ivar arc: ``a_T_b``, shape (3,), by which overlaps between the two were measured, m and rad.
    :ivar graph: number of the overlap graph of the keyframes of both in ``AamState.graphs``.
    :ivar second_keyframes: keyframes of area b.
    :ivar min_ncut: least normalized cut of the graph.
    """

    arc: NDArray[np.float64]
    graph: int
    second_keyframes: frozenset[int]
    min_ncut: float

    def max_displacement(self, arc: NDArray[np.float64], placed: KeyframePoses) -> float:
        """How far at most another arc has the keyframes of area b, {keyframe: pose in b}, from where they were, m."""
        points = np.array([pose[:2] for pose in placed.values()]).reshape(-1, 2)
        return float(np.hypot(*(se2.transform(arc, points) - se2.transform(self.arc, points)).T).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class Partition:
    """What the AAM remembers of one hypothesis; a value, so that the children of a hypothesis inherit it.

    :ivar area: the robot's area.
    :ivar graphs: {area: number of the overlap graph of its keyframes in ``AamState.graphs``} of the areas that the
        robot was in.
    :ivar new_keyframes: keyframes stored since the robot entered ``area``, and those that came over with it.
    :ivar separation_count: at how many of the latest evaluations in a row the newest keyframes separated.
    :ivar overlap_candidate: the known area that the robot seems to be in, and for how many keyframes in a row.
    :ivar joined_graphs: {pair of areas: what was found when it was last asked whether they are one}.
    :ivar door_tracker: the openings that the robot passes, where the policy asks for them.
    :ivar pairs_split_by_door: areas, the smaller first, between which the path went through an opening, likewise.
    """

    area: int
    graphs: Mapping[int, int] = field(default_factory=dict)
    new_keyframes: frozenset[int] = frozenset()
    separation_count: int = 0
    overlap_candidate: tuple[int, int] | None = None
    joined_graphs: Mapping[AreaPair, JoinedGraph] = field(default_factory=dict)
    door_tracker: DoorTracker = field(default_factory=DoorTracker)
    pairs_split_by_door: frozenset[AreaPair] = frozenset()


@dataclass(frozen=True, eq=False)
class AamState:
    """The AAM between two keyframe events, at first before the first one.

    :ivar replica: the maps of the live hypotheses.
    :ivar graphs: {number: overlap graph}; hypotheses share them.
    :ivar partitions: {hypothesis: what is remembered of it}.
    :ivar merge_queue: areas, the smaller first, of which is still to be asked whether they are one.
    :ivar prune_queue: areas that the robot left, of which is still to be asked whether they hold too much.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    graphs: Mapping[int, OverlapGraph] = field(default_factory=dict)
    partitions: Mapping[int, Partition] = field(default_factory=lambda: {FIRST_HYPOTHESIS: Partition(FIRST_AREA)})
    merge_queue: frozenset[AreaPair] = frozenset()
    prune_queue: frozenset[int] = frozenset()

    def with_partition(self, hypothesis: int, partition: Partition) -> AamState:
        """The state with something else remembered of a hypothesis."""
        return replace(self, partitions={**self.partitions, hypothesis: partition})

    def graph(self, number: int | None) -> OverlapGraph:
        """The graph of a number, without keyframes for None."""
        return OverlapGraph() if number is None else self.graphs[number]

    def without_unused_graphs(self) -> AamState:
        """The state without the graphs of which no hypothesis knows any more."""
        known = self.partitions.values()
        used = {number for partition in known for number in partition.graphs.values()}
        used |= {joined.graph for partition in known for joined in partition.joined_graphs.values()}
        if used == self.graphs.keys():
            return self
        return replace(self, graphs={number: graph for number, graph in self.graphs.items() if number in used})

    def without_keyframes(self, keyframes: Collection[int]) -> AamState:
        """The state without keyframes that the maps do not hold any more; areas as one are left as they are."""
        known = self.partitions.values()
        changed = {number for partition in known for number in partition.graphs.values()}
        return replace(
            self,
            graphs={
                number: graph.without_keyframes(keyframes) if number in changed else graph
                for number, graph in self.graphs.items()
            },
            partitions={
                hypothesis: replace(partition, new_keyframes=partition.new_keyframes.difference(keyframes))
                for hypothesis, partition in self.partitions.items()
            },
        )


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
        self._door_factor = self._options.portal_factor if self._options.area_policy == "both" else 1.0

    def track_doors(
        self,
        keyframe: Keyframe,
        leaves: Sequence[HypothesisEstimate],
        replica: Replica,
        partitions: Mapping[int, Partition],
    ) -> dict[int, Partition]:
        """The watches over hypotheses after what a keyframe shows of openings; none by a policy that asks for none.

        All hypotheses see what the most probable one does: what is around the robot they have in common.
        """
        if self._detector is None or not keyframe.mapping or not leaves:
            return {}
        best = max(leaves, key=lambda leaf: (replica.probabilities[leaf.hypothesis], -leaf.hypothesis))
        around = self._observe_surroundings(self._detector, keyframe, best, replica)
        found = {}
        for leaf in leaves:
            watch = partitions[leaf.hypothesis]
            way = watch.door_tracker.break_path() if keyframe.motion_unknown else watch.door_tracker
            pose = PoseGaussian(leaf.pose.mean, around.pose.covariance)
            way = way.update(keyframe.sequence, pose, around)
            found[leaf.hypothesis] = replace(watch, door_tracker=way)
        return found

    def _observe_surroundings(
        self, detector: OpeningDetector, keyframe: Keyframe, leaf: HypothesisEstimate, replica: Replica
    ) -> OpeningView:
        """What is around a keyframe, by the keyframes of its area and those beside it that were taken nearest."""
        hybrid_map, here = replica.maps[leaf.hypothesis], leaf.area
        placed: list[tuple[int, Float64]] = []
        for area in () if detector.sees_around(keyframe.scan) else (here, *connected_neighbors(hybrid_map, here)):
            arc = hybrid_map.arc(here, area) if area != here else None
            frame = np.zeros(3) if arc is None else arc.mean
            placed += [(k, se2.compose(frame, at)) for k, at in hybrid_map.keyframes(area).items()]
        placed = [(k, at) for k, at in placed if k != keyframe.sequence]
        away = [float(np.hypot(*(at[:2] - leaf.pose.mean[:2]))) for _, at in placed]
        nearest = sorted(np.argsort(away, kind="stable")[:_AROUND].tolist())
        scans = [replica.scans[placed[i][0]] for i in nearest]
        poses = np.array([placed[i][1] for i in nearest]).reshape(-1, 3)
        return detector.view(keyframe.scan, leaf.pose.mean, scans, poses)

    def find_separation(
        self, graph: OverlapGraph, new_keyframes: Collection[int], newest: int, door_tracker: DoorTracker
    ) -> Separation | None:
        """The part of the robot's own keyframes, the newest among them, that separates from its area.

        :param graph: of the area.
        :param new_keyframes: the keyframes stored since the robot entered the area.
        :param newest: the newest keyframe, one of ``new_keyframes``.
        :param door_tracker: of the robot.
        """
        if self._options.area_policy == "both":
            graph = graph.weaken_across_doors(door_tracker.segment_labels(new_keyframes), self._door_factor)
        return find_separation(graph, new_keyframes, newest, self._options.ncut_threshold, self._options.min_cluster)

    def min_ncut(self, graph: OverlapGraph, second_keyframes: Collection[int]) -> float:
        """The least NCut of two areas as one between which the path went through an opening.

        :param graph: of the keyframes of both.
        :param second_keyframes: of one of them.
        """
        weakened = graph.weaken_across_doors(dict.fromkeys(second_keyframes, 1), self._door_factor)
        return min_ncut(weakened, second_keyframes, self._options.min_cluster)
