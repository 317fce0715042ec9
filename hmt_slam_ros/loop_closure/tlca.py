"""Topological Loop Closure Acceptance: which topological path is definite, and the global map under it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import AreaPair, HybridMap
from hmt_slam_ros.hybrid_map.hypothesis_agreement import LocalizedHypothesis, supports
from hmt_slam_ros.hybrid_map.pose_graph import consistent_map, shortest_path_map
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.hybrid_map.surroundings import Neighborhood, areas_around
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
from hmt_slam_ros.loop_closure.disambiguation import Disambiguation, probable_hypotheses
from hmt_slam_ros.loop_closure.foreign_ground import ForeignNumbers, GroundTaker, next_foreign_keyframe
from hmt_slam_ros.messages.map_changes import Arc, AreaPose, ForeignGround, MovedKeyframe
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, Keyframe, Message, Notice
from hmt_slam_ros.messages.replica import FIRST_AREA, FIRST_HYPOTHESIS, Replica, ReplicaState
from hmt_slam_ros.messages.statements import StatementEvidence
from hmt_slam_ros.messages.team import JoinedGround

FrameKey = tuple[int, int, int]

_LOOKS_DISTANCE = 2.0
"""Path between two computations of looks while the probable hypotheses stay the same, m."""

_MIN_FALSE_PROBABILITY = 1e-6
"""Smallest probability that an accepted closure is false, whatever ``tlca.accept_probability`` is."""

_MAX_FALSE_PROBABILITY = 0.5
"""Largest one, so that the log-odds of a closure are not negative."""


class PoseAmbiguity:
    """The ambiguity of the robot's pose, with a cache of the frames of its areas.

    :ivar area_frames: {(hypothesis, number of the last change of its map, area): ``map_T_area``, shape (3,), or None
        if no arc joins the area with the first}.
    """

    def __init__(self, area_frames: Mapping[FrameKey, Float64 | None] | None = None) -> None:
        """:param area_frames: to continue from."""
        self.area_frames = dict(area_frames or {})

    def second_moment(self, replica: Replica, poses: Mapping[int, Float64], versions: Mapping[int, int]) -> Float64:
        """The second moment of the robot's pose under all live hypotheses, about its pose under the most probable one.

        p(x) = sum_h P(h) p(x | h) has the covariance of its peaks besides that within each. Frames are composed along
        the least uncertain paths of each hypothesis.

        :param poses: {hypothesis: ``area_T_base`` in the hypothesis's area, shape (3,)}.
        :param versions: {hypothesis: number of the last change of its map}.
        :returns: shape (3, 3), of x, y along the axes of the map, m, and the heading, rad; 0 for one hypothesis.
        """
        moment = np.zeros((3, 3))
        if len(replica.maps) == 1:
            self.area_frames = {}
            return moment
        keys = {h: (h, versions[h], replica.robot_areas[h]) for h in replica.maps}
        self.area_frames = {
            key: self.area_frames[key]
            if key in self.area_frames
            else _area_frame(replica.maps[h], replica.robot_areas[h])
            for h, key in keys.items()
        }
        frames = {h: frame for h, key in keys.items() if (frame := self.area_frames[key]) is not None}
        if replica.best_hypothesis in frames:
            map_poses = {h: se2.compose(frame, poses[h]) for h, frame in frames.items()}
            for hypothesis, pose in map_poses.items():
                difference = pose - map_poses[replica.best_hypothesis]
                difference[2] = se2.wrap(difference[2])
                moment += replica.probabilities[hypothesis] * np.outer(difference, difference)
        return moment


def _area_frame(hybrid_map: HybridMap, area: int) -> Float64 | None:
    """``map_T_area``, or None if no arc joins the area with the first."""
    belief = shortest_path_beliefs(hybrid_map, FIRST_AREA, targets=(area,)).get(area)
    return None if belief is None else belief.mean


@dataclass(frozen=True, eq=False)
class TopologicalPath:
    """What TLCA remembers of one hypothesis; a value, so that children inherit it.

    :ivar version: number of the last change of its areas and arcs, of all hypotheses.
    :ivar branched_at: path length at which it branched off, m.
    :ivar dominant_keyframes: number of the latest keyframes in a row at which it dominated since then.
    :ivar is_definite: whether nothing changed since it was accepted.
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
    :ivar paths: {hypothesis: its topological path}.
    :ivar path_length: path length since the start, m.
    :ivar poses: {hypothesis: the robot's ``area_T_base`` at the last keyframe event, shape (3,), m and rad}.
    :ivar change_count: how often areas or arcs of hypotheses changed.
    :ivar published_change: the change after which global poses were published last, -1 before the first.
    :ivar reported_arcs: definite arcs that were reported as inconsistent with the others.
    :ivar closure_revision: what is remembered of revision requests.
    :ivar area_frames: {(hypothesis, number of the last change of its map, area): ``map_T_area``, shape (3,), or None
        if no arc joins the area with the first}, of the robot's areas under several hypotheses.
    :ivar foreign_numbers: {other robot: numbers of its areas and keyframes in the map}.
    :ivar waiting_ground: ground of other robots that waits for the next event with a single hypothesis, in order.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    paths: Mapping[int, TopologicalPath] = field(default_factory=lambda: {FIRST_HYPOTHESIS: TopologicalPath()})
    path_length: float = 0.0
    poses: Mapping[int, Float64] = field(default_factory=lambda: {FIRST_HYPOTHESIS: np.zeros(3)})
    change_count: int = 0
    published_change: int = -1
    reported_arcs: frozenset[AreaPair] = frozenset()
    closure_revision: ClosureRevisionState = field(default_factory=ClosureRevisionState)
    area_frames: Mapping[FrameKey, Float64 | None] = field(default_factory=dict)
    foreign_numbers: Mapping[str, ForeignNumbers] = field(default_factory=dict)
    waiting_ground: tuple[JoinedGround, ...] = ()


class Tlca:
    """Answers every ``Hypotheses`` with a ``ClosureDecision``, and with an ``Ambiguity`` while several are probable.

    A path is accepted when it has dominated for some keyframes and meters since it branched off, alone or together with
    paths that close more loops far from the robot, and at once when no other is left. Then the others are dropped, the
    areas that it joined are aligned, and arcs are fused with earlier traversals. If accepted closures contradict each
    other, TSBI decides between explanations.

    :ivar supports: {hypothesis: probability of what it states, at the last event}.
    """

    def __init__(self, configuration: Configuration, state: TlcaState | None = None) -> None:
        """:param state: to continue from."""
        state = state or TlcaState()
        self._options = configuration.tlca
        self._acceptance = Acceptance(configuration)
        self._replica = Replica.from_state(state.replica)
        self._gate = chi_square_gate(configuration.tsbi.gate_probability)
        self._closure_revision = ClosureRevision(
            self._options, state.closure_revision, StatementEvidence(configuration.tsbi)
        )
        self._ambiguity = PoseAmbiguity(state.area_frames)
        self._disambiguation = Disambiguation(configuration)
        self._neighborhood = Neighborhood(configuration.tsbi.local_sigma, configuration.tsbi.local_reach)
        # Without the three parts above, which change in place.
        self._state = replace(state, replica=ReplicaState(), closure_revision=ClosureRevisionState(), area_frames={})
        # TSBI's probabilities are not trusted beyond the configured risk.
        self._min_false_probability = max(1.0 - self._options.accept_probability, _MIN_FALSE_PROBABILITY)
        self._new_closures: frozenset[ClosureId] = frozenset()
        self.supports: dict[int, float] = {}
        self._is_mapping, self._looks_are_due = True, False

    @property
    def state(self) -> TlcaState:
        """The state between two keyframe events."""
        return replace(
            self._state,
            replica=self._replica.state,
            closure_revision=self._closure_revision.state,
            area_frames=self._ambiguity.area_frames,
        )

    @property
    def robot_poses(self) -> Mapping[int, Float64]:
        """{hypothesis: the robot's ``area_T_base`` at the last keyframe event, shape (3,), m and rad}."""
        return self._state.poses

    def handle(self, message: Message) -> list[Message]:
        """Learn from a ``Keyframe``; answer ``Hypotheses``."""
        if isinstance(message, Keyframe):
            self._replica.add_keyframe(message)
            self._is_mapping = message.mapping
            self._looks_are_due = self._state.path_length // _LOOKS_DISTANCE != message.path_length // _LOOKS_DISTANCE
            poses = {estimate.hypothesis: estimate.pose.mean for estimate in message.estimates}
            poses = {**self._state.poses, **poses}
            self._state = replace(self._state, path_length=message.path_length, poses=poses)
        elif isinstance(message, JoinedGround):
            self._state = replace(self._state, waiting_ground=(*self._state.waiting_ground, message))
        elif isinstance(message, Hypotheses):
            return self._decide(message)
        return []

    def _decide(self, hypotheses: Hypotheses) -> list[Message]:
        before = _probable(self._replica)
        paths = {h.id: self._updated_path(h, hypotheses.sequence) for h in hypotheses.hypotheses}
        poses = {h.id: _rebase_pose(self._state.poses[h.parent], h) for h in hypotheses.hypotheses}
        self._replica.apply_hypotheses(hypotheses)
        self.supports = self._supported_probabilities(poses)
        paths = {h: self._count_dominance(path, self.supports[h]) for h, path in paths.items()}
        self._state, self._new_closures = replace(self._state, paths=paths, poses=poses), frozenset()
        ground = self._take_over_ground(hypotheses)
        definite = self._dominant_hypothesis(is_lost=any(hypothesis.lost for hypothesis in hypotheses.hypotheses))
        arcs, moved = ((), ()) if definite is None else self._accept_path(definite)
        decision = ClosureDecision(hypotheses.sequence, definite, arcs, moved, foreign_ground=ground)
        self._replica.apply_decision(decision)
        paths = {hypothesis: self._state.paths[hypothesis] for hypothesis in self._replica.maps}
        self._state = replace(self._state, paths=paths)
        versions = {hypothesis: path.version for hypothesis, path in paths.items()}
        decision = replace(decision, ambiguity=self._ambiguity.second_moment(self._replica, poses, versions))
        ambiguities = self._changed_ambiguity(hypotheses.sequence, before, poses)
        request = None if definite is None else self._revision_request(definite, hypotheses.sequence)
        if request is not None:
            # Without global poses: an inconsistent map is not published.
            return [request.notice, replace(decision, revised_hypotheses=request.hypotheses), *ambiguities]
        global_poses, notices = self._global_poses()
        return [*notices, replace(decision, global_poses=global_poses), *ambiguities]

    def _take_over_ground(self, hypotheses: Hypotheses) -> ForeignGround | None:
        """The ground that waits and becomes part of the map of the only hypothesis; its path is definite then."""
        waiting = self._state.waiting_ground
        if not waiting or len(hypotheses.hypotheses) > 1 or hypotheses.hypotheses[0].lost:
            return None
        ground, *later = waiting
        (only,) = self._state.paths
        path, hybrid_map = self._state.paths[only], self._replica.maps[only]
        known = self._state.foreign_numbers.get(ground.robot, ForeignNumbers(ground.session))
        if known.session != ground.session:
            known = known.numbers_of_session(ground, self._replica.scans)
        largest = max(hybrid_map.max_area_id, self._closure_revision.state.max_area_id)
        next_keyframe = next_foreign_keyframe(self._state.foreign_numbers, self._replica.scans)
        taker = GroundTaker(hybrid_map, known, path.arc_keyframes.keys(), largest + 1, next_keyframe)
        taken, numbers = taker.take_over(ground)
        self._closure_revision.note_areas(numbers.areas.values())
        path = replace(path, version=self._count_change(), is_definite=False)
        self._state = replace(
            self._state,
            paths={only: path},
            foreign_numbers={**self._state.foreign_numbers, ground.robot: numbers},
            waiting_ground=tuple(later),
        )
        return taken

    def _supported_probabilities(self, poses: Mapping[int, Float64]) -> dict[int, float]:
        """{hypothesis: probability of what it states}; it leaves open what closures far from the robot others have.

        :param poses: {hypothesis: ``area_T_base`` in the hypothesis's area}.
        """
        maps, probabilities = self._replica.maps, self._replica.probabilities
        dominance = self._options.accept_probability
        if len(maps) == 1 or max(probabilities.values()) >= dominance:
            return dict(probabilities)
        hypotheses = {}
        for hypothesis, hybrid_map in maps.items():
            area = self._replica.robot_areas[hypothesis]
            nearby = areas_around(hybrid_map, area, self._neighborhood)
            hypotheses[hypothesis] = LocalizedHypothesis(hybrid_map, area, poses[hypothesis], nearby)
        return supports(hypotheses, probabilities, dominance)

    def _count_dominance(self, path: TopologicalPath, support: float) -> TopologicalPath:
        dominates = support >= self._options.accept_probability
        return replace(path, dominant_keyframes=path.dominant_keyframes + 1 if dominates else 0)

    def _changed_ambiguity(
        self, sequence: int, before: frozenset[tuple[int, bool]], poses: Mapping[int, Float64]
    ) -> list[Message]:
        """The ambiguity where it may have changed; an empty one where several hypotheses were probable before.

        :param before: :func:`_probable` before the event.
        :param poses: {hypothesis: ``area_T_base`` in the hypothesis's area}.
        """
        now = _probable(self._replica)
        if max(len(now), len(before)) < 2 or (now == before and not self._looks_are_due):
            return []
        return [self._disambiguation.ambiguity(sequence, self._replica, poses)]

    def _revision_request(self, hypothesis: int, event: int) -> RevisionRequest | None:
        """The request to revise closures that are inconsistent, or that a statement contradicts."""
        path = self._state.paths[hypothesis]
        accepted = AcceptedPath(
            self._replica.maps[hypothesis],
            path.history,
            path.closures,
            self._replica.robot_areas[hypothesis],
            self._state.poses[hypothesis],
            statements=self._replica.statements,
        )
        request = self._closure_revision.check(event, accepted, self._new_closures, hypothesis)
        if request is None and len(self._state.paths) == 1 and self._is_mapping:
            request = self._closure_revision.check_statements(event, accepted, hypothesis)
        return request

    def _updated_path(self, hypothesis: Hypothesis, sequence: int) -> TopologicalPath:
        """The path after TSBI's answer, which the maps do not contain yet."""
        path, area_before = self._state.paths[hypothesis.parent], self._replica.robot_areas[hypothesis.parent]
        if hypothesis.id != hypothesis.parent:
            path = replace(path, branched_at=self._state.path_length, dominant_keyframes=0)
        if hypothesis.arcs or hypothesis.moved_keyframes or hypothesis.removed_arcs or hypothesis.area_merge:
            path = replace(path, version=self._count_change(), is_definite=False)
        elif hypothesis.frame_change:
            path = replace(path, is_definite=False)
        revised = self._closure_revision.resolve(hypothesis, sequence)
        if revised is not None:
            return replace(path, is_definite=False, history=revised.steps, closures=revised.closures)
        parent_map = self._replica.maps[hypothesis.parent]
        if hypothesis.area_merge is not None:
            parent_path = AcceptedPath(parent_map, path.history, path.closures, area_before, np.zeros(3))
            history, closures = apply_area_merge(parent_path, hypothesis.area_merge)
            arc_keyframes = merge_arc_keyframes(path.arc_keyframes, hypothesis.area_merge)
            return replace(path, history=history, closures=closures, arc_keyframes=arc_keyframes)
        pending = tuple(pending_arc(arc, hypothesis, sequence, area_before, parent_map) for arc in hypothesis.arcs)
        new = tuple(arc.pair for arc in pending if arc.replaced_arc is None)
        if new or hypothesis.area != area_before:
            joined = frozenset(m.keyframe for m in hypothesis.moved_keyframes if m.area == hypothesis.area)
            step = PathStep(sequence, area_before, hypothesis.area, new, joined)
            path = replace(path, history=(*path.history, step))
        return replace(path, pending_arcs=path.pending_arcs + pending)

    def _dominant_hypothesis(self, *, is_lost: bool) -> int | None:
        """The hypothesis that becomes definite now, if any; of several the most probable.

        Closures of a definite path come into question again where a statement is due.

        :param is_lost: whether the robot is, under one of them.
        """
        paths, best = self._state.paths, self._replica.best_hypothesis
        if len(paths) == 1:
            due = self._closure_revision.due_statement(self._replica.statements)
            is_in_question = due is not None and self._is_mapping and not is_lost
            return None if paths[best].is_definite and not is_in_question else best
        lasting = [h for h, path in paths.items() if self._has_dominated(path)]
        return max(lasting, key=lambda h: (self._replica.probabilities[h], -h), default=None)

    def _has_dominated(self, path: TopologicalPath) -> bool:
        has_lasted = path.dominant_keyframes >= self._options.accept_keyframes
        return has_lasted and self._state.path_length - path.branched_at >= self._options.accept_distance

    def _accept_path(self, hypothesis: int) -> tuple[tuple[Arc, ...], tuple[MovedKeyframe, ...]]:
        """The definite arcs and moved keyframes of an accepted path; changes its map."""
        path, hybrid_map = self._state.paths[hypothesis], self._replica.maps[hypothesis]
        closures = [arc.pair for arc in path.pending_arcs if arc.closure]
        closures += [closure.pair for closure in path.closures if closure.snapshot is None]
        # Refinement changes the map, so there is none without mapping.
        closed = {area for pair in closures for area in pair} if self._is_mapping else set()
        poses = {k: (area, pose) for area in sorted(closed) for k, pose in hybrid_map.keyframes(area).items()}
        result = self._acceptance.accept(hybrid_map, self._replica.scans, path.pending_arcs, path.arc_keyframes, closed)
        snapshot = MapSnapshot(poses, result.arcs_before)
        accepted = replace(
            path,
            version=self._count_change() if result.arcs else path.version,
            is_definite=True,
            pending_arcs=(),
            arc_keyframes=result.arc_keyframes,
            closures=self._accepted_closures(path, self.supports[hypothesis], snapshot),
        )
        self._state = replace(self._state, paths={**self._state.paths, hypothesis: accepted})
        return tuple(result.arcs.values()), tuple(result.moved_keyframes)

    def _count_change(self) -> int:
        """The number of a change of areas or arcs."""
        self._state = replace(self._state, change_count=self._state.change_count + 1)
        return self._state.change_count

    def _accepted_closures(
        self, path: TopologicalPath, probability: float, snapshot: MapSnapshot
    ) -> tuple[Closure, ...]:
        """The closures of an accepted path; arcs that were observed again leave their snapshots."""
        observed_again = {arc.pair for arc in path.pending_arcs if arc.replaced_arc is not None}
        closures = {
            c.pair: replace(c, snapshot=snapshot) if c.snapshot is None else c.without_arcs(observed_again)
            for c in path.closures
        }
        false = min(max(1.0 - probability, self._min_false_probability), _MAX_FALSE_PROBABILITY)
        for arc in path.pending_arcs:
            if arc.closure and arc.pair not in closures:
                closures[arc.pair] = arc.to_closure(math.log((1.0 - false) / false), snapshot)
        self._new_closures = frozenset(c.closure_id for c in list(closures.values())[len(path.closures) :])
        return tuple(closures.values())

    def _global_poses(self) -> tuple[tuple[AreaPose, ...], list[Message]]:
        """The poses of all areas under the most probable hypothesis, if they changed, and notices of misfits."""
        best = self._replica.best_hypothesis
        path = self._state.paths[best]
        if path.version == self._state.published_change:
            return (), []
        self._state = replace(self._state, published_change=path.version)
        hybrid_map = self._replica.maps[best]
        is_consistent = self._options.global_map == "consistent"
        global_map = consistent_map(hybrid_map) if is_consistent else shortest_path_map(hybrid_map)
        notices = self._misfit_notices(global_map.arc_chi2) if path.is_definite else []
        return tuple(AreaPose(area, pose) for area, pose in global_map.poses.items()), notices

    def _misfit_notices(self, arc_chi2: dict[AreaPair, float]) -> list[Message]:
        """A notice of every definite arc that is inconsistent with the others, once: a sign of a false closure."""
        reported = self._state.reported_arcs
        misfits = [pair for pair, value in arc_chi2.items() if value > self._gate and pair not in reported]
        self._state = replace(self._state, reported_arcs=reported.union(misfits))
        return [
            Notice(
                "tlca",
                f"The arc between areas {a} and {b} misses the other arcs by a chi-square of {arc_chi2[a, b]:.1f}, "
                f"above {self._gate:.1f}: a loop may be closed falsely; raise tlca.accept_probability.",
            )
            for a, b in misfits
        ]


def _probable(replica: Replica) -> frozenset[tuple[int, bool]]:
    """The probable hypotheses, and whether each is the most probable."""
    return frozenset((h, number == 0) for number, h in enumerate(probable_hypotheses(replica.probabilities)))


def _rebase_pose(pose: Float64, hypothesis: Hypothesis) -> Float64:
    return pose if hypothesis.frame_change is None else se2.compose(hypothesis.frame_change.mean, pose)
