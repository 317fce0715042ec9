"""The replica: the maps of all live hypotheses, which each process updates from the messages of the chain."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import CommonMap, GraphState, HybridMap
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, AreaPose, ForeignGround, MovedKeyframe
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, Keyframe
from hmt_slam_ros.messages.statements import WeighedStatement
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.scan import BeamRevision

FIRST_HYPOTHESIS = 0
"""Id of the only hypothesis at the start."""

FIRST_AREA = 0
"""Id of the only area at the start."""

_RECENT_SCANS = 100
"""Scans of the last keyframes, whose points are kept."""


@dataclass(frozen=True, eq=False)
class ReplicaState:
    """The maps of all live hypotheses, by default one empty map.

    :ivar scans: {keyframe: scan}.
    :ivar common: areas and arcs of the common map.
    :ivar max_area_id: largest id of an area that was ever in the common map, -1 for none.
    :ivar changes: {hypothesis: areas and arcs that differ from ``common``}.
    :ivar probabilities: {hypothesis: P(gamma^t | d)}.
    :ivar robot_areas: {hypothesis: the robot's area}.
    :ivar statements: what people stated about places, in order.
    """

    scans: Mapping[int, Scan] = field(default_factory=dict)
    common: GraphState = field(default_factory=GraphState.empty)
    max_area_id: int = -1
    changes: Mapping[int, GraphState] = field(default_factory=lambda: {FIRST_HYPOTHESIS: GraphState.empty()})
    probabilities: Mapping[int, float] = field(default_factory=lambda: {FIRST_HYPOTHESIS: 1.0})
    robot_areas: Mapping[int, int] = field(default_factory=lambda: {FIRST_HYPOTHESIS: FIRST_AREA})
    statements: tuple[WeighedStatement, ...] = ()


@dataclass
class Replica:
    """Scans of the keyframes, and the HMT map and probability of every live hypothesis.

    :ivar scans: {keyframe: scan} of the keyframes stored under at least one hypothesis when they came.
    :ivar maps: {hypothesis: map}.
    :ivar probabilities: {hypothesis: P(gamma^t | d)}.
    :ivar robot_areas: {hypothesis: the robot's area}.
    :ivar contested: keyframes that were stored while there were several hypotheses, perhaps under some of them only.
    :ivar statements: what people stated about places, in order.
    """

    scans: dict[int, Scan] = field(default_factory=dict)
    maps: dict[int, HybridMap] = field(default_factory=lambda: {FIRST_HYPOTHESIS: HybridMap()})
    probabilities: dict[int, float] = field(default_factory=lambda: {FIRST_HYPOTHESIS: 1.0})
    robot_areas: dict[int, int] = field(default_factory=lambda: {FIRST_HYPOTHESIS: FIRST_AREA})
    contested: set[int] = field(default_factory=set)
    statements: tuple[WeighedStatement, ...] = ()
    _recent_scans: deque[Scan] = field(default_factory=deque)

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
        maps = {
            h: HybridMap(common, change.area_keyframes(), change.arc_values()) for h, change in state.changes.items()
        }
        definite = {keyframe for keyframes in common.areas.values() for keyframe in keyframes}
        contested = state.scans.keys() - definite
        probabilities, areas = dict(state.probabilities), dict(state.robot_areas)
        return cls(dict(state.scans), maps, probabilities, areas, contested, state.statements)

    @property
    def state(self) -> ReplicaState:
        """The replica as a value."""
        common = next(iter(self.maps.values())).common
        return ReplicaState(
            dict(self.scans),
            GraphState.from_areas_and_arcs(common.areas, common.arcs),
            common.max_area_id,
            {
                hypothesis: GraphState.from_areas_and_arcs(hybrid_map.changed_areas, hybrid_map.changed_arcs)
                for hypothesis, hybrid_map in self.maps.items()
            },
            dict(self.probabilities),
            dict(self.robot_areas),
            self.statements,
        )

    @property
    def best_hypothesis(self) -> int:
        """The most probable hypothesis; of equal ones the oldest."""
        return min(self.probabilities, key=lambda h: (-self.probabilities[h], h))

    def apply_message(self, message: Keyframe | Hypotheses | ClosureDecision) -> None:
        """Apply a message of the chain."""
        match message:
            case Keyframe():
                self.add_keyframe(message)
            case Hypotheses():
                self.apply_hypotheses(message)
            case ClosureDecision():
                self.apply_decision(message)

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Store a keyframe in the maps of the hypotheses under which it is stored."""
        for estimate in keyframe.estimates:
            hybrid_map = self.maps.get(estimate.hypothesis)
            if hybrid_map is None:
                continue
            self.apply_changes(hybrid_map, estimate.revised_keyframes)
            if estimate.stored:
                hybrid_map.set_keyframe(keyframe.sequence, estimate.area, estimate.pose.mean)
                self.scans[keyframe.sequence] = keyframe.scan
                self._keep_in_few_bytes(keyframe.scan)
                if len(self.maps) > 1:
                    self.contested.add(keyframe.sequence)

    def _keep_in_few_bytes(self, scan: Scan) -> None:
        """Keep the points of a new keyframe, and let those of an earlier one be forgotten."""
        self._recent_scans.append(scan)
        if len(self._recent_scans) > _RECENT_SCANS:
            self._recent_scans.popleft().forget_points()

    def apply_hypotheses(self, hypotheses: Hypotheses) -> None:
        """Branch, change and drop hypotheses, revise scans and prune keyframes."""
        self.maps = {h.id: self._child_map(h) for h in hypotheses.hypotheses}
        self.probabilities = {h.id: h.probability for h in hypotheses.hypotheses}
        self.robot_areas = {h.id: h.area for h in hypotheses.hypotheses}
        self.statements = hypotheses.statements
        for stale in hypotheses.stale_beams:
            if stale.keyframe in self.scans:
                revision = BeamRevision(stale.removed, stale.occluded, stale.starts)
                self.scans[stale.keyframe] = self.scans[stale.keyframe].revise(revision)
        for pruned in hypotheses.pruned_keyframes:
            for hybrid_map in self.maps.values():
                hybrid_map.remove_keyframe(pruned.keyframe, pruned.area)
            del self.scans[pruned.keyframe]
            self.contested.discard(pruned.keyframe)

    def _child_map(self, hypothesis: Hypothesis) -> HybridMap:
        parent, merge = self.maps[hypothesis.parent], hypothesis.area_merge
        child = parent if hypothesis.id == hypothesis.parent else parent.branch()
        self.apply_changes(child, hypothesis.moved_keyframes, hypothesis.arcs, hypothesis.removed_arcs)
        if merge is not None:
            child.merge(merge.area, merge.into, merge.pose)
        return child

    def apply_decision(self, decision: ClosureDecision) -> None:
        """Make the accepted hypothesis definite and drop the others, where there is one."""
        if decision.hypothesis is None:
            return
        chosen = self.maps[decision.hypothesis]
        self.apply_changes(chosen, decision.moved_keyframes, decision.arcs)
        if decision.foreign_ground is not None:
            self._add_foreign_ground(chosen, decision.foreign_ground)
        chosen.commit()
        self._drop_contested(chosen)
        self.maps = {decision.hypothesis: chosen}
        self.probabilities = {decision.hypothesis: 1.0}
        self.robot_areas = {decision.hypothesis: self.robot_areas[decision.hypothesis]}

    def _add_foreign_ground(self, hybrid_map: HybridMap, ground: ForeignGround) -> None:
        for new in ground.keyframes:
            hybrid_map.set_keyframe(new.keyframe, new.area, new.pose)
            self.scans[new.keyframe] = new.scan
        self.apply_changes(hybrid_map, (), ground.arcs, ground.removed_arcs)

    def _drop_contested(self, hybrid_map: HybridMap) -> None:
        """Drop the scans that are not in the map of the remaining hypothesis."""
        for keyframe in self.contested:
            if not any(keyframe in keyframes for keyframes in hybrid_map.common.areas.values()):
                del self.scans[keyframe]
        self.contested = set()

    @staticmethod
    def apply_changes(
        hybrid_map: HybridMap,
        moved_keyframes: tuple[MovedKeyframe, ...],
        arcs: tuple[Arc, ...] = (),
        removed_arcs: tuple[ArcEnds, ...] = (),
    ) -> None:
        """Move keyframes, remove arcs and set arcs of a map."""
        for moved in moved_keyframes:
            if moved.previous_area != moved.area:
                hybrid_map.remove_keyframe(moved.keyframe, moved.previous_area)
            hybrid_map.set_keyframe(moved.keyframe, moved.area, moved.pose)
        for ends in removed_arcs:
            hybrid_map.remove_arc(ends.source, ends.target)
        for arc in arcs:
            hybrid_map.set_arc(arc.source, arc.target, arc.pose, closure=arc.closure)


class GlobalPoses(Mapping[int, PoseGaussian]):
    """{area: belief over ``map_T_area``}, a view of a message that takes constant time to make."""

    def __init__(self, areas: Sequence[AreaPose] = ()) -> None:
        """:param areas: poses ordered by id, as in ``ClosureDecision.global_poses``."""
        self._areas = areas

    @property
    def areas(self) -> tuple[AreaPose, ...]:
        """The poses, ordered by id."""
        return tuple(self._areas)

    def __getitem__(self, area: int) -> PoseGaussian:
        row = bisect_left(self._areas, area, key=attrgetter("area"))
        if row == len(self._areas) or self._areas[row].area != area:
            raise KeyError(area)
        return self._areas[row].pose

    def __iter__(self) -> Iterator[int]:
        return (entry.area for entry in self._areas)

    def __len__(self) -> int:
        return len(self._areas)
