"""Area Abstraction Mechanism: which keyframes leave their area, and which known area the robot is in.

It evaluates each hypothesis, since all particles of a hypothesis share one topological path.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hmt_slam_ros.area_abstraction.doors import DoorTracker, OpeningDetector
from hmt_slam_ros.area_abstraction.overlap_graph import (
    OverlapGraph,
    SensedSpace,
    min_ncut,
    overlaps,
    sensed_overlaps,
    synchronize_graph,
)
from hmt_slam_ros.area_abstraction.partition import AamState, AreaPolicy, JoinedGraph, Partition
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import (
    NO_KEYFRAME,
    AreaPair,
    HybridMap,
    KeyframePoses,
    area_pair,
    has_foreign_keyframes,
)
from hmt_slam_ros.hybrid_map.keyframe_pruning import is_same_viewpoint, looks_alike, redundant_keyframes
from hmt_slam_ros.hybrid_map.shortest_path import informative_arc
from hmt_slam_ros.messages.map_changes import AreaMerge, PrunedKeyframe
from hmt_slam_ros.messages.messages import (
    AreaEvent,
    AreaEvents,
    ClosureDecision,
    Hypotheses,
    Hypothesis,
    HypothesisEstimate,
    Keyframe,
    Message,
)
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import is_wide
from hmt_slam_ros.submap.scan_matcher import exceeds_basin

_NEAREST_KEYFRAMES = 8
"""Keyframes of an area, the nearest to a scan, whose overlap with it is measured."""

_BEST_KEYFRAMES = 3
"""Those of them, with the largest overlaps, whose mean is the area's overlap."""

_RECENT_EVENTS = 30
"""Keyframe events for which new keyframes are not pruned."""

_REMEASURE_SHARE = 0.1
"""Smallest displacement of keyframes at which overlaps are measured again, relative to the radius of overlap."""


