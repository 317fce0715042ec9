"""Where in the map is a robot that woke up somewhere? Eq. (6) with a prior that is flat over all known areas.

Blanco et al. name it as future work: the robot awakening problem is a topological loop closure whose prior tells
nothing. What the robot has seen since it woke up, all of it, is laid into every area, at all positions in its place and
all headings. Every scan counts once, since at every look the probability is worked out anew, from the same prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import connected_areas
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions
from hmt_slam_ros.registration.consistency import (
    MAP_IN_MAP,
    MAPS_OUTLIER_RATE,
    WALLS_OF_MAP,
    WALLS_OUTLIER_RATE,
    Clutter,
)
from hmt_slam_ros.topological_inference.global_scan_matching import GlobalScanMatcher, PoseCandidate
from hmt_slam_ros.topological_inference.place_recognition import PerceptualAliasing

UNMAPPED_PRIOR = 0.2
"""Probability that a robot that woke up somewhere is where the map does not reach."""

# Weight of what surfaces say for one area rather than another. A place where less of what the robot sees is known may
# have holes in its map, which come in lumps, and not sample by sample.
_SURFACE_WEIGHT = 0.5
# Probability from which on the walls of a place are looked at.
_PROBABLE = 0.05
# Walls are passed as often as this in a map of long before, relative to one of just before: people stood elsewhere.
_LONG_AGO = 2.0
# Deviations of what somebody says, beyond which no place is looked at.
_DEVIATIONS = 4.0

Pose = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseHint:
    """Where a keyframe is, as somebody says.

    :ivar keyframe: its number.
    :ivar area: a known area.
    :ivar pose: belief over ``area_T_base`` of the keyframe.
    """

    keyframe: int
    area: int
    pose: PoseGaussian


class PoseDistribution(NamedTuple):
    """The probability of every place where the robot may be; the rest is where the map does not reach.

    :ivar candidates: ways in which what it saw lies in the map.
    :ivar probabilities: shape (len(found),).
    """

    candidates: tuple[PoseCandidate, ...]
    probabilities: NDArray[np.float64]

    @property
    def best(self) -> tuple[PoseCandidate, float] | None:
        """The most probable place and its probability."""
        if not self.candidates:
            return None
        n = int(self.probabilities.argmax())
        return self.candidates[n], float(self.probabilities[n])

    def reweight(self, log_weights: Sequence[float] | NDArray[np.float64]) -> PoseDistribution:
        """The same after something more was learnt of every place, relative to where the map does not reach, nats."""
        rest = max(1.0 - float(self.probabilities.sum()), 1e-300)
        logs = np.log(np.maximum(self.probabilities, 1e-300)) + log_weights
        shift = max(0.0, float(logs.max(initial=0.0)))
        weights = np.exp(logs - shift)
        return PoseDistribution(self.candidates, weights / (weights.sum() + rest * math.exp(-shift)))

    def with_unmapped_prior(self, prior: float) -> PoseDistribution:
        """The same, where the map does not reach where the robot is with another probability than ``UNMAPPED``."""
        weights = (1.0 - prior) / prior * UNMAPPED_PRIOR / (1.0 - UNMAPPED_PRIOR) * self.probabilities
        rest = max(0.0, 1.0 - float(self.probabilities.sum()))
        return PoseDistribution(self.candidates, weights / max(rest + float(weights.sum()), 1e-300))

    def with_false_alarm(self, there: NDArray[np.bool_], probability: float, areas: int) -> PoseDistribution:
        """The same for a robot that may be where it would be if it had not been displaced.

        What it sees there is as likely as in new ground at least, since things are moved.

        :param there: which places are where it would be, shape (len(found),).
        :param probability: that it was not displaced.
        :param areas: known areas, over which the prior of one that was is flat.
        """
        rest = max(1.0 - float(self.probabilities.sum()), 1e-300)
        displaced = UNMAPPED_PRIOR / rest * self.probabilities
        stayed = np.where(there, areas / (1.0 - UNMAPPED_PRIOR) * displaced, 0.0)
        weights = (1.0 - probability) * displaced + probability * stayed
        nowhere = (1.0 - probability) * UNMAPPED_PRIOR + probability * max(0.0, 1.0 - float(stayed.sum()))
        return PoseDistribution(self.candidates, weights / (nowhere + weights.sum()))


def localize_globally(
    matcher: GlobalScanMatcher,
    shares: Mapping[int, float],
    aliasing_prior: float,
    hybrid_map: HybridMap,
    poses: Mapping[int, Pose],
    before: int,
    clutter: Clutter,
    pose_hint: PoseHint | None = None,
    radius: float = 0.0,
) -> PoseDistribution:
    """Where some keyframes are.

    How rare a fit is shows in the other areas, in which the same was tried. Whether they are in the map at all is asked
    of the best fit; between those that remain, the surfaces that are known at one and not at the other count too, and
    where these make a place probable, the walls that either side sees through. Where somebody says where they are, the
    prior is not flat, but as wide as that is uncertain, and areas farther off are not looked at.

    :param shares: {area: probability by its look} of all known areas.
    :param aliasing_prior: probability that keyframes fit into an area where they do not lie, before any was tried.
    :param poses: {keyframe: ``reference_T_base`` (3,)}.
    :param before: the map is that of the keyframes before this one.
    :param clutter: what contradicts the robot's map usually, where that is more than of maps.
    :param pose_hint: of the reference.
    :param radius: farthest distance to a keyframe of an area's place, m.
    """
    near = None if pose_hint is None else _areas_near_hint(hybrid_map, pose_hint, radius, before)
    areas = [area for area in shares if near is None or area in near]
    found = matcher.match_regions(hybrid_map, poses, before, {area: shares[area] for area in areas})
    whole: dict[int, float] = {}
    for fit in found:
        whole[fit.area] = float(np.logaddexp(whole.get(fit.area, -math.inf), fit.mode.log_mass))
    most = max(whole.values(), default=0.0)
    log_flat = math.log((1.0 - UNMAPPED_PRIOR) / max(1, len(areas)))
    best = {
        area: max((fit.agreement.matched_share for fit in found if fit.area == area), default=0.0) for area in areas
    }
    usual = max(MAPS_OUTLIER_RATE, clutter.beam_outlier_rate)
    likeness = PerceptualAliasing(aliasing_prior)
    likeness.add_negatives(sorted(best.values())[:-1])
    logs = [
        (log_flat if pose_hint is None or near is None else _log_hint_prior(pose_hint, near[fit.area], fit))
        + fit.mode.log_mass
        - whole[fit.area]
        + _SURFACE_WEIGHT * (whole[fit.area] - most)
        + MAP_IN_MAP.log_likelihood_ratio(fit.agreement, usual)
        + likeness.log_distinctiveness(fit.agreement.matched_share, already_expected=False)
        for fit in found
    ]
    first = _probabilities(logs)
    passed = max(WALLS_OUTLIER_RATE, _LONG_AGO * clutter.wall_outlier_rate)
    for n in np.flatnonzero(first >= _PROBABLE):
        # That none is passed says no more than the surfaces, which count already.
        logs[n] += min(
            0.0, WALLS_OF_MAP.log_likelihood_ratio(matcher.check_walls(hybrid_map, found[n], poses, before), passed)
        )
    return PoseDistribution(tuple(found), _probabilities(logs))


def _probabilities(logs: Sequence[float]) -> NDArray[np.float64]:
    """Of fits with some log-weights, beside that the map does not reach there, shape (len(logs),)."""
    weights = np.exp(np.array([*logs, math.log(UNMAPPED_PRIOR)]))
    return (weights / weights.sum())[:-1]


def _areas_near_hint(hybrid_map: HybridMap, pose_hint: PoseHint, radius: float, before: int) -> dict[int, PoseGaussian]:
    """{area: belief over ``told_area_T_area``} of those in which the reference may be."""
    if not hybrid_map.has_area(pose_hint.area):
        return {}
    reach = radius + _DEVIATIONS * math.sqrt(float(np.linalg.eigvalsh(pose_hint.pose.covariance[:2, :2])[-1]))
    near = {}
    for area, belief in connected_areas(hybrid_map, pose_hint.area).items():
        if min(hybrid_map.keyframes(area), default=before) >= before:
            continue
        away = keyframe_positions(hybrid_map, area, belief.mean) - pose_hint.pose.mean[:2]
        if np.hypot(*away.T).min() <= reach:
            near[area] = belief
    return near


def _log_hint_prior(pose_hint: PoseHint, belief: PoseGaussian, fit: PoseCandidate) -> float:
    """Of a fit, relative to the best that there could be.

    :param belief: over ``told_area_T_area`` of the fit's area.
    """
    there = belief.compose(fit.mode.measured)
    away = se2.log(se2.between(pose_hint.pose.mean, there.mean))
    distance = float(away @ np.linalg.solve(pose_hint.pose.covariance + there.covariance, away))
    return math.log(1.0 - UNMAPPED_PRIOR) - 0.5 * distance
