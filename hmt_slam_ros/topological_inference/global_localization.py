"""Global localization: Eq. (6) over all known areas, with a prior that is flat unless more is known.

Blanco et al. name global localization ("robot awakening") as future work: a topological loop closure whose prior is
uninformative. All keyframes since the robot was lost are matched into every area, at all positions in its place and
all headings. Each search computes the probabilities again from the same prior, so every scan counts once.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import scipy

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import areas_around
from hmt_slam_ros.messages.messages import Notice
from hmt_slam_ros.registration.consistency import (
    MAP_IN_MAP,
    MAPS_OUTLIER_RATE,
    WALLS_OF_MAP,
    WALLS_OUTLIER_RATE,
    Clutter,
)
from hmt_slam_ros.topological_inference.event_work import EventWork
from hmt_slam_ros.topological_inference.global_scan_matching import (
    GlobalScanMatcher,
    PoseCandidate,
    region_neighborhood,
)
from hmt_slam_ros.topological_inference.place_recognition import PerceptualAliasing
from hmt_slam_ros.topological_inference.pose_distribution import MIN_PROBABILITY, UNMAPPED_PRIOR, PoseDistribution
from hmt_slam_ros.topological_inference.search_prior import FLAT_PRIOR, SearchPrior

Pose = Float64

_SURFACE_WEIGHT = 0.5
"""Exponent of the surface likelihood between areas: holes in a map come in lumps, not sample by sample."""

_MIN_WALL_CHECK_PROBABILITY = 0.05
"""Smallest probability of a candidate whose walls are checked (docs/decisions/0025-global-localization.md)."""

_OLD_MAP_FACTOR = 2.0
"""Ratio of the outlier rates of walls in an old map and in a recent one: people stood elsewhere."""

_MIN_MAPPED_PROBABILITY = 0.5
"""Smallest probability of all candidates with which keyframes are not searched elsewhere."""

_MIN_PLAUSIBLE_RATIO = 1e-3
"""Smallest ratio of the probabilities of a candidate and of the best with which its area is searched again."""


@dataclass(frozen=True, eq=False)
class GlobalSearch:
    """A search of the whole map for some keyframes, region by region, which goes on from event to event.

    :ivar poses: {keyframe: ``reference_T_base``, shape (3,)}, ascending; the reference is the first.
    :ivar before: the map is that of the keyframes before this one.
    :ivar areas: number of areas to search.
    :ivar unexamined: {area: probability by its appearance} of those that were not searched yet.
    :ivar candidates: what was found.
    :ivar refuted: number of the candidates that were tested in vain.
    :ivar prepared: the area whose region's map was made at an earlier step, and which is matched next; else None.
    :ivar is_map_missing: whether something fits in the next region, or is expected to, so that its whole map is made.
    """

    poses: Mapping[int, Pose]
    before: int
    areas: int
    unexamined: Mapping[int, float]
    candidates: tuple[PoseCandidate, ...] = ()
    refuted: int = 0
    prepared: int | None = None
    is_map_missing: bool = False

    @property
    def best_share(self) -> float:
        """The largest matched share of the candidates."""
        return max((candidate.agreement.matched_share for candidate in self.candidates), default=0.0)

    @property
    def flat_prior(self) -> float:
        """Prior probability of each area where nothing is known beside scans."""
        return (1.0 - UNMAPPED_PRIOR) / max(1, self.areas)


def begin_search(
    hybrid_map: HybridMap,
    poses: Mapping[int, Pose],
    before: int,
    area_probabilities: Mapping[int, float],
    prior: SearchPrior = FLAT_PRIOR,
    radius: float = 0.0,
    only: Collection[int] = (),
) -> GlobalSearch:
    """The search before its first region.

    :param poses: {keyframe: ``reference_T_base`` (3,)}.
    :param before: the map is that of the keyframes before this one.
    :param area_probabilities: {area: probability by its appearance} of all known areas.
    :param prior: of the reference; a hint excludes areas that are farther away.
    :param radius: largest distance to a keyframe of an area's place, m.
    :param only: the only areas to search, since fewer keyframes fitted nowhere else; all if empty.
    """
    areas = prior.admitted_areas(hybrid_map, area_probabilities, radius, before)
    unexamined = {area: p for area, p in areas.items() if not only or area in only}
    return GlobalSearch(poses, before, len(areas), unexamined, is_map_missing=bool(only or prior.hint))


def continue_search(
    search: GlobalSearch,
    matcher: GlobalScanMatcher,
    hybrid_map: HybridMap,
    work: EventWork,
    first: int | None = None,
    prior: SearchPrior = FLAT_PRIOR,
) -> GlobalSearch:
    """The search after the regions of one event, the most probable by their appearance and by marks.

    The map of a region and the match with it are two steps. Areas that the map lacks by now are dropped.

    :param work: of the event, to which that of the search is added.
    :param first: the area whose region comes first, if it was not searched yet.
    :param prior: of the reference.
    """
    search = _without_missing_areas(search, hybrid_map)
    while search.unexamined and not work.is_exhausted:
        search = _step(search, matcher, hybrid_map, work, first, prior)
    return search


def search_region(
    search: GlobalSearch, matcher: GlobalScanMatcher, hybrid_map: HybridMap, work: EventWork, area: int
) -> GlobalSearch:
    """The search after the region of an area, or of the most probable one if the area is not to be searched.

    :param work: of the event, to which that of the search is added.
    """
    search = _without_missing_areas(search, hybrid_map)
    left = search.unexamined
    while search.unexamined and search.unexamined == left:
        search = _step(search, matcher, hybrid_map, work, area)
    return search


def _without_missing_areas(search: GlobalSearch, hybrid_map: HybridMap) -> GlobalSearch:
    candidates = tuple(candidate for candidate in search.candidates if hybrid_map.has_area(candidate.area))
    unexamined = {area: p for area, p in search.unexamined.items() if hybrid_map.has_area(area)}
    return replace(search, candidates=candidates, unexamined=unexamined)


def _step(
    search: GlobalSearch,
    matcher: GlobalScanMatcher,
    hybrid_map: HybridMap,
    work: EventWork,
    first: int | None,
    prior: SearchPrior = FLAT_PRIOR,
) -> GlobalSearch:
    """The search after the next map was made, or the next region was matched."""
    probabilities = prior.weigh_areas(search.unexamined, search.flat_prior)
    if first is not None and first in probabilities:
        probabilities[first] = 1.0
    region = matcher.find_region(hybrid_map, search.before, probabilities)
    if search.prepared != region.reference or search.is_map_missing:
        matcher.prepare_region(hybrid_map, region, search.before, whole=search.is_map_missing)
        search = replace(search, prepared=region.reference, is_map_missing=False)
        if work.is_exhausted:
            return search
    match = matcher.match_region(hybrid_map, region, search.poses, search.before, search.best_share)
    work.add(match.work)
    if match.candidates is None:
        return replace(search, is_map_missing=True)
    return replace(
        search,
        unexamined={area: p for area, p in search.unexamined.items() if area not in region.own_areas},
        candidates=search.candidates + match.candidates,
        prepared=None,
    )


def check_candidates(
    search: GlobalSearch,
    matcher: GlobalScanMatcher,
    work: EventWork,
    aliasing_prior: float,
    hybrid_map: HybridMap,
    clutter: Clutter,
    prior: SearchPrior = FLAT_PRIOR,
) -> tuple[GlobalSearch, bool]:
    """The search after the walls of its probable candidates were checked, and whether all were at this event.

    :param work: of the event, to which that of the checks is added. The other arguments are those of
        :func:`localize_globally`.
    """
    search = _without_missing_areas(search, hybrid_map)
    candidates = list(search.candidates)
    log_weights, log_rest = _log_weights(search, aliasing_prior, hybrid_map, clutter, prior)
    likely = np.flatnonzero(_probabilities(log_weights, log_rest) >= _MIN_WALL_CHECK_PROBABILITY)
    left = [n for n in likely.tolist() if candidates[n].walls is None]
    while left and not work.is_exhausted:
        n = left.pop(0)
        walls, own = matcher.check_walls(hybrid_map, candidates[n], search.poses, search.before)
        candidates[n] = candidates[n]._replace(walls=walls)
        work.add(own)
    return replace(search, candidates=tuple(candidates)), not left


def localize_globally(
    search: GlobalSearch,
    aliasing_prior: float,
    hybrid_map: HybridMap,
    clutter: Clutter,
    prior: SearchPrior = FLAT_PRIOR,
) -> PoseDistribution:
    """The distribution of the pose of some keyframes in the whole map, as far as it was searched.

    Walls that beams pass count against the candidates that were checked. What was not searched belongs to the rest.

    :param aliasing_prior: prior probability that keyframes match an area in which they do not lie.
    :param clutter: usual rate of contradictions of the robot's map, where that is above the rate of maps.
    :param prior: of the reference.
    """
    log_weights, log_rest = _log_weights(search, aliasing_prior, hybrid_map, clutter, prior)
    wall_rate = max(WALLS_OUTLIER_RATE, _OLD_MAP_FACTOR * clutter.wall_outlier_rate)
    for n, candidate in enumerate(search.candidates):
        if candidate.walls is not None:
            # Walls without violations add nothing to the surfaces, so they only count against a candidate.
            log_weights[n] += min(0.0, WALLS_OF_MAP.log_likelihood_ratio(candidate.walls, wall_rate))
    return PoseDistribution(search.candidates, _probabilities(log_weights, log_rest))


def plausible_areas(distribution: PoseDistribution, hybrid_map: HybridMap, reach: float) -> frozenset[int]:
    """The areas in which keyframes may be after a search, and those around, as a robot drives on.

    None where they are probably on unmapped ground, or in what was not searched: then they may be anywhere.

    :param reach: largest distance between keyframes of two areas of a region, m.
    """
    probabilities = distribution.probabilities
    if float(probabilities.sum()) < _MIN_MAPPED_PROBABILITY:
        return frozenset()
    least = _MIN_PLAUSIBLE_RATIO * float(probabilities.max())
    areas = {c.area for c, p in zip(distribution.candidates, probabilities, strict=True) if p >= least}
    around = (areas_around(hybrid_map, area, region_neighborhood(reach)) for area in sorted(areas))
    return frozenset().union(*around)


def is_conclusive(
    search: GlobalSearch,
    aliasing_prior: float,
    hybrid_map: HybridMap,
    clutter: Clutter,
    probability: float,
    prior: SearchPrior = FLAT_PRIOR,
) -> bool:
    """Whether the search is over: all areas were searched, or a candidate is probable in spite of those that were not.

    Candidates that were tested in vain wait for another one, or for the end of the search.

    :param probability: of such a candidate, before walls count against it.
    :param prior: of the reference.
    """
    if not search.unexamined:
        return True
    if len(search.candidates) <= search.refuted:
        return False
    log_weights, log_rest = _log_weights(search, aliasing_prior, hybrid_map, clutter, prior)
    return bool(_probabilities(log_weights, log_rest).max(initial=0.0) >= probability)


def _log_weights(
    search: GlobalSearch, aliasing_prior: float, hybrid_map: HybridMap, clutter: Clutter, prior: SearchPrior
) -> tuple[list[float], float]:
    """Log of the weight of every candidate, and of the rest: unmapped ground, and the areas that were not searched.

    The best matches in the other areas show how distinctive a match is. Whether the keyframes are in the map at all is
    tested with the best match. Between candidates the surfaces also count that are known at one and not at the other.
    In an area that was not searched keyframes may match as well as at the best candidate, which is there by chance
    then, as improbable as it is distinctive.
    """
    log_mass: dict[int, float] = {}
    for candidate in search.candidates:
        log_mass[candidate.area] = float(np.logaddexp(log_mass.get(candidate.area, -math.inf), candidate.mode.log_mass))
    max_log_mass = max(log_mass.values(), default=0.0)
    log_priors = prior.log_priors(hybrid_map, search.candidates, search.flat_prior)
    log_marks = prior.log_mark_factors(hybrid_map, search.candidates, search.flat_prior)
    outlier_rate = max(MAPS_OUTLIER_RATE, clutter.beam_outlier_rate)
    aliasing = PerceptualAliasing(aliasing_prior)
    aliasing.add_negatives(_other_shares(search))
    log_weights, log_chance = [], 0.0
    for n, c in enumerate(search.candidates):
        log_there = (
            c.mode.log_mass
            - log_mass[c.area]
            + _SURFACE_WEIGHT * (log_mass[c.area] - max_log_mass)
            + MAP_IN_MAP.log_likelihood_ratio(c.agreement, outlier_rate)
        )
        distinctiveness = aliasing.log_distinctiveness(c.agreement.matched_share, already_expected=False)
        log_weights.append(log_priors[n] + log_there + distinctiveness + log_marks[n])
        log_chance = max(log_chance, log_there)
    weights = prior.weigh_areas(search.unexamined, search.flat_prior)
    unexamined = (1.0 - UNMAPPED_PRIOR) * sum(weights.values())
    log_unexamined = math.log(max(unexamined, MIN_PROBABILITY)) + log_chance
    return log_weights, float(np.logaddexp(prior.log_unmapped, log_unexamined))


def _other_shares(search: GlobalSearch) -> list[float]:
    """The largest matched share in every area that was searched, ascending, without the largest of all."""
    best: dict[int, float] = {}
    for candidate in search.candidates:
        best[candidate.area] = max(best.get(candidate.area, 0.0), candidate.agreement.matched_share)
    without = search.areas - len(search.unexamined) - len(best)
    return [*[0.0] * without, *sorted(best.values())][:-1]


def _probabilities(log_weights: Sequence[float], log_rest: float) -> Float64:
    """Probabilities of candidates beside the rest, shape (len(log_weights),)."""
    return np.asarray(scipy.special.softmax(np.array([*log_weights, log_rest]))[:-1], dtype=np.float64)


class LandmarkEvidence(Protocol):
    """Weighs pose candidates by landmarks, and proposes loops: the protocol behind which the second paper plugs in."""

    def weigh(
        self, distribution: PoseDistribution, hybrid_map: HybridMap, poses: Mapping[int, Float64], before: int
    ) -> PoseDistribution:
        """The distribution with the evidence of landmarks.

        :param poses: {keyframe: ``reference_T_base`` (3,)} of the robot's keyframes, m and rad.
        :param before: the map is that of the keyframes before this one.
        """
        ...

    def prepare_places(self, maps: Iterable[tuple[HybridMap, int]]) -> None:
        """Compute a part of what :meth:`weigh` needs, between two searches.

        :param maps: each with the keyframe before which it is.
        """
        ...

    def propose_loop(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with an arc where landmarks propose a loop; the map itself where they do not.

        :param area: the robot's.
        """
        ...

    def prepare_loops(self, hybrid_map: HybridMap, area: int) -> None:
        """Compute a part of what :meth:`propose_loop` needs, between two cuts.

        :param area: the robot's.
        """
        ...

    def notices(self) -> list[Notice]:
        """Notices of the loops proposed since the last call."""
        ...

    def on_localized(self) -> None:
        """Free what served global localization, which has ended."""
        ...

    def forget_scans(self) -> None:
        """Drop what was computed from scans, of which some have changed."""
        ...
