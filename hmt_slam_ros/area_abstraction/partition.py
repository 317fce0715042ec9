"""Partition of areas: what the AAM remembers of every hypothesis, and the criterion by which an area ends.

The areas of Blanco et al. need not be rooms. For Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, a place ends at
an opening. With the policy ``both``, overlaps through a crossed opening count less in the normalized cut.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

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

_NEARBY_KEYFRAMES = 10
"""Keyframes whose map is searched for openings around the robot (docs/decisions/0010-area-policy.md)."""


@dataclass(frozen=True, eq=False)
class JoinedGraph:
    """The overlap graph of two areas a and b that a closure joins.

    :ivar arc: ``a_T_b``, shape (3,), with which overlaps between the two were measured, m and rad.
    :ivar graph: number of the overlap graph of the keyframes of both in ``AamState.graphs``.
    :ivar second_keyframes: keyframes of area b.
    :ivar min_ncut: smallest normalized cut of the graph.
    """

    arc: Float64
    graph: int
    second_keyframes: frozenset[int]
    min_ncut: float

    def max_displacement(self, arc: Float64, poses: KeyframePoses) -> float:
        """Largest distance by which another arc moves the keyframes of area b, {keyframe: pose in b}, m."""
        points = np.array([pose[:2] for pose in poses.values()]).reshape(-1, 2)
        return float(np.hypot(*(se2.transform(arc, points) - se2.transform(self.arc, points)).T).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class Partition:
    """What the AAM remembers of one hypothesis; a value, so that the children of a hypothesis inherit it.

    :ivar area: the robot's area.
    :ivar graphs: {area: number of its overlap graph in ``AamState.graphs``} of the areas that the robot was in.
    :ivar new_keyframes: keyframes stored since the robot entered ``area``, and those that moved there with it.
    :ivar separation_count: number of the latest evaluations in a row at which the newest keyframes separated.
    :ivar overlap_candidate: the known area that the robot seems to be in, and for how many keyframes in a row.
    :ivar joined_graphs: {pair of areas: their graph when a merge was last evaluated}.
    :ivar door_tracker: the openings on the path, if the policy uses them.
    :ivar pairs_split_by_door: areas, the smaller first, between which the path crossed an opening, likewise.
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
    :ivar partitions: {hypothesis: its partition}.
    :ivar merge_queue: pairs of areas, the smaller first, of which a merge is still to be evaluated.
    :ivar prune_queue: areas that the robot left, which are still to be pruned.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    graphs: Mapping[int, OverlapGraph] = field(default_factory=dict)
    partitions: Mapping[int, Partition] = field(default_factory=lambda: {FIRST_HYPOTHESIS: Partition(FIRST_AREA)})
    merge_queue: frozenset[AreaPair] = frozenset()
    prune_queue: frozenset[int] = frozenset()

    def with_partition(self, hypothesis: int, partition: Partition) -> AamState:
        """The state with another partition of a hypothesis."""
        return replace(self, partitions={**self.partitions, hypothesis: partition})

    def graph(self, number: int | None) -> OverlapGraph:
        """The graph with a number; an empty one for None."""
        return OverlapGraph() if number is None else self.graphs[number]

    def without_unused_graphs(self) -> AamState:
        """The state without the graphs that no hypothesis uses any more."""
        partitions = self.partitions.values()
        used = {number for partition in partitions for number in partition.graphs.values()}
        used |= {joined.graph for partition in partitions for joined in partition.joined_graphs.values()}
        if used == self.graphs.keys():
            return self
        return replace(self, graphs={number: graph for number, graph in self.graphs.items() if number in used})

    def without_keyframes(self, keyframes: Collection[int]) -> AamState:
        """The state without keyframes that were pruned; joined graphs stay as they are."""
        changed = {number for partition in self.partitions.values() for number in partition.graphs.values()}
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


