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
from hmt_slam_ros.hybrid_map.surroundings import agreeing, areas_around
from hmt_slam_ros.messages.map_changes import AreaPose, LocalArea
from hmt_slam_ros.messages.messages import (
    Accepted,
    AreaEvent,
    AreaEvents,
    Arriving,
    Hypotheses,
    Keyframe,
    Leaf,
    LeafEstimate,
    Message,
)
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, GlobalPoses, Replica, ReplicaState
from hmt_slam_ros.random_streams import Purpose, stream
from hmt_slam_ros.topological_inference.branching import Branches, Branching, BranchingState, Child, Parent, reopened
from hmt_slam_ros.topological_inference.branching import merged as merged_into
from hmt_slam_ros.topological_inference.global_localization import Whereabouts
from hmt_slam_ros.topological_inference.hypothesis_merging import Claim, merged
from hmt_slam_ros.topological_inference.hypothesis_tree import LeafNotes, Settled, Spot, settle
from hmt_slam_ros.topological_inference.kidnapping import displaced_or_not, with_displaced
from hmt_slam_ros.topological_inference.localization_status import Localization, Standing, localization
from hmt_slam_ros.topological_inference.relocalization import arrived, looked_for, surely_found

# Keyframe events in a row that the robot has to spend in an area of the local map before an arc joins it.
_ASTRAY = 3
# Keyframes after which it is looked whether the robot is in known ground that it saw before it.
_SOON = 3


