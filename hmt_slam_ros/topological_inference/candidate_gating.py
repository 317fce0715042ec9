"""Which known areas keyframes may lie in by the arcs alone: the gate, and the transition model of Eq. (6).

The robot entered an area where most of the keyframes lie in its place. The belief of the arcs makes this a probability
pi(gamma). Places exclude each other, so the pi sum to 1 at most, and new ground has the rest. The paper has a constant
n for new ground instead.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.topology import InferenceParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, inverse_pose_covariance, propagate_covariance
from hmt_slam_ros.geometry.se2 import transform_point
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import ShortestPaths, shortest_paths
from hmt_slam_ros.hybrid_map.surroundings import (
    AreaPlace,
    containing_areas,
    keyframe_positions,
    min_distance,
    stack_poses,
)

Pose = Float64

_MAX_EXAMINED = 64
"""Most areas whose keyframes are examined, where the arcs admit many (docs/decisions/0021-bounded-cost-of-a-cut.md)."""

_MAX_NEGATIVES = 6
"""Most areas in which the keyframes surely do not lie that they are compared with."""

_DRAWS = 512
"""Draws from a belief for the probability of a place."""

_ROUNDING = 1e-6
"""Margin of the bounds on distances, m."""

_MIN_BOUND = 1e-300
"""Smallest bound on a probability that is not 0."""


@dataclass(frozen=True, eq=False)
class Query:
    """Keyframes whose area is in question.

    :ivar belief: over ``area_T_reference``, of the area that they are in; the reference is the first keyframe.
    :ivar poses: {keyframe: ``reference_T_base``}.
    """

    belief: PoseGaussian
    poses: Mapping[int, Pose]

    @property
    def poses_in_area(self) -> Float64:
        """``area_T_base`` of the keyframes, shape (n, 3)."""
        return se2.compose(self.belief.mean, stack_poses(self.poses))


class AreaCandidate(NamedTuple):
    """A known area in which the query may lie.

    :ivar prior: belief over ``candidate_T_reference`` by the arcs.
    :ivar unmatched_poses: {keyframe: ``reference_T_base``} of those not yet compared with it.
    :ivar max_probability: upper bound on the probability that they lie in its place, above 0.
    """

    prior: PoseGaussian
    unmatched_poses: Mapping[int, Pose]
    max_probability: float


class CandidateGating:
    """Separates the areas in which keyframes may lie from those in which they surely do not.

    :ivar gate: squared Mahalanobis distance up to which the arcs admit a pose.
    """

    def __init__(self, options: InferenceParameters) -> None:
        self._options = options
        self.gate = chi_square_gate(options.gate_probability)

    def classify_areas(
        self, hybrid_map: HybridMap, area: int, query: Query, excluded: Collection[int]
    ) -> tuple[dict[int, PoseGaussian], dict[int, float], list[int]]:
        """The known areas in which the query may lie, and some of those in which it surely does not.

        :returns: priors of the areas to examine; a bound on the probability of the others, where there are too many;
            and areas in which the query surely does not lie.
        """
        paths = shortest_paths(hybrid_map, area, self._options.prior_limit**2)
        bounds = np.where(np.isin(paths.areas, list(excluded)), 0.0, self._entry_bounds(hybrid_map, paths, query))
        order = np.argsort(-bounds, kind="stable")[: np.count_nonzero(bounds)]
        within = {}
        for i in order[:_MAX_EXAMINED]:
            prior = self.prior(PoseGaussian(paths.means[i], paths.covariances[i]), query)
            if self._is_within_reach(hybrid_map, int(paths.areas[i]), prior, query.poses):
                within[int(paths.areas[i])] = prior
        others = order[_MAX_EXAMINED:]
        unexamined = dict(zip(paths.areas[others].tolist(), bounds[others].tolist(), strict=True))
        is_elsewhere = ~np.isin(paths.areas, [*excluded, *within, *unexamined])
        return within, unexamined, _spread_out(paths.areas[is_elsewhere], _MAX_NEGATIVES).tolist()

    def _entry_bounds(self, hybrid_map: HybridMap, paths: ShortestPaths, query: Query) -> Float64:
        lever = float(np.hypot(*stack_poses(query.poses)[:, :2].T).max())
        reach = hybrid_map.extents(paths.areas) + lever + self._options.place_radius
        return quick_entry_bounds(paths, query.belief, lever, reach, self._options.prior_scale, math.sqrt(self.gate))

    def candidates(
        self,
        hybrid_map: HybridMap,
        query: Query,
        matched: Mapping[int, Collection[int]],
        within: Mapping[int, PoseGaussian],
        certain: Collection[int] = (),
    ) -> dict[int, AreaCandidate]:
        """The known areas within reach with which most of the query was not compared yet.

        :param matched: {known area: keyframes that were compared with it}.
        :param within: {known area: prior over ``area_T_reference``}.
        :param certain: those that are candidates even where the arcs hardly admit them.
        """
        candidates = {}
        for area, prior in within.items():
            unmatched = {k: pose for k, pose in query.poses.items() if k not in matched.get(area, ())}
            if area in certain and 2 * len(unmatched) >= len(query.poses):
                candidates[area] = AreaCandidate(prior, unmatched, 1.0)
            elif 2 * len(unmatched) >= len(query.poses) and self._is_within_reach(hybrid_map, area, prior, unmatched):
                positions = keyframe_positions(hybrid_map, area)
                bound = sampled_entry_bound(positions, prior, stack_poses(unmatched), self._options.place_radius)
                if bound > 0.0:
                    candidates[area] = AreaCandidate(prior, unmatched, bound)
        return candidates

    def prior(self, belief: PoseGaussian, query: Query) -> PoseGaussian:
        """The belief over ``candidate_T_reference`` from that over ``area_T_candidate``, scaled by ``prior_scale``."""
        prior = belief.inverse().compose(query.belief)
        return PoseGaussian(prior.mean, self._options.prior_scale**2 * prior.covariance)

    def _is_within_reach(
        self, hybrid_map: HybridMap, area: int, prior: PoseGaussian, poses: Mapping[int, Pose]
    ) -> bool:
        """Whether a keyframe of the area is near enough to one of the query's, somewhere within the gate."""
        positions = se2.compose(prior.mean, stack_poses(poses))[:, :2]
        lever = float(np.hypot(*(positions - prior.mean[:2]).T).max())
        widest = math.sqrt(np.linalg.eigvalsh(prior.covariance[:2, :2]).max())
        spread = widest + lever * math.sqrt(prior.covariance[2, 2])
        known = keyframe_positions(hybrid_map, area)
        return min_distance(positions, known) <= self._options.place_radius + math.sqrt(self.gate) * spread


