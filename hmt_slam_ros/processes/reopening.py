"""What TLCA asks TSBI anew where closures that were accepted contradict each other."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.configuration.topological import LoopClosureAcceptance
from hmt_slam_ros.geometry.chi_square import gate
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.closure_account import Account, Name
from hmt_slam_ros.processes.doubts import Doubt, Doubts, Explanation
from hmt_slam_ros.processes.messages import Arc, ArcEnds, Leaf, Notice, Relabelled
from hmt_slam_ros.processes.replica import FIRST_AREA
from hmt_slam_ros.topology.common_map import Pair
from hmt_slam_ros.topology.hybrid_map import HybridMap

_Key = tuple[tuple[Pair, ...], tuple[Pair, ...]]


class Question(NamedTuple):
    """A question that is open again.

    :ivar leaves: the answers.
    :ivar notice: what a person should know of it.
    """

    leaves: tuple[Leaf, ...]
    notice: Notice


class Reopening:
    """Finds contradictions, and knows the answers again that TSBI goes on with."""

    def __init__(self, options: LoopClosureAcceptance) -> None:
        self._bound = gate(options.contradiction_probability)
        self._least = 1.0 - options.accept_probability
        self._largest_area = FIRST_AREA
        self._asked_at = -1
        self._accounts: dict[_Key, Account] = {}

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
        self._accounts = {
            _key(leaf): explanation.account for leaf, explanation in zip(leaves, doubt.explanations, strict=True)
        }
        for leaf in leaves:
            self._know(leaf)
        return Question(leaves, Notice("tlca", _told(doubt, self._bound)))

    def followed(self, leaf: Leaf, event: int) -> Account | None:
        """Learn of a leaf; where it answers the question of the event before, the account of that answer."""
        self._know(leaf)
        return self._accounts[_key(leaf)] if event == self._asked_at + 1 and self._accounts else None

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


def _key(leaf: Leaf) -> _Key:
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
