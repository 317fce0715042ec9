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
from hmt_slam_ros.hybrid_map.shortest_path import joined
from hmt_slam_ros.hybrid_map.surroundings import positions
from hmt_slam_ros.registration.consistency import MAPS, MAPS_USUAL, WALLS, WALLS_USUAL, Clutter
from hmt_slam_ros.topological_inference.global_scan_matching import Located, WholeMap
from hmt_slam_ros.topological_inference.place_recognition import Likeness

UNMAPPED = 0.2
"""Probability that a robot that woke up somewhere is where the map does not reach."""

# Weight of what surfaces say for one area rather than another. A place where less of what the robot sees is known may
# have holes in its map, which come in lumps, and not sample by sample.
_BETWEEN = 0.5
# Probability from which on the walls of a place are looked at.
_PROBABLE = 0.05
# Walls are passed as often as this in a map of long before, relative to one of just before: people stood elsewhere.
_LONG_AGO = 2.0
# Deviations of what somebody says, beyond which no place is looked at.
_DEVIATIONS = 4.0

Pose = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Told:
    """Where a keyframe is, as somebody says.

    :ivar keyframe: its number.
    :ivar area: a known area.
    :ivar pose: belief over ``area_T_base`` of the keyframe.
    """

    keyframe: int
    area: int
    pose: PoseGaussian


class Whereabouts(NamedTuple):
    """The probability of every place where the robot may be; the rest is where the map does not reach.

    :ivar found: ways in which what it saw lies in the map.
    :ivar probabilities: shape (len(found),).
    """

    found: tuple[Located, ...]
    probabilities: NDArray[np.float64]

    @property
    def best(self) -> tuple[Located, float] | None:
        """The most probable place and its probability."""
        if not self.found:
            return None
        n = int(self.probabilities.argmax())
        return self.found[n], float(self.probabilities[n])

    def weighed(self, log_weights: Sequence[float] | NDArray[np.float64]) -> Whereabouts:
        """The same after something more was learnt of every place, relative to where the map does not reach, nats."""
        rest = max(1.0 - float(self.probabilities.sum()), 1e-300)
        logs = np.log(np.maximum(self.probabilities, 1e-300)) + log_weights
        shift = max(0.0, float(logs.max(initial=0.0)))
        weights = np.exp(logs - shift)
        return Whereabouts(self.found, weights / (weights.sum() + rest * math.exp(-shift)))

    def with_unmapped(self, prior: float) -> Whereabouts:
        """The same, where the map does not reach where the robot is with another probability than ``UNMAPPED``."""
        weights = (1.0 - prior) / prior * UNMAPPED / (1.0 - UNMAPPED) * self.probabilities
        rest = max(0.0, 1.0 - float(self.probabilities.sum()))
        return Whereabouts(self.found, weights / max(rest + float(weights.sum()), 1e-300))

    def or_stayed(self, there: NDArray[np.bool_], probability: float, areas: int) -> Whereabouts:
        """The same for a robot that may be where it would be if it had not been displaced.

        What it sees there is as likely as in new ground at least, since things are moved.

        :param there: which places are where it would be, shape (len(found),).
        :param probability: that it was not displaced.
        :param areas: known areas, over which the prior of one that was is flat.
        """
        rest = max(1.0 - float(self.probabilities.sum()), 1e-300)
        displaced = UNMAPPED / rest * self.probabilities
        stayed = np.where(there, areas / (1.0 - UNMAPPED) * displaced, 0.0)
        weights = (1.0 - probability) * displaced + probability * stayed
        nowhere = (1.0 - probability) * UNMAPPED + probability * max(0.0, 1.0 - float(stayed.sum()))
        return Whereabouts(self.found, weights / (nowhere + weights.sum()))