def _spread_out(areas: Int64, count: int) -> Int64:
    """Some areas from all over the map: those whose numbers are divisible by the largest powers of two.

    The choice hardly changes from cut to cut, so that grids of these areas stay cached. One area more or less changes
    one choice at most.
    """
    power = 1 << int(areas.max(initial=1)).bit_length()
    while power > 1 and np.count_nonzero(areas & (power - 1) == 0) <= count:
        power //= 2
    chosen = areas[areas & (power - 1) == 0]
    return chosen[np.lexsort((chosen, -(chosen & -chosen)))][:count]


class Transition(NamedTuple):
    """P(gamma | d): ``known`` {area: pi} and ``new``; the sum is 1."""

    known: dict[int, float]
    new: float


def transition_model(probabilities: Mapping[int, float], new_floor: float) -> Transition:
    """The transition model from the probability of each place by itself.

    These are computed one by one, and may sum to more than 1 where beliefs over neighboring areas disagree.

    :param probabilities: {area: pi}.
    :param new_floor: smallest probability of new ground: arcs may be wrong, and a place is only a model.
    """
    total = sum(probabilities.values())
    new = max(1.0 - total, new_floor)
    scale = (1.0 - new) / total if total > 0.0 else 0.0
    known = {area: scale * probability for area, probability in probabilities.items()}
    return Transition(known, new if total > 0.0 else 1.0)


class EntryPrior(NamedTuple):
    """Whether the keyframes lie in an area's place, by the arcs.

    :ivar probability: pi(gamma), the probability that they do, exactly 0 where no draw has them there.
    :ivar median_mahalanobis2: median squared Mahalanobis distance of the poses in the place from the belief's mean.
    """

    probability: float
    median_mahalanobis2: float


def entry_prior(place: AreaPlace, belief: PoseGaussian, poses: Float64, radius: float) -> EntryPrior:
    """The probability that keyframes lie in a place.

    :param belief: over ``area_T_reference``.
    :param poses: shape (m, 3), ``reference_T_base`` of the keyframes.
    :param radius: largest distance to a keyframe of the place, m.
    """
    is_inside = containing_areas(place, _sampled_positions(belief, poses), radius) == place.area
    distances = np.sum(_normal_points()[is_inside] ** 2, axis=1)
    return EntryPrior(float(np.mean(is_inside)), float(np.median(distances)) if is_inside.any() else 0.0)


def sampled_entry_bound(known: Float64, belief: PoseGaussian, poses: Float64, radius: float) -> float:
    """Upper bound on the probability of :func:`entry_prior`: that one keyframe is near one of the area's.

    :param known: shape (k, 2), positions of the area's keyframes, m.
    :param belief: over ``area_T_reference``; ``poses`` and ``radius`` as there.
    """
    return float(np.mean(_any_near(_sampled_positions(belief, poses), known, radius)))


def _sampled_positions(belief: PoseGaussian, poses: Float64) -> Float64:
    """Positions of keyframes (m, 3) under draws from the belief over their reference, shape (draws, m, 2)."""
    return _transformed_positions(_normal_points(), belief.mean, np.linalg.cholesky(belief.covariance), poses)


