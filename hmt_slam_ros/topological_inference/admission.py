"""In which known areas may some keyframes lie, by the arcs alone?"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.topology import TopologicalInference
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, gate
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import Reached, reached
from hmt_slam_ros.hybrid_map.surroundings import entry_bound, entry_bounds, gap, positions, stacked

Pose = NDArray[np.float64]

# Areas within reach of which the keyframes are looked at, where the arcs admit many.
_LOOKED_AT = 64
# Areas in which the keyframes surely do not lie that they are compared with all the same.
_ELSEWHERE = 6


@dataclass(frozen=True, eq=False)
class Query:
    """Keyframes in question.

    :ivar belief: over ``area_T_reference``, of the area that they are in; the reference is the first keyframe.
    :ivar poses: {keyframe: ``reference_T_base``}.
    """

    belief: PoseGaussian
    poses: Mapping[int, Pose]

    @property
    def in_area(self) -> NDArray[np.float64]:
        """``area_T_base`` of the keyframes, shape (n, 3)."""
        return se2.compose(self.belief.mean, stacked(self.poses))


class Candidate(NamedTuple):
    """A known area in which the query may lie.

    :ivar prior: belief over ``candidate_T_reference`` by the arcs.
    :ivar fresh: {keyframe: ``reference_T_base``} of those not yet compared with it.
    :ivar most: a bound on the probability that they lie in its place, above 0.
    """

    prior: PoseGaussian
    fresh: Mapping[int, Pose]
    most: float


class Admission:
    """Tells the areas that keyframes may lie in from those in which they surely do not.

    :ivar gate: squared Mahalanobis distance up to which the arcs admit a pose.
    """

    def __init__(self, options: TopologicalInference) -> None:
        self._options = options
        self.gate = gate(options.gate_probability)

    def divided(
        self, hybrid_map: HybridMap, area: int, query: Query, excluded: Collection[int]
    ) -> tuple[dict[int, PoseGaussian], dict[int, float], list[int]]:
        """The known areas in which the query may lie, and some of those in which it surely does not.

        :returns: the priors of those that are looked at; where they are too many, of the others a bound on the
            probability that the query lies there; and areas elsewhere.
        """
        found = reached(hybrid_map, area, self._options.prior_limit**2)
        bounds = np.where(np.isin(found.areas, list(excluded)), 0.0, self._entry_bounds(hybrid_map, found, query))
        order = np.argsort(-bounds, kind="stable")[: np.count_nonzero(bounds)]
        within = {}
        for i in order[:_LOOKED_AT]:
            prior = self.prior(PoseGaussian(found.means[i], found.covariances[i]), query)
            if self._within_reach(hybrid_map, int(found.areas[i]), prior, query.poses):
                within[int(found.areas[i])] = prior
        others = order[_LOOKED_AT:]
        distant = dict(zip(found.areas[others].tolist(), bounds[others].tolist(), strict=True))
        known = ~np.isin(found.areas, [*excluded, *within, *distant])
        return within, distant, _spread_out(found.areas[known], _ELSEWHERE).tolist()

    def _entry_bounds(self, hybrid_map: HybridMap, found: Reached, query: Query) -> NDArray[np.float64]:
        lever = float(np.hypot(*stacked(query.poses)[:, :2].T).max())
        reach = hybrid_map.extents(found.areas) + lever + self._options.place_radius
        return entry_bounds(found, query.belief, lever, reach, self._options.prior_scale, math.sqrt(self.gate))

    def candidates(
        self,
        hybrid_map: HybridMap,
        query: Query,
        compared: Mapping[int, Collection[int]],
        within: Mapping[int, PoseGaussian],
    ) -> dict[int, Candidate]:
        """The known areas within reach with which most of the query was not compared yet."""
        found = {}
        for known, prior in within.items():
            fresh = {k: pose for k, pose in query.poses.items() if k not in compared.get(known, ())}
            # An area with which most of the keyframes were compared has had its chance.
            if 2 * len(fresh) >= len(query.poses) and self._within_reach(hybrid_map, known, prior, fresh):
                at = positions(hybrid_map, known, np.zeros(3))
                most = entry_bound(at, prior, stacked(fresh), self._options.place_radius)
                if most > 0.0:
                    found[known] = Candidate(prior, fresh, most)
        return found

    def prior(self, belief: PoseGaussian, query: Query) -> PoseGaussian:
        """``candidate_T_reference`` from ``area_T_candidate`` and ``area_T_reference``, widened."""
        prior = belief.inverse().compose(query.belief)
        return PoseGaussian(prior.mean, self._options.prior_scale**2 * prior.covariance)

    def _within_reach(self, hybrid_map: HybridMap, area: int, prior: PoseGaussian, poses: Mapping[int, Pose]) -> bool:
        """Whether a keyframe of the area is near enough to one of the query's, somewhere within the gate."""
        asked = se2.compose(prior.mean, stacked(poses))[:, :2]
        lever = float(np.hypot(*(asked - prior.mean[:2]).T).max())
        spread = math.sqrt(np.linalg.eigvalsh(prior.covariance[:2, :2])[-1]) + lever * math.sqrt(prior.covariance[2, 2])
        known = positions(hybrid_map, area, np.zeros(3))
        return gap(asked, known) <= self._options.place_radius + math.sqrt(self.gate) * spread


def _spread_out(areas: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Some of the areas from all over the map, those whose numbers are divisible by the largest powers of two.

    They stay the same from cut to cut, so that the maps made of them serve for many: where one more area is known, or
    one less is elsewhere, at most one of them changes.
    """
    power = 1 << int(areas.max(initial=1)).bit_length()
    while power > 1 and np.count_nonzero(areas & (power - 1) == 0) <= count:
        power //= 2
    some = areas[areas & (power - 1) == 0]
    return some[np.lexsort((some, -(some & -some)))][:count]
