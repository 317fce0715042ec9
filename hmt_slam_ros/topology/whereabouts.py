"""Where in the map is a robot that woke up somewhere? Eq. (6) with a prior that is flat over all known areas.

Blanco et al. name it as future work: the robot awakening problem is a topological loop closure whose prior tells
nothing. What the robot has seen since it woke up, all of it, is laid into every area, at all positions in its place and
all headings. Every scan counts once, since at every look the probability is worked out anew, from the same prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.agreement import MAPS, MAPS_USUAL
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.likeness import Likeness
from hmt_slam_ros.topology.relocation import Located, Relocation

UNMAPPED = 0.2
"""Probability that a robot that woke up somewhere is where the map does not reach."""

# Areas whose surfaces are compared.
_MOST = 16


class Whereabouts(NamedTuple):
    """The probability of every place where the robot may be; the rest is where the map does not reach.

    :ivar found: ways in which what it saw lies in the map.
    :ivar probabilities: shape (len(found),).
    :ivar unseen: probability of the areas that were not looked at.
    :ivar others: their number.
    """

    found: tuple[Located, ...]
    probabilities: NDArray[np.float64]
    unseen: float
    others: int

    @property
    def best(self) -> tuple[Located, float] | None:
        """The most probable place and its probability."""
        if not self.found:
            return None
        n = int(self.probabilities.argmax())
        return self.found[n], float(self.probabilities[n])


def whereabouts(
    relocation: Relocation,
    alike: float,
    hybrid_map: HybridMap,
    poses: Mapping[int, NDArray[np.float64]],
    before: int,
) -> Whereabouts:
    """Where some keyframes are.

    How rare a fit is shows in the other areas, in which the same was tried.

    :param alike: probability that keyframes fit into an area where they do not lie, before any was tried.
    :param poses: {keyframe: ``reference_T_base`` (3,)}.
    :param before: the map is that of the keyframes before this one.
    """
    known = sum(any(k < before for k in hybrid_map.keyframes(area)) for area in hybrid_map.area_ids())
    found, looked_at, unseen = relocation.fits(hybrid_map, poses, before, _MOST)
    whole: dict[int, float] = {}
    for fit in found:
        whole[fit.area] = float(np.logaddexp(whole.get(fit.area, -math.inf), fit.mode.log_mass))
    log_prior = math.log((1.0 - UNMAPPED) / max(1, known))
    best = {area: max((fit.found.share for fit in found if fit.area == area), default=0.0) for area in looked_at}
    likeness = Likeness(alike)
    likeness.count(sorted(best.values())[:-1])
    logs = [
        log_prior + fit.mode.log_mass - whole[fit.area]
        + MAPS.log_ratio(fit.found, MAPS_USUAL)
        + likeness.log_rarity(fit.found.share, foretold=False)
        for fit in found
    ]  # fmt: skip
    weights = np.exp(np.array([*logs, math.log(UNMAPPED), math.log((1.0 - UNMAPPED) * unseen + 1e-300)]))
    probabilities = weights / weights.sum()
    others = max(0, known - len(looked_at))
    return Whereabouts(tuple(found), probabilities[: len(found)], float(probabilities[-1]), others)
