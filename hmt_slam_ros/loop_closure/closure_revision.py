"""Consistency of accepted closures, and their revision by TSBI where they contradict each other.

A new closure is consistent if the chi-square of all arcs grows by no more than a quantile with its cycle. Otherwise it
is false, or an earlier closure is and with it what was accepted because of it, or it is chance. The most probable
explanation has the smallest chi-square, and pays for a false closure the odds at which it was accepted:

    -2 log P = chi2 - 3 (closures left) + 2 log odds(first false closure) + const

Closures accepted after a false one were judged by a false map: of these, the inconsistent ones are false at no price.

What a person states about two places is one more observation: -2 log P(statement | map) is added. Where it contradicts
closures, these are the question likewise (docs/decisions/0081-statements.md).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, TypeAlias

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
from hmt_slam_ros.messages.statements import StatementEvidence, WeighedStatement

LogLikelihood: TypeAlias = Callable[[HybridMap], float]

_DEGREES_OF_FREEDOM = 3
"""Degrees of freedom of a cycle of arcs."""

_MAX_SUSPECTED = 64
"""Closures that a statement may contradict, the newest; bounds the work of an event."""

_UNDECIDED = 0.5
"""Probability below which a statement is false in a map."""

_NOT_WITHDRAWABLE = "no closure joins them that can be withdrawn, since areas were merged or arcs fused there"
_IMPROBABLE = "all arcs make a false closure there more improbable than tlca.accept_probability leaves open"


class Explanation(NamedTuple):
    """One set of false closures that explains a contradiction.

    :ivar path: the path without them.
    :ivar false_closures: in the order of acceptance.
    :ivar probability: of the explanation.
    """

    path: AcceptedPath
    false_closures: tuple[Closure, ...]
    probability: float


class Inconsistency(NamedTuple):
    """A new closure that contradicts others.

    :ivar closure: the new closure.
    :ivar excess_chi2: growth of the chi-square with it.
    :ivar explanations: of that, the most probable first.
    """

    closure: Closure
    excess_chi2: float
    explanations: tuple[Explanation, ...]


class ClosureConsistencyCheck:
    """Tests the closures of one path.

    :param max_excess: the quantile of chi-square.
    :param new_area: the first number that no area has.
    :param log_likelihood: of what people stated, for a map, nats.
    """

    def __init__(
        self, path: AcceptedPath, max_excess: float, new_area: int, log_likelihood: LogLikelihood | None = None
    ) -> None:
        self._path = path
        self._log_likelihood = log_likelihood
        self._max_excess = max_excess
        self._new_area = new_area
        self._paths: dict[frozenset[ClosureId], AcceptedPath] = {}
        self._chi2: dict[frozenset[ClosureId], float] = {}

    def find_inconsistency(self, new: Collection[ClosureId], min_probability: float) -> Inconsistency | None:
        """The worst contradiction of new closures, or None.

        :param min_probability: smallest probability of an explanation.
        """
        excess = {closure: self._excess_chi2(closure, frozenset()) for closure in self._closures_by_id(new)}
        worst = max(excess, key=lambda closure: excess[closure], default=None)
        if worst is None or excess[worst] <= self._max_excess:
            return None
        return Inconsistency(worst, excess[worst], tuple(self._explanations(worst, min_probability)))

    def explain_statement(self, suspected: Collection[Closure], min_probability: float) -> tuple[Explanation, ...]:
        """The explanations of a statement that closures contradict: it is wrong, or one of them is the first false one.

        :param suspected: closures of the path.
        :param min_probability: smallest probability of an explanation.
        """
        firsts = [(closure, self._false_with(closure, self._later(closure))) for closure in suspected]
        return tuple(self._weigh(firsts, min_probability))

    def _explanations(self, inconsistent: Closure, min_probability: float) -> list[Explanation]:
        firsts = [(first, self._false_closures(first, inconsistent)) for first in self._path.closures]
        found = [(first, false) for first, false in firsts if false is not None]
        return self._weigh(found, min_probability)

    def _weigh(
        self, firsts: Iterable[tuple[Closure, frozenset[ClosureId]]], min_probability: float
    ) -> list[Explanation]:
        """The probable explanations, the most probable first, among them that none is false.

        :param firsts: (the first false closure, all that are false with it).
        """
        costs = {frozenset[ClosureId](): self._cost(frozenset())}
        for first, false in firsts:
            cost = self._cost(false) + 2.0 * first.log_odds
            costs[false] = min(cost, costs.get(false, np.inf))
        weights = np.exp(-0.5 * (np.array(list(costs.values())) - min(costs.values())))
        explanations = [
            Explanation(self._path_without(false), self._closures_by_id(false), float(probability))
            for false, probability in zip(costs, weights / weights.sum(), strict=True)
            if probability >= min_probability
        ]
        return sorted(explanations, key=lambda explanation: -explanation.probability)

    def _false_closures(self, first: Closure, inconsistent: Closure) -> frozenset[ClosureId] | None:
        """The false closures if ``first`` is the first of them; None if that does not explain the contradiction."""
        later = [other for other in self._later(first) if other != inconsistent.closure_id]
        all_false = frozenset({first.closure_id, *later})
        if first is not inconsistent and self._excess_chi2(inconsistent, all_false) > self._max_excess:
            return None
        false = self._false_with(first, later)
        return false if self._excess_chi2(first, false - {first.closure_id}) > self._max_excess else None

    def _later(self, first: Closure) -> list[ClosureId]:
        """The closures that were accepted after one."""
        order = [closure.closure_id for closure in self._path.closures]
        return order[order.index(first.closure_id) + 1 :]

    def _false_with(self, first: Closure, later: Collection[ClosureId]) -> frozenset[ClosureId]:
        """A false closure, and those of some later ones that are inconsistent without it."""
        false = frozenset({first.closure_id, *later})
        for other in later:
            closure = self._closures_by_id({other})[0]
            if self._excess_chi2(closure, false - {other}) <= self._max_excess:
                false -= {other}
        return false

    def _closures_by_id(self, ids: Collection[ClosureId]) -> tuple[Closure, ...]:
        return tuple(closure for closure in self._path.closures if closure.closure_id in ids)

    def _excess_chi2(self, closure: Closure, false: frozenset[ClosureId]) -> float:
        """Growth of the chi-square with a closure, if others are false."""
        return self._total_arc_chi2(false) - self._total_arc_chi2(false | {closure.closure_id})

    def _cost(self, false: frozenset[ClosureId]) -> float:
        path = self._path_without(false)
        cost = self._total_arc_chi2(false) - _DEGREES_OF_FREEDOM * len(path.closures)
        return cost if self._log_likelihood is None else cost - 2.0 * self._log_likelihood(path.hybrid_map)

    def _total_arc_chi2(self, false: frozenset[ClosureId]) -> float:
        if false not in self._chi2:
            self._chi2[false] = total_arc_chi2(map_as_measured(self._path_without(false)))
        return self._chi2[false]

    def _path_without(self, false: frozenset[ClosureId]) -> AcceptedPath:
        """The path without some closures, the last of which is withdrawn first."""
        if false not in self._paths:
            path, closures = self._path, self._closures_by_id(false)
            if closures:
                path = undo_refinements(path, closures[0].closure_id)
            for new_area, closure in enumerate(reversed(closures), self._new_area):
                path = withdraw_closure(path, closure.closure_id, new_area)
            self._paths[false] = path
        return self._paths[false]


ExplanationKey = tuple[tuple[AreaPair, ...], tuple[AreaPair, ...]]


class RevisionRequest(NamedTuple):
    """A request to TSBI to decide between explanations.

    :ivar hypotheses: the explanations, as children of the hypothesis.
    :ivar notice: about the contradiction.
    """

    hypotheses: tuple[Hypothesis, ...]
    notice: Notice


class PathHistory(NamedTuple):
    """The steps and closures of a path.

    :ivar steps: the keyframe events at which the robot changed its area or arcs were new, in order.
    :ivar closures: those that were accepted, in order.
    """

    steps: tuple[PathStep, ...]
    closures: tuple[Closure, ...]


@dataclass(frozen=True, eq=False)
class ClosureRevisionState:
    """What TLCA remembers of its revision requests.

    :ivar max_area_id: the largest area that there ever was.
    :ivar requested_at: the keyframe event of the last request, -1 before the first.
    :ivar histories: {(arcs removed, arcs set): the history of a path that follows this explanation}.
    :ivar examined_statement: the newest of these that closures were examined for.
    """

    max_area_id: int = FIRST_AREA
    requested_at: int = -1
    histories: Mapping[ExplanationKey, PathHistory] = field(default_factory=dict)
    examined_statement: int = 0


class ClosureRevision:
    """Finds contradictions, and recognizes the explanations with which TSBI continues.

    :ivar state: what is remembered.
    """

    def __init__(
        self, options: LoopClosureParameters, state: ClosureRevisionState, statement_evidence: StatementEvidence
    ) -> None:
        """:param state: to continue from."""
        self._statement_evidence = statement_evidence
        self._max_excess = chi_square_gate(options.contradiction_probability)
        self._min_probability = 1.0 - options.accept_probability
        self.state = state

    def check(
        self, event: int, path: AcceptedPath, new: Collection[ClosureId], hypothesis: int
    ) -> RevisionRequest | None:
        """The request to revise closures that were just accepted, if they are inconsistent.

        :param new: these closures.
        :param hypothesis: the hypothesis of the path.
        """
        found = self._consistency_check(path).find_inconsistency(new, self._min_probability)
        if found is None:
            return None
        return self._request(event, path, hypothesis, found.explanations, _notice_text(found, self._max_excess))

    def check_statements(self, event: int, path: AcceptedPath, hypothesis: int) -> RevisionRequest | None:
        """The request to revise closures that the next statement contradicts; without hypotheses where they stay.

        :param hypothesis: the only hypothesis, whose path is definite.
        """
        due = self.due_statement(path.statements)
        if due is None:
            return None
        self.state = replace(self.state, examined_statement=due.number)
        if due.statement.kind == "same" or self._probability(path.hybrid_map, due) >= _UNDECIDED:
            return None
        suspected = self._suspected_closures(path, due)
        explanations = self._consistency_check(path).explain_statement(suspected, self._min_probability)
        if len(explanations) == 1 and not explanations[0].false_closures:
            reason = _IMPROBABLE if suspected else _NOT_WITHDRAWABLE
            return RevisionRequest((), Notice("tlca", f"{due}, but the map stays as it is: {reason}."))
        return self._request(event, path, hypothesis, explanations, _statement_text(due, explanations))

    def due_statement(self, statements: Sequence[WeighedStatement]) -> WeighedStatement | None:
        """The next of some statements for which closures were not examined yet; None without."""
        return next((one for one in statements if one.number > self.state.examined_statement), None)

    def _suspected_closures(self, path: AcceptedPath, weighed: WeighedStatement) -> list[Closure]:
        """The closures without whose arc a statement that is false in the map is true, of the newest."""
        suspected = []
        for closure in path.closures[-_MAX_SUSPECTED:]:
            without = path.hybrid_map.branch()
            without.remove_arc(closure.near, closure.far)
            if self._probability(without, weighed) >= _UNDECIDED:
                suspected.append(closure)
        return suspected

    def _probability(self, hybrid_map: HybridMap, weighed: WeighedStatement) -> float:
        return self._statement_evidence.probability(hybrid_map, weighed)

    def _consistency_check(self, path: AcceptedPath) -> ClosureConsistencyCheck:
        evidence, statements = self._statement_evidence, path.statements
        log_likelihood = partial(evidence.log_likelihood, statements=statements) if statements else None
        return ClosureConsistencyCheck(path, self._max_excess, self.state.max_area_id + 1, log_likelihood)

    def _request(
        self, event: int, path: AcceptedPath, hypothesis: int, explanations: Sequence[Explanation], text: str
    ) -> RevisionRequest:
        hypotheses = tuple(_as_hypothesis(one, hypothesis, path.hybrid_map) for one in explanations)
        histories = {
            _explanation_key(child): PathHistory(explanation.path.history, explanation.path.closures)
            for child, explanation in zip(hypotheses, explanations, strict=True)
        }
        self.state = replace(self.state, requested_at=event, histories=histories)
        for child in hypotheses:
            self._note_new_areas(child)
        return RevisionRequest(hypotheses, Notice("tlca", text))

    def resolve(self, hypothesis: Hypothesis, event: int) -> PathHistory | None:
        """The history of a hypothesis that follows an explanation of the last event's request; None for others."""
        self._note_new_areas(hypothesis)
        histories = self.state.histories if event == self.state.requested_at + 1 else {}
        return histories[_explanation_key(hypothesis)] if histories else None

    def _note_new_areas(self, hypothesis: Hypothesis) -> None:
        self.note_areas([hypothesis.area, *(area for arc in hypothesis.arcs for area in (arc.source, arc.target))])

    def note_areas(self, areas: Collection[int]) -> None:
        """Use the numbers of areas for no new one."""
        self.state = replace(self.state, max_area_id=max([self.state.max_area_id, *areas]))


