"""Topological Space Bayesian Inference: the probability distribution over topological paths, Eqs. (6) and (14)."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hypothesis_agreement import (
    LocalizedHypothesis,
    elsewhere_probability,
    merge_equivalent,
)
from hmt_slam_ros.hybrid_map.surroundings import areas_around, consistent_pose
from hmt_slam_ros.messages.evidence import Evidence
from hmt_slam_ros.messages.map_changes import AreaPose, LocalArea, PrunedKeyframe
from hmt_slam_ros.messages.messages import (
    AreaEvent,
    AreaEvents,
    ClosureDecision,
    Hypotheses,
    Hypothesis,
    HypothesisEstimate,
    Keyframe,
    Message,
    Notice,
    TrackingReset,
)
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, GlobalPoses, Replica, ReplicaState
from hmt_slam_ros.messages.statements import PlaceStatement, WeighedStatement
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.topological_inference.branches import Branches, Child, Parent
from hmt_slam_ros.topological_inference.branching import Branching, BranchingState
from hmt_slam_ros.topological_inference.closure_search import known_ground_log_ratio
from hmt_slam_ros.topological_inference.evidence_record import EvidenceRecord
from hmt_slam_ros.topological_inference.hypothesis_changes import apply_revision, merge_areas
from hmt_slam_ros.topological_inference.hypothesis_tree import (
    HypothesisState,
    Lost,
    PoseInArea,
    ReducedDistribution,
    Tracking,
    normalize_and_reduce,
)
from hmt_slam_ros.topological_inference.kidnapping import decide_without_mapping, spawn_kidnapped_hypothesis
from hmt_slam_ros.topological_inference.marks import Anchor, nearest_anchor
from hmt_slam_ros.topological_inference.pose_distribution import (
    LocalizationStatus,
    PoseDistribution,
    summarize_localization,
)
from hmt_slam_ros.topological_inference.relocalization import (
    accept_relocalization,
    begin_relocalization,
    is_search_due,
    is_searching,
    update_relocalization,
)
from hmt_slam_ros.topological_inference.statements import replace_keyframes

_ONSET_STEP = 10
"""Keyframe events between two changes of the ground that counts as seen before a fault, so that its grid stays cached.
"""

_OVERLAP_PERSISTENCE = 3
"""Keyframe events in a row that the robot has to be in an area of the submap before an arc joins it."""

_RETRY_KEYFRAMES = 3
"""Keyframes after which pending candidates are compared again (docs/decisions/0020-retry-beside-known-areas.md)."""

_UNEXAMINED_DECAY = 0.5
"""Factor on the unexamined probability at a search: unexamined ground would match again by now."""

_MIN_PROBABILITY = 1e-300
"""Smallest probability of a hypothesis, for logarithms."""


@dataclass(frozen=True, eq=False)
class TsbiState:
    """TSBI between two keyframe events, at first before the first one.

    :ivar replica: the maps of the live hypotheses.
    :ivar branching: what branching remembers beside these.
    :ivar hypothesis_states: {hypothesis: its state}.
    :ivar next_hypothesis: the first number that no hypothesis had.
    :ivar unexamined: probability of the topologies that were not examined.
    :ivar global_poses: ``map_T_area`` of TLCA's last decision, ordered by area.
    :ivar revised_hypotheses: the explanations of TLCA's revision request, until they are applied; else empty.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    branching: BranchingState = field(default_factory=BranchingState)
    hypothesis_states: Mapping[int, HypothesisState] = field(
        default_factory=lambda: {FIRST_HYPOTHESIS: HypothesisState()}
    )
    next_hypothesis: int = FIRST_HYPOTHESIS + 1
    unexamined: float = 0.0
    global_poses: tuple[AreaPose, ...] = ()
    revised_hypotheses: tuple[Hypothesis, ...] = ()


