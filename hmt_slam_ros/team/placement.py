"""Placements: the PMF over how one component lies in another, "apart" included.

Each window of the second component is searched in the first with a flat prior. A candidate of it implies a placement.
Candidates of several windows that imply the same one, as far as the arcs between them tell, are one placement H:

    log P(H) = log prior + l_best + S(H) - max(0, S_2)

    log P(apart) = log(prior + sum over H of beta(H) P(H))

with l the log Bayes factor of a window, relative to ground that the first component does not have, and S(H) the
evidence of the other windows (:mod:`hmt_slam_ros.team.placement_evidence`). Of two placements one at least is false:
the second largest S shows how far false ones agree in this building, and is no evidence
(docs/decisions/0070-joining-two-maps.md). beta is the probability of a building that repeats itself, so that what looks
like the first component's ground may be its twin (:mod:`hmt_slam_ros.team.repetition`). Of ground that both have, one
map alone is evidence of that (docs/decisions/0095-repetition-of-common-ground.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import connected_areas
from hmt_slam_ros.messages.team import NO_REPETITION, Repetition
from hmt_slam_ros.team.placement_evidence import (
    PlacementEvidence,
    WindowEvidence,
    placement_evidence,
    similar_probability,
)
from hmt_slam_ros.team.windows import Window
from hmt_slam_ros.topological_inference.pose_distribution import UNMAPPED_PRIOR, PoseDistribution

Pose = Float64

APART_PRIOR = 0.5
"""Prior probability that two components show no common ground, or none by which they could be joined."""

_UNSEEN_AREAS = 8
"""Areas of a building that no component has, a priori: robots that begin in it are rarely at one place."""

BEYOND = 0.5
"""Probability that the twin of mapped ground, if there is one, is not mapped itself."""

_REPETITION_PRIOR = 0.003
"""Prior odds of a building that repeats itself, so that ground has a twin (docs/decisions/0085-repetition.md)."""

_GATE = chi_square_gate(0.999)
"""Squared Mahalanobis distance up to which candidates of two windows agree."""

_SAME_PLACE = np.diag([1.0, 1.0, math.radians(15.0)]) ** 2 / _GATE
"""Covariance that the gate has with certain arcs: 1 m and 15 degrees are within it."""

_MAX_PLACEMENTS, _MAX_WINDOWS = 32, 33
"""Most placements that are weighed: the others have less evidence at their best window. Most windows of each.

