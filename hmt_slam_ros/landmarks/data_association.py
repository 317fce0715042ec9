"""Data association of lines: the largest set of pairings that is compatible jointly.

Joint compatibility branch and bound (Neira and Tardos 2001). Pairings may each be within their gate, and yet not all of
them together, since an error of the pose moves all lines alike.

A wrong pairing is never undone. So an ambiguous one is left out: where another set has as many pairings and fits nearly
as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.gaussian import chi_square_gate

_MIN_MARGIN = 2.0 * math.log(100.0)
"""Difference of the squared distances of two sets, at least, for the better one to be unambiguous: a factor of 100 in
likelihood."""


class Pairing(NamedTuple):
    """An observed line as a re-observation of a line of the map.

    :ivar scan_line: number of the line in its scan.
    :ivar map_line: number of the line in the map.
    :ivar difference: (2,), alpha and r as observed minus as expected, rad and m.
    :ivar jacobian: of the expected line by the state, (2, n).
    :ivar noise: covariance of the observed line, (2, 2).
    """

    scan_line: int
    map_line: int
    difference: Float64
    jacobian: Float64
    noise: Float64

    def distance2(self, covariance: Float64) -> float:
        """Squared Mahalanobis distance, Eq. (13) of Tomatis et al.; chi-square with 2 degrees of freedom."""
        spread = self.jacobian @ covariance @ self.jacobian.T + self.noise
        return float(self.difference @ np.linalg.solve(spread, self.difference))


def compatible_pairings(covariance: Float64, pairings: Sequence[Pairing], probability: float) -> list[Pairing]:
    """The unambiguous pairings of the largest set that chi-square admits; of equally large ones the best.

    :param covariance: of the state, (n, n).
    :param pairings: each within its own gate; the set has one at most for each observed line.
    :param probability: that chi-square admits a true set.
    """
    if not pairings:
        return []
    search = _CompatibilitySearch(covariance, pairings, probability)
    best = search.largest_set()
    return [pairings[k] for k in best.chosen if search.is_unambiguous(k, best)]


class _PairingSet(NamedTuple):
    """Pairings, by number, and their joint squared Mahalanobis distance."""

    chosen: tuple[int, ...] = ()
    distance2: float = 0.0

    def is_better_than(self, other: _PairingSet) -> bool:
        """Whether the set is larger, or as large with a better fit."""
        count = len(self.chosen) - len(other.chosen)
        return count > 0 or (count == 0 and self.distance2 < other.distance2)


class _CompatibilitySearch:
    """Branch and bound over the choices for each observed line."""

    def __init__(self, covariance: Float64, pairings: Sequence[Pairing], probability: float) -> None:
        jacobian = np.concatenate([pairing.jacobian for pairing in pairings])
        self._spread = jacobian @ covariance @ jacobian.T
        for k, pairing in enumerate(pairings):
            self._spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += pairing.noise
        self._difference = np.concatenate([pairing.difference for pairing in pairings])
        observed = dict.fromkeys(pairing.scan_line for pairing in pairings)
        self._choices = [[k for k, pairing in enumerate(pairings) if pairing.scan_line == each] for each in observed]
        self._gates = [chi_square_gate(probability, 2 * count) for count in range(1, len(observed) + 1)]

    def largest_set(self, without: int | None = None) -> _PairingSet:
        """The largest set; of equally large ones the best.

        :param without: number of a pairing that is left out.
        """
        return self._search_from(0, _PairingSet(), _PairingSet(), without)

    def is_unambiguous(self, k: int, best: _PairingSet) -> bool:
        """Whether a pairing of the best set has no alternative."""
        if any(choices == [k] for choices in self._choices):
            return True
        other = self.largest_set(without=k)
        return len(other.chosen) < len(best.chosen) or other.distance2 - best.distance2 > _MIN_MARGIN

    def _search_from(self, level: int, chosen: _PairingSet, best: _PairingSet, without: int | None) -> _PairingSet:
        """The better of a set and the best extension of ``chosen`` by the observed lines from ``level`` on."""
        remaining = len(self._choices) - level
        if not remaining:
            return chosen if chosen.is_better_than(best) else best
        for k in self._choices[level]:
            longer = self._add_pairing(chosen, k)
            if k != without and longer.distance2 <= self._gates[len(chosen.chosen)]:
                best = self._search_from(level + 1, longer, best, without)
        if len(chosen.chosen) + remaining > len(best.chosen):
            best = self._search_from(level + 1, chosen, best, without)
        return best

    def _add_pairing(self, chosen: _PairingSet, k: int) -> _PairingSet:
        numbers = (*chosen.chosen, k)
        rows = np.array([row for number in numbers for row in (2 * number, 2 * number + 1)])
        difference = self._difference[rows]
        return _PairingSet(numbers, float(difference @ np.linalg.solve(self._spread[np.ix_(rows, rows)], difference)))
