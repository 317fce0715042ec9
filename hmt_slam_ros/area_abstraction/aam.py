"""Area Abstraction Mechanism: when do the newest keyframes no longer belong to the area, and which known one is this?

A hypothesis is one topological path, so "once for every group of particles with the same path" is once for every leaf.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.area_abstraction.doors import DoorTracker, OpeningDetector
from hmt_slam_ros.area_abstraction.overlap import SensedSpace, overlaps, sensed_overlaps
from hmt_slam_ros.area_abstraction.overlap_graph import OverlapGraph, Separation, min_ncut, synchronize_graph
from hmt_slam_ros.area_abstraction.partition import AamState, AreaPolicy, JoinedGraph, Partition
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import AreaPair, HybridMap, KeyframePoses, area_pair
from hmt_slam_ros.hybrid_map.keyframe_pruning import is_same_viewpoint, redundant_keyframes
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

# An area's overlap with a scan is that of the best few keyframes among those taken nearest to it.
_NEAREST, _BEST = 8, 3
# Keyframe events for which all that is new stays.
_RECENT = 30
# Where an arc moved keyframes by less than this share of the radius of overlap, overlaps are not measured again.
_REMEASURE_SHARE = 0.1


class Aam:
    """Answers every keyframe event with the areas that were left.

    The overlap of two keyframes is measured once, when the later one joins the area of the earlier one, and inherited
    by the hypotheses that branch off. It is not measured again when metric SLAM or TLCA corrects poses: a correction
    within an area is small against the radius of overlap. Between two areas it is when the arc between them moved.

    A cut and a move have to be found at ``aam.confirmations`` evaluations in a row, so that one poor scan does nothing.

    Two areas that a definite closure joins are one if nothing in what both hold together separates, so that an area of
    all of it would not be cut. This is asked when the closure becomes definite, when it is refined again, and when the
    robot leaves one of the two.

    Keyframes of ground that is passed again and again are forgotten, where there is one hypothesis: those stored in an
    area before it showed that the robot was in the next one, which has some there itself; and of an area that the robot
    left, those of which a place holds too many.
    """

    def __init__(
        self, configuration: Configuration, state: AamState | None = None, detector: OpeningDetector | None = None
    ) -> None:
        """:param state: to go on from.

        :param detector: sees openings, for a partition that asks for doors.
        :raises HmtSlamError: where that asks for them and there is no detector.
        """
        state = state or AamState()
        self._options = configuration.aam
        self._filter = configuration.filter
        self._max_range = configuration.local_map.max_range
        self._policy = AreaPolicy(configuration, detector)
        self._replica = Replica.from_state(state.replica)
        self._sensed_spaces: dict[int, SensedSpace] = {}
        # All but the replica, which changes in place.
        self._state = replace(state, replica=ReplicaState())

    @property
    def state(self) -> AamState:
        """All that the AAM knows, as a value."""
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
        partitions = {leaf.id: self._update_partition(leaf) for leaf in hypotheses.hypotheses}
        self._state = replace(self._state, partitions=partitions)
        pruned = {one.keyframe for one in hypotheses.pruned_keyframes}
        if pruned:
            self._state = self._state.without_keyframes(pruned)
        for keyframe in pruned | {late.keyframe for late in hypotheses.stale_beams}:
            self._sensed_spaces.pop(keyframe, None)

    def _apply_decision(self, decision: ClosureDecision, hypothesis: int) -> None:
        """Go on with the hypothesis that is definite now."""
        self._replica.apply_decision(decision)
        partition = self._state.partitions[hypothesis]
        if decision.moved_keyframes:
            # With the keyframes the robot moved.
            partition = replace(partition, door_tracker=partition.door_tracker.break_path())
        merge_queue = self._state.merge_queue | {area_pair(arc.source, arc.target) for arc in decision.arcs}
        if decision.revised_hypotheses:
            merge_queue, partition = frozenset(), replace(partition, joined_graphs={})
        self._state = replace(self._state, partitions={hypothesis: partition}, merge_queue=merge_queue)

    def _examine(self, keyframe: Keyframe) -> AreaEvents:
        self._replica.add_keyframe(keyframe)
        self._sensed_spaces[keyframe.sequence] = self._sense(keyframe.scan)
        partitions = self._state.partitions
        known = [leaf for leaf in keyframe.estimates if leaf.hypothesis in partitions]
        tracked = self._policy.track_doors(keyframe, known, self._replica, partitions)
        self._state = replace(self._state, partitions={**partitions, **tracked})
        events = [
            self._find_cut(leaf, keyframe.sequence)
            or (self._find_merge(leaf.hypothesis) if keyframe.mapping else None)
            or self._find_move(leaf, keyframe.sequence)
            for leaf in known
        ]
        if not any(leaf.stored for leaf in known):
            del self._sensed_spaces[keyframe.sequence]
        may_forget = keyframe.mapping and len(partitions) == 1
        forgotten = self._keyframes_to_prune(known[0], events[0], keyframe.sequence) if may_forget else ()
        return AreaEvents(keyframe.sequence, tuple(event for event in events if event is not None), forgotten)

    def _keyframes_to_prune(
        self, leaf: HypothesisEstimate, event: AreaEvent | None, newest: int
    ) -> tuple[PrunedKeyframe, ...]:
        """The keyframes of the one hypothesis that may be forgotten now."""
        if event is None:
            return self._redundant_after_leaving(leaf.hypothesis, newest)
        return self._redundant_after_move(leaf.hypothesis, event.area) if event.kind == "moved" else ()

    def _redundant_after_move(self, hypothesis: int, entered: int) -> tuple[PrunedKeyframe, ...]:
        """The robot's own keyframes of the area that it leaves which the one that it is in would not have stored.

        Metric SLAM did, as it does not hold areas whose place is uncertain. Without that an area grew into the next one
        with every pass, by as many keyframes as it takes to notice the move.
        """
        watch, hybrid_map = self._state.partitions[hypothesis], self._replica.maps[hypothesis]
        arc, known = hybrid_map.arc(entered, watch.area), np.array(list(self._keyframes(hypothesis, entered).values()))
        placed = self._keyframes(hypothesis, watch.area)
        if arc is None or not known.size:
            return ()
        first = next(iter(placed))
        return tuple(
            PrunedKeyframe(keyframe, watch.area)
            for keyframe in sorted(watch.new_keyframes & placed.keys() - {first})
            if is_same_viewpoint(se2.between(known, se2.compose(arc.mean, placed[keyframe])), self._filter).any()
        )

    def _redundant_after_leaving(self, hypothesis: int, newest: int) -> tuple[PrunedKeyframe, ...]:
        """The superfluous keyframes of an area that the robot left."""
        if not self._state.prune_queue:
            return ()
        area = min(self._state.prune_queue)
        self._state = replace(self._state, prune_queue=self._state.prune_queue - {area})
        if not self._replica.maps[hypothesis].has_area(area):
            return ()
        placed = self._keyframes(hypothesis, area)
        kept = {
            *list(placed)[:1],
            *(k for k in placed if k > newest - _RECENT),
            *self._state.partitions[hypothesis].new_keyframes,
        }
        return tuple(
            PrunedKeyframe(k, area)
            for k in redundant_keyframes(placed, kept, self._options.keyframes_per_place, self._filter)
        )

    def _sense(self, scan: Scan) -> SensedSpace:
        return SensedSpace.from_scan(scan, self._max_range, self._options.overlap_points)

    def _sensed_space(self, keyframe: int) -> SensedSpace:
        """What is compared of a keyframe's scan, worked out once."""
        if keyframe not in self._sensed_spaces:
            self._sensed_spaces[keyframe] = self._sense(self._replica.scans[keyframe])
        return self._sensed_spaces[keyframe]

    def _find_cut(self, leaf: HypothesisEstimate, newest: int) -> AreaEvent | None:
        """The event that the newest keyframes leave the robot's area, when that has lasted."""
        if not leaf.stored:
            return None
        watch = self._state.partitions[leaf.hypothesis]
        graph = self._graph(watch, leaf.hypothesis, watch.area)
        own = watch.new_keyframes | {newest}
        found = self._policy.find_separation(graph, own, newest, watch.door_tracker)
        watch = replace(
            watch,
            graphs=self._with_graph(watch.graphs, watch.area, graph),
            new_keyframes=own,
            separation_count=watch.separation_count + 1 if found else 0,
        )
        self._state = self._state.with_partition(leaf.hypothesis, watch)
        return self._cut_event(leaf.hypothesis, watch, found)

    def _cut_event(self, hypothesis: int, partition: Partition, found: Separation | None) -> AreaEvent | None:
        if found is None or partition.separation_count < self._options.confirmations:
            return None
        return AreaEvent(hypothesis, "cut", found.keyframes, partition.area, found.ncut)

    def _find_merge(self, hypothesis: int) -> AreaEvent | None:
        """The event that two areas are one, where there is no other hypothesis."""
        hybrid_map = self._replica.maps[hypothesis]
        while self._state.merge_queue and len(self._state.partitions) == 1:
            into, area = pair = min(self._state.merge_queue)
            self._state = replace(self._state, merge_queue=self._state.merge_queue - {pair})
            arc = hybrid_map.arc_value(into, area)
            if arc is None or not arc.closure:
                continue
            joint = self._joined_graph(hypothesis, pair, arc.pose.mean)
            least = joint.min_ncut
            if pair in self._state.partitions[hypothesis].pairs_split_by_door:
                least = self._policy.min_ncut(self._state.graph(joint.graph), joint.second_keyframes)
            if least > self._options.ncut_threshold:
                return AreaEvent(hypothesis, "merged", (), area, least, into)
        return None

    def _joined_graph(self, hypothesis: int, pair: AreaPair, arc: NDArray[np.float64]) -> JoinedGraph:
        """Two areas as one, whose arc is ``arc``; from what was found before, measuring only what is new."""
        watch, (into, area) = self._state.partitions[hypothesis], pair
        other, before = self._keyframes(hypothesis, area), watch.joined_graphs.get(pair)
        placed = dict(self._keyframes(hypothesis, into))
        placed |= {keyframe: se2.compose(arc, pose) for keyframe, pose in other.items()}
        known = [self._state.graph(watch.graphs.get(one)) for one in pair]
        if before is not None and before.max_displacement(arc, other) < _REMEASURE_SHARE * self._options.overlap_radius:
            graph_before = self._state.graph(before.graph)
            if before.second_keyframes == other.keys() and set(graph_before.keyframes) == placed.keys():
                return before
            arc, known = before.arc, [graph_before, *known]
        graph = self._synchronize_graph(placed, *known)
        least = min_ncut(graph, other, self._options.min_cluster)
        joint = JoinedGraph(arc, self._add_graph(graph), frozenset(other), least)
        watch = replace(watch, joined_graphs={**watch.joined_graphs, pair: joint})
        self._state = self._state.with_partition(hypothesis, watch)
        return joint

    def _find_move(self, leaf: HypothesisEstimate, newest: int) -> AreaEvent | None:
        """The event that the robot went into a known area one arc away, when that has lasted.

        The margin by which the other area has to overlap more keeps the robot from going back and forth at a border.
        Keyframes that the robot stored in the area it leaves stay there.
        """
        watch = self._state.partitions[leaf.hypothesis]
        shares = self._area_overlaps(leaf, newest)
        best = max(shares, key=lambda area: (shares[area], -area))
        inside = best == watch.area or shares[best] < shares[watch.area] + self._options.move_margin
        times = (
            1
            if watch.overlap_candidate is None or watch.overlap_candidate[0] != best
            else watch.overlap_candidate[1] + 1
        )
        watch = replace(watch, overlap_candidate=None if inside else (best, times))
        self._state = self._state.with_partition(leaf.hypothesis, watch)
        if inside or times < self._options.confirmations:
            return None
        return AreaEvent(leaf.hypothesis, "moved", (), best, shares[best])

    def _area_overlaps(self, leaf: HypothesisEstimate, newest: int) -> dict[int, float]:
        """Overlap of the newest scan with the robot's area and with those one arc away."""
        hybrid_map, here = self._replica.maps[leaf.hypothesis], leaf.area
        shares = {here: self._area_overlap(hybrid_map, here, leaf.pose.mean, newest)}
        for area in hybrid_map.neighbors(here):
            arc = informative_arc(hybrid_map, area, here)
            if arc is not None:
                shares[area] = self._area_overlap(hybrid_map, area, se2.compose(arc.mean, leaf.pose.mean), newest)
        return shares

    def _area_overlap(self, hybrid_map: HybridMap, area: int, pose: NDArray[np.float64], newest: int) -> float:
        """Overlap of the newest scan, taken at ``pose`` = ``area_T_base``, with an area."""
        placed = hybrid_map.keyframes(area)
        others = [keyframe for keyframe in placed if keyframe != newest]
        if not others:
            return 0.0
        poses = np.array([placed[keyframe] for keyframe in others])
        nearest = np.argsort(np.hypot(*(poses[:, :2] - pose[:2]).T), kind="stable")[:_NEAREST]
        found = sensed_overlaps(
            self._sensed_space(newest),
            pose,
            [self._sensed_space(others[i]) for i in nearest],
            poses[nearest],
            self._options.overlap_radius,
        )
        return float(np.sort(found)[-_BEST:].mean())

    def _update_partition(self, leaf: Hypothesis) -> Partition:
        """The watch over a hypothesis after TSBI's answer."""
        watch = self._state.partitions[leaf.parent]
        if leaf.area_merge is not None:
            return self._merge_in_partition(watch, leaf, leaf.area_merge)
        if leaf.area == watch.area:
            return replace(watch, door_tracker=watch.door_tracker.break_path()) if leaf.removed_arcs else watch
        moved = frozenset(r.keyframe for r in leaf.moved_keyframes if r.area == leaf.area)
        entered = self._graph(watch, leaf.id, leaf.area)
        left = self._state.graph(watch.graphs.get(watch.area)).subgraph(self._keyframes(leaf.id, watch.area))
        beside = self._replica.maps[leaf.id].neighbors(watch.area)
        self._state = replace(
            self._state,
            merge_queue=self._state.merge_queue | {area_pair(watch.area, other) for other in beside},
            prune_queue=self._state.prune_queue | {watch.area},
        )
        graphs = self._with_graph(self._with_graph(watch.graphs, watch.area, left), leaf.area, entered)
        way, parted = (
            DoorTracker() if leaf.frame_change is None else watch.door_tracker.transform(leaf.frame_change.mean),
            watch.pairs_split_by_door,
        )
        if moved and watch.door_tracker.segment_labels(moved)[max(moved)] != 0:
            parted |= {area_pair(watch.area, leaf.area)}
        way = way.keep_crossings_after(min(moved, default=None))
        return Partition(
            leaf.area, graphs, moved, joined_graphs=watch.joined_graphs, door_tracker=way, pairs_split_by_door=parted
        )

    def _merge_in_partition(self, partition: Partition, leaf: Hypothesis, merged: AreaMerge) -> Partition:
        """The watch with one area for two; what was the robot's own in one of them still is."""
        merge_queue = frozenset(pair for pair in self._state.merge_queue if merged.area not in pair)
        self._state = replace(self._state, merge_queue=merge_queue)
        graphs = {area: number for area, number in partition.graphs.items() if area != merged.area}
        one, other = (self._state.graph(partition.graphs.get(area)) for area in (merged.into, merged.area))
        whole = self._synchronize_graph(self._keyframes(leaf.id, merged.into), one, other)
        joints = {pair: joint for pair, joint in partition.joined_graphs.items() if merged.area not in pair}
        way = (
            partition.door_tracker
            if leaf.area == partition.area
            else partition.door_tracker.transform(merged.pose.mean)
        )
        named = (
            {merged.into if area == merged.area else area for area in pair} for pair in partition.pairs_split_by_door
        )
        parted = frozenset((min(pair), max(pair)) for pair in named if len(pair) == 2)
        return replace(
            partition,
            area=leaf.area,
            graphs=self._with_graph(graphs, merged.into, whole),
            overlap_candidate=None,
            joined_graphs=joints,
            door_tracker=way,
            pairs_split_by_door=parted,
        )

    def _with_graph(self, graphs: Mapping[int, int], area: int, graph: OverlapGraph) -> dict[int, int]:
        """{area: number of its overlap graph} where that of one area is this."""
        if area in graphs and self._state.graphs[graphs[area]] is graph:
            return dict(graphs)
        return {**graphs, area: self._add_graph(graph)}

    def _add_graph(self, graph: OverlapGraph) -> int:
        """The number under which a graph is held now."""
        number = max(self._state.graphs, default=-1) + 1
        self._state = replace(self._state, graphs={**self._state.graphs, number: graph})
        return number

    def _graph(self, partition: Partition, hypothesis: int, area: int) -> OverlapGraph:
        """The overlap graph of an area as it is now, from what the watch knows."""
        known = [self._state.graph(partition.graphs.get(one)) for one in (area, partition.area)]
        return self._synchronize_graph(self._keyframes(hypothesis, area), *known)

    def _keyframes(self, hypothesis: int, area: int) -> KeyframePoses:
        return self._replica.maps[hypothesis].keyframes(area)

    def _synchronize_graph(self, placed: KeyframePoses, graph: OverlapGraph, *others: OverlapGraph) -> OverlapGraph:
        """The overlap graph of keyframes, {keyframe: pose}, measuring only what none of the graphs holds."""

        def measure(keyframe: int, others: tuple[int, ...]) -> NDArray[np.float64]:
            poses = np.array([placed[other] for other in others]).reshape(-1, 3)
            seen = [self._sensed_space(other).points for other in others]
            return overlaps(
                self._sensed_space(keyframe).points, placed[keyframe], seen, poses, self._options.overlap_radius
            )

        return synchronize_graph(graph, placed, measure, *others)