They are the nearest in time: 130 m of path before the best one, and as much after it.
"""

_REACH, _REACH_SIGMAS = 10.0, 4.0
"""Distance in the first component, m and deviations, beyond which a candidate does not agree with a belief."""

_MIN_UNMAPPED = 1e-12
"""Smallest probability of unmapped ground, for logarithms."""


def is_same_placement(one: Pose, other: Pose) -> bool:
    """Whether two poses ``first_T_second``, shape (3,), are within 1 m and 15 degrees of each other."""
    return PoseGaussian(one, _SAME_PLACE).mahalanobis2(PoseGaussian.from_pose(other)) <= _GATE


class WindowCandidate(NamedTuple):
    """A pose of a window in the first component.

    :ivar window: number of the window.
    :ivar area: of the first component.
    :ivar belief: over ``area_T_reference``, by the match alone.
    :ivar log_ratio: log p(scans | there) / p(scans | unmapped ground), nats.
    """

    window: int
    area: int
    belief: PoseGaussian
    log_ratio: float


class PlacementPrior(NamedTuple):
    """What is known of placements before any window was compared.

    :ivar places: number of areas of the building, in each of which the second component may begin.
    :ivar repetitions: what either component shows in itself of a building that repeats itself.
    """

    places: int
    repetitions: tuple[Repetition, Repetition]

    @classmethod
    def of_pair(
        cls,
        known_areas: int,
        other_areas: int,
        repetitions: tuple[Repetition, Repetition] = (NO_REPETITION, NO_REPETITION),
    ) -> PlacementPrior:
        """The prior that is flat over a building that is as large as both components together, and unseen areas.

        :param known_areas: number of areas of the first component.
        :param other_areas: number of areas of the second.
        :param repetitions: what either shows in itself.
        """
        return cls(known_areas + other_areas + _UNSEEN_AREAS, repetitions)

    def twin_ratio(self, windows: Mapping[int, WindowEvidence]) -> float:
        """Probability that a twin of the first component's ground explains a placement, over that of common ground.

        A twin that neither component has may be as large as the building. One that is in them ends as it does in the
        component with the larger Bayes factor (docs/decisions/0098-twins-end.md).

        :param windows: evidence of the windows under the placement. Those in ground of the first component show it once
            more, and are no further evidence of a building that repeats itself.
        """
        first, second = self.repetitions
        own = 1.0 - sum(window.is_in_place for window in windows.values()) / len(windows)
        odds = _REPETITION_PRIOR * math.exp(first.log_ratio + own * second.log_ratio)
        unseen = min(odds, _REPETITION_PRIOR * BEYOND ** (1.0 + own))
        seen = odds - unseen
        likelier = max(self.repetitions)
        log_end = max(0.0, placement_evidence(windows, likelier.persistence).agreement)
        return unseen / (1.0 + unseen) + seen / (1.0 + seen) * math.exp(-log_end)


@dataclass(frozen=True, eq=False)
class Placement:
    """A way in which the second component may lie in the first.

    :ivar pose: shape (3,), ``first_T_second``, of the frames of the robots' maps.
    :ivar matches: {window: candidate} of those that agree, the best first.
    :ivar windows: {window: its evidence}.
    :ivar evidence: of all windows.
    :ivar probability: of the placement.
    """

    pose: Pose
    matches: Mapping[int, WindowCandidate]
    windows: Mapping[int, WindowEvidence]
    evidence: PlacementEvidence
    probability: float = 0.0


@dataclass(frozen=True, eq=False)
class PlacementDistribution:
    """The PMF over placements.

    :ivar placements: the most probable first.
    :ivar apart: probability that the components have no common ground, or lie otherwise.
    """

    placements: tuple[Placement, ...]
    apart: float

    @property
    def best(self) -> Placement | None:
        """The most probable placement."""
        return self.placements[0] if self.placements else None


def window_candidates(number: int, distribution: PoseDistribution, areas: int) -> list[WindowCandidate]:
    """The candidates of a window with their Bayes factors, from their probabilities and the flat prior.

    :param number: of the window.
    :param areas: number of areas over which the prior was flat.
    """
    unmapped = max(1.0 - float(distribution.probabilities.sum()), _MIN_UNMAPPED)
    log_odds = math.log(UNMAPPED_PRIOR / (1.0 - UNMAPPED_PRIOR) * areas)
    return [
        WindowCandidate(number, c.area, c.mode.measured, math.log(p / unmapped) + log_odds)
        for c, p in zip(distribution.candidates, distribution.probabilities.tolist(), strict=True)
        if p > 0.0
    ]


class PlacementGeometry:
    """Where windows lie in the first component if another window lies at a candidate, along the arcs of both."""

    def __init__(self, hybrid_map: HybridMap, windows: Sequence[Window]) -> None:
        """:param hybrid_map: of both components, between which no informative arc is."""
        self._hybrid_map, self._windows = hybrid_map, windows
        self._paths: dict[int, dict[int, PoseGaussian]] = {}
        self._origins: dict[int, int] = {}

    def paths(self, area: int) -> dict[int, PoseGaussian]:
        """{other: belief over ``area_T_other``} of the areas of the same component."""
        if area not in self._paths:
            self._paths[area] = connected_areas(self._hybrid_map, area)
        return self._paths[area]

    def map_pose(self, area: int, pose: Pose) -> Pose:
        """A pose in an area in the frame of its component, by the arcs alone, shape (3,)."""
        if area not in self._origins:
            origin = min(self.paths(area))
            self._origins |= dict.fromkeys(self.paths(area), origin)
        return se2.compose(self.paths(self._origins[area])[area].mean, pose)

    def predict(self, window: int, matches: Mapping[int, WindowCandidate]) -> tuple[int, PoseGaussian] | None:
        """An area of the first component, and the belief over ``area_T_reference`` of a window.

        It follows from the match with the most certain path to the window, of equals the nearest one in time.

        :param matches: {other window: candidate}, at least one.
        :returns: None where no arcs lead to the window.
        """
        own = self._windows[window]
        paths = self.paths(own.area)
        reached = {m: paths[self._windows[m].area] for m in matches if self._windows[m].area in paths}
        if not reached:
            return None
        near = min(reached, key=lambda m: (float(np.trace(reached[m].covariance[:2, :2])), abs(m - window), m))
        between = (
            PoseGaussian.from_pose(se2.inverse(self._windows[near].reference))
            .compose(reached[near].inverse())
            .compose(PoseGaussian.from_pose(own.reference))
        )
        return matches[near].area, matches[near].belief.compose(between)

    def log_share(self, candidate: WindowCandidate, area: int, predicted: PoseGaussian) -> float | None:
        """Log of the share of a predicted belief that a candidate has, None where it does not agree with it.

        :param area: in which ``predicted`` is a belief over ``area_T_reference``.
        """
        paths = self.paths(candidate.area)
        if area not in paths:
            return None
        there = paths[area].compose(predicted)
        own = PoseGaussian(candidate.belief.mean, candidate.belief.covariance + _SAME_PLACE)
        if there.mahalanobis2(own) > _GATE:
            return None
        spread = there.covariance_at(own.mean) + own.covariance
        return min(0.0, 0.5 * float(np.linalg.slogdet(own.covariance)[1] - np.linalg.slogdet(spread)[1]))

    def component_pose(self, first: int, second: int, match: WindowCandidate) -> Pose:
        """``first_T_second`` of two areas, one of each component, if a window lies at a candidate, shape (3,)."""
        window = self._windows[match.window]
        first_T_reference = se2.compose(self.paths(first)[match.area].mean, match.belief.mean)
        second_T_reference = se2.compose(self.paths(second)[window.area].mean, window.reference)
        return se2.compose(first_T_reference, se2.inverse(second_T_reference))


Comparison = Callable[[int, int, PoseGaussian, bool], float | None]
"""Log Bayes factor, nats, at most 0, of the contradictions of a window where a placement has it; None in no place.