@njit(cache=True)
def _transformed_positions(normal: Float64, mean: Float64, root: Float64, poses: Float64) -> Float64:
    """Positions of the poses (m, 3) after ``mean exp(root normal)``, for each of n points (n, 3); shape (n, m, 2)."""
    positions = np.empty((normal.shape[0], poses.shape[0], 2))
    cos, sin = np.cos(mean[2]), np.sin(mean[2])
    for n in range(normal.shape[0]):
        a, b, c = normal[n]
        turn = root[2, 0] * a + root[2, 1] * b + root[2, 2] * c
        x, y = se2.exp_shift(root[0, 0] * a, root[1, 0] * a + root[1, 1] * b, turn)
        x, y = transform_point(mean[0], mean[1], cos, sin, x, y)
        turned_cos, turned_sin = np.cos(mean[2] + turn), np.sin(mean[2] + turn)
        for k in range(poses.shape[0]):
            positions[n, k, 0], positions[n, k, 1] = transform_point(
                x, y, turned_cos, turned_sin, poses[k, 0], poses[k, 1]
            )
    return positions


@njit(cache=True)
def _any_near(positions: Float64, known: Float64, radius: float) -> Bool:
    """Which of n draws of m positions (n, m, 2) have one within ``radius`` of one of (k, 2), shape (n,)."""
    near = np.zeros(positions.shape[0], np.bool_)
    for n in range(positions.shape[0]):
        for m in range(positions.shape[1]):
            for k in range(known.shape[0]):
                dx, dy = positions[n, m, 0] - known[k, 0], positions[n, m, 1] - known[k, 1]
                if dx * dx + dy * dy <= radius * radius:
                    near[n] = True
                    break
            if near[n]:
                break
    return near


@cache
def _normal_points() -> Float64:
    """Standard normal points of a low-discrepancy sequence, shape (draws, 3), the first one 0; always the same.

    They are the multiples of powers of the number g with g^4 = g + 1, which generalizes the golden ratio.
    """
    g = 1.2207440846057596
    steps = np.arange(_DRAWS)[:, None] / g ** np.arange(1, 4)
    return np.asarray(scipy.special.ndtri((0.5 + steps) % 1.0), dtype=np.float64)


def quick_entry_bounds(
    paths: ShortestPaths, query: PoseGaussian, lever: float, reach: Float64, scale: float, deviations: float
) -> Float64:
    """Fast upper bounds on the probability that a query lies in the places of areas, shape (n,).

    They are 0 where no keyframe of the area can be near enough to one of the query's.

    :param paths: areas seen from the query's area.
    :param query: belief over ``area_T_reference`` of the query's reference.
    :param lever: largest distance of the query's keyframes from their reference, m.
    :param reach: shape (n,), largest distance of the reference from an area's origin if the query is in its place, m.
    :param scale: factor on the deviations of the prior.
    :param deviations: how many deviations are admitted.
    """
    return _quick_entry_bounds(
        paths.means, paths.covariances, query.mean, query.covariance, reach, lever, scale, deviations
    )


@njit(cache=True)
def _quick_entry_bounds(
    means: Float64,
    covariances: Float64,
    mean: Float64,
    covariance: Float64,
    reach: Float64,
    lever: float,
    scale: float,
    deviations: float,
) -> Float64:
    bounds = np.zeros(len(means))
    own = np.sqrt(covariance[0, 0] + covariance[1, 1])
    for n in range(len(means)):
        distance = np.hypot(mean[0] - means[n, 0], mean[1] - means[n, 1])
        # The root of the trace bounds the deviation in any direction; it rules out most areas.
        turn = np.sqrt(covariances[n, 2, 2])
        widest = np.sqrt(covariances[n, 0, 0] + covariances[n, 1, 1]) + distance * turn + own
        widest += lever * (turn + np.sqrt(covariance[2, 2]))
        if distance > reach[n] + deviations * scale * widest + 2.0 * _ROUNDING:
            continue
        prior = (
            scale * scale * (propagate_covariance(inverse_pose_covariance(covariances[n], means[n]), mean) + covariance)
        )
        half, apart = 0.5 * (prior[0, 0] + prior[1, 1]), 0.5 * (prior[0, 0] - prior[1, 1])
        turn = np.sqrt(apart * apart + prior[0, 1] * prior[0, 1])
        spread = np.sqrt(max(0.0, half + turn)) + lever * np.sqrt(max(0.0, prior[2, 2]))
        if distance > reach[n] + deviations * spread + _ROUNDING:
            continue
        # The area of the disc of this reach times the largest density in it, for a normal of this spread.
        off = max(0.0, distance - reach[n]) / max(spread, _ROUNDING)
        density = np.exp(-0.5 * off * off) / max(np.sqrt(max(0.0, half * half - turn * turn)), _ROUNDING)
        bounds[n] = min(1.0, max(0.5 * reach[n] * reach[n] * density, _MIN_BOUND))
    return bounds
