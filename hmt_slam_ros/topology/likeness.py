"""p(z | new ground): how often does this building look like itself?

New ground is seldom like nothing that is known: corridors look like corridors. That keyframes fit into a known area
speaks for it only as far as such a fit is rare where they surely do not lie (as the average place of Cummins and Newman
2008, but counted on this building): in one where every corridor is like the next it tells next to nothing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.area_grid import AreaGrid
from hmt_slam_ros.topology.area_matching import MatchSettings, best_pose

# Where a robot would be that drives where another drove before, or the other way: 1.5 m along, 0.7 m across, 6 degrees.
_ALIKE = np.diag([1.5, 0.7, math.radians(6.0)]) ** 2
_HEADINGS = (np.zeros(3), np.array([0.0, 0.0, math.pi]))
# Squared Mahalanobis distance up to which is searched: 90 % of 3 degrees of freedom.
_GATE = 6.25
# Only the best is asked for, and that not where a quarter of the samples at most is on surfaces: so much fits anywhere.
_MARGIN, _LEAST = 1.0, 0.25 * math.log(3.0)  # nat
# As much as so many places counts what is believed before any was tried; so many are kept.
_TRIED, _KEPT = 2.0, 64
# What looks like another place at one spot does so in so many cases, at most, at the next.
_ALIKE_NEXT = 0.4
# How far the share of one and the same place varies.
_SAME_SHARE = 0.02


class Elsewhere(NamedTuple):
    """A place in which the keyframes do not lie: its map, and ``map_T_base`` of a robot there, shape (3,)."""

    grid: AreaGrid
    pose: NDArray[np.float64]


def best_shares(query: AreaGrid, elsewhere: Iterable[Elsewhere], settings: MatchSettings) -> list[float]:
    """How large a share of the keyframes' surfaces is on known ones, where they fit best in each of the places.

    :param query: map of the keyframes, in the frame of the first of them.
    """
    near = replace(settings, gate=_GATE, margin=_MARGIN, least=_LEAST)
    found = []
    for place in elsewhere:
        poses = [best_pose(query, place.grid, PoseGaussian(place.pose + turn, _ALIKE), near) for turn in _HEADINGS]
        best = max((pose for pose in poses if pose is not None), key=lambda pose: pose[1], default=None)
        found.append(0.0 if best is None else place.grid.agreement(query.points, best[0]).share)
    return found


@dataclass
class Likeness:
    """What was counted so far.

    :ivar alike: probability that keyframes fit into a place where they do not lie, before any was tried.
    :ivar shares: of the places that were tried last.
    """

    alike: float
    shares: deque[float] = field(default_factory=partial(deque, maxlen=_KEPT))

    def count(self, shares: Iterable[float]) -> None:
        """Keep what keyframes found in places where they do not lie."""
        self.shares.extend(shares)

    def log_rarity(self, share: float, *, foretold: bool) -> float:
        """-log of the probability that keyframes elsewhere fit as well or better, nats.

        :param foretold: whether earlier keyframes fitted, from which it follows that these lie in the place.
        """
        as_well = sum(other > share - _SAME_SHARE for other in self.shares)
        rarity = math.log((_TRIED + len(self.shares)) / (_TRIED * self.alike + as_well))
        return min(rarity, -math.log(_ALIKE_NEXT)) if foretold else rarity
