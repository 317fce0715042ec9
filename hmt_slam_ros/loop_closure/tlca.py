"""Topological Loop Closure Acceptance: which topological path is definite, and where everything lies under it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import AreaPair, HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import consistent_map, shortest_path_map
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.loop_closure.acceptance import Acceptance, PendingArc, pending_arc
from hmt_slam_ros.loop_closure.closure_history import (
    AcceptedPath,
    Closure,
    ClosureId,
    MapSnapshot,
    PathStep,
    apply_area_merge,
    merge_arc_keyframes,
)
from hmt_slam_ros.loop_closure.closure_revision import ClosureRevision, ClosureRevisionState, RevisionRequest
from hmt_slam_ros.messages.map_changes import Arc, AreaPose, MovedKeyframe
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, Keyframe, Message, Notice
from hmt_slam_ros.messages.replica import FIRST_AREA, FIRST_HYPOTHESIS, Replica, ReplicaState

FrameKey = tuple[int, int, int]


class PoseAmbiguity:
    """Remembers where each hypothesis has the robot's area, as long as nothing about it changes.

    :ivar area_frames: {(hypothesis, number of the last change of its map, area): ``map_T_area``, shape (3,), or None
        where no arc joins the area with the first}.
    """

    def __init__(self, area_frames: Mapping[FrameKey, NDArray[np.float64] | None] | None = None) -> None:
        """:param area_frames: to go on from."""
        self.area_frames = dict(area_frames or {})

    def second_moment(
        self, replica: Replica, poses: Mapping[int, NDArray[np.float64]], versions: Mapping[int, int]
    ) -> NDArray[np.float64]:
        """The second moment of the robot's pose under all live hypotheses, about its pose under the most probable one.

        p(x) = sum_h P(h) p(x | h) has the covariance of its peaks besides that within each. All are placed along the
        least uncertain paths, so that what they differ in is what they claim.

        :param poses: {hypothesis: ``area_T_base`` in the hypothesis's area, shape (3,)}.
        :param versions: {hypothesis: number of the last change of its map}.
        :returns: shape (3, 3), of x, y along the axes of the map, m, and the heading, rad; 0 where one hypothesis is
            left.
        """
        found = np.zeros((3, 3))
        if len(replica.maps) == 1:
            self.area_frames = {}
            return found
        named = {h: (h, versions[h], replica.robot_areas[h]) for h in replica.maps}
        self.area_frames = {
            name: self.area_frames[name]
            if name in self.area_frames
            else _area_frame(replica.maps[h], replica.robot_areas[h])
            for h, name in named.items()
        }
        frames = {h: frame for h, name in named.items() if (frame := self.area_frames[name]) is not None}
        if replica.best_hypothesis in frames:
            placed = {h: se2.compose(frame, poses[h]) for h, frame in frames.items()}
            for hypothesis, pose in placed.items():
                away = pose - placed[replica.best_hypothesis]
                away[2] = se2.wrap(away[2])
                found += replica.probabilities[hypothesis] * np.outer(away, away)
        return found


def _area_frame(hybrid_map: HybridMap, area: int) -> NDArray[np.float64] | None:
    """``map_T_area``, or None where no arc joins the area with the first."""
    belief = shortest_path_beliefs(hybrid_map, FIRST_AREA, targets=(area,)).get(area)
    return None if belief is None else belief.mean


# Closures are never taken for more certain than this, whatever tlca.accept_probability is.
_MIN_FALSE_PROBABILITY = 1e-6


@dataclass(frozen=True, eq=False)
class TopologicalPath:
    """What TLCA remembers of one hypothesis; a value, so that children inherit it.

    :ivar version: number of the last change of its areas and arcs, of all hypotheses.
    :ivar branched_at: path length at which it parted from others, m.
    :ivar dominant_keyframes: at how many of the latest keyframes in a row it dominated since then.
    :ivar is_definite: whether nothing happened since it was accepted.
    :ivar pending_arcs: arcs that wait for acceptance, in order.
    :ivar arc_keyframes: {arc: the keyframes by which it was observed}, of the definite arcs.
    :ivar history: the keyframe events at which the robot changed its area or arcs were new, in order.
    :ivar closures: those that were accepted, in order.
    """

    version: int = 0
    branched_at: float = 0.0
    dominant_keyframes: int = 0
    is_definite: bool = False
    pending_arcs: tuple[PendingArc, ...] = ()
    arc_keyframes: Mapping[AreaPair, frozenset[int]] = field(default_factory=dict)
    history: tuple[PathStep, ...] = ()
    closures: tuple[Closure, ...] = ()


@dataclass(frozen=True, eq=False)
class TlcaState:
    """TLCA between two keyframe events, at first before the first one.

    :ivar replica: the maps of the live hypotheses.
    :ivar paths: {hypothesis: what is remembered of it}.
    :ivar path_length: path length since the start, m.
    :ivar poses: {hypothesis: the robot's ``area_T_base`` at the last keyframe event, shape (3,), m and rad}.
    :ivar change_count: how often areas or arcs of hypotheses changed.
    :ivar published_change: the change after which global poses were told last, -1 before the first.
    :ivar reported_arcs: definite arcs of which it was told that they do not fit the others.
    :ivar closure_revision: what is known of questions that were opened again.
    :ivar area_frames: {(hypothesis, number of the last change of its map, area): ``map_T_area``, shape (3,), or None
        where no arc joins the area with the first}, of the robot's areas under several hypotheses.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    paths: Mapping[int, TopologicalPath] = field(default_factory=lambda: {FIRST_HYPOTHESIS: TopologicalPath()})
    path_length: float = 0.0
    poses: Mapping[int, NDArray[np.float64]] = field(default_factory=lambda: {FIRST_HYPOTHESIS: np.zeros(3)})
    change_count: int = 0
    published_change: int = -1
    reported_arcs: frozenset[AreaPair] = frozenset()
    closure_revision: ClosureRevisionState = field(default_factory=ClosureRevisionState)
    area_frames: Mapping[FrameKey, NDArray[np.float64] | None] = field(default_factory=dict)


class Tlca:
    """Answers every ``Hypotheses`` with an ``ClosureDecision``.

    A path is accepted when it has dominated for some keyframes and meters since it parted from the last other one, and
    at once when no other is left. Then the others are dropped, the areas that it joined are finely aligned, and arcs
    that were traveled before are fused with what was known of them. Where accepted closures contradict each other,
    TSBI is asked anew instead.
    """

    def __init__(self, configuration: Configuration, state: TlcaState | None = None) -> None:
        """:param state: to go on from."""
        state = state or TlcaState()
        self._options = configuration.tlca
        self._acceptance = Acceptance(configuration)
        self._replica = Replica.from_state(state.replica)
        self._gate = chi_square_gate(configuration.tsbi.gate_probability)
        self._closure_revision = ClosureRevision(self._options, state.closure_revision)
        self._ambiguity = PoseAmbiguity(state.area_frames)
        # All but the three parts above, which change in place.
        self._state = replace(state, replica=ReplicaState(), closure_revision=ClosureRevisionState(), area_frames={})
        # The stated risk: beyond it, TSBI's probabilities are not taken at their word.
        self._min_false_probability = max(1.0 - self._options.accept_probability, _MIN_FALSE_PROBABILITY)
        self._new_closures: frozenset[ClosureId] = frozenset()
        self._is_mapping = True

    @property
    def state(self) -> TlcaState:
        """All that TLCA knows between two keyframe events, as a value."""
        return replace(
            self._state,
            replica=self._replica.state,
            closure_revision=self._closure_revision.state,
            area_frames=self._ambiguity.area_frames,
        )

    def handle(self, message: Message) -> list[Message]:
        """Learn from a ``Keyframe``; answer ``Hypotheses``."""
        if isinstance(message, Keyframe):
            self._replica.add_keyframe(message)
            self._is_mapping = message.mapping
            poses = {**self._state.poses, **{leaf.hypothesis: leaf.pose.mean for leaf in message.estimates}}
            self._state = replace(self._state, path_length=message.path_length, poses=poses)
        elif isinstance(message, Hypotheses):
            return self._decide(message)
        return []

    def shortest_path_poses(self) -> dict[int, PoseGaussian]:
        """``map_T_area`` of the most probable hypothesis along the least uncertain paths only, Eq. (15)."""
        return shortest_path_map(self._replica.maps[self._replica.best_hypothesis]).poses

    def _decide(self, hypotheses: Hypotheses) -> list[Message]:
        paths = {leaf.id: self._updated_path(leaf, hypotheses.sequence) for leaf in hypotheses.hypotheses}
        poses = {leaf.id: _rebase_pose(self._state.poses[leaf.parent], leaf) for leaf in hypotheses.hypotheses}
        self._replica.apply_hypotheses(hypotheses)
        self._state, self._new_closures = replace(self._state, paths=paths, poses=poses), frozenset()
        chosen = self._dominant_hypothesis()
        arcs, relabelled = ((), ()) if chosen is None else self._accept_path(chosen)
        accepted = ClosureDecision(hypotheses.sequence, chosen, arcs, relabelled)
        self._replica.apply_decision(accepted)
        paths = {hypothesis: self._state.paths[hypothesis] for hypothesis in self._replica.maps}
        self._state = replace(self._state, paths=paths)
        versions = {hypothesis: path.version for hypothesis, path in paths.items()}
        accepted = replace(accepted, ambiguity=self._ambiguity.second_moment(self._replica, poses, versions))
        question = None if chosen is None else self._revision_request(chosen, hypotheses.sequence)
        if question is not None:
            # No pose is told: the map is not bent to what does not fit.
            return [question.notice, replace(accepted, revised_hypotheses=question.hypotheses)]
        global_poses, notices = self._global_poses()
        return [*notices, replace(accepted, global_poses=global_poses)]

    def _revision_request(self, hypothesis: int, event: int) -> RevisionRequest | None:
        """The contradiction that the closures bring that have just been accepted, if any."""
        path, area = self._state.paths[hypothesis], self._replica.robot_areas[hypothesis]
        pose = self._state.poses[hypothesis]
        account = AcceptedPath(self._replica.maps[hypothesis], path.history, path.closures, area, pose)
        return self._closure_revision.check(event, account, self._new_closures, hypothesis)

    def _updated_path(self, leaf: Hypothesis, sequence: int) -> TopologicalPath:
        """The path after TSBI's answer, which is not applied yet: the arcs that it replaces are still there."""
        path, before = self._state.paths[leaf.parent], self._replica.robot_areas[leaf.parent]
        if leaf.id != leaf.parent:
            path = replace(path, branched_at=self._state.path_length, dominant_keyframes=0)
        dominates = leaf.probability >= self._options.accept_probability
        path = replace(path, dominant_keyframes=path.dominant_keyframes + 1 if dominates else 0)
        if leaf.arcs or leaf.moved_keyframes or leaf.removed_arcs or leaf.area_merge:
            path = replace(path, version=self._count_change(), is_definite=False)
        elif leaf.frame_change:
            path = replace(path, is_definite=False)
        past = self._closure_revision.resolve(leaf, sequence)
        if past is not None:
            return replace(path, is_definite=False, history=past.steps, closures=past.closures)
        parent = self._replica.maps[leaf.parent]
        if leaf.area_merge is not None:
            history, closures = apply_area_merge(
                AcceptedPath(parent, path.history, path.closures, before, np.zeros(3)), leaf.area_merge
            )
            witnesses = merge_arc_keyframes(path.arc_keyframes, leaf.area_merge)
            return replace(path, history=history, closures=closures, arc_keyframes=witnesses)
        observations = tuple(pending_arc(arc, leaf, sequence, before, parent) for arc in leaf.arcs)
        new = tuple(seen.pair for seen in observations if seen.replaced_arc is None)
        if new or leaf.area != before:
            joined = frozenset(r.keyframe for r in leaf.moved_keyframes if r.area == leaf.area)
            path = replace(path, history=(*path.history, PathStep(sequence, before, leaf.area, new, joined)))
        return replace(path, pending_arcs=path.pending_arcs + observations)

    def _dominant_hypothesis(self) -> int | None:
        """The hypothesis that becomes definite now, if any."""
        best = self._replica.best_hypothesis
        path = self._state.paths[best]
        if len(self._state.paths) == 1:
            return None if path.is_definite else best
        held = path.dominant_keyframes >= self._options.accept_keyframes
        return best if held and self._state.path_length - path.branched_at >= self._options.accept_distance else None

    def _accept_path(self, hypothesis: int) -> tuple[tuple[Arc, ...], tuple[MovedKeyframe, ...]]:
        """Align and fuse what the accepted path observed, changing its map."""
        path, hybrid_map = self._state.paths[hypothesis], self._replica.maps[hypothesis]
        found = [seen.pair for seen in path.pending_arcs if seen.closure]
        found += [closure.pair for closure in path.closures if closure.snapshot is None]
        # What is refined moves, which is a change of the map.
        closed = {area for pair in found for area in pair} if self._is_mapping else set()
        poses = {k: (area, pose) for area in sorted(closed) for k, pose in hybrid_map.keyframes(area).items()}
        made = self._acceptance.accept(hybrid_map, self._replica.scans, path.pending_arcs, path.arc_keyframes, closed)
        version = self._count_change() if made.arcs else path.version
        closures = self._accepted_closures(
            path, self._replica.probabilities[hypothesis], MapSnapshot(poses, made.arcs_before)
        )
        accepted = replace(
            path,
            version=version,
            is_definite=True,
            pending_arcs=(),
            arc_keyframes=made.arc_keyframes,
            closures=closures,
        )
        self._state = replace(self._state, paths={**self._state.paths, hypothesis: accepted})
        return tuple(made.arcs.values()), tuple(made.moved_keyframes)

    def _count_change(self) -> int:
        """The number of a change of areas or arcs."""
        self._state = replace(self._state, change_count=self._state.change_count + 1)
        return self._state.change_count

    def _accepted_closures(self, path: TopologicalPath, probability: float, undo: MapSnapshot) -> tuple[Closure, ...]:
        """Those of a path that is now accepted; what was observed again since is not to be undone."""
        again = {seen.pair for seen in path.pending_arcs if seen.replaced_arc is not None}
        closures = {
            c.pair: replace(c, snapshot=undo) if c.snapshot is None else c.without_arcs(again) for c in path.closures
        }
        doubt = min(max(1.0 - probability, self._min_false_probability), 0.5)
        for seen in path.pending_arcs:
            if seen.closure and seen.pair not in closures:
                closures[seen.pair] = seen.to_closure(math.log((1.0 - doubt) / doubt), undo)
        self._new_closures = frozenset(c.closure_id for c in list(closures.values())[len(path.closures) :])
        return tuple(closures.values())

    def _global_poses(self) -> tuple[tuple[AreaPose, ...], list[Message]]:
        """The poses of all areas under the most probable hypothesis, where they changed; arcs that refuse to fit."""
        best = self._replica.best_hypothesis
        path = self._state.paths[best]
        if path.version == self._state.published_change:
            return (), []
        self._state = replace(self._state, published_change=path.version)
        hybrid_map = self._replica.maps[best]
        consistent = self._options.global_map == "consistent"
        found = consistent_map(hybrid_map) if consistent else shortest_path_map(hybrid_map)
        notices = self._misfit_notices(found.arc_chi2) if path.is_definite else []
        return tuple(AreaPose(area, pose) for area, pose in found.poses.items()), notices

    def _misfit_notices(self, arc_chi2: dict[AreaPair, float]) -> list[Message]:
        """A notice of every definite arc that does not fit the others, once: a sign of a closure that was false."""
        known = self._state.reported_arcs
        wrong = [pair for pair, value in arc_chi2.items() if value > self._gate and pair not in known]
        self._state = replace(self._state, reported_arcs=known.union(wrong))
        return [
            Notice(
                "tlca",
                f"The arc between areas {a} and {b} misses the other arcs by a chi-square of {arc_chi2[a, b]:.1f}, "
                f"above {self._gate:.1f}: a loop may be closed falsely; raise tlca.accept_probability.",
            )
            for a, b in wrong
        ]


def _rebase_pose(pose: NDArray[np.float64], leaf: Hypothesis) -> NDArray[np.float64]:
    return pose if leaf.frame_change is None else se2.compose(leaf.frame_change.mean, pose)