class Tsbi:
    """Answers the area events of every keyframe with the live hypotheses.

    Consumes TrackingReset, Keyframe, AreaEvents, ClosureDecision, PlaceStatement; produces Hypotheses, and Notices of
    proposed loops and of statements.
    """

    def __init__(
        self,
        configuration: Configuration,
        branching: Callable[[Configuration, Replica], Branching] = Branching,
        state: TsbiState | None = None,
    ) -> None:
        """:param branching: makes the children of hypotheses.

        :param state: to continue from.
        """
        state = state or TsbiState()
        self._options = configuration.tsbi
        self._seed = configuration.seed
        self._replica = Replica.from_state(state.replica)
        self._branching = branching(configuration, self._replica)
        self._branching.restore(state.branching)
        # Without the two parts above, which change in place.
        self._state = replace(state, replica=ReplicaState(), branching=BranchingState())
        self._keyframe: Keyframe | None = None
        self._estimates: dict[int, HypothesisEstimate] = {}
        # Not part of the state, since the next event computes them again, or the next search.
        self._robot_poses: dict[int, Float64] = {}
        self._reset_event = -1
        self._pose_distribution: PoseDistribution | None = None
        self._notices: list[Notice] = []
        self._evidence = EvidenceRecord()

    @property
    def evidence(self) -> Evidence:
        """Why there are several hypotheses; the same object until that changes."""
        return self._evidence.evidence

    def restore_evidence(self, evidence: Evidence) -> None:
        """Go on from the evidence that belongs to the state with which the process began."""
        self._evidence.restore(evidence)

    @property
    def state(self) -> TsbiState:
        """The state between two keyframe events."""
        return replace(self._state, replica=self._replica.state, branching=self._branching.state)

    @property
    def localization(self) -> LocalizationStatus:
        """Whether the robot is localized, and the entropy of the belief over its area."""
        is_reset = (-1 if self._keyframe is None else self._keyframe.sequence) < self._reset_event
        states = self._state.hypothesis_states
        areas, lost, tracked = defaultdict[int, float](float), 0.0, list[int]()
        for hypothesis, probability in self._replica.probabilities.items():
            if is_reset or states[hypothesis].is_lost:
                lost += probability
            else:
                areas[self._replica.robot_areas[hypothesis]] += probability
                tracked.append(hypothesis)
        best = self._replica.best_hypothesis
        localization, hybrid_map = states[best].localization, self._replica.maps[best]
        since = self._reset_event if is_reset else localization.since if isinstance(localization, Lost) else None
        known = sum(
            since is None or any(k < since for k in hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()
        )
        distribution = None if is_reset else self._pose_distribution
        allowed = self._options.lost_probability
        elsewhere = 0.0 if lost > allowed else self._elsewhere_probability(tracked, allowed - lost)
        return summarize_localization(areas, lost, self._state.unexamined, known, distribution, allowed, elsewhere)

    def _elsewhere_probability(self, tracked: Sequence[int], allowed: float) -> float:
        """The probability that the robot is elsewhere than the most probable of some hypotheses has it.

        After a restart all others count until the next keyframe event: where they have the robot is not known.

        :param allowed: where the others have no more together, this is all they have: they are not compared.
        """
        probabilities = [self._replica.probabilities[hypothesis] for hypothesis in tracked]
        others = sum(probabilities) - max(probabilities, default=0.0)
        if others <= allowed or not self._robot_poses.keys() >= set(tracked):
            return others
        maps, areas = self._replica.maps, self._replica.robot_areas
        localized = [LocalizedHypothesis(maps[h], areas[h], self._robot_poses[h], {areas[h]}) for h in tracked]
        return elsewhere_probability(localized, probabilities)

    def handle(self, message: Message) -> list[Message]:
        """Learn from keyframes, decisions and statements; answer ``AreaEvents`` with ``Hypotheses``."""
        if isinstance(message, Keyframe):
            self._add_keyframe(message)
        elif isinstance(message, AreaEvents):
            answer, landmarks = self._infer(message), self._branching.landmarks
            notices, self._notices = self._notices, []
            return [*(landmarks.notices() if landmarks else ()), *notices, answer]
        elif isinstance(message, ClosureDecision):
            self._accept(message)
        elif isinstance(message, PlaceStatement):
            self._branching.statements.add(message)
        elif isinstance(message, TrackingReset):
            self._reset_event, self._pose_distribution = message.event, None
        return []

    def _add_keyframe(self, keyframe: Keyframe) -> None:
        """Store the keyframe, and update the state of every hypothesis by its scan."""
        self._replica.add_keyframe(keyframe)
        self._keyframe = keyframe
        self._estimates = {estimate.hypothesis: estimate for estimate in keyframe.estimates}
        states, priors = dict(self._state.hypothesis_states), self._branching.kidnapping_priors
        for estimate in keyframe.estimates:
            if estimate.hypothesis not in states:
                continue
            unstored_pose = None
            if not keyframe.mapping and not estimate.stored:
                unstored_pose = PoseInArea(estimate.area, keyframe.sequence, estimate.pose.mean)
            state = states[estimate.hypothesis]
            state = state.after_motion(keyframe.sequence, keyframe.motion_condition, priors)
            log_ends, log_walls = self._log_ratios(estimate, state, keyframe)
            state = state.after_scan(keyframe.sequence, log_ends, log_walls, priors, unstored_pose)
            if estimate.stored:
                state = state.after_keyframe(keyframe.sequence, estimate.pose.covariance)
            states[estimate.hypothesis] = state
        self._state = replace(self._state, hypothesis_states=states)
        wanted = {event for state in states.values() for event in state.unstored_poses}
        self._branching.keep_scans(keyframe.sequence, keyframe.scan, wanted)
        if keyframe.marks:
            marks = self._branching.marks
            self._branching.marks = marks.after_event(
                keyframe.sequence, keyframe.marks, self._anchor(keyframe), self._lost_since(keyframe)
            )

    def _lost_since(self, keyframe: Keyframe) -> int:
        """The event since which the robot is lost under any hypothesis at a keyframe, 0 if it is not."""
        if keyframe.motion_unknown:
            return keyframe.sequence
        localizations = (state.localization for state in self._state.hypothesis_states.values())
        return max((lost.since for lost in localizations if isinstance(lost, Lost)), default=0)

    def _anchor(self, keyframe: Keyframe) -> Anchor | None:
        """The keyframe that observations of marks are relative to: this one if it is stored, or the nearest one."""
        if any(estimate.stored for estimate in keyframe.estimates):
            return Anchor(keyframe.sequence, np.zeros(3))
        if len(self._replica.maps) > 1:
            return None
        estimate, hybrid_map = keyframe.estimates[0], self._replica.maps[self._replica.best_hypothesis]
        if not hybrid_map.has_area(estimate.area):
            return None
        return nearest_anchor(hybrid_map, estimate.area, estimate.pose.mean)

    def _log_ratios(
        self, estimate: HypothesisEstimate, state: HypothesisState, keyframe: Keyframe
    ) -> tuple[float, float]:
        """log p(scan | not kidnapped) / p(scan | kidnapped) of the ends of its beams, and of walls they hit or pass.

        After a motion that was not ordinary, agreement with what the robot saw since tells nothing.

        :param state: after the motion to the keyframe.
        """
        log_ends, log_walls = estimate.log_evidence, -estimate.log_kidnapping_ratio - estimate.log_evidence
        onset = min(state.onset_conditions, default=keyframe.sequence)
        if onset == keyframe.sequence:
            return log_ends, log_walls
        hybrid_map, search = self._replica.maps[estimate.hypothesis], self._branching.search
        local_areas = {area: pose for area, pose in state.local_area_poses.items() if hybrid_map.has_area(area)}
        poses, points = {estimate.area: np.zeros(3), **local_areas}, search.surface_points(keyframe.scan)
        agreement = search.known_ground_agreement(
            hybrid_map, poses, points, estimate.pose.mean, onset // _ONSET_STEP * _ONSET_STEP
        )
        log_ends = known_ground_log_ratio(agreement, estimate.clutter.beam_outlier_rate)
        return log_ends, min(0.0, log_walls) + agreement.matched_share * max(0.0, log_walls)

    def _infer(self, events: AreaEvents) -> Hypotheses:
        """Weigh, branch, normalize, reduce."""
        if self._keyframe is None or self._keyframe.sequence != events.sequence:
            last = "none" if self._keyframe is None else self._keyframe.sequence
            raise HmtSlamError(
                f"area events {events.sequence} came, but the last keyframe is {last}: a message was lost, start again"
            )
        self._branching.begin_event()
        self._take_statements(events.sequence)
        by_hypothesis = {event.hypothesis: event for event in events.events}
        keyframe = self._keyframe
        parents = self._parents(keyframe)
        branched = {
            parent.hypothesis: self._branch(parent, by_hypothesis.get(parent.hypothesis), keyframe)
            for parent in _in_turn(parents, events.sequence)
        }
        branches = [branched[parent.hypothesis] for parent in parents]
        children = [child for branch in branches for child in branch.children]
        distributions = (branch.pose_distribution for branch in branches)
        self._pose_distribution = next((d for d in distributions if d is not None), self._pose_distribution)
        if not any(branch.closures_searched for branch in branches):
            self._branching.look_ahead(parents)
        reduced = self._reduce(events.sequence, children, branches)
        survivors = [children[k] for k in reduced.indices]
        hypotheses = self._surviving_hypotheses(children, survivors, reduced.probabilities)
        self._evidence.after_event(events.sequence, self._replica.maps, hypotheses, survivors)
        # Keyframes and beams that a revision, a reset or a kidnapping moves must still be there.
        revised = self._state.revised_hypotheses
        is_reset = keyframe.motion_unknown or keyframe.initial_pose is not None
        is_moved = any(hypothesis.moved_keyframes for hypothesis in hypotheses)
        comparisons = [child.state.comparison for child in survivors if child.state.comparison is not None]
        is_waiting = any(events.events or comparison.kind == "stated" for comparison in comparisons)
        pruned = () if revised or is_reset or is_moved or is_waiting else events.redundant_keyframes
        stale_beams = () if revised or is_reset else keyframe.stale_beams
        moved = self._move_pruned(pruned) if pruned else {}
        answer = Hypotheses(events.sequence, tuple(hypotheses), reduced.unexamined, pruned, stale_beams)
        statements = replace_keyframes(self._replica.statements, moved)
        self._replica.apply_hypotheses(answer)
        statements = self._weigh_statements(statements) if statements else ()
        if stale_beams:
            self._branching.forget_scans()
        loaded = [self._with_local_map(h, child) for h, child in zip(hypotheses, survivors, strict=True)]
        still_revised = revised if keyframe.motion_unknown else ()
        self._state = replace(self._state, unexamined=reduced.unexamined, revised_hypotheses=still_revised)
        ordered = tuple(sorted(loaded, key=lambda hypothesis: hypothesis.id))
        return replace(answer, hypotheses=ordered, statements=statements)

    def _take_statements(self, event: int) -> None:
        """Weigh the statements that came since the last event; during a revision they wait for the next one."""
        if not self._state.revised_hypotheses:
            self._notices += [Notice("tsbi", f"{text}.") for text in self._branching.statements.take(event)]

    def _weigh_statements(self, statements: tuple[WeighedStatement, ...]) -> tuple[WeighedStatement, ...]:
        """The statements with their probabilities under the surviving hypotheses."""
        self._notices += [Notice("tsbi", f"{text}.") for text in self._branching.statements.weigh(statements)]
        return self._replica.statements

    def _move_pruned(self, pruned: Sequence[PrunedKeyframe]) -> dict[int, int]:
        """Let marks be at the nearest keyframe of the same area instead of one that is pruned.

        :returns: {pruned keyframe: that one}.
        """
        hybrid_map = self._replica.maps[self._replica.best_hypothesis]
        gone = {one.keyframe for one in pruned}
        anchors = {
            one.keyframe: nearest_anchor(hybrid_map, one.area, hybrid_map.keyframes(one.area)[one.keyframe], gone)
            for one in pruned
        }
        self._branching.marks = self._branching.marks.without_keyframes(anchors)
        return {keyframe: anchor.keyframe for keyframe, anchor in anchors.items() if anchor is not None}

    def _parents(self, keyframe: Keyframe) -> list[Parent]:
        """The live hypotheses with their weights; of equivalent ones the heaviest, with the weight of all."""
        parents = [self._parent(hypothesis) for hypothesis in sorted(self._state.hypothesis_states)]
        if len(parents) == 1:
            return parents
        poses = [self._estimates[parent.hypothesis].pose.mean for parent in parents]
        points, kidnapped = self._branching.search.surface_points(keyframe.scan), self._kidnapped_since
        parents = [
            self._branching.reweight_by_known_ground(parent, pose, points, keyframe.sequence, kidnapped)
            for parent, pose in zip(parents, poses, strict=True)
        ]
        parents = [
            self._branching.reweight_by_marks(parent, self._estimates[parent.hypothesis].pose, keyframe.sequence)
            for parent in map(self._branching.statements.reweigh, parents)
        ]
        localized = [
            LocalizedHypothesis(p.hybrid_map, p.area, pose, {p.area, *p.local_area_poses()})
            for p, pose in zip(parents, poses, strict=True)
        ]
        log_weights = merge_equivalent(localized, [parent.log_weight for parent in parents])
        return [replace(parents[n], log_weight=log_weight) for n, log_weight in sorted(log_weights.items())]

    def _parent(self, hypothesis: int) -> Parent:
        estimate = self._estimates[hypothesis]
        probability = self._replica.probabilities[hypothesis]
        state = self._state.hypothesis_states[hypothesis]
        # A kidnapping is tested by the walls that beams pass as well.
        is_kidnapped = self._kidnapped_since is not None
        log_evidence = state.surroundings.log_likelihood if is_kidnapped else estimate.log_evidence
        return Parent(
            hypothesis,
            self._replica.robot_areas[hypothesis],
            self._replica.maps[hypothesis],
            state,
            math.log(max(probability, _MIN_PROBABILITY)) + log_evidence,
            probability,
            estimate.clutter,
        )

    @property
    def _kidnapped_since(self) -> int | None:
        """The first keyframe after a kidnapping of the robot under one of the hypotheses; None without one."""
        localizations = (state.localization for state in self._state.hypothesis_states.values())
        return min(
            (lost.since for lost in localizations if isinstance(lost, Lost) and lost.tracked_pose is not None),
            default=None,
        )

    def _branch(self, parent: Parent, event: AreaEvent | None, keyframe: Keyframe) -> Branches:
        """The children of one hypothesis, each with its weight."""
        if keyframe.motion_unknown or keyframe.initial_pose is not None:
            pose = self._estimates[parent.hypothesis].pose.mean
            branches = begin_relocalization(self._branching, parent, keyframe, pose)
            return branches if keyframe.mapping else accept_relocalization(branches)
        if self._state.revised_hypotheses:
            revised = self._state.revised_hypotheses
            return Branches([apply_revision(parent, explanation, keyframe.sequence) for explanation in revised])
        if not keyframe.mapping and isinstance(parent.state.localization, Tracking):
            relocalized_area = parent.state.localization.relocalized_area
            return self._branch_without_mapping(parent, event, keyframe.sequence, relocalized_area)
        if not any(state.is_lost for state in self._state.hypothesis_states.values()):
            kidnapped = spawn_kidnapped_hypothesis(self._branching, parent)
            if kidnapped is not None:
                return kidnapped
        if event is not None:
            return self._branch_on_area_event(parent, event)
        return self._branch_without_area_event(parent, self._estimates[parent.hypothesis], keyframe)

    def _branch_without_mapping(
        self, parent: Parent, event: AreaEvent | None, sequence: int, relocalized_area: int | None
    ) -> Branches:
        """The children without mapping: the robot in the same area, in another known one, or lost.

        What it mapped while it was lost leads nowhere, so it moves to the area of its relocalization as soon as that
        is certain.

        :param relocalized_area: that area, if there is one.
        """
        child = decide_without_mapping(self._branching, parent, sequence)
        if child.state.is_lost:
            return Branches([child])
        if (
            relocalized_area is not None
            and len(self._state.hypothesis_states) == 1
            and parent.hybrid_map.has_area(relocalized_area)
        ):
            return self._branching.entry.move(parent, relocalized_area)
        if event is not None and event.kind == "moved":
            return self._branching.entry.move(parent, event.area)
        return Branches([child])

    def _branch_on_area_event(self, parent: Parent, event: AreaEvent) -> Branches:
        """The children after an area was cut, two were merged, or the robot changed its area."""
        if event.kind == "cut":
            return self._branching.cut(parent, event.keyframes)
        if event.into is not None:
            return Branches([merge_areas(parent, event.area, event.into, self._branching.search)])
        if parent.state.comparison is not None:
            # Area abstraction repeats the move.
            return self._branching.continue_comparison(parent, parent.state.comparison)
        return self._branching.entry.move(parent, event.area)

    def _branch_without_area_event(self, parent: Parent, estimate: HypothesisEstimate, keyframe: Keyframe) -> Branches:
        """The children in the same area; the robot may be on known ground that no arc leads to."""
        overlap = self._branching.find_unlinked_overlap(parent, estimate.pose.mean)
        lost = parent.state.localization if isinstance(parent.state.localization, Lost) else None
        state = replace(parent.state.after_overlap(overlap), localization=lost or Tracking())
        parent = replace(parent, state=state)
        if state.unlinked_overlap is not None and state.unlinked_overlap[1] >= _OVERLAP_PERSISTENCE:
            return self._branching.entry.link(parent, state.unlinked_overlap[0], keyframe.scan, estimate.pose)
        unmatched = len(state.unmatched_keyframes)
        is_recheck_due = unmatched >= self._options.recheck_keyframes or (
            unmatched >= _RETRY_KEYFRAMES and self._branching.leads_elsewhere(parent)
        )
        if state.comparison is not None:
            # A search and a comparison that both go on take turns.
            is_recheck_due = keyframe.sequence % 2 == 0
        if is_search_due(self._branching, parent) or (is_searching(parent) and not is_recheck_due):
            branches = update_relocalization(self._branching, parent)
            return branches if keyframe.mapping else accept_relocalization(branches)
        if state.comparison is not None:
            return self._branching.continue_comparison(parent, state.comparison)
        pair = self._branching.statements.due_pair(parent) if keyframe.mapping else None
        if pair is not None:
            return self._branching.compare_stated(parent, pair)
        is_retry_due = bool(state.pending_candidates) and unmatched == _RETRY_KEYFRAMES and estimate.stored
        if is_recheck_due or is_retry_due:
            return self._branching.recheck(parent, () if is_recheck_due else state.pending_candidates)
        return Branches([parent.unchanged_child()])

    def _reduce(self, sequence: int, children: Sequence[Child], branches: Sequence[Branches]) -> ReducedDistribution:
        generator = random_stream(self._seed, Purpose.HYPOTHESES, sequence)
        searched = any(branch.closures_searched for branch in branches)
        return normalize_and_reduce(
            np.array([child.log_weight for child in children]),
            float(np.logaddexp.reduce([branch.log_skipped_weight for branch in branches])),
            self._state.unexamined * (_UNEXAMINED_DECAY if searched else 1.0),
            self._options.max_hypotheses,
            self._options.drop_probability,
            generator,
        )

    def _surviving_hypotheses(
        self, children: Sequence[Child], survivors: Sequence[Child], probabilities: Float64
    ) -> list[Hypothesis]:
        """The surviving hypotheses; an only child keeps the id of its parent, others get new ones."""
        self._robot_poses = {}
        siblings = Counter(child.parent for child in children)
        hypotheses = [
            self._hypothesis(child, siblings[child.parent] > 1, float(probability))
            for child, probability in zip(survivors, probabilities, strict=True)
        ]
        states = {hypothesis.id: child.state for hypothesis, child in zip(hypotheses, survivors, strict=True)}
        self._state = replace(self._state, hypothesis_states=states)
        if not any(state.is_lost for state in states.values()):
            self._branching.end_global_localization()
        return hypotheses

    def _hypothesis(self, child: Child, branched: bool, probability: float) -> Hypothesis:
        hypothesis = child.parent
        if branched:
            hypothesis = self._state.next_hypothesis
            self._state = replace(self._state, next_hypothesis=hypothesis + 1)
        localization, pose = child.state.localization, self._estimates[child.parent].pose.mean
        frame = child.frame_change
        self._robot_poses[hypothesis] = pose if frame is None else se2.compose(frame.mean, pose)
        newest = -1 if self._keyframe is None else self._keyframe.sequence
        return Hypothesis(
            hypothesis,
            child.parent,
            probability,
            child.area,
            child.frame_change,
            child.moved_keyframes,
            child.arcs,
            removed_arcs=child.removed_arcs,
            area_merge=child.area_merge,
            lost=isinstance(localization, Lost),
            tracking_reset=isinstance(localization, Lost) and localization.since > newest,
        )

    def _with_local_map(self, hypothesis: Hypothesis, child: Child) -> Hypothesis:
        """The hypothesis with the areas of its submap, if that is to be loaded again."""
        if not child.reload_local_map:
            return hypothesis
        search, area = self._branching.search, hypothesis.area
        around = areas_around(self._replica.maps[hypothesis.id], area, search.submap_radius)
        global_poses = GlobalPoses(self._state.global_poses)
        poses = {
            other: consistent_pose(belief, area, other, global_poses, search.gating.gate)
            for other, belief in around.items()
            if other != area
        }
        states = self._state.hypothesis_states
        state = replace(states[hypothesis.id], local_area_poses=poses)
        self._state = replace(self._state, hypothesis_states={**states, hypothesis.id: state})
        others = [LocalArea(other, pose) for other, pose in poses.items()]
        return replace(hypothesis, local_areas=(LocalArea(area, np.zeros(3)), *others))

    def _accept(self, decision: ClosureDecision) -> None:
        """Drop the other hypotheses and what was not examined, where one is definite."""
        if decision.global_poses:
            self._state = replace(self._state, global_poses=decision.global_poses)
        if decision.hypothesis is None:
            return
        self._evidence.clear(decision.sequence)
        self._replica.apply_decision(decision)
        self._branching.marks = self._branching.marks.restricted_to(self._replica.scans)
        self._state = replace(
            self._state,
            revised_hypotheses=decision.revised_hypotheses,
            hypothesis_states={decision.hypothesis: self._state.hypothesis_states[decision.hypothesis]},
            unexamined=0.0,
        )


def _in_turn(parents: Sequence[Parent], sequence: int) -> Sequence[Parent]:
    """The order in which hypotheses use the work of an event.

    While a comparison goes on, each is first in turn. A lost robot is searched for the most probable one first.
    """
    if all(parent.state.comparison is None for parent in parents):
        is_lost = any(parent.state.is_lost for parent in parents)
        return sorted(parents, key=lambda parent: -parent.log_weight) if is_lost else parents
    first = sequence % len(parents)
    return [*parents[first:], *parents[:first]]
