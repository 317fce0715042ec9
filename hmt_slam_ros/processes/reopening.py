"""What TLCA asks TSBI anew where closures that were accepted contradict each other."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.configuration.topological import LoopClosureAcceptance
from hmt_slam_ros.geometry.chi_square import gate
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.closure_account import Account, Closure, Name, Step, steps_of
from hmt_slam_ros.processes.doubts import Doubt, Doubts, Explanation
from hmt_slam_ros.processes.map_parts import Arc, ArcEnds, Relabelled
from hmt_slam_ros.processes.messages import Leaf, Notice
from hmt_slam_ros.processes.replica import FIRST_AREA
from hmt_slam_ros.topology.common_map import Pair
from hmt_slam_ros.topology.hybrid_map import HybridMap

Key = tuple[tuple[Pair, ...], tuple[Pair, ...]]


class Question(NamedTuple):
    """A question that is open again.

    :ivar leaves: the answers.
    :ivar notice: what a person should know of it.
    """

    leaves: tuple[Leaf, ...]
    notice: Notice


class Past(NamedTuple):
    """What a path went through.

    :ivar steps: the keyframe events at which the robot changed its area or arcs were new, in order.
    :ivar closures: those that were accepted, in order.
    """

    steps: tuple[Step, ...]
    closures: tuple[Closure, ...]


@dataclass(frozen=True, eq=False)
class ReopeningState:
    """What is known of questions that were opened again.

    :ivar largest_area: the largest area that there ever was.
    :ivar asked_at: the keyframe event of the last question, -1 before the first.
    :ivar answers: {(arcs withdrawn, arcs set): the past of a path that goes on with this answer to it}.
    """

    largest_area: int = FIRST_AREA
    asked_at: int = -1
    answers: Mapping[Key, Past] = field(default_factory=dict)


class Reopening:
    """Finds contradictions, and knows the answers again that TSBI goes on with."""

    def __init__(self, options: LoopClosureAcceptance, state: ReopeningState) -> None:
        """:param state: to go on from."""
        self._bound = gate(options.contradiction_probability)
        self._least = 1.0 - options.accept_probability
        self._largest_area = state.largest_area
        self._asked_at = state.asked_at
        self._answers = dict(state.answers)

    @property
    def state(self) -> ReopeningState:
        """All that is known."""
        return ReopeningState(self._largest_area, self._asked_at, dict(self._answers))

    def asked(self, event: int, account: Account, new: Collection[Name], hypothesis: int) -> Question | None:
        """The question that closures raise which have just been accepted, if they do not fit.

        :param new: these closures.
        :param hypothesis: the hypothesis of the account.
        """
        doubt = Doubts(account, self._bound, self._largest_area + 1).raised(new, self._least)
        if doubt is None:
            return None
        leaves = tuple(_as_leaf(explanation, hypothesis, account.hybrid_map) for explanation in doubt.explanations)
        self._asked_at = event
        self._answers = {
            _key(leaf): Past(steps_of(explanation.account.history), explanation.account.closures)
            for leaf, explanation in zip(leaves, doubt.explanations, strict=True)
        }
        for leaf in leaves:
            self._know(leaf)
        return Question(leaves, Notice("tlca", _told(doubt, self._bound)))

    def followed(self, leaf: Leaf, event: int) -> Past | None:
        """Learn of a leaf; where it answers the question of the event before, the past of a path with that answer."""
        self._know(leaf)
        return self._answers[_key(leaf)] if event == self._asked_at + 1 and self._answers else None

    def _know(self, leaf: Leaf) -> None:
        areas = [area for arc in leaf.arcs for area in (arc.source, arc.target)]
        self._largest_area = max(self._largest_area, leaf.area, *areas)


def _as_leaf(explanation: Explanation, hypothesis: int, hybrid_map: HybridMap) -> Leaf:
    """What an explanation changes, as the child of a hypothesis.

    :param hybrid_map: of the hypothesis.
    """
    account = explanation.account
    changed = account.hybrid_map
    former = {k: area for area in changed.areas if hybrid_map.has_area(area) for k in hybrid_map.keyframes(area)}
    relabelled = tuple(
        Relabelled(k, former[k], area, pose)
        for area, keyframes in sorted(changed.areas.items())
        for k, pose in keyframes.items()
        if former[k] != area or not np.array_equal(pose, hybrid_map.keyframes(area)[k])
    )
    rebase = None if account.rebase is None else PoseGaussian.exactly(account.rebase)
    return Leaf(
        hypothesis,
        hypothesis,
        explanation.probability,
        account.area,
        rebase,
        relabelled,
        tuple(Arc(a, b, arc.pose, arc.closure) for (a, b), arc in sorted(changed.arcs.items()) if arc is not None),
        withdrawn=tuple(
            ArcEnds(a, b) for (a, b), arc in sorted(changed.arcs.items()) if arc is None and hybrid_map.arc(a, b)
        ),
    )


def _key(leaf: Leaf) -> Key:
    withdrawn = tuple((ends.source, ends.target) for ends in leaf.withdrawn)
    return withdrawn, tuple((arc.source, arc.target) for arc in leaf.arcs)


def _told(doubt: Doubt, bound: float) -> str:
    """One sentence."""
    a, b = doubt.closure.pair
    best = doubt.explanations[0]
    false = " and ".join(f"{closure.near}-{closure.far}" for closure in best.false) or "none"
    return (
        f"The closure between areas {a} and {b} contradicts those accepted before by a chi-square of "
        f"{doubt.excess:.1f}, above {bound:.1f}: of all closures {false} is taken for false with probability "
        f"{best.probability:.3f}; raise tlca.accept_probability if this happens often."
    )
