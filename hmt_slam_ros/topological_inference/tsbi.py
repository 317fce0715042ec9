"""Topological Space Bayesian Inference: the probability distribution over topological paths, Eqs. (6) and (14)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.hybrid_map.surroundings import areas_around, consistent_pose
from hmt_slam_ros.messages.map_changes import AreaPose, LocalArea
from hmt_slam_ros.messages.messages import (
    AreaEvent,
    AreaEvents,
    ClosureDecision,
    Hypotheses,
    Hypothesis,
    HypothesisEstimate,
    Keyframe,
    Message,
    TrackingReset,
)
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, GlobalPoses, Replica, ReplicaState
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.topological_inference.branching import (
    Branches,
    Branching,
    BranchingState,
    Child,
    Parent,
    apply_revision,
    merge_areas,
)
from hmt_slam_ros.topological_inference.global_localization import (
    HypothesisSummary,
    LocalizationStatus,
    PoseDistribution,
    summarize_localization,
)
from hmt_slam_ros.topological_inference.hypothesis_tree import (
    HypothesisState,
    LocalizedHypothesis,
    Lost,
    PoseInArea,
    ReducedDistribution,
    Tracking,
    merge_equivalent,
    normalize_and_reduce,
)
from hmt_slam_ros.topological_inference.relocalization import (
    accept_relocalization,
    begin_relocalization,
    decide_without_mapping,
    spawn_kidnapped_hypothesis,
    update_relocalization,
)

# Keyframe events in a row that the robot has to spend in an area of the local map before an arc joins it.
_OVERLAP_PERSISTENCE = 3
# Keyframes after which it is looked whether the robot is in known ground that it saw before it.
_RETRY_KEYFRAMES = 3


@dataclass(frozen=True, eq=False)
class TsbiState:
    """TSBI between two keyframe events, at first before the first one.

    :ivar replica: the maps of the live hypotheses.
    :ivar branching: what is known of areas beside these.
    :ivar hypothesis_states: {hypothesis: what is remembered of it}.
    :ivar next_hypothesis: the first number that no hypothesis had.
    :ivar unexamined: probability of the topologies that were not looked at.
    :ivar global_poses: ``map_T_area`` as TLCA told it last, ordered by area.
    :ivar revised_hypotheses: the explanations of a contradiction that TLCA has asked about, else empty.
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

    Consumes TrackingReset, Keyframe, AreaEvents, ClosureDecision; produces Hypotheses, and Notices of loops that are
    looked for.
    """

    def __init__(
        self,
        configuration: Configuration,
        branching: Callable[[Configuration, Replica], Branching] = Branching,
        state: TsbiState | None = None,
    ) -> None:
        """:param branching: what makes the children of hypotheses, such as one that is watched.

        :param state: to go on from.
        """
        state = state or TsbiState()
        self._options = configuration.tsbi
        self._seed = configuration.seed
        self._replica = Replica.from_state(state.replica)
        self._branching = branching(configuration, self._replica)
        self._branching.restore(state.branching)
        # All but the two parts above, which change in place.
        self._state = replace(state, replica=ReplicaState(), branching=BranchingState())
        self._keyframe: Keyframe | None = None
        self._estimates: dict[int, HypothesisEstimate] = {}
        # What the next look finds out anew: the keyframe event before which the robot arrived, and where it may be.
        self._reset_event = -1
        self._pose_distribution: PoseDistribution | None = None

    @property
    def state(self) -> TsbiState:
        """All that TSBI knows between two keyframe events, as a value."""
        return replace(self._state, replica=self._replica.state, branching=self._branching.state)

    @property
    def localization(self) -> LocalizationStatus:
        """What is known of the robot's place."""
        arriving = (-1 if self._keyframe is None else self._keyframe.sequence) < self._reset_event
        standings = [
            HypothesisSummary(
                probability,
                self._replica.robot_areas[hypothesis],
                arriving or self._state.hypothesis_states[hypothesis].is_lost,
            )
            for hypothesis, probability in self._replica.probabilities.items()
        ]
        best = self._replica.best_hypothesis
        leading = self._state.hypothesis_states[best].localization
        since = self._reset_event if arriving else leading.since if isinstance(leading, Lost) else None
        hybrid_map = self._replica.maps[best]
        known = sum(
            since is None or any(k < since for k in hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()
        )
        return summarize_localization(
            standings, self._state.unexamined, known, None if arriving else self._pose_distribution
        )

    def handle(self, message: Message) -> list[Message]:
        """Learn from ``Keyframe`` and ``ClosureDecision``; answer ``AreaEvents`` with ``Hypotheses``."""
        if isinstance(message, Keyframe):
            self._add_keyframe(message)
        elif isinstance(message, AreaEvents):
            answer = self._infer(message)
            landmarks = self._branching.landmarks
            return [*(landmarks.notices() if landmarks else ()), answer]
        elif isinstance(message, ClosureDecision):
            self._accept(message)
        elif isinstance(message, TrackingReset):
            self._reset_event, self._pose_distribution = message.event, None
        return []

    def _add_keyframe(self, keyframe: Keyframe) -> None:
        """Store the keyframe and what its scan says of every hypothesis."""
        self._replica.add_keyframe(keyframe)
        self._keyframe = keyframe
        self._estimates = {leaf.hypothesis: leaf for leaf in keyframe.estimates}
        states = dict(self._state.hypothesis_states)
        for leaf in keyframe.estimates:
            if leaf.hypothesis in states:
                held = keyframe.mapping or leaf.stored
                spot = None if held else PoseInArea(leaf.area, keyframe.sequence, leaf.pose.mean)
                notes = states[leaf.hypothesis].after_scan(keyframe.sequence, leaf.log_kidnapping_ratio, spot)
                stored = notes.after_keyframe(keyframe.sequence, leaf.pose.covariance) if leaf.stored else notes
                states[leaf.hypothesis] = stored
        self._state = replace(self._state, hypothesis_states=states)
        wanted = {event for notes in states.values() for event in notes.unstored_poses}
        self._branching.keep_scans(keyframe.sequence, keyframe.scan, wanted)

    def _infer(self, events: AreaEvents) -> Hypotheses:
        """Weight, branch, normalise, reduce."""
        if self._keyframe is None or self._keyframe.sequence != events.sequence:
            last = "none" if self._keyframe is None else self._keyframe.sequence
            raise HmtSlamError(
                f"area events {events.sequence} came, but the last keyframe is {last}: a message was lost, start again"
            )
        self._branching.begin_event()
        by_hypothesis = {event.hypothesis: event for event in events.events}
        keyframe = self._keyframe
        parents = self._parents(keyframe)
        branches = [self._branch(parent, by_hypothesis.get(parent.hypothesis), keyframe) for parent in parents]
        children = [child for branch in branches for child in branch.children]
        self._pose_distribution = next(
            (branch.pose_distribution for branch in branches if branch.pose_distribution is not None),
            self._pose_distribution,
        )
        if not any(branch.closures_searched for branch in branches):
            self._branching.look_ahead(parents)
        settled = self._reduce(events.sequence, children, branches)
        chosen = [children[k] for k in settled.indices]
        changed = self._surviving_hypotheses(children, chosen, settled.probabilities)
        # What a question that is open again moves has to be there.
        arrived_now = keyframe.motion_unknown or keyframe.initial_pose is not None
        # Area abstraction, which does not know that the robot was displaced, forgets where it moves nothing itself.
        displaced = any(leaf.moved_keyframes for leaf in changed)
        revised = self._state.revised_hypotheses
        forgotten = () if revised or arrived_now or displaced else events.redundant_keyframes
        outdated = () if revised or arrived_now else keyframe.stale_beams
        self._replica.apply_hypotheses(
            Hypotheses(events.sequence, tuple(changed), settled.unexamined, forgotten, outdated)
        )
        if outdated:
            self._branching.forget_scans()
        loaded = [self._with_local_map(changed[n], child) for n, child in enumerate(chosen)]
        still_revised = revised if keyframe.motion_unknown else ()
        self._state = replace(self._state, unexamined=settled.unexamined, revised_hypotheses=still_revised)
        leaves = tuple(sorted(loaded, key=lambda leaf: leaf.id))
        return Hypotheses(events.sequence, leaves, settled.unexamined, forgotten, outdated)

    def _parents(self, keyframe: Keyframe) -> list[Parent]:
        """The live hypotheses with their weights; of those that say the same, the heaviest, with the weight of all."""
        parents = [self._parent(hypothesis) for hypothesis in sorted(self._state.hypothesis_states)]
        if len(parents) == 1:
            return parents
        poses = [self._estimates[parent.hypothesis].pose.mean for parent in parents]
        points = self._branching.search.surface_points(keyframe.scan)
        parents = [
            self._branching.reweight_by_known_ground(parent, pose, points, keyframe.sequence)
            for parent, pose in zip(parents, poses, strict=True)
        ]
        claims = [
            LocalizedHypothesis(p.hybrid_map, p.area, pose, {p.area, *p.local_area_poses()})
            for p, pose in zip(parents, poses, strict=True)
        ]
        weights = merge_equivalent(claims, [parent.log_weight for parent in parents])
        return [replace(parents[n], log_weight=weight) for n, weight in sorted(weights.items())]

    def _parent(self, hypothesis: int) -> Parent:
        estimate = self._estimates[hypothesis]
        probability = self._replica.probabilities[hypothesis]
        # Where it is asked whether the robot was displaced, the walls that its beams pass tell.
        log_evidence = -estimate.log_kidnapping_ratio if self._is_kidnapped else estimate.log_evidence
        log_weight = math.log(max(probability, 1e-300)) + log_evidence
        area, hybrid_map = self._replica.robot_areas[hypothesis], self._replica.maps[hypothesis]
        return Parent(
            hypothesis,
            area,
            hybrid_map,
            self._state.hypothesis_states[hypothesis],
            log_weight,
            probability,
            estimate.clutter,
        )

    @property
    def _is_kidnapped(self) -> bool:
        """Whether the robot was displaced under one of the hypotheses, and is not found yet."""
        found = [state.localization for state in self._state.hypothesis_states.values()]
        return any(isinstance(one, Lost) and one.tracked_pose is not None for one in found)

    def _branch(self, parent: Parent, event: AreaEvent | None, keyframe: Keyframe) -> Branches:
        """The continuations of one hypothesis, each with its weight."""
        if keyframe.motion_unknown or keyframe.initial_pose is not None:
            come = begin_relocalization(self._branching, parent, keyframe, self._estimates[parent.hypothesis].pose.mean)
            return come if keyframe.mapping else accept_relocalization(come)
        if self._state.revised_hypotheses:
            return Branches(
                [apply_revision(parent, leaf, keyframe.sequence) for leaf in self._state.revised_hypotheses]
            )
        if not keyframe.mapping and isinstance(parent.state.localization, Tracking):
            found = parent.state.localization.relocalized_area
            return self._branch_without_mapping(parent, event, keyframe.sequence, found)
        if not any(notes.is_lost for notes in self._state.hypothesis_states.values()):
            displaced = spawn_kidnapped_hypothesis(self._branching, parent)
            if displaced is not None:
                return displaced
        if event is not None:
            return self._branch_on_area_event(parent, event)
        return self._branch_without_area_event(parent, self._estimates[parent.hypothesis], keyframe)

    def _branch_without_mapping(
        self, parent: Parent, event: AreaEvent | None, sequence: int, relocalized_area: int | None
    ) -> Branches:
        """The map stays as it is; the robot may go into another area of it, or be lost.

        What it mapped while it was lost is joined to the map in one place alone and leads nowhere, so that it goes over
        into the area where it was recognized as soon as that is sure.

        :param relocalized_area: that area, if there is one.
        """
        child = decide_without_mapping(self._branching, parent, sequence)
        if child.state.is_lost:
            return Branches([child])
        found = relocalized_area
        if found is not None and len(self._state.hypothesis_states) == 1 and parent.hybrid_map.has_area(found):
            return self._branching.move(parent, found)
        if event is not None and event.kind == "moved":
            return self._branching.move(parent, event.area)
        return Branches([child])

    def _branch_on_area_event(self, parent: Parent, event: AreaEvent) -> Branches:
        """Areas changed, or the robot its own."""
        if event.kind == "cut":
            return self._branching.cut(parent, event.keyframes)
        if event.into is not None:
            return Branches([merge_areas(parent, event.area, event.into, self._branching.search)])
        return self._branching.move(parent, event.area)

    def _branch_without_area_event(self, parent: Parent, estimate: HypothesisEstimate, keyframe: Keyframe) -> Branches:
        """No area was left; but the robot may be in known ground that area abstraction does not know to be near."""
        overlap = self._branching.find_unlinked_overlap(parent, estimate.pose.mean)
        lost = parent.state.localization if isinstance(parent.state.localization, Lost) else None
        notes = replace(parent.state.after_overlap(overlap), localization=lost or Tracking())
        parent = replace(parent, state=notes)
        if notes.unlinked_overlap is not None and notes.unlinked_overlap[1] >= _OVERLAP_PERSISTENCE:
            return self._branching.link(parent, notes.unlinked_overlap[0], keyframe.scan, estimate.pose)
        enough = self._options.recheck_keyframes
        if lost is not None and len(notes.unmatched_keyframes) >= (enough if lost.pose_hint is None else 1):
            looked = update_relocalization(self._branching, parent)
            return looked if keyframe.mapping else accept_relocalization(looked)
        if len(notes.unmatched_keyframes) >= enough:
            return self._branching.recheck(parent)
        if notes.pending_candidates and len(notes.unmatched_keyframes) == _RETRY_KEYFRAMES:
            return self._branching.recheck(parent, notes.pending_candidates)
        return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, notes)])

    def _reduce(self, sequence: int, children: Sequence[Child], branches: Sequence[Branches]) -> ReducedDistribution:
        generator = random_stream(self._seed, Purpose.HYPOTHESES, sequence)
        # Ground that was not looked at would show again by now, in the keyframes that are looked at.
        searched = any(branch.closures_searched for branch in branches)
        return normalize_and_reduce(
            np.array([child.log_weight for child in children]),
            float(np.logaddexp.reduce([branch.log_skipped_weight for branch in branches])),
            self._state.unexamined * (0.5 if searched else 1.0),
            self._options.max_hypotheses,
            self._options.drop_probability,
            generator,
        )

    def _surviving_hypotheses(
        self, children: Sequence[Child], chosen: Sequence[Child], probabilities: NDArray[np.float64]
    ) -> list[Hypothesis]:
        """The survivors; a hypothesis that did not branch keeps its id, children of one that did get new ones."""
        siblings = Counter(child.parent for child in children)
        leaves = [
            self._hypothesis(child, siblings[child.parent] > 1, float(probability))
            for child, probability in zip(chosen, probabilities, strict=True)
        ]
        states = {leaf.id: child.state for leaf, child in zip(leaves, chosen, strict=True)}
        self._state = replace(self._state, hypothesis_states=states)
        if not any(notes.is_lost for notes in states.values()):
            self._branching.end_global_localization()
        return leaves

    def _hypothesis(self, child: Child, branched: bool, probability: float) -> Hypothesis:
        hypothesis = child.parent
        if branched:
            hypothesis = self._state.next_hypothesis
            self._state = replace(self._state, next_hypothesis=hypothesis + 1)
        found, newest = child.state.localization, -1 if self._keyframe is None else self._keyframe.sequence
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
            lost=isinstance(found, Lost),
            tracking_reset=isinstance(found, Lost) and found.since > newest,
        )

    def _with_local_map(self, leaf: Hypothesis, child: Child) -> Hypothesis:
        """The leaf with the areas that its local map must hold, where that is to be loaded anew."""
        if not child.reload_local_map:
            return leaf
        around = areas_around(self._replica.maps[leaf.id], leaf.area, self._branching.search.submap_radius)
        global_poses = GlobalPoses(self._state.global_poses)
        poses = {
            area: consistent_pose(belief, leaf.area, area, global_poses, self._branching.search.gating.gate)
            for area, belief in around.items()
            if area != leaf.area
        }
        states = self._state.hypothesis_states
        located = replace(states[leaf.id], local_area_poses=poses)
        self._state = replace(self._state, hypothesis_states={**states, leaf.id: located})
        loaded = [LocalArea(area, pose) for area, pose in poses.items()]
        return replace(leaf, local_areas=(LocalArea(leaf.area, np.zeros(3)), *loaded))

    def _accept(self, accepted: ClosureDecision) -> None:
        """One hypothesis is definite: the others, and what was not examined, are gone."""
        if accepted.global_poses:
            self._state = replace(self._state, global_poses=accepted.global_poses)
        if accepted.hypothesis is None:
            return
        self._replica.apply_decision(accepted)
        self._state = replace(
            self._state,
            revised_hypotheses=accepted.revised_hypotheses,
            hypothesis_states={accepted.hypothesis: self._state.hypothesis_states[accepted.hypothesis]},
            unexamined=0.0,
        )
