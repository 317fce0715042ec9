"""Where the robot is under each hypothesis: which hypotheses state the same, and which state another place."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, AreaPair, HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs

_SAME_DISTANCE = 0.5
"""Largest distance between equivalent poses, m; fine alignment closes it.

From docs/decisions/0015-merging-equivalent-hypotheses.md.
"""

_SAME_ANGLE = math.radians(5.0)
"""Largest difference of their headings, rad (docs/decisions/0015-merging-equivalent-hypotheses.md)."""

_ALIGNMENT_COVARIANCE = np.diag([0.5 * _SAME_DISTANCE, 0.5 * _SAME_DISTANCE, 0.5 * _SAME_ANGLE]) ** 2
"""How far fine alignment may move an arc, m and rad, squared."""

_MAX_VARIANCE = 1.0
"""Largest variance of a position on which a hypothesis is certain, m^2."""

_EQUIVALENCE_GATE = chi_square_gate(0.95)
"""Largest squared Mahalanobis distance of equivalent arcs."""

_ANOTHER_DISTANCE, _ANOTHER_ANGLE = 1.0, math.radians(15.0)
"""Distance, m, or angle, rad, from which poses are in two places, if no uncertainty explains it."""

_UNCERTAINTY_GATE = chi_square_gate(0.999)
"""Squared Mahalanobis distance of two poses up to which the arcs' uncertainty explains that they differ."""


@dataclass(frozen=True, eq=False)
class LocalizedHypothesis:
    """The map of a hypothesis, and the robot's pose in it, to be compared with another hypothesis.

    Over known ground, hypotheses differ in the area by which they enter it, or in the mode of one match. They state the
    same topology if their maps would agree after fine alignment.

    :ivar area: the robot's area.
    :ivar pose: ``area_T_base``, shape (3,).
    :ivar nearby_areas: the areas that the robot is in or beside.
    """

    hybrid_map: HybridMap
    area: int
    pose: Float64
    nearby_areas: Collection[int]

    @cached_property
    def _certain_areas(self) -> Mapping[int, PoseGaussian]:
        """{area: belief over its pose in the robot's} of the areas relative to which the robot's pose is certain."""
        return shortest_path_beliefs(self.hybrid_map, self.area, cost_limit=_MAX_VARIANCE)

    @cached_property
    def _poses_in_areas(self) -> Mapping[int, Float64]:
        """{area: ``area_T_base``} of the same areas."""
        return {area: se2.between(belief.mean, self.pose) for area, belief in self._certain_areas.items()}

    @cached_property
    def closures(self) -> Mapping[AreaPair, ArcValue]:
        """The arcs that closed loops and are not definite."""
        return self.hybrid_map.pending_closures

    @cached_property
    def removed_arcs(self) -> frozenset[AreaPair]:
        """The definite arcs that the hypothesis lacks."""
        return frozenset(pair for pair, arc in self.hybrid_map.changed_arcs.items() if arc is None)

    def is_equivalent(self, other: LocalizedHypothesis) -> bool:
        """Whether both have the same robot pose in all common areas around it, and close the same loops.

        A closure is a statement of its own, even where the arcs alone imply it.
        """
        return (
            bool(self.closures) == bool(other.closures)
            and self._is_in_same_place(other)
            and not self._unimplied_closures(other)
            and not other._unimplied_closures(self)
        )

    def leaves_open(self, other: LocalizedHypothesis) -> bool:
        """Whether another hypothesis closes the same loops, and more, whose areas are not around the robot.

        Both expect the same scans here, so that none tells whether those closures are true.
        """
        if not self.closures or not self._is_in_same_place(other) or other._unimplied_closures(self):
            return False
        nearby = {*self.nearby_areas, *other.nearby_areas}
        more = self._unimplied_closures(other)
        return bool(more) and nearby.isdisjoint(area for pair in more for area in pair)

    def _is_in_same_place(self, other: LocalizedHypothesis) -> bool:
        """Whether both lack the same arcs, and have the same robot pose in all common areas around it."""
        nearby = {*self.nearby_areas, *other.nearby_areas}
        common = {area for area in nearby if self._has_areas(area) and other._has_areas(area)}
        return (
            self.removed_arcs == other.removed_arcs
            and bool(common)
            and all(self._agrees_on_pose(other, area) for area in common)
        )

    def _unimplied_closures(self, other: LocalizedHypothesis) -> list[AreaPair]:
        """The closures of another hypothesis that this one does not imply."""
        return [pair for pair, arc in other.closures.items() if not self._implies_closure(pair, arc)]

    def is_elsewhere(self, other: LocalizedHypothesis) -> bool:
        """Whether the robot is in another place under another hypothesis, and no uncertainty of the arcs explains that.

        It is where its poses differ in one of the areas relative to which both are certain.
        """
        common = self._certain_areas.keys() & other._certain_areas.keys()
        return any(self._is_apart(other, area) for area in sorted(common))

    def _is_apart(self, other: LocalizedHypothesis, area: int) -> bool:
        """Whether the poses in an area are in two places, and not only uncertain."""
        one, two = self._poses_in_areas[area], other._poses_in_areas[area]
        x, y, angle = difference = se2.log(se2.between(one, two))
        if math.hypot(x, y) <= _ANOTHER_DISTANCE and abs(float(angle)) <= _ANOTHER_ANGLE:
            return False
        spread = sum(
            hypothesis._certain_areas[area].inverse().compose(PoseGaussian.from_pose(hypothesis.pose)).covariance
            for hypothesis in (self, other)
        )
        return float(difference @ np.linalg.solve(spread + _ALIGNMENT_COVARIANCE, difference)) > _UNCERTAINTY_GATE

    def _has_areas(self, *areas: int) -> bool:
        return all(map(self.hybrid_map.has_area, areas))

    def _implies_closure(self, pair: AreaPair, arc: ArcValue) -> bool:
        """Whether this hypothesis has two areas as an arc of another one has them, by its own closure or for certain.

        It need not have areas that only the other has.
        """
        if not self._has_areas(*pair):
            return True
        own = self.closures.get(pair)
        belief = self._certain_belief(pair, arc) if own is None else own.pose
        # Fine alignment may move the arc.
        return (
            belief is not None
            and arc.pose.mahalanobis2(PoseGaussian(belief.mean, _ALIGNMENT_COVARIANCE)) <= _EQUIVALENCE_GATE
        )

    def _certain_belief(self, pair: AreaPair, arc: ArcValue) -> PoseGaussian | None:
        """The belief over the second of two areas in the first, if it is not much less certain than an arc."""
        limit = max(_MAX_VARIANCE, 4.0 * float(np.trace(arc.pose.covariance[:2, :2])))
        return shortest_path_beliefs(self.hybrid_map, pair[0], limit, targets=pair[1:]).get(pair[1])

    def _agrees_on_pose(self, other: LocalizedHypothesis, area: int) -> bool:
        one, two = self._poses_in_areas.get(area), other._poses_in_areas.get(area)
        if one is None or two is None:
            return False
        difference = se2.between(one, two)
        is_near = math.hypot(difference[0], difference[1]) <= _SAME_DISTANCE
        return is_near and abs(float(difference[2])) <= _SAME_ANGLE