def whereabouts(
    whole_map: WholeMap,
    shares: Mapping[int, float],
    alike: float,
    hybrid_map: HybridMap,
    poses: Mapping[int, Pose],
    before: int,
    clutter: Clutter,
    told: Told | None = None,
    radius: float = 0.0,
) -> Whereabouts:
    """Where some keyframes are.

    How rare a fit is shows in the other areas, in which the same was tried. Whether they are in the map at all is asked
    of the best fit; between those that remain, the surfaces that are known at one and not at the other count too, and
    where these make a place probable, the walls that either side sees through. Where somebody says where they are, the
    prior is not flat, but as wide as that is uncertain, and areas farther off are not looked at.

    :param shares: {area: probability by its look} of all known areas.
    :param alike: probability that keyframes fit into an area where they do not lie, before any was tried.
    :param poses: {keyframe: ``reference_T_base`` (3,)}.
    :param before: the map is that of the keyframes before this one.
    :param clutter: what contradicts the robot's map usually, where that is more than of maps.
    :param told: of the reference.
    :param radius: farthest distance to a keyframe of an area's place, m.
    """
    near = None if told is None else _near(hybrid_map, told, radius, before)
    areas = [area for area in shares if near is None or area in near]
    found = whole_map.fits(hybrid_map, poses, before, {area: shares[area] for area in areas})
    whole: dict[int, float] = {}
    for fit in found:
        whole[fit.area] = float(np.logaddexp(whole.get(fit.area, -math.inf), fit.mode.log_mass))
    most = max(whole.values(), default=0.0)
    log_flat = math.log((1.0 - UNMAPPED) / max(1, len(areas)))
    best = {area: max((fit.found.share for fit in found if fit.area == area), default=0.0) for area in areas}
    usual = max(MAPS_USUAL, clutter.ends)
    likeness = Likeness(alike)
    likeness.count(sorted(best.values())[:-1])
    logs = [
        (log_flat if told is None or near is None else _log_prior(told, near[fit.area], fit))
        + fit.mode.log_mass
        - whole[fit.area]
        + _BETWEEN * (whole[fit.area] - most)
        + MAPS.log_ratio(fit.found, usual)
        + likeness.log_rarity(fit.found.share, foretold=False)
        for fit in found
    ]
    first = _probabilities(logs)
    passed = max(WALLS_USUAL, _LONG_AGO * clutter.walls)
    for n in np.flatnonzero(first >= _PROBABLE):
        # That none is passed says no more than the surfaces, which count already.
        logs[n] += min(0.0, WALLS.log_ratio(whole_map.walls(hybrid_map, found[n], poses, before), passed))
    return Whereabouts(tuple(found), _probabilities(logs))


def _probabilities(logs: Sequence[float]) -> NDArray[np.float64]:
    """Of fits with some log-weights, beside that the map does not reach there, shape (len(logs),)."""
    weights = np.exp(np.array([*logs, math.log(UNMAPPED)]))
    return (weights / weights.sum())[:-1]


def _near(hybrid_map: HybridMap, told: Told, radius: float, before: int) -> dict[int, PoseGaussian]:
    """{area: belief over ``told_area_T_area``} of those in which the reference may be."""
    if not hybrid_map.has_area(told.area):
        return {}
    reach = radius + _DEVIATIONS * math.sqrt(float(np.linalg.eigvalsh(told.pose.covariance[:2, :2])[-1]))
    near = {}
    for area, belief in joined(hybrid_map, told.area).items():
        if min(hybrid_map.keyframes(area), default=before) >= before:
            continue
        away = positions(hybrid_map, area, belief.mean) - told.pose.mean[:2]
        if np.hypot(*away.T).min() <= reach:
            near[area] = belief
    return near


def _log_prior(told: Told, belief: PoseGaussian, fit: Located) -> float:
    """Of a fit, relative to the best that there could be.

    :param belief: over ``told_area_T_area`` of the fit's area.
    """
    there = belief.compose(fit.mode.measured)
    away = se2.log(se2.between(told.pose.mean, there.mean))
    distance = float(away @ np.linalg.solve(told.pose.covariance + there.covariance, away))
    return math.log(1.0 - UNMAPPED) - 0.5 * distance
