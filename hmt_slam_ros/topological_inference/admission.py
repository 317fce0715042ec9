"""In which known areas may some keyframes lie, by the arcs alone?"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.topology import InferenceParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import ShortestPaths, shortest_paths
from hmt_slam_ros.hybrid_map.surroundings import (
    keyframe_positions,
    min_distance,
    quick_entry_bounds,
    sampled_entry_bound,
    stack_poses,
)

Pose = NDArray[np.float64]

# Areas within reach of which the keyframes are looked at, where the arcs admit many.
_MAX_EXAMINED = 64
# Areas in which the keyframes surely do not lie that they are compared with all the same.
_MAX_NEGATIVES = 6


@dataclass(frozen=True, eq=False)
class Query:
    """Keyframes in question.

    :ivar belief: over ``area_T_reference``, of the area that they are in; the reference is the first keyframe.
    :ivar poses: {keyframe: ``reference_T_base``}.
    """

    belief: PoseGaussian
    poses: Mapping[int, Pose]

    @property
    def poses_in_area(self) -> NDArray[np.float64]:
        """``area_T_base`` of the keyframes, shape (n, 3)."""
        return se2.compose(self.belief.mean, stack_poses(self.poses))


class AreaCandidate(NamedTuple):
    """A known area in which the query may lie.

    :ivar prior: belief over ``candidate_T_reference`` by the arcs.
    :ivar unmatched_poses: {keyframe: ``reference_T_base``} of those not yet compared with it.
    :ivar max_probability: a bound on the probability that they lie in its place, above 0.
    """

    prior: PoseGaussian
    unmatched_poses: Mapping[int, Pose]
    max_probability: float


class CandidateGating:
    """Tells the areas that keyframes may lie in from those in which they surely do not.

    :ivar gate: squared Mahalanobis distance up to which the arcs admit a pose.
    """

    def __init__(self, options: InferenceParameters) -> None:
        self._options = options
        self.gate = chi_square_gate(options.gate_probability)

    def classify_areas(
        self, hybrid_map: HybridMap, area: int, query: Query, excluded: Collection[int]
    ) -> tuple[dict[int, PoseGaussian], dict[int, float], list[int]]:
        """The known areas in which the query may lie, and some of those in which it surely does not.

        :returns: the priors of those that are looked at; where they are too many, of the others a bound on the
            probability that the query lies there; and areas elsewhere.
        """
        found = shortest_paths(hybrid_map, area, self._options.prior_limit**2)
        bounds = np.where(np.isin(found.areas, list(excluded)), 0.0, self._entry_bounds(hybrid_map, found, query))
        order = np.argsort(-bounds, kind="stable")[: np.count_nonzero(bounds)]
        within = {}
        for i in order[:_MAX_EXAMINED]:
            prior = self.prior(PoseGaussian(found.means[i], found.covariances[i]), query)
            if self._is_within_reach(hybrid_map, int(found.areas[i]), prior, query.poses):
                within[int(found.areas[i])] = prior
        others = order[_MAX_EXAMINED:]
        distant = dict(zip(found.areas[others].tolist(), bounds[others].tolist(), strict=True))
        known = ~np.isin(found.areas, [*excluded, *within, *distant])
        return within, distant, _spread_out(found.areas[known], _MAX_NEGATIVES).tolist()

    def _entry_bounds(self, hybrid_map: HybridMap, found: ShortestPaths, query: Query) -> NDArray[np.float64]:
        lever = float(np.hypot(*stack_poses(query.poses)[:, :2].T).max())
        reach = hybrid_map.extents(found.areas) + lever + self._options.place_radius
        return quick_entry_bounds(found, query.belief, lever, reach, self._options.prior_scale, math.sqrt(self.gate))

    def candidates(
        self,
        hybrid_map: HybridMap,
        query: Query,
        compared: Mapping[int, Collection[int]],
        within: Mapping[int, PoseGaussian],
    ) -> dict[int, AreaCandidate]:
        """The known areas within reach with which most of the query was not compared yet."""
        found = {}
        for known, prior in within.items():
            fresh = {k: pose for k, pose in query.poses.items() if k not in compared.get(known, ())}
            # An area with which most of the keyframes were compared has had its chance.
            if 2 * len(fresh) >= len(query.poses) and self._is_within_reach(hybrid_map, known, prior, fresh):
                at = keyframe_positions(hybrid_map, known, np.zeros(3))
                most = sampled_entry_bound(at, prior, stack_poses(fresh), self._options.place_radius)
                if most > 0.0:
                    found[known] = AreaCandidate(prior, fresh, most)
        return found

    def prior(self, belief: PoseGaussian, query: Query) -> PoseGaussian:
        """``candidate_T_reference`` from ``area_T_candidate`` and ``area_T_reference``, widened."""
        prior = belief.inverse().compose(query.belief)
        return PoseGaussian(prior.mean, self._options.prior_scale**2 * prior.covariance)

    def _is_within_reach(
        self, hybrid_map: HybridMap, area: int, prior: PoseGaussian, poses: Mapping[int, Pose]
    ) -> bool:
        """Whether a keyframe of the area is near enough to one of the query's, somewhere within the gate."""
        asked = se2.compose(prior.mean, stack_poses(poses))[:, :2]
        lever = float(np.hypot(*(asked - prior.mean[:2]).T).max())
        spread = math.sqrt(np.linalg.eigvalsh(prior.covariance[:2, :2])[-1]) + lever * math.sqrt(prior.covariance[2, 2])
        known = keyframe_positions(hybrid_map, area, np.zeros(3))
        return min_distance(asked, known) <= self._options.place_radius + math.sqrt(self.gate) * spread


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