def merge_equivalent(hypotheses: Sequence[LocalizedHypothesis], log_weights: Sequence[float]) -> dict[int, float]:
    """{number of a hypothesis: log of the weight of all equivalent ones}, the heaviest of each first."""
    merged: dict[int, float] = {}
    for number in sorted(range(len(hypotheses)), key=lambda n: (-log_weights[n], n)):
        same = next((kept for kept in merged if hypotheses[kept].is_equivalent(hypotheses[number])), number)
        merged[same] = float(np.logaddexp(merged.get(same, -math.inf), log_weights[number]))
    return merged


def supports(
    hypotheses: Mapping[int, LocalizedHypothesis], probabilities: Mapping[int, float], dominance: float
) -> dict[int, float]:
    """{hypothesis: probability of what it states}: its own, and that of those whose further closures it leaves open.

    :param dominance: share of the probability of two hypotheses from which on one is left to itself.
    """
    return {
        one: probabilities[one]
        + sum(
            probabilities[other]
            for other, further in hypotheses.items()
            if probabilities[other] < dominance * (probabilities[one] + probabilities[other])
            and hypothesis.leaves_open(further)
        )
        for one, hypothesis in hypotheses.items()
    }


def elsewhere_probability(hypotheses: Sequence[LocalizedHypothesis], probabilities: Sequence[float]) -> float:
    """The probability that the robot is in another place than under the most probable hypothesis."""
    if len(hypotheses) < 2:
        return 0.0
    best = hypotheses[int(np.argmax(probabilities))]
    return sum(
        p for one, p in zip(hypotheses, probabilities, strict=True) if one is not best and best.is_elsewhere(one)
    )
