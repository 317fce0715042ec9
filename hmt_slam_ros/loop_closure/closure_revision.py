"""Do accepted closures contradict each other, and what TLCA asks TSBI anew where they do.

A closure fits where the chi-square of all arcs does not grow by more than a quantile with its cycle. Where one that is
new does not fit, either it is false, or one that was accepted before and with it whatever was accepted because of it,
or chance has been unkind. The most probable explanation is the one of least chi-square, with the odds at which a
closure was accepted as the price of its being false:

    -2 log P = chi2 - 3 (closures left) + 2 log odds(first that is false) + const

What was accepted after a false closure was judged by a false map; of these, all that do not fit are false for nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.configuration.topology import LoopClosureAcceptance
from hmt_slam_ros.geometry.gaussian import PoseGaussian, gate
from hmt_slam_ros.hybrid_map.common_map import Pair
from hmt_slam_ros.hybrid_map.global_map import contradiction
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.loop_closure.closure_history import (
    Account,
    Closure,
    Name,
    Step,
    as_measured,
    steps_of,
    unrefined,
    without,
)
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, Relabelled
from hmt_slam_ros.messages.messages import Leaf, Notice
from hmt_slam_ros.messages.replica import FIRST_AREA

_DEGREES_OF_FREEDOM = 3


class Explanation(NamedTuple):
    """One way in which closures that contradict each other go together.

    :ivar account: the path without what is false.
    :ivar false: the closures that are false, in the order of acceptance.
    :ivar probability: that this is so.
    """

    account: Account
    false: tuple[Closure, ...]
    probability: float


class Doubt(NamedTuple):
    """A closure that does not fit.

    :ivar closure: the new closure.
    :ivar excess: by how much the chi-square grows with it.
    :ivar explanations: of that, the most probable first.
    """

    closure: Closure
    excess: float
    explanations: tuple[Explanation, ...]


class Doubts:
    """Looks for contradictions in one account.

    :param bound: the quantile of chi-square.
    :param new_area: the first number that no area has.
    """

    def __init__(self, account: Account, bound: float, new_area: int) -> None:
        self._account = account
        self._bound = bound
        self._new_area = new_area
        self._accounts: dict[frozenset[Name], Account] = {}
        self._chi2: dict[frozenset[Name], float] = {}

    def raised(self, new: Collection[Name], least: float) -> Doubt | None:
        """The contradiction that new closures bring, or None.

        :param least: explanations less probable are left out.
        """
        excess = {closure: self._excess(closure, frozenset()) for closure in self._closures(new)}
        worst = max(excess, key=lambda closure: excess[closure], default=None)
        if worst is None or excess[worst] <= self._bound:
            return None
        return Doubt(worst, excess[worst], tuple(self._explanations(worst, least)))

    def _explanations(self, doubted: Closure, least: float) -> list[Explanation]:
        costs = {frozenset[Name](): self._cost(frozenset())}
        for root in self._account.closures:
            false = self._false_with(root, doubted)
            if false is not None:
                cost = self._cost(false) + 2.0 * root.log_odds
                costs[false] = min(cost, costs.get(false, np.inf))
        weights = np.exp(-0.5 * (np.array(list(costs.values())) - min(costs.values())))
        found = [
            Explanation(self._without(false), self._closures(false), float(probability))
            for false, probability in zip(costs, weights / weights.sum(), strict=True)
            if probability >= least
        ]
        return sorted(found, key=lambda explanation: -explanation.probability)

    def _false_with(self, root: Closure, doubted: Closure) -> frozenset[Name] | None:
        """What is false where ``root`` is the first that is; None where that does not explain the doubt."""
        order = [closure.name for closure in self._account.closures]
        later = [name for name in order[order.index(root.name) + 1 :] if name != doubted.name]
        false = frozenset({root.name, *later})
        if root is not doubted and self._excess(doubted, false) > self._bound:
            return None
        for name in later:
            closure = self._closures({name})[0]
            if self._excess(closure, false - {name}) <= self._bound:
                false -= {name}
        return false if self._excess(root, false - {root.name}) > self._bound else None

    def _closures(self, names: Collection[Name]) -> tuple[Closure, ...]:
        return tuple(closure for closure in self._account.closures if closure.name in names)

    def _excess(self, closure: Closure, false: frozenset[Name]) -> float:
        """By how much the chi-square grows with a closure, where others are false."""
        return self._contradiction(false) - self._contradiction(false | {closure.name})

    def _cost(self, false: frozenset[Name]) -> float:
        return self._contradiction(false) - _DEGREES_OF_FREEDOM * len(self._without(false).closures)

    def _contradiction(self, false: frozenset[Name]) -> float:
        if false not in self._chi2:
            self._chi2[false] = contradiction(as_measured(self._without(false)))
        return self._chi2[false]

    def _without(self, false: frozenset[Name]) -> Account:
        """The account without some closures; what hangs on several of them hangs on the last."""
        if false not in self._accounts:
            account, new_area, closures = self._account, self._new_area, self._closures(false)
            account = unrefined(account, closures[0].name) if closures else account
            for closure in reversed(closures):
                account = without(account, closure.name, new_area)
                new_area += 1
            self._accounts[false] = account
        return self._accounts[false]


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
