"""Area Abstraction Mechanism: when do the newest keyframes no longer belong to the area, and which known one is this?

A hypothesis is one topological path, so "once for every group of particles with the same path" is once for every leaf.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.area_abstraction.doors import OpeningDetector, Way
from hmt_slam_ros.area_abstraction.overlap import Sensed, overlaps, sensed_overlaps
from hmt_slam_ros.area_abstraction.overlap_graph import OverlapGraph, Separation, least_cut, synchronised
from hmt_slam_ros.area_abstraction.partition import AamState, AreaPolicy, Joint, Watch, numbered, watch_of
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.common_map import Keyframes, Pair
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.keyframe_pruning import crowded, in_place
from hmt_slam_ros.hybrid_map.shortest_path import telling_arc
from hmt_slam_ros.messages.map_changes import Forgotten, Merged
from hmt_slam_ros.messages.messages import (
    Accepted,
    AreaEvent,
    AreaEvents,
    Hypotheses,
    Keyframe,
    Leaf,
    LeafEstimate,
    Message,
)
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.sensors import Scan

# An area's overlap with a scan is that of the best few keyframes among those taken nearest to it.
_NEAREST, _BEST = 8, 3
# Keyframes that one place of an area may hold, and keyframe events for which all that is new stays.
_MOST_IN_PLACE, _RECENT = 2, 30
# Where an arc moved keyframes by less than this share of the radius of overlap, overlaps are not measured again.
_UNMOVED = 0.1


class Aam:
    """Answers every keyframe event with the areas that were left.

    The overlap of two keyframes is measured once, when the later one joins the area of the earlier one, and inherited
    by the hypotheses that branch off. It is not measured again when metric SLAM or TLCA corrects poses: a correction
    within an area is small against the radius of overlap. Between two areas it is when the arc between them moved.

    A cut and a move have to be found at ``aam.persistence`` evaluations in a row, so that one poor scan does nothing.

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
        self._replica = Replica.of(state.replica)
        self._seen: dict[int, Sensed] = {}
        self._watches = {hypothesis: watch_of(own, state.graphs) for hypothesis, own in state.watches.items()}
        self._asked = set(state.asked)
        self._left = set(state.left)

    @property
    def state(self) -> AamState:
        """All that the AAM knows, as a value."""
        known = self._watches.values()
        graphs = {id(graph): graph for watch in known for graph in watch.graphs.values()}
        graphs |= {id(joint.graph): joint.graph for watch in known for joint in watch.joints.values()}
        numbers = {name: number for number, name in enumerate(graphs)}
        watches = {hypothesis: numbered(watch, numbers) for hypothesis, watch in self._watches.items()}
        asked, left = frozenset(self._asked), frozenset(self._left)
        return AamState(self._replica.state, tuple(graphs.values()), watches, asked, left)

    def handle(self, message: Message) -> list[Message]:
        """Answer a ``Keyframe`` with its ``AreaEvents``; learn from ``Hypotheses`` and ``Accepted``."""
        if isinstance(message, Keyframe):
            return [self._examine(message)]
        if isinstance(message, Hypotheses):
            self._replica.apply(message)
            self._watches = {leaf.hypothesis: self._follow(leaf) for leaf in message.leaves}
            self._forget({one.keyframe for one in message.forgotten})
            for late in message.outdated:
                self._seen.pop(late.keyframe, None)
        elif isinstance(message, Accepted) and message.hypothesis is not None:
            self._replica.accept(message)
            self._watches = {message.hypothesis: self._watches[message.hypothesis]}
            if message.relabelled:
                self._interrupt(message.hypothesis)
            self._asked |= {(min(arc.source, arc.target), max(arc.source, arc.target)) for arc in message.arcs}
            if message.reopened:
                self._asked = set()
                self._watches = {one: replace(watch, joints={}) for one, watch in self._watches.items()}
        return []

    def _examine(self, keyframe: Keyframe) -> AreaEvents:
        self._replica.add(keyframe)
        self._seen[keyframe.sequence] = self._sensed(keyframe.scan)
        known = [leaf for leaf in keyframe.leaves if leaf.hypothesis in self._watches]
        self._watches |= self._policy.seen(keyframe, known, self._replica, self._watches)
        events = [
            self._cut(leaf, keyframe.sequence)
            or (self._merged(leaf.hypothesis) if keyframe.mapping else None)
            or self._moved(leaf, keyframe.sequence)
            for leaf in known
        ]
        if not any(leaf.stored for leaf in known):
            del self._seen[keyframe.sequence]
        may_forget = keyframe.mapping and len(self._watches) == 1
        forgotten = self._superfluous(known[0], events[0], keyframe.sequence) if may_forget else ()
        return AreaEvents(keyframe.sequence, tuple(event for event in events if event is not None), forgotten)

    def _superfluous(self, leaf: LeafEstimate, event: AreaEvent | None, newest: int) -> tuple[Forgotten, ...]:
        """The keyframes of the one hypothesis that may be forgotten now."""
        if event is None:
            return self._crowded(leaf.hypothesis, newest)
        return self._passed_again(leaf.hypothesis, event.area) if event.kind == "moved" else ()

    def _passed_again(self, hypothesis: int, entered: int) -> tuple[Forgotten, ...]:
        """The robot's own keyframes of the area that it leaves which the one that it is in would not have stored.

        Metric SLAM did, as it does not hold areas whose place is uncertain. Without that an area grew into the next one
        with every pass, by as many keyframes as it takes to notice the move.
        """
        watch, hybrid_map = self._watches[hypothesis], self._replica.maps[hypothesis]
        arc, known = hybrid_map.arc(entered, watch.area), np.array(list(self._keyframes(hypothesis, entered).values()))
        placed = self._keyframes(hypothesis, watch.area)
        if arc is None or not known.size:
            return ()
        first = next(iter(placed))
        return tuple(
            Forgotten(keyframe, watch.area)
            for keyframe in sorted(watch.own & placed.keys() - {first})
            if in_place(se2.between(known, se2.compose(arc.mean, placed[keyframe])), self._filter).any()
        )

    def _crowded(self, hypothesis: int, newest: int) -> tuple[Forgotten, ...]:
        """The superfluous keyframes of an area that the robot left."""
        if not self._left:
            return ()
        area = min(self._left)
        self._left.discard(area)
        if not self._replica.maps[hypothesis].has_area(area):
            return ()
        placed = self._keyframes(hypothesis, area)
        kept = {*list(placed)[:1], *(k for k in placed if k > newest - _RECENT), *self._watches[hypothesis].own}
        return tuple(Forgotten(k, area) for k in crowded(placed, kept, _MOST_IN_PLACE, self._filter))

    def _forget(self, keyframes: set[int]) -> None:
        """Go on without what the maps do not hold any more."""
        if not keyframes:
            return
        for keyframe in keyframes:
            self._seen.pop(keyframe, None)
        for hypothesis, watch in self._watches.items():
            held = {area: graph.without(keyframes) for area, graph in watch.graphs.items()}
            self._watches[hypothesis] = replace(watch, graphs=held, own=watch.own - keyframes)

    def _sensed(self, scan: Scan) -> Sensed:
        return Sensed.of(scan, self._max_range, self._options.overlap_points)

    def _seen_by(self, keyframe: int) -> Sensed:
        """What is compared of a keyframe's scan, worked out once."""
        if keyframe not in self._seen:
            self._seen[keyframe] = self._sensed(self._replica.scans[keyframe])
        return self._seen[keyframe]

    def _cut(self, leaf: LeafEstimate, newest: int) -> AreaEvent | None:
        """The event that the newest keyframes leave the robot's area, when that has lasted."""
        if not leaf.stored:
            return None
        watch = self._watches[leaf.hypothesis]
        graph = self._graph(watch, leaf.hypothesis, watch.area)
        own = watch.own | {newest}
        found = self._policy.separation(graph, own, newest, watch.way)
        watch = replace(
            watch, graphs=watch.graphs | {watch.area: graph}, own=own, separate=watch.separate + 1 if found else 0
        )
        self._watches[leaf.hypothesis] = watch
        return self._cut_event(leaf.hypothesis, watch, found)

    def _cut_event(self, hypothesis: int, watch: Watch, found: Separation | None) -> AreaEvent | None:
        if found is None or watch.separate < self._options.persistence:
            return None
        return AreaEvent(hypothesis, "cut", found.keyframes, watch.area, found.ncut)

    def _merged(self, hypothesis: int) -> AreaEvent | None:
        """The event that two areas are one, where there is no other hypothesis."""
        hybrid_map = self._replica.maps[hypothesis]
        while self._asked and len(self._watches) == 1:
            into, area = pair = min(self._asked)
            self._asked.discard(pair)
            arc = hybrid_map.arc_value(into, area)
            if arc is None or not arc.closure:
                continue
            joint = self._joint(hypothesis, pair, arc.pose.mean)
            least = self._policy.least_cut(joint) if pair in self._watches[hypothesis].parted else joint.least
            if least > self._options.ncut_threshold:
                return AreaEvent(hypothesis, "merged", (), area, least, into)
        return None

    def _joint(self, hypothesis: int, pair: Pair, arc: NDArray[np.float64]) -> Joint:
        """Two areas as one, whose arc is ``arc``; from what was found before, measuring only what is new."""
        watch, (into, area) = self._watches[hypothesis], pair
        other, before = self._keyframes(hypothesis, area), watch.joints.get(pair)
        placed = dict(self._keyframes(hypothesis, into))
        placed |= {keyframe: se2.compose(arc, pose) for keyframe, pose in other.items()}
        known = [watch.graphs.get(one, OverlapGraph()) for one in pair]
        if before is not None and before.moved(arc, other) < _UNMOVED * self._options.overlap_radius:
            if before.part == other.keys() and set(before.graph.keyframes) == placed.keys():
                return before
            arc, known = before.arc, [before.graph, *known]
        graph = self._synchronised(placed, *known)
        joint = Joint(arc, graph, frozenset(other), least_cut(graph, other, self._options.min_cluster))
        self._watches[hypothesis] = replace(watch, joints=watch.joints | {pair: joint})
        return joint

    def _moved(self, leaf: LeafEstimate, newest: int) -> AreaEvent | None:
        """The event that the robot went into a known area one arc away, when that has lasted.

        The margin by which the other area has to overlap more keeps the robot from going back and forth at a border.
        Keyframes that the robot stored in the area it leaves stay there.
        """
        watch = self._watches[leaf.hypothesis]
        shares = self._shares(leaf, newest)
        best = max(shares, key=lambda area: (shares[area], -area))
        inside = best == watch.area or shares[best] < shares[watch.area] + self._options.move_margin
        times = 1 if watch.beyond is None or watch.beyond[0] != best else watch.beyond[1] + 1
        self._watches[leaf.hypothesis] = replace(watch, beyond=None if inside else (best, times))
        if inside or times < self._options.persistence:
            return None
        return AreaEvent(leaf.hypothesis, "moved", (), best, shares[best])

    def _shares(self, leaf: LeafEstimate, newest: int) -> dict[int, float]:
        """Overlap of the newest scan with the robot's area and with those one arc away."""
        hybrid_map, here = self._replica.maps[leaf.hypothesis], leaf.area
        shares = {here: self._share(hybrid_map, here, leaf.pose.mean, newest)}
        for area in hybrid_map.neighbours(here):
            arc = telling_arc(hybrid_map, area, here)
            if arc is not None:
                shares[area] = self._share(hybrid_map, area, se2.compose(arc.mean, leaf.pose.mean), newest)
        return shares

    def _share(self, hybrid_map: HybridMap, area: int, pose: NDArray[np.float64], newest: int) -> float:
        """Overlap of the newest scan, taken at ``pose`` = ``area_T_base``, with an area."""
        placed = hybrid_map.keyframes(area)
        others = [keyframe for keyframe in placed if keyframe != newest]
        if not others:
            return 0.0
        poses = np.array([placed[keyframe] for keyframe in others])
        nearest = np.argsort(np.hypot(*(poses[:, :2] - pose[:2]).T), kind="stable")[:_NEAREST]
        found = sensed_overlaps(
            self._seen_by(newest),
            pose,
            [self._seen_by(others[i]) for i in nearest],
            poses[nearest],
            self._options.overlap_radius,
        )
        return float(np.sort(found)[-_BEST:].mean())

    def _follow(self, leaf: Leaf) -> Watch:
        """The watch over a hypothesis after TSBI's answer."""
        watch = self._watches[leaf.parent]
        if leaf.merged is not None:
            return self._follow_merged(watch, leaf, leaf.merged)
        if leaf.area == watch.area:
            return replace(watch, way=watch.way.interrupted()) if leaf.withdrawn else watch
        moved = frozenset(r.keyframe for r in leaf.relabelled if r.area == leaf.area)
        entered = self._graph(watch, leaf.hypothesis, leaf.area)
        left = watch.graphs.get(watch.area, OverlapGraph()).only(self._keyframes(leaf.hypothesis, watch.area))
        beside = self._replica.maps[leaf.hypothesis].neighbours(watch.area)
        self._asked |= {(min(watch.area, other), max(watch.area, other)) for other in beside}
        self._left.add(watch.area)
        graphs = watch.graphs | {watch.area: left, leaf.area: entered}
        way, parted = Way() if leaf.rebase is None else watch.way.in_frame(leaf.rebase.mean), watch.parted
        if moved and watch.way.chambers(moved)[max(moved)] != 0:
            parted |= {(min(watch.area, leaf.area), max(watch.area, leaf.area))}
        way = way.since(min(moved, default=None))
        return Watch(leaf.area, graphs, moved, joints=watch.joints, way=way, parted=parted)

    def _follow_merged(self, watch: Watch, leaf: Leaf, merged: Merged) -> Watch:
        """The watch with one area for two; what was the robot's own in one of them still is."""
        self._asked = {pair for pair in self._asked if merged.area not in pair}
        graphs = {area: graph for area, graph in watch.graphs.items() if area != merged.area}
        one, other = (watch.graphs.get(area, OverlapGraph()) for area in (merged.into, merged.area))
        graphs[merged.into] = self._synchronised(self._keyframes(leaf.hypothesis, merged.into), one, other)
        joints = {pair: joint for pair, joint in watch.joints.items() if merged.area not in pair}
        way = watch.way if leaf.area == watch.area else watch.way.in_frame(merged.pose.mean)
        named = ({merged.into if area == merged.area else area for area in pair} for pair in watch.parted)
        parted = frozenset((min(pair), max(pair)) for pair in named if len(pair) == 2)
        return replace(watch, area=leaf.area, graphs=graphs, beyond=None, joints=joints, way=way, parted=parted)

    def _interrupt(self, hypothesis: int) -> None:
        """Keyframes of a hypothesis moved, and the robot with them."""
        watch = self._watches[hypothesis]
        self._watches[hypothesis] = replace(watch, way=watch.way.interrupted())

    def _graph(self, watch: Watch, hypothesis: int, area: int) -> OverlapGraph:
        """The overlap graph of an area as it is now, from what the watch knows."""
        known = [watch.graphs.get(one, OverlapGraph()) for one in (area, watch.area)]
        return self._synchronised(self._keyframes(hypothesis, area), *known)

    def _keyframes(self, hypothesis: int, area: int) -> Keyframes:
        return self._replica.maps[hypothesis].keyframes(area)

    def _synchronised(self, placed: Keyframes, graph: OverlapGraph, *others: OverlapGraph) -> OverlapGraph:
        """The overlap graph of keyframes, {keyframe: pose}, measuring only what none of the graphs holds."""

        def measure(keyframe: int, others: tuple[int, ...]) -> NDArray[np.float64]:
            poses = np.array([placed[other] for other in others]).reshape(-1, 3)
            seen = [self._seen_by(other).points for other in others]
            return overlaps(self._seen_by(keyframe).points, placed[keyframe], seen, poses, self._options.overlap_radius)

        return synchronised(graph, placed, measure, *others)