class Aam:
    """Answers every keyframe event with the areas that keyframes left.

    The overlap of two keyframes is measured once, when the later one enters the area of the earlier one, and inherited
    by child hypotheses. Corrections within an area are small against the radius of overlap. Between two areas it is
    measured again when the arc between them moved.

    A cut and a move have to be confirmed at ``aam.confirmations`` evaluations in a row, against single poor scans.

    Two areas that a definite closure joins are merged if no cut separates their joined graph. This is evaluated when
    the closure becomes definite, when it is refined again, and when the robot leaves one of the two.

    Keyframes are pruned while there is one hypothesis: those stored in an area before the move to the next one was
    noticed, if that has keyframes at their viewpoints; and those at crowded viewpoints of an area that the robot left.
    """

    def __init__(
        self, configuration: Configuration, state: AamState | None = None, detector: OpeningDetector | None = None
    ) -> None:
        """:param state: to continue from.

        :param detector: detects openings, for a partition by doors.
        :raises HmtSlamError: if that needs a detector and there is none.
        """
        state = state or AamState()
        self._options = configuration.aam
        self._filter = configuration.filter
        self._max_range = configuration.local_map.max_range
        self._policy = AreaPolicy(configuration, detector)
        self._replica = Replica.from_state(state.replica)
        self._sensed_spaces: dict[int, SensedSpace] = {}
        # Without the replica, which changes in place.
        self._state = replace(state, replica=ReplicaState())

    @property
    def state(self) -> AamState:
        """The state between two keyframe events."""
        return replace(self._state, replica=self._replica.state)

    def handle(self, message: Message) -> list[Message]:
        """Answer a ``Keyframe`` with its ``AreaEvents``; learn from ``Hypotheses`` and ``ClosureDecision``."""
        answers: list[Message] = []
        if isinstance(message, Keyframe):
            answers = [self._examine(message)]
        elif isinstance(message, Hypotheses):
            self._apply_hypotheses(message)
        elif isinstance(message, ClosureDecision) and message.hypothesis is not None:
            self._apply_decision(message, message.hypothesis)
        self._state = self._state.without_unused_graphs()
        return answers

    def _apply_hypotheses(self, hypotheses: Hypotheses) -> None:
        self._replica.apply_hypotheses(hypotheses)
        partitions = {hypothesis.id: self._update_partition(hypothesis) for hypothesis in hypotheses.hypotheses}
        self._state = replace(self._state, partitions=partitions)
        pruned = {keyframe.keyframe for keyframe in hypotheses.pruned_keyframes}
        if pruned:
            self._state = self._state.without_keyframes(pruned)
        for keyframe in pruned | {beams.keyframe for beams in hypotheses.stale_beams}:
            self._sensed_spaces.pop(keyframe, None)

    def _apply_decision(self, decision: ClosureDecision, hypothesis: int) -> None:
        """Continue with the hypothesis that is definite now."""
        self._replica.apply_decision(decision)
        partition = self._state.partitions[hypothesis]
        if decision.moved_keyframes:
            # The robot moved with the keyframes.
            partition = replace(partition, door_tracker=partition.door_tracker.break_path())
        merge_queue = self._state.merge_queue | {area_pair(arc.source, arc.target) for arc in decision.arcs}
        if decision.revised_hypotheses:
            merge_queue, partition = frozenset(), replace(partition, joined_graphs={})
        self._state = replace(self._state, partitions={hypothesis: partition}, merge_queue=merge_queue)

    def _examine(self, keyframe: Keyframe) -> AreaEvents:
        self._replica.add_keyframe(keyframe)
        self._sensed_spaces[keyframe.sequence] = self._sense(keyframe.scan)
        partitions = self._state.partitions
        known = [estimate for estimate in keyframe.estimates if estimate.hypothesis in partitions]
        tracked = self._policy.track_doors(keyframe, known, self._replica, partitions)
        self._state = replace(self._state, partitions={**partitions, **tracked})
        events = [
            self._find_cut(estimate, keyframe.sequence)
            or (self._find_merge(estimate.hypothesis) if keyframe.mapping else None)
            or self._find_move(estimate, keyframe.sequence)
            for estimate in known
        ]
        if not any(estimate.stored for estimate in known):
            del self._sensed_spaces[keyframe.sequence]
        may_prune = keyframe.mapping and len(partitions) == 1
        pruned = self._keyframes_to_prune(known[0], events[0], keyframe.sequence) if may_prune else ()
        return AreaEvents(keyframe.sequence, tuple(event for event in events if event is not None), pruned)

    def _keyframes_to_prune(
        self, estimate: HypothesisEstimate, event: AreaEvent | None, newest: int
    ) -> tuple[PrunedKeyframe, ...]:
        """The keyframes of the only hypothesis to prune now."""
        if event is None:
            return self._redundant_after_leaving(estimate.hypothesis, newest)
        return self._redundant_after_move(estimate.hypothesis, event.area) if event.kind == "moved" else ()

    def _redundant_after_move(self, hypothesis: int, entered: int) -> tuple[PrunedKeyframe, ...]:
        """The new keyframes of the area that the robot leaves at viewpoints of the area that it enters.

        Metric SLAM stored them, since its submap lacks areas of uncertain pose. Without pruning, an area would grow
        into the next one with every pass.
        """
        partition, hybrid_map = self._state.partitions[hypothesis], self._replica.maps[hypothesis]
        arc = hybrid_map.arc(entered, partition.area)
        entered_poses = np.array(list(self._keyframes(hypothesis, entered).values()))
        poses = self._keyframes(hypothesis, partition.area)
        if arc is None or not entered_poses.size:
            return ()
        first, scans = next(iter(poses)), self._replica.scans
        mountings = np.array([scans[k].laser_pose for k in self._keyframes(hypothesis, entered)])

        def is_known_view(keyframe: int) -> bool:
            relative = se2.between(entered_poses, se2.compose(arc.mean, poses[keyframe]))
            alike = looks_alike(scans[keyframe].laser_pose, mountings, self._filter)
            return bool((is_same_viewpoint(relative, self._filter) & alike).any())

        candidates = sorted(partition.new_keyframes & poses.keys() - {first})
        return tuple(PrunedKeyframe(k, partition.area) for k in candidates if is_known_view(k))

    def _redundant_after_leaving(self, hypothesis: int, newest: int) -> tuple[PrunedKeyframe, ...]:
        """The redundant keyframes of an area that the robot left."""
        if not self._state.prune_queue:
            return ()
        area = min(self._state.prune_queue)
        self._state = replace(self._state, prune_queue=self._state.prune_queue - {area})
        if not self._replica.maps[hypothesis].has_area(area):
            return ()
        poses = self._keyframes(hypothesis, area)
        recent = {k for k in poses if k > newest - _RECENT_EVENTS}
        foreign = {k for k in poses if k < NO_KEYFRAME}
        protected = recent | foreign | self._state.partitions[hypothesis].new_keyframes | set(list(poses)[:1])
        most = self._options.keyframes_per_place
        redundant = redundant_keyframes(poses, self._replica.scans, protected, most, self._filter)
        return tuple(PrunedKeyframe(k, area) for k in redundant)

    def _sense(self, scan: Scan) -> SensedSpace:
        return SensedSpace.from_scan(scan, self._max_range, self._options.overlap_points)

    def _sensed_space(self, keyframe: int) -> SensedSpace:
        """The sensed space of a keyframe's scan, computed once."""
        if keyframe not in self._sensed_spaces:
            self._sensed_spaces[keyframe] = self._sense(self._replica.scans[keyframe])
        return self._sensed_spaces[keyframe]

    def _find_cut(self, estimate: HypothesisEstimate, newest: int) -> AreaEvent | None:
        """The event that the newest keyframes leave the robot's area, once confirmed."""
        if not estimate.stored:
            return None
        partition = self._state.partitions[estimate.hypothesis]
        if is_wide(estimate.pose.covariance, self._filter):
            return AreaEvent(estimate.hypothesis, "cut", (newest,), partition.area, 0.0)
        graph = self._graph(partition, estimate.hypothesis, partition.area)
        new_keyframes = partition.new_keyframes | {newest}
        separation = self._policy.find_separation(graph, new_keyframes, newest, partition.door_tracker)
        partition = replace(
            partition,
            graphs=self._with_graph(partition.graphs, partition.area, graph),
            new_keyframes=new_keyframes,
            separation_count=partition.separation_count + 1 if separation else 0,
        )
        self._state = self._state.with_partition(estimate.hypothesis, partition)
        if separation is None or partition.separation_count < self._options.confirmations:
            return None
        return AreaEvent(estimate.hypothesis, "cut", separation.keyframes, partition.area, separation.ncut)

    def _find_merge(self, hypothesis: int) -> AreaEvent | None:
        """The event that two areas are one, if there is no other hypothesis."""
        hybrid_map = self._replica.maps[hypothesis]
        while self._state.merge_queue and len(self._state.partitions) == 1:
            into, area = pair = min(self._state.merge_queue)
            self._state = replace(self._state, merge_queue=self._state.merge_queue - {pair})
            arc = hybrid_map.arc_value(into, area)
            if arc is None or not arc.closure or exceeds_basin(arc.pose.covariance):
                continue
            if any(has_foreign_keyframes(hybrid_map.keyframes(side)) for side in pair):
                continue
            joined = self._joined_graph(hypothesis, pair, arc.pose.mean)
            value = joined.min_ncut
            if pair in self._state.partitions[hypothesis].pairs_split_by_door:
                value = self._policy.min_ncut(self._state.graph(joined.graph), joined.second_keyframes)
            if value > self._options.ncut_threshold:
                return AreaEvent(hypothesis, "merged", (), area, value, into)
        return None

    def _joined_graph(self, hypothesis: int, pair: AreaPair, arc: Float64) -> JoinedGraph:
        """The joined graph of two areas with the arc ``arc``; only overlaps that are not known are measured."""
        partition, (into, area) = self._state.partitions[hypothesis], pair
        second, before = self._keyframes(hypothesis, area), partition.joined_graphs.get(pair)
        poses = dict(self._keyframes(hypothesis, into))
        poses |= {keyframe: se2.compose(arc, pose) for keyframe, pose in second.items()}
        known = [self._state.graph(partition.graphs.get(side)) for side in pair]
        max_displacement = _REMEASURE_SHARE * self._options.overlap_radius
        if before is not None and before.max_displacement(arc, second) < max_displacement:
            graph_before = self._state.graph(before.graph)
            if before.second_keyframes == second.keys() and set(graph_before.keyframes) == poses.keys():
                return before
            arc, known = before.arc, [graph_before, *known]
        graph = self._synchronize_graph(poses, *known)
        value = min_ncut(graph, second, self._options.min_cluster)
        joined = JoinedGraph(arc, self._add_graph(graph), frozenset(second), value)
        partition = replace(partition, joined_graphs={**partition.joined_graphs, pair: joined})
        self._state = self._state.with_partition(hypothesis, partition)
        return joined

    def _find_move(self, estimate: HypothesisEstimate, newest: int) -> AreaEvent | None:
        """The event that the robot entered a known area one arc away, once confirmed.

        The margin by which the other area has to overlap more keeps the robot from alternating at a border. Keyframes
        that it stored in the area that it leaves stay there.
        """
        partition = self._state.partitions[estimate.hypothesis]
        overlaps_by_area = self._area_overlaps(estimate, newest)
        best = max(overlaps_by_area, key=lambda area: (overlaps_by_area[area], -area))
        required = overlaps_by_area[partition.area] + self._options.move_margin
        stays = best == partition.area or overlaps_by_area[best] < required
        candidate, count = partition.overlap_candidate or (None, 0)
        count = count + 1 if candidate == best else 1
        partition = replace(partition, overlap_candidate=None if stays else (best, count))
        self._state = self._state.with_partition(estimate.hypothesis, partition)
        if stays or count < self._options.confirmations:
            return None
        return AreaEvent(estimate.hypothesis, "moved", (), best, overlaps_by_area[best])

    def _area_overlaps(self, estimate: HypothesisEstimate, newest: int) -> dict[int, float]:
        """Overlap of the newest scan with the robot's area and with those one arc away, {area: overlap}."""
        hybrid_map, own = self._replica.maps[estimate.hypothesis], estimate.area
        overlaps_by_area = {own: self._area_overlap(hybrid_map, own, estimate.pose.mean, newest)}
        for area in hybrid_map.neighbors(own):
            arc = informative_arc(hybrid_map, area, own)
            if arc is not None:
                pose = se2.compose(arc.mean, estimate.pose.mean)
                overlaps_by_area[area] = self._area_overlap(hybrid_map, area, pose, newest)
        return overlaps_by_area

    def _area_overlap(self, hybrid_map: HybridMap, area: int, pose: Float64, newest: int) -> float:
        """Overlap of the newest scan, taken at ``pose`` = ``area_T_base``, with an area."""
        others = {k: other for k, other in hybrid_map.keyframes(area).items() if k != newest}
        if not others:
            return 0.0
        keyframes, poses = list(others), np.array(list(others.values()))
        nearest = np.argsort(np.hypot(*(poses[:, :2] - pose[:2]).T), kind="stable")[:_NEAREST_KEYFRAMES]
        shares = sensed_overlaps(
            self._sensed_space(newest),
            pose,
            [self._sensed_space(keyframes[i]) for i in nearest],
            poses[nearest],
            self._options.overlap_radius,
        )
        return float(np.sort(shares)[-_BEST_KEYFRAMES:].mean())

    def _update_partition(self, hypothesis: Hypothesis) -> Partition:
        """The partition of a hypothesis after TSBI's answer."""
        before, area = self._state.partitions[hypothesis.parent], hypothesis.area
        tracker = before.door_tracker
        if hypothesis.area_merge is not None:
            return self._merge_in_partition(before, hypothesis, hypothesis.area_merge)
        if area == before.area:
            return replace(before, door_tracker=tracker.break_path()) if hypothesis.removed_arcs else before
        moved = frozenset(m.keyframe for m in hypothesis.moved_keyframes if m.area == area)
        entered_graph = self._graph(before, hypothesis.id, area)
        left_keyframes = self._keyframes(hypothesis.id, before.area)
        left_graph = self._state.graph(before.graphs.get(before.area)).subgraph(left_keyframes)
        neighbors = self._replica.maps[hypothesis.id].neighbors(before.area)
        self._state = replace(
            self._state,
            merge_queue=self._state.merge_queue | {area_pair(before.area, other) for other in neighbors},
            prune_queue=self._state.prune_queue | {before.area},
        )
        graphs = self._with_graph(self._with_graph(before.graphs, before.area, left_graph), area, entered_graph)
        frame = hypothesis.frame_change
        tracker = DoorTracker() if frame is None else tracker.transform(frame.mean)
        split_pairs = before.pairs_split_by_door
        if moved and before.door_tracker.segment_labels(moved)[max(moved)] != 0:
            split_pairs |= {area_pair(before.area, area)}
        return Partition(
            area,
            graphs,
            moved,
            joined_graphs=before.joined_graphs,
            door_tracker=tracker.keep_crossings_after(min(moved, default=None)),
            pairs_split_by_door=split_pairs,
        )

    def _merge_in_partition(self, partition: Partition, hypothesis: Hypothesis, merge: AreaMerge) -> Partition:
        """The partition with one area for two; new keyframes of either stay new."""
        merge_queue = frozenset(pair for pair in self._state.merge_queue if merge.area not in pair)
        self._state = replace(self._state, merge_queue=merge_queue)
        graphs = {area: number for area, number in partition.graphs.items() if area != merge.area}
        known = [self._state.graph(partition.graphs.get(area)) for area in (merge.into, merge.area)]
        merged_graph = self._synchronize_graph(self._keyframes(hypothesis.id, merge.into), *known)
        tracker = partition.door_tracker
        renamed = (
            area_pair(*(merge.into if area == merge.area else area for area in pair))
            for pair in partition.pairs_split_by_door
        )
        return replace(
            partition,
            area=hypothesis.area,
            graphs=self._with_graph(graphs, merge.into, merged_graph),
            overlap_candidate=None,
            joined_graphs={pair: graph for pair, graph in partition.joined_graphs.items() if merge.area not in pair},
            door_tracker=tracker if hypothesis.area == partition.area else tracker.transform(merge.pose.mean),
            pairs_split_by_door=frozenset(pair for pair in renamed if pair[0] != pair[1]),
        )

    def _with_graph(self, graphs: Mapping[int, int], area: int, graph: OverlapGraph) -> dict[int, int]:
        """{area: number of its overlap graph} with this graph of an area."""
        if area in graphs and self._state.graphs[graphs[area]] is graph:
            return dict(graphs)
        return {**graphs, area: self._add_graph(graph)}

    def _add_graph(self, graph: OverlapGraph) -> int:
        """The new number of a graph."""
        number = max(self._state.graphs, default=-1) + 1
        self._state = replace(self._state, graphs={**self._state.graphs, number: graph})
        return number

    def _graph(self, partition: Partition, hypothesis: int, area: int) -> OverlapGraph:
        """The present overlap graph of an area, with overlaps from the graphs of the partition."""
        known = [self._state.graph(partition.graphs.get(a)) for a in (area, partition.area)]
        return self._synchronize_graph(self._keyframes(hypothesis, area), *known)

    def _keyframes(self, hypothesis: int, area: int) -> KeyframePoses:
        return self._replica.maps[hypothesis].keyframes(area)

    def _synchronize_graph(self, poses: KeyframePoses, graph: OverlapGraph, *others: OverlapGraph) -> OverlapGraph:
        """The overlap graph of keyframes, {keyframe: pose}, measuring only what none of the graphs holds."""

        def measure(keyframe: int, others: tuple[int, ...]) -> Float64:
            other_poses = np.array([poses[other] for other in others]).reshape(-1, 3)
            other_points = [self._sensed_space(other).points for other in others]
            points, radius = self._sensed_space(keyframe).points, self._options.overlap_radius
            return overlaps(points, poses[keyframe], other_points, other_poses, radius)

        return synchronize_graph(graph, poses, measure, *others)