Its arguments are the window, an area of the first component, the belief over ``area_T_reference``, and whether the
window was matched there.
"""


@dataclass
class _Growth:
    """A placement while windows are added to it.

    :ivar matches: {window: candidate} of those that agree.
    :ivar log_ratios: {window: log Bayes factor} of those that have a candidate there.
    :ivar windows: those that may agree, ascending.
    :ivar covered: candidates that imply the same placement, as (window, number).
    """

    matches: dict[int, WindowCandidate]
    log_ratios: dict[int, float]
    windows: Sequence[int]
    covered: set[tuple[int, int]] = field(default_factory=set)


def placement_distribution(
    geometry: PlacementGeometry,
    candidates: Sequence[Sequence[WindowCandidate]],
    joint: tuple[int, int],
    prior: PlacementPrior,
    compare: Comparison,
) -> PlacementDistribution:
    """The PMF over placements, from the candidates of all windows.

    :param candidates: of each window.
    :param joint: areas of the first and of the second component whose frames are those of the components.
    """
    grown = _grow_placements(geometry, candidates)
    windows = [_window_evidence(geometry, each, compare) for each in grown]
    placements = []
    for n, (each, own) in enumerate(zip(grown, windows, strict=True)):
        matches = {w: each.matches[w] for w in sorted(each.matches, key=lambda w: (-own[w].log_ratio, w))}
        pose = geometry.component_pose(*joint, next(iter(matches.values())))
        similar = similar_probability(windows[:n] + windows[n + 1 :])
        placements.append(Placement(pose, matches, own, placement_evidence(own, similar)))
    return weigh_placements(placements, prior)


def weigh_placements(placements: Sequence[Placement], prior: PlacementPrior) -> PlacementDistribution:
    """The PMF from the evidence of placements.

    Where the building repeats itself, a twin of the ground that the first component has explains a placement as well.
    """
    share = (1.0 - APART_PRIOR) / prior.places
    false_agreement = sorted([0.0, 0.0, *(each.evidence.agreement for each in placements)])[-2]
    logs = np.array([math.log(share) + sum(each.evidence) - false_agreement for each in placements])
    log_twins = np.log([prior.twin_ratio(each.windows) for each in placements])
    apart = np.append(logs + log_twins, math.log(max(APART_PRIOR, 1.0 - share * len(placements))))
    weights = scipy.special.softmax(np.append(logs, scipy.special.logsumexp(apart))).tolist()
    weighed = [replace(each, probability=p) for each, p in zip(placements, weights[:-1], strict=True)]
    return PlacementDistribution(tuple(sorted(weighed, key=lambda each: -each.probability)), weights[-1])


def _grow_placements(geometry: PlacementGeometry, candidates: Sequence[Sequence[WindowCandidate]]) -> list[_Growth]:
    """The placements of the candidates with the most evidence.

    Those that fit no better than unmapped ground make none. One that a better candidate of an earlier placement agrees
    with is that placement, with a window explained worse.
    """
    seeds = [(w, n) for w, own in enumerate(candidates) for n, each in enumerate(own) if each.log_ratio > 0.0]
    seeds.sort(key=lambda seed: -candidates[seed[0]][seed[1]].log_ratio)
    locations = [_Locations.of_candidates(geometry, own) for own in candidates]
    grown: list[_Growth] = []
    covered: set[tuple[int, int]] = set()
    for seed in seeds:
        if len(grown) == _MAX_PLACEMENTS:
            break
        if seed in covered:
            continue
        growth = _grow(geometry, candidates, locations, seed)
        if not growth.covered & covered:
            grown.append(growth)
        covered |= growth.covered
    return grown


class _Locations(NamedTuple):
    """Where the n candidates of a window are.

    :ivar positions: shape (n, 2), in the frame of the first component, m.
    :ivar reaches: shape (n,), distance within which a certain pose may agree, m.
    """

    positions: Float64
    reaches: Float64

    @classmethod
    def of_candidates(cls, geometry: PlacementGeometry, candidates: Sequence[WindowCandidate]) -> _Locations:
        positions = [geometry.map_pose(c.area, c.belief.mean)[:2] for c in candidates]
        reaches = [_REACH + _REACH_SIGMAS * _deviation(c.belief) for c in candidates]
        return cls(np.reshape(positions, (-1, 2)), np.array(reaches))

    def near(self, pose: Pose, deviation: float) -> list[int]:
        """Numbers of the candidates that may agree with a belief, from its mean, shape (3,), and deviation, m."""
        distances = np.hypot(*(self.positions - pose[:2]).T)
        return np.flatnonzero(distances <= self.reaches + _REACH_SIGMAS * deviation).tolist()


def _deviation(belief: PoseGaussian) -> float:
    """Deviation of a position, both axes together, m."""
    return math.sqrt(float(np.trace(belief.covariance[:2, :2])))


def _grow(
    geometry: PlacementGeometry,
    candidates: Sequence[Sequence[WindowCandidate]],
    locations: Sequence[_Locations],
    seed: tuple[int, int],
) -> _Growth:
    """The placement that a candidate implies, with the windows that agree, from the nearest in time on."""
    first = candidates[seed[0]][seed[1]]
    nearest = sorted(range(len(candidates)), key=lambda w: (abs(w - seed[0]), w))[:_MAX_WINDOWS]
    grown = _Growth({seed[0]: first}, {seed[0]: first.log_ratio}, sorted(nearest))
    for window in nearest:
        predicted = geometry.predict(window, grown.matches)
        if predicted is None:
            continue
        area, belief = predicted
        near = locations[window].near(geometry.map_pose(area, belief.mean), _deviation(belief))
        log_shares = {n: geometry.log_share(candidates[window][n], area, belief) for n in near}
        log_ratios = {
            n: _log_mixture(log_share, candidates[window][n].log_ratio)
            for n, log_share in log_shares.items()
            if log_share is not None
        }
        if not log_ratios:
            continue
        best = max(log_ratios, key=lambda n: log_ratios[n])
        grown.covered |= {(window, n) for n in log_ratios}
        if window != seed[0]:
            grown.log_ratios[window] = log_ratios[best]
            if log_ratios[best] > 0.0:
                grown.matches[window] = candidates[window][best]
    return grown


def _log_mixture(log_share: float, log_ratio: float) -> float:
    """Log Bayes factor where a share of the belief is at a candidate, and the rest is uninformative."""
    return float(np.log1p(math.exp(log_share) * math.expm1(log_ratio)))


def _window_evidence(geometry: PlacementGeometry, grown: _Growth, compare: Comparison) -> dict[int, WindowEvidence]:
    """{window: its evidence} under a placement, contradictions included."""
    evidence = {}
    for window in grown.windows:
        match, own = grown.matches.get(window), grown.log_ratios.get(window, 0.0)
        if match is not None:
            own += compare(window, match.area, match.belief, True) or 0.0
            evidence[window] = WindowEvidence(own, True)
        elif window in grown.log_ratios:
            evidence[window] = WindowEvidence(own, True)
        else:
            predicted = geometry.predict(window, grown.matches)
            against = None if predicted is None else compare(window, *predicted, False)
            evidence[window] = WindowEvidence(against or 0.0, against is not None)
    return evidence