@dataclass(frozen=True, eq=False)
class TsbiState:
    """TSBI between two keyframe events, at first before the first one.

    :ivar replica: the maps of the live hypotheses.
    :ivar branching: what is known of areas beside these.
    :ivar notes: {hypothesis: what is remembered of it}.
    :ivar next_hypothesis: the first number that no hypothesis had.
    :ivar unexamined: probability of the topologies that were not looked at.
    :ivar global_poses: ``map_T_area`` as TLCA told it last, ordered by area.
    :ivar reopened: the explanations of a contradiction that TLCA has asked about, else empty.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    branching: BranchingState = field(default_factory=BranchingState)
    notes: Mapping[int, LeafNotes] = field(default_factory=lambda: {FIRST_HYPOTHESIS: LeafNotes()})
    next_hypothesis: int = FIRST_HYPOTHESIS + 1
    unexamined: float = 0.0
    global_poses: tuple[AreaPose, ...] = ()
    reopened: tuple[Leaf, ...] = ()


class Tsbi:
    """Answers the area events of every keyframe with the live hypotheses.

    Consumes Arriving, Keyframe, AreaEvents, Accepted; produces Hypotheses, and Notices of loops that are looked for.
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
        self._replica = Replica.of(state.replica)
        self._branching = branching(configuration, self._replica)
        self._branching.go_on_from(state.branching)
        self._notes = dict(state.notes)
        self._keyframe: Keyframe | None = None
        self._estimates: dict[int, LeafEstimate] = {}
        self._next_hypothesis = state.next_hypothesis
        self._unexamined = state.unexamined
        self._global_poses = GlobalPoses(state.global_poses)
        self._reopened = state.reopened
        # What the next look finds out anew: the keyframe event before which the robot arrived, and where it may be.
        self._arriving = -1
        self._where: Whereabouts | None = None

    @property
    def state(self) -> TsbiState:
        """All that TSBI knows between two keyframe events, as a value."""
        return TsbiState(
            self._replica.state,
            self._branching.state,
            dict(self._notes),
            self._next_hypothesis,
            self._unexamined,
            self._global_poses.areas,
            self._reopened,
        )

    @property
    def localization(self) -> Localization:
        """What is known of the robot's place."""
        arriving = (-1 if self._keyframe is None else self._keyframe.sequence) < self._arriving
        standings = [
            Standing(probability, self._replica.areas[hypothesis], arriving or self._notes[hypothesis].lost is not None)
            for hypothesis, probability in self._replica.probabilities.items()
        ]
        best = self._replica.best
        since = self._arriving if arriving else self._notes[best].lost
        hybrid_map = self._replica.maps[best]
        known = sum(
            since is None or any(k < since for k in hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()
        )
        return localization(standings, self._unexamined, known, None if arriving else self._where)

    def handle(self, message: Message) -> list[Message]:
        """Learn from ``Keyframe`` and ``Accepted``; answer ``AreaEvents`` with ``Hypotheses``."""
        if isinstance(message, Keyframe):
            self._note(message)
        elif isinstance(message, AreaEvents):
            answer = self._infer(message)
            landmarks = self._branching.landmarks
            return [*(landmarks.notices() if landmarks else ()), answer]
        elif isinstance(message, Accepted):
            self._accept(message)
        elif isinstance(message, Arriving):
            self._arriving, self._where = message.event, None
        return []

    def _note(self, keyframe: Keyframe) -> None:
        """Store the keyframe and what its scan says of every hypothesis."""
        self._replica.add(keyframe)
        self._keyframe = keyframe
        self._estimates = {leaf.hypothesis: leaf for leaf in keyframe.leaves}
        for leaf in keyframe.leaves:
            if leaf.hypothesis in self._notes:
                held = keyframe.mapping or leaf.stored
                spot = None if held else Spot(leaf.area, keyframe.sequence, leaf.pose.mean)
                notes = self._notes[leaf.hypothesis].heard(keyframe.sequence, leaf.doubt, spot)
                stored = notes.stored(keyframe.sequence, leaf.pose.covariance) if leaf.stored else notes
                self._notes[leaf.hypothesis] = stored
        wanted = {event for notes in self._notes.values() for event in notes.spots}
        self._branching.remember(keyframe.sequence, keyframe.scan, wanted)

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
        self._where = next((branch.where for branch in branches if branch.where is not None), self._where)
        if not any(branch.looked for branch in branches):
            self._branching.look_ahead(parents)
        settled = self._settle(events.sequence, children, branches)
        chosen = [children[k] for k in settled.kept]
        changed = self._leaves(children, chosen, settled.probabilities)
        # What a question that is open again moves has to be there.
        arrived_now = keyframe.carried or keyframe.place is not None
        # Area abstraction, which does not know that the robot was displaced, forgets where it moves nothing itself.
        displaced = any(leaf.relabelled for leaf in changed)
        forgotten = () if self._reopened or arrived_now or displaced else events.forgotten
        outdated = () if self._reopened or arrived_now else keyframe.outdated
        self._replica.apply(Hypotheses(events.sequence, tuple(changed), settled.unexamined, forgotten, outdated))
        if outdated:
            self._branching.forget_scans()
        loaded = [self._loaded(changed[n], child) for n, child in enumerate(chosen)]
        self._unexamined, self._reopened = settled.unexamined, self._reopened if keyframe.carried else ()
        leaves = tuple(sorted(loaded, key=lambda leaf: leaf.hypothesis))
        return Hypotheses(events.sequence, leaves, settled.unexamined, forgotten, outdated)

    def _parents(self, keyframe: Keyframe) -> list[Parent]:
        """The live hypotheses with their weights; of those that say the same, the heaviest, with the weight of all."""
        parents = [self._parent(hypothesis) for hypothesis in sorted(self._notes)]
        if len(parents) == 1:
            return parents
        poses = [self._estimates[parent.hypothesis].pose.mean for parent in parents]
        points = self._branching.search.surface_points(keyframe.scan)
        parents = [
            self._branching.recognized(parent, pose, points, keyframe.sequence)
            for parent, pose in zip(parents, poses, strict=True)
        ]
        claims = [
            Claim(p.hybrid_map, p.area, pose, {p.area, *p.around()}) for p, pose in zip(parents, poses, strict=True)
        ]
        weights = merged(claims, [parent.log_weight for parent in parents])
        return [replace(parents[n], log_weight=weight) for n, weight in sorted(weights.items())]

    def _parent(self, hypothesis: int) -> Parent:
        estimate = self._estimates[hypothesis]
        probability = self._replica.probabilities[hypothesis]
        # Where it is asked whether the robot was displaced, the walls that its beams pass tell.
        log_evidence = -estimate.doubt if self._displaced else estimate.log_evidence
        log_weight = math.log(max(probability, 1e-300)) + log_evidence
        area, hybrid_map = self._replica.areas[hypothesis], self._replica.maps[hypothesis]
        return Parent(hypothesis, area, hybrid_map, self._notes[hypothesis], log_weight, probability, estimate.clutter)

    @property
    def _displaced(self) -> bool:
        """Whether the robot was displaced under one of the hypotheses, and is not found yet."""
        return any(notes.claim is not None for notes in self._notes.values())

    def _branch(self, parent: Parent, event: AreaEvent | None, keyframe: Keyframe) -> Branches:
        """The continuations of one hypothesis, each with its weight."""
        if keyframe.carried or keyframe.place is not None:
            come = arrived(self._branching, parent, keyframe, self._estimates[parent.hypothesis].pose.mean)
            return come if keyframe.mapping else surely_found(come)
        if self._reopened:
            return Branches([reopened(parent, leaf, keyframe.sequence) for leaf in self._reopened])
        if not keyframe.mapping and parent.notes.lost is None:
            return self._unmapped(parent, event, keyframe.sequence)
        if not any(notes.lost is not None for notes in self._notes.values()):
            displaced = with_displaced(self._branching, parent)
            if displaced is not None:
                return displaced
        if event is not None:
            return self._changed(parent, event)
        return self._go_on(parent, self._estimates[parent.hypothesis], keyframe)

    def _unmapped(self, parent: Parent, event: AreaEvent | None, sequence: int) -> Branches:
        """The map stays as it is; the robot may go into another area of it, or be lost.

        What it mapped while it was lost is joined to the map in one place alone and leads nowhere, so that it goes over
        into the area where it was recognized as soon as that is sure.
        """
        child, found = displaced_or_not(self._branching, parent, sequence), parent.notes.found
        if child.notes.lost is not None:
            return Branches([child])
        if found is not None and len(self._notes) == 1 and parent.hybrid_map.has_area(found):
            return self._branching.move(parent, found)
        if event is not None and event.kind == "moved":
            return self._branching.move(parent, event.area)
        return Branches([child])

    def _changed(self, parent: Parent, event: AreaEvent) -> Branches:
        """Areas changed, or the robot its own."""
        if event.kind == "cut":
            return self._branching.cut(parent, event.keyframes)
        if event.into is not None:
            return Branches([merged_into(parent, event.area, event.into, self._branching.search)])
        return self._branching.move(parent, event.area)

    def _go_on(self, parent: Parent, estimate: LeafEstimate, keyframe: Keyframe) -> Branches:
        """No area was left; but the robot may be in known ground that area abstraction does not know to be near."""
        notes = replace(parent.notes.seen_in(self._branching.astray(parent, estimate.pose.mean)), found=None)
        parent = replace(parent, notes=notes)
        if notes.astray is not None and notes.astray[1] >= _ASTRAY:
            return self._branching.link(parent, notes.astray[0], keyframe.scan, estimate.pose)
        enough = self._options.recheck_keyframes if notes.told is None else 1
        if len(notes.unchecked) >= enough and notes.lost is not None:
            looked = looked_for(self._branching, parent)
            return looked if keyframe.mapping else surely_found(looked)
        if len(notes.unchecked) >= self._options.recheck_keyframes:
            return self._branching.recheck(parent)
        if notes.beside and len(notes.unchecked) == _SOON:
            return self._branching.recheck(parent, notes.beside)
        return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, notes)])

    def _settle(self, sequence: int, children: Sequence[Child], branches: Sequence[Branches]) -> Settled:
        generator = stream(self._seed, Purpose.HYPOTHESES, sequence)
        # Ground that was not looked at would show again by now, in the keyframes that are looked at.
        if any(branch.looked for branch in branches):
            self._unexamined *= 0.5
        return settle(
            np.array([child.log_weight for child in children]),
            float(np.logaddexp.reduce([branch.log_skipped for branch in branches])),
            self._unexamined,
            self._options.max_hypotheses,
            self._options.drop_probability,
            generator,
        )

    def _leaves(
        self, children: Sequence[Child], chosen: Sequence[Child], probabilities: NDArray[np.float64]
    ) -> list[Leaf]:
        """The survivors; a hypothesis that did not branch keeps its id, children of one that did get new ones."""
        siblings = Counter(child.parent for child in children)
        leaves = [
            self._leaf(child, siblings[child.parent] > 1, float(probability))
            for child, probability in zip(chosen, probabilities, strict=True)
        ]
        self._notes = {leaf.hypothesis: child.notes for leaf, child in zip(leaves, chosen, strict=True)}
        if all(notes.lost is None for notes in self._notes.values()):
            self._branching.found()
        return leaves

    def _leaf(self, child: Child, branched: bool, probability: float) -> Leaf:
        hypothesis = child.parent
        if branched:
            hypothesis = self._next_hypothesis
            self._next_hypothesis += 1
        lost, newest = child.notes.lost, -1 if self._keyframe is None else self._keyframe.sequence
        return Leaf(
            hypothesis,
            child.parent,
            probability,
            child.area,
            child.rebase,
            child.relabelled,
            child.arcs,
            withdrawn=child.withdrawn,
            merged=child.merged,
            lost=lost is not None,
            arriving=lost is not None and lost > newest,
        )

    def _loaded(self, leaf: Leaf, child: Child) -> Leaf:
        """The leaf with the areas that its local map must hold, where that is to be loaded anew."""
        if not child.reload:
            return leaf
        around = areas_around(self._replica.maps[leaf.hypothesis], leaf.area, self._branching.search.nearness)
        poses = {
            area: agreeing(belief, leaf.area, area, self._global_poses, self._branching.search.admission.gate)
            for area, belief in around.items()
            if area != leaf.area
        }
        self._notes[leaf.hypothesis] = replace(self._notes[leaf.hypothesis], local=poses)
        loaded = [LocalArea(area, pose) for area, pose in poses.items()]
        return replace(leaf, local=(LocalArea(leaf.area, np.zeros(3)), *loaded))

    def _accept(self, accepted: Accepted) -> None:
        """One hypothesis is definite: the others, and what was not examined, are gone."""
        if accepted.global_poses:
            self._global_poses = GlobalPoses(accepted.global_poses)
        if accepted.hypothesis is None:
            return
        self._replica.accept(accepted)
        self._reopened = accepted.reopened
        self._notes = {accepted.hypothesis: self._notes[accepted.hypothesis]}
        self._unexamined = 0.0
