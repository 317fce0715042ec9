"""Do two hypotheses say the same? Then they are one, and have the sum of both probabilities.

A robot that drives over known ground enters it by one area in one hypothesis and by the next in another, or by modes of
one match that part by centimetres. All these are the same topology: after a closer look they would have the same map.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, AreaPair, HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs

# Fine alignment brings together what lies so far apart.
_DISTANCE, _ANGLE = 0.5, math.radians(5.0)
_ALIGNED = np.diag([0.5 * _DISTANCE, 0.5 * _DISTANCE, 0.5 * _ANGLE]) ** 2
# Variance of a position, m^2, above which a hypothesis says nothing of it.
_MAX_VARIANCE = 1.0
_EQUIVALENCE_GATE = chi_square_gate(0.95)


@dataclass(frozen=True, eq=False)
class LocalizedHypothesis:
    """Where a hypothesis has the robot.

    :ivar hybrid_map: its map.
    :ivar area: the robot's area.
    :ivar pose: ``area_T_base``, shape (3,).
    :ivar nearby_areas: the areas that the robot is in or beside.
    """

    hybrid_map: HybridMap
    area: int
    pose: NDArray[np.float64]
    nearby_areas: Collection[int]

    @cached_property
    def poses_in_areas(self) -> Mapping[int, NDArray[np.float64]]:
        """{area: ``area_T_base``} of the areas relative to which the hypothesis is certain of the robot's place."""
        found = shortest_path_beliefs(self.hybrid_map, self.area, cost_limit=_MAX_VARIANCE)
        return {area: se2.between(belief.mean, self.pose) for area, belief in found.items()}

    @cached_property
    def closures(self) -> Mapping[AreaPair, ArcValue]:
        """The arcs that closed loops which the definite map leaves open."""
        return self.hybrid_map.pending_closures

    @cached_property
    def removed_arcs(self) -> frozenset[AreaPair]:
        """The definite arcs that the hypothesis lacks."""
        return frozenset(pair for pair, arc in self.hybrid_map.changed_arcs.items() if arc is None)

    def is_equivalent(self, other: LocalizedHypothesis) -> bool:
        """Whether both have the robot at the same place of all areas around that both have, and close the same loops.

        That it is in known ground is a claim of its own, even where the arcs alone would have it there.
        """
        if bool(self.closures) != bool(other.closures) or self.removed_arcs != other.removed_arcs:
            return False
        both = {
            area
            for area in {*self.nearby_areas, *other.nearby_areas}
            if self._has_areas(area) and other._has_areas(area)
        }
        return (
            bool(both)
            and all(self._agrees_on_pose(other, area) for area in both)
            and all(other._implies_closure(pair, arc) for pair, arc in self.closures.items())
            and all(self._implies_closure(pair, arc) for pair, arc in other.closures.items())
        )

    def _has_areas(self, *areas: int) -> bool:
        return all(map(self.hybrid_map.has_area, areas))

    def _implies_closure(self, pair: AreaPair, arc: ArcValue) -> bool:
        """Whether an arc of another hypothesis is no news: this one has the two areas there, and is certain of it or
        closed that loop itself.

        Areas that only the other has are not asked for.
        """
        if not self._has_areas(*pair):
            return True
        own = self.closures.get(pair)
        known = self._certain_pose(pair, arc) if own is None else own.pose
        return known is not None and _admits(arc.pose, known.mean)

    def _certain_pose(self, pair: AreaPair, arc: ArcValue) -> PoseGaussian | None:
        """Where the hypothesis has the second of two areas seen from the first, if it is not much less certain of that
        than an arc is.
        """
        limit = max(_MAX_VARIANCE, 4.0 * float(np.trace(arc.pose.covariance[:2, :2])))
        return shortest_path_beliefs(self.hybrid_map, pair[0], limit, targets=pair[1:]).get(pair[1])

    def _agrees_on_pose(self, other: LocalizedHypothesis, area: int) -> bool:
        here, there = self.poses_in_areas.get(area), other.poses_in_areas.get(area)
        return here is not None and there is not None and _is_close(here, there)


def _is_close(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    apart = se2.between(one, other)
    return math.hypot(apart[0], apart[1]) <= _DISTANCE and abs(float(apart[2])) <= _ANGLE


def _admits(belief: PoseGaussian, pose: NDArray[np.float64]) -> bool:
    """Whether a belief, after fine alignment, may come to be at a pose."""
    return belief.mahalanobis2(PoseGaussian(pose, _ALIGNED)) <= _EQUIVALENCE_GATE


def merge_equivalent(hypotheses: Sequence[LocalizedHypothesis], log_weights: Sequence[float]) -> dict[int, float]:
    """{number of a claim: log of the weight of all that say the same}, the heaviest of each first."""
    found: dict[int, float] = {}
    for number in sorted(range(len(hypotheses)), key=lambda n: (-log_weights[n], n)):
        same = next((kept for kept in found if hypotheses[kept].is_equivalent(hypotheses[number])), number)
        found[same] = float(np.logaddexp(found.get(same, -math.inf), log_weights[number]))
    return found
