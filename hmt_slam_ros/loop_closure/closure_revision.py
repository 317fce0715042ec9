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
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.configuration.topology import LoopClosureParameters
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import AreaPair, HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import total_arc_chi2
from hmt_slam_ros.loop_closure.closure_history import (
    AcceptedPath,
    Closure,
    ClosureId,
    PathStep,
    map_as_measured,
    undo_refinements,
    withdraw_closure,
)
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis, Notice
from hmt_slam_ros.messages.replica import FIRST_AREA

_DEGREES_OF_FREEDOM = 3


class Explanation(NamedTuple):
    """One way in which closures that contradict each other go together.

    :ivar path: the path without what is false.
    :ivar false_closures: the closures that are false, in the order of acceptance.
    :ivar probability: that this is so.
    """

    path: AcceptedPath
    false_closures: tuple[Closure, ...]
    probability: float


class Inconsistency(NamedTuple):
    """A closure that does not fit.

    :ivar closure: the new closure.
    :ivar excess_chi2: by how much the chi-square grows with it.
    :ivar explanations: of that, the most probable first.
    """

    closure: Closure
    excess_chi2: float
    explanations: tuple[Explanation, ...]


class ClosureConsistencyCheck:
    """Looks for contradictions in one account.

    :param max_excess: the quantile of chi-square.
    :param new_area: the first number that no area has.
    """

    def __init__(self, path: AcceptedPath, max_excess: float, new_area: int) -> None:
        self._path = path
        self._max_excess = max_excess
        self._new_area = new_area
        self._paths: dict[frozenset[ClosureId], AcceptedPath] = {}
        self._chi2: dict[frozenset[ClosureId], float] = {}

    def find_inconsistency(self, new: Collection[ClosureId], min_probability: float) -> Inconsistency | None:
        """The contradiction that new closures bring, or None.

        :param min_probability: explanations less probable are left out.
        """
        excess = {closure: self._excess_chi2(closure, frozenset()) for closure in self._closures_by_id(new)}
        worst = max(excess, key=lambda closure: excess[closure], default=None)
        if worst is None or excess[worst] <= self._max_excess:
            return None
        return Inconsistency(worst, excess[worst], tuple(self._explanations(worst, min_probability)))

    def _explanations(self, doubted: Closure, least: float) -> list[Explanation]:
        costs = {frozenset[ClosureId](): self._cost(frozenset())}
        for root in self._path.closures:
            false = self._false_closures(root, doubted)
            if false is not None:
                cost = self._cost(false) + 2.0 * root.log_odds
                costs[false] = min(cost, costs.get(false, np.inf))
        weights = np.exp(-0.5 * (np.array(list(costs.values())) - min(costs.values())))
        found = [
            Explanation(self._path_without(false), self._closures_by_id(false), float(probability))
            for false, probability in zip(costs, weights / weights.sum(), strict=True)
            if probability >= least
        ]
        return sorted(found, key=lambda explanation: -explanation.probability)

    def _false_closures(self, root: Closure, doubted: Closure) -> frozenset[ClosureId] | None:
        """What is false where ``root`` is the first that is; None where that does not explain the doubt."""
        order = [closure.closure_id for closure in self._path.closures]
        later = [name for name in order[order.index(root.closure_id) + 1 :] if name != doubted.closure_id]
        false = frozenset({root.closure_id, *later})
        if root is not doubted and self._excess_chi2(doubted, false) > self._max_excess:
            return None
        for name in later:
            closure = self._closures_by_id({name})[0]
            if self._excess_chi2(closure, false - {name}) <= self._max_excess:
                false -= {name}
        return false if self._excess_chi2(root, false - {root.closure_id}) > self._max_excess else None

    def _closures_by_id(self, names: Collection[ClosureId]) -> tuple[Closure, ...]:
        return tuple(closure for closure in self._path.closures if closure.closure_id in names)

    def _excess_chi2(self, closure: Closure, false: frozenset[ClosureId]) -> float:
        """By how much the chi-square grows with a closure, where others are false."""
        return self._total_arc_chi2(false) - self._total_arc_chi2(false | {closure.closure_id})

    def _cost(self, false: frozenset[ClosureId]) -> float:
        return self._total_arc_chi2(false) - _DEGREES_OF_FREEDOM * len(self._path_without(false).closures)

    def _total_arc_chi2(self, false: frozenset[ClosureId]) -> float:
        if false not in self._chi2:
            self._chi2[false] = total_arc_chi2(map_as_measured(self._path_without(false)))
        return self._chi2[false]

    def _path_without(self, false: frozenset[ClosureId]) -> AcceptedPath:
        """The account without some closures; what hangs on several of them hangs on the last."""
        if false not in self._paths:
            account, new_area, closures = self._path, self._new_area, self._closures_by_id(false)
            account = undo_refinements(account, closures[0].closure_id) if closures else account
            for closure in reversed(closures):
                account = withdraw_closure(account, closure.closure_id, new_area)
                new_area += 1
            self._paths[false] = account
        return self._paths[false]


ExplanationKey = tuple[tuple[AreaPair, ...], tuple[AreaPair, ...]]


