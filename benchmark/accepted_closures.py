"""The closures that TLCA accepts while a recorded log is mapped, and whether they are right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from benchmark.localization import slam_of
from benchmark.relation_chains import RelationChains, TruePair
from benchmark.simulated.closures import RECENT, known_end
from benchmark.simulated.truth import placement_error
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap, area_pair
from hmt_slam_ros.loop_closure.closure_history import Closure, ClosureId
from hmt_slam_ros.loop_closure.tlca import Tlca
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis
from hmt_slam_ros.offline.lock_step import LockStepRun

RELATIONS, TRAJECTORY, NOTHING = "relations", "trajectory", "nothing"
"""By what a closure is judged; nothing where its areas were merged before it could be seen."""


@dataclass(frozen=True, eq=False)
class DefiniteClosure:
    """A closure when it was accepted.

    :ivar event: the keyframe event.
    :ivar stamp: of its scan, ns.
    :ivar probability: of its path.
    :ivar areas: the known area, and the one that the robot was in.
    :ivar placement: belief over ``known_T_other``.
    :ivar known: {stamp of a scan: ``known_T_base`` (3,)} of the keyframes of the known area.
    :ivar query: likewise of the keyframes that the closure placed.
    """

    event: int
    stamp: int
    probability: float
    areas: tuple[int, int]
    placement: PoseGaussian
    known: Mapping[int, Float64]
    query: Mapping[int, Float64]


class PlacedKeyframes(NamedTuple):
    """The keyframes that a closure placed when TSBI found it.

    They are those that moved into the known area, else the newest ones of the area that the robot was in.

    :ivar in_known: whether they moved.
    :ivar poses: {keyframe: ``area_T_base`` (3,)} in the area that they were in then.
    """

    in_known: bool
    poses: Mapping[int, Float64]


@dataclass
class EventWatch:
    """Follows a run: its keyframe events, and the closures that are accepted.

    :ivar stamps: of the scans of all keyframe events, ns.
    :ivar accepted: the closures, in their order.
    """

    stamps: list[int] = field(default_factory=list)
    accepted: list[DefiniteClosure] = field(default_factory=list)
    _seen: set[ClosureId] = field(default_factory=set)
    _placed: dict[ClosureId, PlacedKeyframes] = field(default_factory=dict)

    def update(self, run: LockStepRun) -> None:
        """Take in what a record of the log caused."""
        recorder = run.recorder
        while (event := len(self.stamps)) in recorder.decisions:
            self.stamps.append(recorder.keyframes[event].scan.stamp)
            self._add_found(run, recorder.hypotheses[event])
            if recorder.decisions[event].hypothesis is not None:
                self._add_new(run, recorder.decisions[event])

    def _add_found(self, run: LockStepRun, hypotheses: Hypotheses) -> None:
        """Remember which keyframes were placed by the closures that TSBI found."""
        maps = slam_of(run).replica.maps
        for hypothesis in hypotheses.hypotheses:
            for arc in hypothesis.arcs:
                if arc.closure and hypothesis.id in maps:
                    closure_id = hypotheses.sequence, area_pair(arc.source, arc.target)
                    self._placed[closure_id] = _placed_keyframes(hypothesis, arc, maps[hypothesis.id])

    def _add_new(self, run: LockStepRun, decision: ClosureDecision) -> None:
        tlca = run.lock_step.processes["tlca"]
        assert isinstance(tlca, Tlca)
        closures = [c for path in tlca.state.paths.values() for c in path.closures if c.snapshot is not None]
        new = {c.closure_id: c for c in closures if c.closure_id not in self._seen}
        self._seen |= new.keys()
        self.accepted += [self._make_closure(run, decision, closure) for closure in new.values()]

    def _make_closure(self, run: LockStepRun, decision: ClosureDecision, closure: Closure) -> DefiniteClosure:
        replica = slam_of(run).replica
        hybrid_map, scans = replica.maps[replica.best_hypothesis], replica.scans
        known, other = (
            dict(hybrid_map.keyframes(area)) if hybrid_map.has_area(area) else {}
            for area in (closure.far, closure.near)
        )
        tlca = run.lock_step.processes["tlca"]
        assert isinstance(tlca, Tlca)
        assert decision.hypothesis is not None
        probability = tlca.supports[decision.hypothesis]
        arc = hybrid_map.arc(closure.far, closure.near) if known and other else None
        placement, found = arc or closure.pose.inverse(), self._placed[closure.closure_id]
        query = {}
        for keyframe, pose in found.poses.items():
            if keyframe in known:
                query[keyframe] = known.pop(keyframe)
            elif keyframe in other:
                query[keyframe] = se2.compose(placement.mean, other[keyframe])
            else:  # it moved on into a newer area
                query[keyframe] = pose if found.in_known else se2.compose(se2.inverse(closure.pose.mean), pose)
        return DefiniteClosure(
            decision.sequence,
            self.stamps[-1],
            probability,
            (closure.far, closure.near),
            placement,
            {scans[k].stamp: pose for k, pose in known.items()},
            {scans[k].stamp: pose for k, pose in query.items() if k in scans},
        )


def _placed_keyframes(hypothesis: Hypothesis, arc: Arc, hybrid_map: HybridMap) -> PlacedKeyframes:
    known_area = known_end(hypothesis, arc)
    known, other = (
        hybrid_map.keyframes(area) if hybrid_map.has_area(area) else {}
        for area in (known_area, arc.source + arc.target - known_area)
    )
    moved = {m.keyframe for m in hypothesis.moved_keyframes if m.area == known_area != m.previous_area}
    if moved & known.keys():
        return PlacedKeyframes(True, {k: known[k] for k in sorted(moved & known.keys())})
    return PlacedKeyframes(False, {k: other[k] for k in sorted(other)[-RECENT:]})


def judge_closure(
    closure: DefiniteClosure, numbers: Mapping[int, int], chains: RelationChains | None, trajectory: Float64
) -> dict[str, Any]:
    """The error of a closure between the two keyframes of its areas that truly are nearest to each other.

    :param numbers: {stamp of a scan: its number}.
    :param chains: of the log's relations, None without any.
    :param trajectory: shape (n, 3), ``map_T_base`` of the scans, for closures that no chain judges.
    :returns: its event and scan, probability, areas, by what it was judged, whether it is right, and its error.
    """
    facts = {
        "event": closure.event,
        "scan": numbers[closure.stamp],
        "probability": closure.probability,
        "areas": closure.areas,
    }
    known, query = ({numbers[stamp]: pose for stamp, pose in own.items()} for own in (closure.known, closure.query))
    if not known or not query:
        return facts | {"by": NOTHING, "right": False}
    chained = chains.nearest_pair(list(known), list(query)) if chains else None
    pair = chained or _nearest_by_trajectory(list(known), list(query), trajectory)
    one, other = pair.scans
    poses = known[one], query[other]
    error = placement_error(pair.scans, poses, pair.pose, closure.placement, same_place=True)
    return facts | {"by": RELATIONS if chained else TRAJECTORY, "right": bool(error.true), **error._asdict()}


def _nearest_by_trajectory(known: list[int], query: list[int], trajectory: Float64) -> TruePair:
    ours, theirs = trajectory[known], trajectory[query]
    apart = np.hypot(*(ours[:, None, :2] - theirs[None, :, :2]).transpose(2, 0, 1))
    k, m = np.unravel_index(np.argmin(apart), apart.shape)
    return TruePair((known[k], query[m]), se2.between(ours[k], theirs[m]))
