"""Topological Loop Closure Acceptance: which topological path is definite, and where everything lies under it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, gate
from hmt_slam_ros.hybrid_map.common_map import Pair
from hmt_slam_ros.hybrid_map.global_map import consistent_map, shortest_path_map
from hmt_slam_ros.loop_closure.acceptance import Acceptance, Observation, observed
from hmt_slam_ros.loop_closure.closure_history import (
    Account,
    Closure,
    History,
    Name,
    Step,
    Undo,
    history_of,
    merged,
    steps_of,
    witnesses_of,
)
from hmt_slam_ros.loop_closure.closure_revision import Past, Question, Reopening, ReopeningState
from hmt_slam_ros.loop_closure.pose_ambiguity import Ambiguity, Frame
from hmt_slam_ros.messages.map_changes import Arc, AreaPose, Relabelled
from hmt_slam_ros.messages.messages import Accepted, Hypotheses, Keyframe, Leaf, Message, Notice
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica, ReplicaState

# Closures are never taken for more certain than this, whatever tlca.accept_probability is.
_LEAST_DOUBT = 1e-6


@dataclass(frozen=True, eq=False)
class _Path:
    """What TLCA remembers of one hypothesis; a value, so that children inherit it.

    :ivar version: number of the last change of its areas and arcs, of all hypotheses.
    :ivar parted: path length at which it parted from others, m.
    :ivar held: at how many of the latest keyframes in a row it dominated since then.
    :ivar definite: whether nothing happened since it was accepted.
    :ivar observations: arcs that wait for acceptance, in order.
    :ivar witnesses: {arc: the keyframes by which it was observed}, of the definite arcs.
    :ivar history: where the robot was.
    :ivar closures: those that were accepted, in order.
    """

    version: int = 0
    parted: float = 0.0
    held: int = 0
    definite: bool = False
    observations: tuple[Observation, ...] = ()
    witnesses: dict[Pair, frozenset[int]] = field(default_factory=dict)
    history: History = None
    closures: tuple[Closure, ...] = ()


@dataclass(frozen=True, eq=False)
class PathState:
    """What TLCA remembers of one hypothesis.

    :ivar version: number of the last change of its areas and arcs, of all hypotheses.
    :ivar parted: path length at which it parted from others, m.
    :ivar held: at how many of the latest keyframes in a row it dominated since then.
    :ivar definite: whether nothing happened since it was accepted.
    :ivar observations: arcs that wait for acceptance, in order.
    :ivar witnesses: {arc: the keyframes by which it was observed}, of the definite arcs.
    :ivar past: where the robot was, and the closures that were accepted.
    """

    version: int
    parted: float
    held: int
    definite: bool
    observations: tuple[Observation, ...]
    witnesses: Mapping[Pair, frozenset[int]]
    past: Past

    @classmethod
    def of(cls, path: _Path) -> PathState:
        """Of a path."""
        past = Past(steps_of(path.history), path.closures)
        return cls(path.version, path.parted, path.held, path.definite, path.observations, path.witnesses, past)

    def path(self) -> _Path:
        """The path."""
        return _Path(
            self.version,
            self.parted,
            self.held,
            self.definite,
            self.observations,
            dict(self.witnesses),
            history_of(self.past.steps),
            self.past.closures,
        )


@dataclass(frozen=True, eq=False)
class TlcaState:
    """TLCA between two keyframe events, at first before the first one.

    :ivar replica: the maps of the live hypotheses.
    :ivar paths: {hypothesis: what is remembered of it}.
    :ivar travelled: path length since the start, m.
    :ivar poses: {hypothesis: the robot's ``area_T_base`` at the last keyframe event, shape (3,), m and rad}.
    :ivar changes: how often areas or arcs of hypotheses changed.
    :ivar published: the change after which global poses were told last, -1 before the first.
    :ivar doubted: definite arcs of which it was told that they do not fit the others.
    :ivar reopening: what is known of questions that were opened again.
    :ivar frames: {(hypothesis, number of the last change of its map, area): ``map_T_area``, shape (3,), or None where
        no arc joins the area with the first}, of the robot's areas under several hypotheses.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    paths: Mapping[int, PathState] = field(default_factory=lambda: {FIRST_HYPOTHESIS: PathState.of(_Path())})
    travelled: float = 0.0
    poses: Mapping[int, NDArray[np.float64]] = field(default_factory=lambda: {FIRST_HYPOTHESIS: np.zeros(3)})
    changes: int = 0
    published: int = -1
    doubted: frozenset[Pair] = frozenset()
    reopening: ReopeningState = field(default_factory=ReopeningState)
    frames: Mapping[Frame, NDArray[np.float64] | None] = field(default_factory=dict)


class Tlca:
    """Answers every ``Hypotheses`` with an ``Accepted``.

    A path is accepted when it has dominated for some keyframes and metres since it parted from the last other one, and
    at once when no other is left. Then the others are dropped, the areas that it joined are finely aligned, and arcs
    that were travelled before are fused with what was known of them. Where accepted closures contradict each other,
    TSBI is asked anew instead.
    """

    def __init__(self, configuration: Configuration, state: TlcaState | None = None) -> None:
        """:param state: to go on from."""
        state = state or TlcaState()
        self._options = configuration.tlca
        self._acceptance = Acceptance(configuration)
        self._replica = Replica.of(state.replica)
        self._paths = {hypothesis: path.path() for hypothesis, path in state.paths.items()}
        self._travelled = state.travelled
        self._poses = dict(state.poses)
        self._changes, self._published = state.changes, state.published
        self._gate = gate(configuration.tsbi.gate_probability)
        self._doubted = set(state.doubted)
        self._reopening = Reopening(self._options, state.reopening)
        self._ambiguity = Ambiguity(state.frames)
        # The stated risk: beyond it, TSBI's probabilities are not taken at their word.
        self._least_doubt = max(1.0 - self._options.accept_probability, _LEAST_DOUBT)
        self._accepted_now: frozenset[Name] = frozenset()
        self._mapping = True

    @property
    def state(self) -> TlcaState:
        """All that TLCA knows between two keyframe events, as a value."""
        return TlcaState(
            self._replica.state,
            {hypothesis: PathState.of(path) for hypothesis, path in self._paths.items()},
            self._travelled,
            dict(self._poses),
            self._changes,
            self._published,
            frozenset(self._doubted),
            self._reopening.state,
            dict(self._ambiguity.frames),
        )

    def handle(self, message: Message) -> list[Message]:
        """Learn from a ``Keyframe``; answer ``Hypotheses``."""
        if isinstance(message, Keyframe):
            self._replica.add(message)
            self._travelled, self._mapping = message.travelled, message.mapping
            self._poses |= {leaf.hypothesis: leaf.pose.mean for leaf in message.leaves}
        elif isinstance(message, Hypotheses):
            return self._judge(message)
        return []

    def shortest_path_poses(self) -> dict[int, PoseGaussian]:
        """``map_T_area`` of the most probable hypothesis along the least uncertain paths only, Eq. (15)."""
        return shortest_path_map(self._replica.maps[self._replica.best]).poses

    def _judge(self, hypotheses: Hypotheses) -> list[Message]:
        paths = {leaf.hypothesis: self._followed(leaf, hypotheses.sequence) for leaf in hypotheses.leaves}
        self._poses = {leaf.hypothesis: _rebased(self._poses[leaf.parent], leaf) for leaf in hypotheses.leaves}
        self._replica.apply(hypotheses)
        self._paths, self._accepted_now = paths, frozenset()
        chosen = self._dominant()
        arcs, relabelled = ((), ()) if chosen is None else self._refined(chosen)
        accepted = Accepted(hypotheses.sequence, chosen, arcs, relabelled)
        self._replica.accept(accepted)
        self._paths = {hypothesis: self._paths[hypothesis] for hypothesis in self._replica.maps}
        versions = {hypothesis: path.version for hypothesis, path in self._paths.items()}
        accepted = replace(accepted, ambiguity=self._ambiguity.of(self._replica, self._poses, versions))
        question = None if chosen is None else self._contradicted(chosen, hypotheses.sequence)
        if question is not None:
            # No pose is told: the map is not bent to what does not fit.
            return [question.notice, replace(accepted, reopened=question.leaves)]
        poses, notices = self._global_poses()
        return [*notices, replace(accepted, global_poses=poses)]

    def _contradicted(self, hypothesis: int, event: int) -> Question | None:
        """The contradiction that the closures bring that have just been accepted, if any."""
        path, area = self._paths[hypothesis], self._replica.areas[hypothesis]
        account = Account(self._replica.maps[hypothesis], path.history, path.closures, area, self._poses[hypothesis])
        return self._reopening.asked(event, account, self._accepted_now, hypothesis)

    def _followed(self, leaf: Leaf, sequence: int) -> _Path:
        """The path after TSBI's answer, which is not applied yet: the arcs that it replaces are still there."""
        path, before = self._paths[leaf.parent], self._replica.areas[leaf.parent]
        if leaf.hypothesis != leaf.parent:
            path = replace(path, parted=self._travelled, held=0)
        dominates = leaf.probability >= self._options.accept_probability
        path = replace(path, held=path.held + 1 if dominates else 0)
        if leaf.arcs or leaf.relabelled or leaf.withdrawn or leaf.merged:
            self._changes += 1
            path = replace(path, version=self._changes, definite=False)
        elif leaf.rebase:
            path = replace(path, definite=False)
        past = self._reopening.followed(leaf, sequence)
        if past is not None:
            return replace(path, definite=False, history=history_of(past.steps), closures=past.closures)
        parent = self._replica.maps[leaf.parent]
        if leaf.merged is not None:
            history, closures = merged(Account(parent, path.history, path.closures, before, np.zeros(3)), leaf.merged)
            witnesses = witnesses_of(path.witnesses, leaf.merged)
            return replace(path, history=history, closures=closures, witnesses=witnesses)
        observations = tuple(observed(arc, leaf, sequence, before, parent) for arc in leaf.arcs)
        new = tuple(seen.pair for seen in observations if seen.before is None)
        if new or leaf.area != before:
            joined = frozenset(r.keyframe for r in leaf.relabelled if r.area == leaf.area)
            path = replace(path, history=(path.history, Step(sequence, before, leaf.area, new, joined)))
        return replace(path, observations=path.observations + observations)

    def _dominant(self) -> int | None:
        """The hypothesis that becomes definite now, if any."""
        best = self._replica.best
        path = self._paths[best]
        if len(self._paths) == 1:
            return None if path.definite else best
        held = path.held >= self._options.accept_keyframes
        return best if held and self._travelled - path.parted >= self._options.accept_distance else None

    def _refined(self, hypothesis: int) -> tuple[tuple[Arc, ...], tuple[Relabelled, ...]]:
        """Align and fuse what the accepted path observed, changing its map."""
        path, hybrid_map = self._paths[hypothesis], self._replica.maps[hypothesis]
        found = [seen.pair for seen in path.observations if seen.closure]
        found += [closure.pair for closure in path.closures if closure.undo is None]
        # What is refined moves, which is a change of the map.
        closed = {area for pair in found for area in pair} if self._mapping else set()
        poses = {k: (area, pose) for area in sorted(closed) for k, pose in hybrid_map.keyframes(area).items()}
        made = self._acceptance.of(hybrid_map, self._replica.scans, path.observations, path.witnesses, closed)
        if made.arcs:
            self._changes += 1
        version = self._changes if made.arcs else path.version
        closures = self._closures(path, self._replica.probabilities[hypothesis], Undo(poses, made.before))
        self._paths[hypothesis] = replace(
            path, version=version, definite=True, observations=(), witnesses=made.witnesses, closures=closures
        )
        return tuple(made.arcs.values()), tuple(made.relabelled)

    def _closures(self, path: _Path, probability: float, undo: Undo) -> tuple[Closure, ...]:
        """Those of a path that is now accepted; what was observed again since is not to be undone."""
        again = {seen.pair for seen in path.observations if seen.before is not None}
        closures = {c.pair: replace(c, undo=undo) if c.undo is None else c.but_for(again) for c in path.closures}
        doubt = min(max(1.0 - probability, self._least_doubt), 0.5)
        for seen in path.observations:
            if seen.closure and seen.pair not in closures:
                closures[seen.pair] = seen.accepted(math.log((1.0 - doubt) / doubt), undo)
        self._accepted_now = frozenset(c.name for c in list(closures.values())[len(path.closures) :])
        return tuple(closures.values())

    def _global_poses(self) -> tuple[tuple[AreaPose, ...], list[Message]]:
        """The poses of all areas under the most probable hypothesis, where they changed; arcs that refuse to fit."""
        best = self._replica.best
        version = self._paths[best].version
        if version == self._published:
            return (), []
        self._published = version
        hybrid_map = self._replica.maps[best]
        consistent = self._options.global_map == "consistent"
        found = consistent_map(hybrid_map) if consistent else shortest_path_map(hybrid_map)
        notices = self._misfits(found.arc_chi2) if self._paths[best].definite else []
        return tuple(AreaPose(area, pose) for area, pose in found.poses.items()), notices

    def _misfits(self, arc_chi2: dict[Pair, float]) -> list[Message]:
        """A notice of every definite arc that does not fit the others, once: a sign of a closure that was false."""
        wrong = [pair for pair, value in arc_chi2.items() if value > self._gate and pair not in self._doubted]
        self._doubted.update(wrong)
        return [
            Notice(
                "tlca",
                f"The arc between areas {a} and {b} misses the other arcs by a chi-square of {arc_chi2[a, b]:.1f}, "
                f"above {self._gate:.1f}: a loop may be closed falsely; raise tlca.accept_probability.",
            )
            for a, b in wrong
        ]


def _rebased(pose: NDArray[np.float64], leaf: Leaf) -> NDArray[np.float64]:
    return pose if leaf.rebase is None else se2.compose(leaf.rebase.mean, pose)