class RevisionRequest(NamedTuple):
    """A question that is open again.

    :ivar hypotheses: the answers.
    :ivar notice: what a person should know of it.
    """

    hypotheses: tuple[Hypothesis, ...]
    notice: Notice


class PathHistory(NamedTuple):
    """What a path went through.

    :ivar steps: the keyframe events at which the robot changed its area or arcs were new, in order.
    :ivar closures: those that were accepted, in order.
    """

    steps: tuple[PathStep, ...]
    closures: tuple[Closure, ...]


@dataclass(frozen=True, eq=False)
class ClosureRevisionState:
    """What is known of questions that were opened again.

    :ivar max_area_id: the largest area that there ever was.
    :ivar requested_at: the keyframe event of the last question, -1 before the first.
    :ivar histories: {(arcs withdrawn, arcs set): the past of a path that goes on with this answer to it}.
    """

    max_area_id: int = FIRST_AREA
    requested_at: int = -1
    histories: Mapping[ExplanationKey, PathHistory] = field(default_factory=dict)


class ClosureRevision:
    """Finds contradictions, and knows the answers again that TSBI goes on with."""

    def __init__(self, options: LoopClosureParameters, state: ClosureRevisionState) -> None:
        """:param state: to go on from."""
        self._max_excess = chi_square_gate(options.contradiction_probability)
        self._min_probability = 1.0 - options.accept_probability
        self._state = state

    @property
    def state(self) -> ClosureRevisionState:
        """All that is known."""
        return self._state

    def check(
        self, event: int, path: AcceptedPath, new: Collection[ClosureId], hypothesis: int
    ) -> RevisionRequest | None:
        """The question that closures raise which have just been accepted, if they do not fit.

        :param new: these closures.
        :param hypothesis: the hypothesis of the account.
        """
        doubt = ClosureConsistencyCheck(path, self._max_excess, self._state.max_area_id + 1).find_inconsistency(
            new, self._min_probability
        )
        if doubt is None:
            return None
        leaves = tuple(_as_hypothesis(explanation, hypothesis, path.hybrid_map) for explanation in doubt.explanations)
        histories = {
            _explanation_key(leaf): PathHistory(explanation.path.history, explanation.path.closures)
            for leaf, explanation in zip(leaves, doubt.explanations, strict=True)
        }
        self._state = replace(self._state, requested_at=event, histories=histories)
        for leaf in leaves:
            self._note_areas(leaf)
        return RevisionRequest(leaves, Notice("tlca", _notice_text(doubt, self._max_excess)))

    def resolve(self, leaf: Hypothesis, event: int) -> PathHistory | None:
        """Learn of a leaf; where it answers the question of the event before, the past of a path with that answer."""
        self._note_areas(leaf)
        asked = self._state.histories if event == self._state.requested_at + 1 else {}
        return asked[_explanation_key(leaf)] if asked else None

    def _note_areas(self, leaf: Hypothesis) -> None:
        areas = [area for arc in leaf.arcs for area in (arc.source, arc.target)]
        self._state = replace(self._state, max_area_id=max(self._state.max_area_id, leaf.area, *areas))


def _as_hypothesis(explanation: Explanation, hypothesis: int, hybrid_map: HybridMap) -> Hypothesis:
    """What an explanation changes, as the child of a hypothesis.

    :param hybrid_map: of the hypothesis.
    """
    account = explanation.path
    changed = account.hybrid_map
    former = {
        k: area for area in changed.changed_areas if hybrid_map.has_area(area) for k in hybrid_map.keyframes(area)
    }
    relabelled = tuple(
        MovedKeyframe(k, former[k], area, pose)
        for area, keyframes in sorted(changed.changed_areas.items())
        for k, pose in keyframes.items()
        if former[k] != area or not np.array_equal(pose, hybrid_map.keyframes(area)[k])
    )
    rebase = None if account.frame_change is None else PoseGaussian.from_pose(account.frame_change)
    return Hypothesis(
        hypothesis,
        hypothesis,
        explanation.probability,
        account.area,
        rebase,
        relabelled,
        tuple(
            Arc(a, b, arc.pose, arc.closure) for (a, b), arc in sorted(changed.changed_arcs.items()) if arc is not None
        ),
        removed_arcs=tuple(
            ArcEnds(a, b)
            for (a, b), arc in sorted(changed.changed_arcs.items())
            if arc is None and hybrid_map.arc(a, b)
        ),
    )


def _explanation_key(leaf: Hypothesis) -> ExplanationKey:
    withdrawn = tuple((ends.source, ends.target) for ends in leaf.removed_arcs)
    return withdrawn, tuple((arc.source, arc.target) for arc in leaf.arcs)


def _notice_text(doubt: Inconsistency, bound: float) -> str:
    """One sentence."""
    a, b = doubt.closure.pair
    best = doubt.explanations[0]
    false = " and ".join(f"{closure.near}-{closure.far}" for closure in best.false_closures) or "none"
    return (
        f"The closure between areas {a} and {b} contradicts those accepted before by a chi-square of "
        f"{doubt.excess_chi2:.1f}, above {bound:.1f}: of all closures {false} is taken for false with probability "
        f"{best.probability:.3f}; raise tlca.accept_probability if this happens often."
    )