class AreaPolicy:
    """The criterion by which keyframes separate from an area, with the openings that it needs."""

    def __init__(self, configuration: Configuration, detector: OpeningDetector | None = None) -> None:
        """:param detector: detects openings; required by the policy ``both``.

        :raises HmtSlamError: if there is none then.
        """
        self._options, self._detector = configuration.aam, detector
        if configuration.aam.area_policy == "both" and detector is None:
            raise HmtSlamError("aam.area_policy = both needs landmarks, which see openings: give the AAM a detector")
        self._door_factor = self._options.portal_factor if self._options.area_policy == "both" else 1.0

    def track_doors(
        self,
        keyframe: Keyframe,
        estimates: Sequence[HypothesisEstimate],
        replica: Replica,
        partitions: Mapping[int, Partition],
    ) -> dict[int, Partition]:
        """The partitions after the openings of a keyframe; none for a policy without openings.

        All hypotheses take the openings of the most probable one, since they share the robot's surroundings.
        """
        if self._detector is None or not keyframe.mapping or not estimates:
            return {}
        best = max(estimates, key=lambda e: (replica.probabilities[e.hypothesis], -e.hypothesis))
        view = self._observe_surroundings(self._detector, keyframe, best, replica)
        tracked = {}
        for estimate in estimates:
            partition = partitions[estimate.hypothesis]
            tracker = partition.door_tracker.break_path() if keyframe.motion_unknown else partition.door_tracker
            tracker = tracker.update(keyframe.sequence, PoseGaussian(estimate.pose.mean, view.pose.covariance), view)
            tracked[estimate.hypothesis] = replace(partition, door_tracker=tracker)
        return tracked

    def _observe_surroundings(
        self, detector: OpeningDetector, keyframe: Keyframe, estimate: HypothesisEstimate, replica: Replica
    ) -> OpeningView:
        """The openings around a keyframe, in the map of the nearest keyframes of its area and the neighbors."""
        hybrid_map, area = replica.maps[estimate.hypothesis], estimate.area
        poses: list[tuple[int, Float64]] = []
        for other in () if detector.sees_around(keyframe.scan) else (area, *connected_neighbors(hybrid_map, area)):
            arc = hybrid_map.arc(area, other) if other != area else None
            frame = np.zeros(3) if arc is None else arc.mean
            poses += [(k, se2.compose(frame, pose)) for k, pose in hybrid_map.keyframes(other).items()]
        poses = [(k, pose) for k, pose in poses if k != keyframe.sequence]
        distances = [float(np.hypot(*(pose[:2] - estimate.pose.mean[:2]))) for _, pose in poses]
        nearest = [poses[i] for i in sorted(np.argsort(distances, kind="stable")[:_NEARBY_KEYFRAMES].tolist())]
        scans = [replica.scans[k] for k, _ in nearest]
        return detector.view(keyframe.scan, estimate.pose.mean, scans, np.array([p for _, p in nearest]).reshape(-1, 3))

    def find_separation(
        self, graph: OverlapGraph, new_keyframes: Collection[int], newest: int, door_tracker: DoorTracker
    ) -> Separation | None:
        """The part of the new keyframes, the newest among them, that separates from the area.

        :param graph: of the area.
        :param new_keyframes: the keyframes stored since the robot entered the area.
        :param newest: the newest keyframe, one of ``new_keyframes``.
        :param door_tracker: of the robot.
        """
        if self._options.area_policy == "both":
            graph = graph.weaken_across_doors(door_tracker.segment_labels(new_keyframes), self._door_factor)
        return find_separation(graph, new_keyframes, newest, self._options.ncut_threshold, self._options.min_cluster)

    def min_ncut(self, graph: OverlapGraph, second_keyframes: Collection[int]) -> float:
        """The smallest NCut of two areas between which the path crossed an opening.

        :param graph: of the keyframes of both.
        :param second_keyframes: of one of them.
        """
        weakened = graph.weaken_across_doors(dict.fromkeys(second_keyframes, 1), self._door_factor)
        return min_ncut(weakened, second_keyframes, self._options.min_cluster)
