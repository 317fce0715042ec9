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
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reachable

# Fine alignment brings together what lies so far apart. Where a hypothesis is less certain than this, it says nothing.
_DISTANCE, _ANGLE = 0.5, math.radians(5.0)


@dataclass(frozen=True, eq=False)
class Claim:
    """Where a hypothesis has the robot.

    :ivar hybrid_map: its map.
    :ivar area: the robot's area.
    :ivar pose: ``area_T_base``, shape (3,).
    :ivar around: the areas that the robot is in or beside.
    """

    hybrid_map: HybridMap
    area: int
    pose: NDArray[np.float64]
    around: Collection[int]

    @cached_property
    def seen_from(self) -> Mapping[int, NDArray[np.float64]]:
        """{area: ``area_T_base``} of the areas relative to which the hypothesis is certain of the robot's place."""
        found = reachable(self.hybrid_map, self.area, cost_limit=_DISTANCE**2)
        return {area: se2.between(belief.mean, self.pose) for area, belief in found.items()}

    @cached_property
    def loops(self) -> tuple[bool, frozenset[tuple[int, int]]]:
        """Whether an arc closed a loop that the definite map leaves open, and which definite arcs are withdrawn."""
        own, definite = self.hybrid_map.arcs, self.hybrid_map.common.arcs
        closes = any(value is not None and value.closure and pair not in definite for pair, value in own.items())
        return closes, frozenset(pair for pair, value in own.items() if value is None)

    def equals(self, other: Claim) -> bool:
        """Whether both have the robot at the same place of all areas around that both have.

        That it is in known ground is a claim of its own, even where the arcs alone would have it there.
        """
        if self.loops != other.loops:
            return False
        both = {
            area
            for area in {*self.around, *other.around}
            if self.hybrid_map.has_area(area) and other.hybrid_map.has_area(area)
        }
        return bool(both) and all(self._agrees(other, area) for area in both)

    def _agrees(self, other: Claim, area: int) -> bool:
        here, there = self.seen_from.get(area), other.seen_from.get(area)
        if here is None or there is None:
            return False
        apart = se2.between(here, there)
        return math.hypot(apart[0], apart[1]) <= _DISTANCE and abs(float(apart[2])) <= _ANGLE


def merged(claims: Sequence[Claim], log_weights: Sequence[float]) -> dict[int, float]:
    """{number of a claim: log of the weight of all that say the same}, the heaviest of each first."""
    found: dict[int, float] = {}
    for number in sorted(range(len(claims)), key=lambda n: (-log_weights[n], n)):
        same = next((kept for kept in found if claims[kept].equals(claims[number])), number)
        found[same] = float(np.logaddexp(found.get(same, -math.inf), log_weights[number]))
    return found
