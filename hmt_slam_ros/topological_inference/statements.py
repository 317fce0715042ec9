"""Statements of people about places, as evidence for the topology (docs/decisions/0081-statements.md).

A statement weighs every live hypothesis by whether it is true under it. Two areas that are stated to be one place are
compared, and their closure is one more hypothesis. TLCA withdraws closures that statements make improbable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import connected_neighbors
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.statements import (
    PlaceStatement,
    StatementEvidence,
    StatementOutlook,
    WeighedStatement,
    standing_keyframe,
)
from hmt_slam_ros.topological_inference.area_comparison import StatedPair
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.candidate_gating import Query

_MAX_STATEMENTS = 16
"""Statements that are remembered; of more the oldest is forgotten. They bound the work of an event."""

_MAX_WAITING = 64
"""Statements that wait for the next event; further ones are dropped."""

_TRUE, _FALSE = 0.95, 0.05
"""Probabilities from which a statement is reported as true or as false."""


@dataclass(frozen=True, eq=False)
class StatementQueue:
    """Statements that wait for the next event.

    :ivar waiting: in the order in which they came.
    :ivar next_number: of the next statement.
    """

    waiting: tuple[PlaceStatement, ...] = ()
    next_number: int = 1

    def add(self, statement: PlaceStatement) -> StatementQueue:
        """The queue with one more statement."""
        return replace(self, waiting=(*self.waiting, statement)[:_MAX_WAITING])

    def take(
        self, known: Sequence[WeighedStatement], hybrid_map: HybridMap, event: int
    ) -> tuple[StatementQueue, tuple[WeighedStatement, ...], list[str]]:
        """The empty queue, all statements, and sentences about those that are dropped.

        A person who states something else about the same areas changes the statement, which counts once.

        :param known: the statements before.
        :param hybrid_map: of the most probable hypothesis.
        """
        statements, number, dropped = list(known), self.next_number, []
        for statement in self.waiting:
            areas = statement.first, statement.second
            keyframes = [standing_keyframe(statement, hybrid_map, area) for area in areas]
            missing = [area for area, keyframe in zip(areas, keyframes, strict=True) if keyframe is None]
            if missing:
                dropped.append(
                    f"the statement '{statement.kind} {areas[0]} {areas[1]}' is dropped, since the map has no area "
                    f"{missing[0]}: name areas as the page and map.png number them"
                )
                continue
            first, second = (keyframe for keyframe in keyframes if keyframe is not None)
            statements = [one for one in statements if not _is_changed_by(one.statement, statement)]
            statements.append(WeighedStatement(number, event, statement, first, second))
            number += 1
        return StatementQueue((), number), tuple(statements[-_MAX_STATEMENTS:]), dropped


def weigh_statements(
    statements: Sequence[WeighedStatement],
    maps: Mapping[int, HybridMap],
    probabilities: Mapping[int, float],
    evidence: StatementEvidence,
) -> tuple[tuple[WeighedStatement, ...], list[str]]:
    """Statements with their probabilities under the live hypotheses, and sentences where they are new or decided.

    :param maps: {hypothesis: its map}, of all that are alive.
    :param probabilities: {hypothesis: probability}.
    """
    weighed, sentences = [], []
    total = sum(probabilities.values())
    for one in statements:
        true = sum(p * evidence.probability(maps[h], one) for h, p in probabilities.items()) / total
        outlook = _outlook(true)
        weighed.append(replace(one, probability=min(true, 1.0), outlook=outlook))
        if one.outlook == "new" or outlook not in ("open", one.outlook):
            sentences.append(f"{one}: this has a probability of {true:.3f} now")
    return tuple(weighed), sentences


def replace_keyframes(statements: Sequence[WeighedStatement], moved: Mapping[int, int]) -> tuple[WeighedStatement, ...]:
    """Statements about other keyframes instead of pruned ones.

    :param moved: {pruned keyframe: one in its place}.
    """
    return tuple(
        replace(
            one,
            first_keyframe=moved.get(one.first_keyframe, one.first_keyframe),
            second_keyframe=moved.get(one.second_keyframe, one.second_keyframe),
        )
        for one in statements
    )


def _is_changed_by(before: PlaceStatement, statement: PlaceStatement) -> bool:
    """Whether a later statement of the same person is about the same two areas."""
    areas = {before.first, before.second}
    return before.author == statement.author and areas == {statement.first, statement.second}


def _outlook(probability: float) -> StatementOutlook:
    if probability >= _TRUE:
        return "true"
    return "false" if probability <= _FALSE else "open"


def reweigh_by_statements(
    parent: Parent, statements: Sequence[WeighedStatement], evidence: StatementEvidence
) -> Parent:
    """The hypothesis with the evidence of all statements for its map, in place of what counted before."""
    log_likelihood = evidence.log_likelihood(parent.hybrid_map, statements)
    before = parent.state.statement_evidence
    gained = 0.0 if before is None else log_likelihood - before
    state = replace(parent.state, statement_evidence=log_likelihood)
    return replace(parent, log_weight=parent.log_weight + gained, state=state)


def _are_apart(hybrid_map: HybridMap, area: int, other: int) -> bool:
    return area != other and other not in connected_neighbors(hybrid_map, area)


def area_query(hybrid_map: HybridMap, area: int, covariance: Float64) -> Query:
    """All keyframes of an area as a query.

    :param covariance: of the first one's pose in the area, shape (3, 3).
    """
    poses = hybrid_map.keyframes(area)
    first = next(iter(poses.values()))
    return Query(PoseGaussian(first, covariance), {k: se2.between(first, pose) for k, pose in poses.items()})


class PlaceStatements:
    """What people stated about places: it weighs hypotheses, and proposes comparisons.

    :ivar queue: the statements that wait for the next event; all others are in the replica.
    """

    def __init__(self, evidence: StatementEvidence, replica: Replica) -> None:
        self.queue = StatementQueue()
        self._evidence, self._replica = evidence, replica

    def add(self, statement: PlaceStatement) -> None:
        """Let a statement wait for the next event."""
        self.queue = self.queue.add(statement)

    def take(self, event: int) -> list[str]:
        """Weigh the statements that wait from now on; returns sentences about those that are dropped."""
        if not self.queue.waiting:
            return []
        hybrid_map, known = self._replica.maps[self._replica.best_hypothesis], self._replica.statements
        self.queue, self._replica.statements, dropped = self.queue.take(known, hybrid_map, event)
        return dropped

    def reweigh(self, parent: Parent) -> Parent:
        """A hypothesis with the evidence of all statements for its map."""
        statements = self._replica.statements
        return reweigh_by_statements(parent, statements, self._evidence) if statements else parent

    def weigh(self, statements: Sequence[WeighedStatement]) -> list[str]:
        """Keep statements with their probabilities under the live hypotheses; returns sentences about them."""
        maps, probabilities = self._replica.maps, self._replica.probabilities
        self._replica.statements, sentences = weigh_statements(statements, maps, probabilities, self._evidence)
        return sentences

    def due_pair(self, parent: Parent) -> StatedPair | None:
        """The next two areas that are stated to be one place and may be compared under a hypothesis; None without."""
        if parent.state.is_lost:
            return None
        for one in self._replica.statements:
            areas = one.areas_in(parent.hybrid_map)
            if one.statement.kind != "same" or one.number <= parent.state.compared_statement or areas is None:
                continue
            if _are_apart(parent.hybrid_map, *areas):
                return StatedPair(one.number, *areas)
        return None
