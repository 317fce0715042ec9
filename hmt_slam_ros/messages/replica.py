"""The maps of all live hypotheses, kept up to date in every process from the messages that it hears."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import CommonMap, GraphState, HybridMap
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, AreaPose, MovedKeyframe
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, Keyframe
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.scan import BeamRevision

FIRST_HYPOTHESIS = 0
FIRST_AREA = 0


@dataclass(frozen=True, eq=False)
class ReplicaState:
    """The maps of all live hypotheses, at first one in which nothing is known.

    :ivar scans: {keyframe: scan}.
    :ivar common: the areas and arcs that all hypotheses agree on.
    :ivar max_area_id: the largest area that there ever was among these, -1 where there was none.
    :ivar changes: {hypothesis: the areas in which it differs from ``common``, whole, and likewise the arcs}.
    :ivar probabilities: {hypothesis: P(gamma^t | d)}.
    :ivar robot_areas: {hypothesis: the robot's area}.
    """

    scans: Mapping[int, Scan] = field(default_factory=dict)
    common: GraphState = field(default_factory=GraphState.empty)
    max_area_id: int = -1
    changes: Mapping[int, GraphState] = field(default_factory=lambda: {FIRST_HYPOTHESIS: GraphState.empty()})
    probabilities: Mapping[int, float] = field(default_factory=lambda: {FIRST_HYPOTHESIS: 1.0})
    robot_areas: Mapping[int, int] = field(default_factory=lambda: {FIRST_HYPOTHESIS: FIRST_AREA})


@dataclass
class Replica:
    """Scans of the keyframes, and the HMT map and probability of every live hypothesis.

    :ivar scans: {keyframe: scan} of the keyframes stored under at least one hypothesis when they came.
    :ivar maps: {hypothesis: map}.
    :ivar probabilities: {hypothesis: P(gamma^t | d)}.
    :ivar robot_areas: {hypothesis: the robot's area}.
    :ivar contested: keyframes stored while there were several hypotheses, of which it may be that only some did.
    """

    scans: dict[int, Scan] = field(default_factory=dict)
    maps: dict[int, HybridMap] = field(default_factory=lambda: {FIRST_HYPOTHESIS: HybridMap()})
    probabilities: dict[int, float] = field(default_factory=lambda: {FIRST_HYPOTHESIS: 1.0})
    robot_areas: dict[int, int] = field(default_factory=lambda: {FIRST_HYPOTHESIS: FIRST_AREA})
    contested: set[int] = field(default_factory=set)

    @classmethod
    def from_state(cls, state: ReplicaState) -> Replica:
        """The replica of a state."""
        common = CommonMap()
        for area, keyframes in state.common.area_keyframes().items():
            common.set_area(area, keyframes)
        for pair, arc in state.common.arc_values().items():
            assert arc is not None
            common.set_arc(pair, arc)
        common.max_area_id = state.max_area_id
        maps = {h: HybridMap(common, own.area_keyframes(), own.arc_values()) for h, own in state.changes.items()}
        agreed = {keyframe for keyframes in common.areas.values() for keyframe in keyframes}
        contested = state.scans.keys() - agreed
        return cls(dict(state.scans), maps, dict(state.probabilities), dict(state.robot_areas), contested)

    @property
    def state(self) -> ReplicaState:
        """All of it as a value."""
        common = next(iter(self.maps.values())).common
        return ReplicaState(
            dict(self.scans),
            GraphState.from_areas_and_arcs(common.areas, common.arcs),
            common.max_area_id,
            {
                hypothesis: GraphState.from_areas_and_arcs(own.changed_areas, own.changed_arcs)
                for hypothesis, own in self.maps.items()
            },
            dict(self.probabilities),
            dict(self.robot_areas),
        )

    @property
    def best_hypothesis(self) -> int:
        """The most probable hypothesis; of equals the oldest."""
        return min(self.probabilities, key=lambda h: (-self.probabilities[h], h))

    def apply_message(self, message: Keyframe | Hypotheses | ClosureDecision) -> None:
        """Take in a message of the chain, for one who has no decision in it."""
        match message:
            case Keyframe():
                self.add_keyframe(message)
            case Hypotheses():
                self.apply_hypotheses(message)
            case ClosureDecision():
                self.apply_decision(message)

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Store a keyframe in the maps of the hypotheses that want it."""
        for leaf in keyframe.estimates:
            if leaf.hypothesis in self.maps:
                self.apply_changes(self.maps[leaf.hypothesis], leaf.revised_keyframes)
            if leaf.stored and leaf.hypothesis in self.maps:
                self.maps[leaf.hypothesis].set_keyframe(keyframe.sequence, leaf.area, leaf.pose.mean)
                self.scans[keyframe.sequence] = keyframe.scan
                if len(self.maps) > 1:
                    self.contested.add(keyframe.sequence)

    def apply_hypotheses(self, hypotheses: Hypotheses) -> None:
        """Branch, change and drop hypotheses as TSBI decided."""
        self.maps = {leaf.id: self._child_map(leaf) for leaf in hypotheses.hypotheses}
        self.probabilities = {leaf.id: leaf.probability for leaf in hypotheses.hypotheses}
        self.robot_areas = {leaf.id: leaf.area for leaf in hypotheses.hypotheses}
        for late in hypotheses.stale_beams:
            if late.keyframe in self.scans:
                revision = BeamRevision(late.removed, late.occluded, late.starts)
                self.scans[late.keyframe] = self.scans[late.keyframe].revise(revision)
        for one in hypotheses.pruned_keyframes:
            for hybrid_map in self.maps.values():
                hybrid_map.remove_keyframe(one.keyframe, one.area)
            del self.scans[one.keyframe]
            self.contested.discard(one.keyframe)

    def _child_map(self, leaf: Hypothesis) -> HybridMap:
        parent = self.maps[leaf.parent]
        child = parent if leaf.id == leaf.parent else parent.branch()
        self.apply_changes(child, leaf.moved_keyframes, leaf.arcs, leaf.removed_arcs)
        if leaf.area_merge is not None:
            child.merge(leaf.area_merge.area, leaf.area_merge.into, leaf.area_merge.pose)
        return child

    def apply_decision(self, accepted: ClosureDecision) -> None:
        """Make one hypothesis definite and drop the others."""
        if accepted.hypothesis is None:
            return
        chosen = self.maps[accepted.hypothesis]
        self.apply_changes(chosen, accepted.moved_keyframes, accepted.arcs)
        chosen.commit()
        self._drop_contested(chosen)
        self.maps = {accepted.hypothesis: chosen}
        self.probabilities = {accepted.hypothesis: 1.0}
        self.robot_areas = {accepted.hypothesis: self.robot_areas[accepted.hypothesis]}

    def _drop_contested(self, hybrid_map: HybridMap) -> None:
        """Forget the scans that were stored under hypotheses that are no more, when the map of one is left."""
        for keyframe in self.contested:
            if not any(keyframe in keyframes for keyframes in hybrid_map.common.areas.values()):
                del self.scans[keyframe]
        self.contested = set()

    @staticmethod
    def apply_changes(
        hybrid_map: HybridMap,
        relabelled: tuple[MovedKeyframe, ...],
        arcs: tuple[Arc, ...] = (),
        withdrawn: tuple[ArcEnds, ...] = (),
    ) -> None:
        """Move keyframes, take arcs out and set arcs, as a message says."""
        for r in relabelled:
            if r.previous_area != r.area:
                hybrid_map.remove_keyframe(r.keyframe, r.previous_area)
            hybrid_map.set_keyframe(r.keyframe, r.area, r.pose)
        for ends in withdrawn:
            hybrid_map.remove_arc(ends.source, ends.target)
        for arc in arcs:
            hybrid_map.set_arc(arc.source, arc.target, arc.pose, closure=arc.closure)


class GlobalPoses(Mapping[int, PoseGaussian]):
    """{area: belief over ``map_T_area``}; taking over a message costs the same however many areas it has."""

    def __init__(self, areas: Sequence[AreaPose] = ()) -> None:
        """:param areas: ordered by id, as ``ClosureDecision.global_poses`` is."""
        self._areas = areas

    @property
    def areas(self) -> tuple[AreaPose, ...]:
        """All of them, ordered by id."""
        return tuple(self._areas)

    def __getitem__(self, area: int) -> PoseGaussian:
        place = bisect_left(self._areas, area, key=attrgetter("area"))
        if place == len(self._areas) or self._areas[place].area != area:
            raise KeyError(area)
        return self._areas[place].pose

    def __iter__(self) -> Iterator[int]:
        return (entry.area for entry in self._areas)

    def __len__(self) -> int:
        return len(self._areas)