def _as_hypothesis(explanation: Explanation, hypothesis: int, hybrid_map: HybridMap) -> Hypothesis:
    """An explanation as a child of a hypothesis.

    :param hybrid_map: of the hypothesis.
    """
    path = explanation.path
    changed_areas, changed_arcs = path.hybrid_map.changed_areas, sorted(path.hybrid_map.changed_arcs.items())
    former_areas = {k: area for area in changed_areas if hybrid_map.has_area(area) for k in hybrid_map.keyframes(area)}
    moved = tuple(
        MovedKeyframe(k, former_areas[k], area, pose)
        for area, keyframes in sorted(changed_areas.items())
        for k, pose in keyframes.items()
        if former_areas[k] != area or not np.array_equal(pose, hybrid_map.keyframes(area)[k])
    )
    return Hypothesis(
        hypothesis,
        hypothesis,
        explanation.probability,
        path.area,
        None if path.frame_change is None else PoseGaussian.from_pose(path.frame_change),
        moved,
        tuple(Arc(a, b, arc.pose, arc.closure) for (a, b), arc in changed_arcs if arc is not None),
        removed_arcs=tuple(ArcEnds(a, b) for (a, b), arc in changed_arcs if arc is None and hybrid_map.arc(a, b)),
    )


def _explanation_key(hypothesis: Hypothesis) -> ExplanationKey:
    removed = tuple((ends.source, ends.target) for ends in hypothesis.removed_arcs)
    return removed, tuple((arc.source, arc.target) for arc in hypothesis.arcs)


def _statement_text(weighed: WeighedStatement, explanations: Sequence[Explanation]) -> str:
    """One sentence."""
    best = explanations[0]
    return (
        f"{weighed}, with reliability {weighed.statement.reliability:g}, against accepted closures: of these "
        f"{_false_names(best)} is taken for false with probability {best.probability:.3f}; further scans decide."
    )


def _false_names(explanation: Explanation) -> str:
    return " and ".join(f"{closure.near}-{closure.far}" for closure in explanation.false_closures) or "none"


def _notice_text(inconsistency: Inconsistency, bound: float) -> str:
    """One sentence."""
    a, b = inconsistency.closure.pair
    best = inconsistency.explanations[0]
    false = _false_names(best)
    return (
        f"The closure between areas {a} and {b} contradicts those accepted before by a chi-square of "
        f"{inconsistency.excess_chi2:.1f}, above {bound:.1f}: of all closures {false} is taken for false with "
        f"probability {best.probability:.3f}; raise tlca.accept_probability if this happens often."
    )
