"""In which known areas may some keyframes lie, and how do they fit there? Prior and evidence of Eq. (6)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import (
    WHOLE_MAP_CACHE_BYTES,
    AreaPlace,
    EntryPrior,
    GridCache,
    Neighborhood,
    Transition,
    containing_area,
    entry_prior,
    keyframe_positions,
    min_distance,
    stack_poses,
    transition_model,
)
from hmt_slam_ros.registration.area_to_area import MatchMode, MatchSettings, match_areas
from hmt_slam_ros.registration.consistency import MAP_IN_MAP, MAPS_OUTLIER_RATE, SCAN_IN_STORED_MAP, Clutter
from hmt_slam_ros.registration.likelihood_grid import GridModel, build_area_grid, surface_points
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.admission import AreaCandidate, CandidateGating, Query
from hmt_slam_ros.topological_inference.global_localization import PoseDistribution, PoseHint, localize_globally
from hmt_slam_ros.topological_inference.global_scan_matching import FreeSpaceCheck, GlobalScanMatcher, query_bounds
from hmt_slam_ros.topological_inference.place_recognition import (
    NegativeSample,
    PerceptualAliasing,
    ScanDescriptors,
    best_shares,
)

Pose = NDArray[np.float64]

# Keyframe events after which what was seen is known ground, and in steps of how many.
_LONG_AGO, _RENEWED = 30, 20


class Fit(NamedTuple):
    """One way in which the keyframes lie in a known area.

    :ivar log_weight: log pi p(z), p(z) relative to new ground. Where surfaces are compared, the look of the place
        has nothing to add (`python -m benchmark evidence`).
    """

    area: int
    mode: MatchMode
    log_weight: float


class AreaComparison(NamedTuple):
    """What came of comparing keyframes with the known areas.

    :ivar transition: pi of the known areas and of new ground.
    :ivar fits: the modes in all areas that were examined, the heaviest of each.
    :ivar examined_areas: those areas.
    :ivar pending_candidates: areas beside whose place the keyframes fit; they are not in it yet, so that was not
        examined.
    :ivar skipped_weight: probability of those that were not, and of further modes, on the scale of
        ``exp(Fit.log_weight)``.
    """

    transition: Transition
    fits: tuple[Fit, ...]
    examined_areas: tuple[int, ...]
    pending_candidates: tuple[int, ...]
    skipped_weight: float


@dataclass(frozen=True)
class SearchState:
    """What was learnt of the building by comparing its places.

    :class:`ClosureSearch` does not hold it, as the shares are in a queue that drops the oldest.

    :ivar negative_shares: how large a share of their surfaces keyframes found in places where they do not lie, of those
        that were tried last.
    :ivar newest_sampled: the newest of the keyframes with which that was tried last, -1 before the first.
    """

    negative_shares: tuple[float, ...] = ()
    newest_sampled: int = -1


class ClosureSearch:
    """Compares keyframes with the areas of a hybrid map.

    :ivar gating: which areas come into question.
    :ivar submap_radius: which areas count as around another.
    """

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        """:param scans: {keyframe: scan}, which may grow."""
        self._options = options = configuration.tsbi
        self.gating = CandidateGating(options)
        self.submap_radius = Neighborhood(options.local_sigma, options.local_reach)
        self._settings = MatchSettings.from_options(options)
        self._model = GridModel.from_configuration(configuration)
        self._grid_cache = GridCache(scans, self._model, self.submap_radius)
        self._aliasing = PerceptualAliasing(options.aliasing_prior)
        self._descriptors = ScanDescriptors(scans)
        self._whole_map_cache = GridCache(scans, self._model, self.submap_radius, WHOLE_MAP_CACHE_BYTES)
        self._global_matcher = GlobalScanMatcher(
            self._whole_map_cache,
            FreeSpaceCheck(scans, configuration),
            self._settings,
            options.place_radius,
            options.local_reach,
        )
        self._newest_sampled = -1
        self._look_ahead_queue: list[tuple[int, Collection[int]]] = []

    @property
    def state(self) -> SearchState:
        """All that was learnt."""
        return SearchState(tuple(self._aliasing.negative_shares), self._newest_sampled)

    def restore(self, state: SearchState) -> None:
        """Take over what was learnt before anything is compared."""
        self._aliasing.add_negatives(state.negative_shares)
        self._newest_sampled = state.newest_sampled

    def forget_scans(self) -> None:
        """Work out anew what is made of scans, of which some have changed."""
        self._grid_cache.clear()
        self._whole_map_cache.clear()
        self._descriptors.clear()

    def tracked_area(
        self, hybrid_map: HybridMap, area: int, around: Mapping[int, Pose], poses: NDArray[np.float64]
    ) -> int | None:
        """The area in whose place most of the poses lie, of areas whose position is certain.

        :param area: in whose frame the poses are.
        :param around: {other area: ``area_T_other``}.
        :param poses: shape (n, 3), ``area_T_base``.
        """
        gaps = [
            min_distance(poses[:, :2], keyframe_positions(hybrid_map, other, pose)) for other, pose in around.items()
        ]
        if min(gaps, default=math.inf) > self._options.place_radius:
            return None
        return containing_area(
            self._grid_cache.place_among(hybrid_map, area, around), poses, self._options.place_radius
        )

    def is_same_place(self, hybrid_map: HybridMap, area: int, other: int, pose: Pose) -> bool:
        """Whether what two areas saw is rather the same place than one that looks alike.

        :param pose: ``area_T_other``, shape (3,).
        """
        known = self._grid_cache.place(hybrid_map, area, (other,)).grid
        seen = self._grid_cache.grid(hybrid_map.keyframes(other))
        return MAP_IN_MAP.log_likelihood_ratio(known.compare(seen.points, pose), MAPS_OUTLIER_RATE) > 0.0

    def measure_pose(
        self, hybrid_map: HybridMap, other: int, without: int, scan: Scan, prior: PoseGaussian
    ) -> PoseGaussian | None:
        """The belief over ``other_T_base`` of a scan from its match with a known area, or None where it fits nowhere.

        :param without: an area that is left out of the map.
        :param prior: over ``other_T_base``.
        """
        place = self._grid_cache.place(hybrid_map, other, (without,))
        query = build_area_grid([scan], np.zeros((1, 3)), self._model)
        found = match_areas(query, place.grid, prior, self._settings).modes
        return found[0].measured if found else None

    def surface_points(self, scan: Scan) -> NDArray[np.float64]:
        """What a scan is recognized by, shape (n, 2), m, base frame."""
        return surface_points(scan, self._model)

    def known_ground_log_ratio(
        self, hybrid_map: HybridMap, poses: Mapping[int, Pose], points: NDArray[np.float64], pose: Pose, keyframe: int
    ) -> float:
        """log p(scan | the robot is there) / p(scan | it is in a place that looks alike), by what was seen long before.

        :param poses: {area: ``area_T_other``} of the areas that the robot is in or beside.
        :param points: of :meth:`surface_points`.
        :param pose: ``area_T_base`` of the scan.
        :param keyframe: the newest.
        """
        before = (keyframe - _LONG_AGO) // _RENEWED * _RENEWED
        grid = self._grid_cache.grid_before(hybrid_map, poses, before)
        return SCAN_IN_STORED_MAP.log_likelihood_ratio(grid.compare(points, pose), MAPS_OUTLIER_RATE)

    def compare(
        self,
        hybrid_map: HybridMap,
        area: int,
        query: Query,
        compared: Mapping[int, Collection[int]],
        excluded: Collection[int],
        most: int,
        only: Collection[int] = (),
    ) -> AreaComparison:
        """Prior and evidence of all admitted areas.

        :param area: the area that the keyframes are in.
        :param compared: {known area: keyframes that were compared with it}.
        :param excluded: areas that are neither candidates nor part of a candidate's map.
        :param most: this many areas are examined at most, those that the keyframes are most probably in.
        :param only: if there are any, none but these.
        """
        within, distant, elsewhere = self.gating.classify_areas(hybrid_map, area, query, excluded)
        if only:
            within, distant = {known: prior for known, prior in within.items() if known in only}, {}
        self._look_ahead_queue = [(other, excluded) for other in elsewhere if within]
        candidates = self.gating.candidates(hybrid_map, query, compared, within)
        ranked = sorted(candidates, key=lambda known: (-candidates[known].max_probability, known))
        looked_at, rest = ranked[:most], {known: candidates[known].max_probability for known in ranked[most:]} | distant
        # Before those of the candidates, for which they may have to go.
        wanted = elsewhere if looked_at and max(query.poses) != self._newest_sampled else ()
        others = [self._negative_sample(hybrid_map, other, excluded) for other in wanted]
        places = {known: self._grid_cache.place(hybrid_map, known, excluded) for known in looked_at}
        entries = {known: self._entry_probability(place, candidates[known]) for known, place in places.items()}
        shares = {known: found.probability for known, found in entries.items() if found.probability > 0.0}
        modes = {known: self._modes(places[known], candidates[known]) for known in shares}
        beside = tuple(known for known, found in modes.items() if found is None)
        model = transition_model(shares | rest, self._options.new_probability)
        if shares:
            self._sample_aliasing(query, others)
        fits = [
            fit
            for known in sorted(shares, key=lambda known: (-shares[known], known))
            for fit in self._fits(
                hybrid_map, places[known], candidates[known], modes[known] or (), entries[known], model.known[known]
            )
        ]
        kept, left_out = _split_heaviest(fits, self._options.max_modes)
        skipped = sum(model.known[known] for known in rest) + sum(math.exp(fit.log_weight) for fit in left_out)
        return AreaComparison(model, kept, tuple(known for known in shares if known not in beside), beside, skipped)

    def look_ahead(self, hybrid_map: HybridMap) -> None:
        """Make the map of one of the areas that the next keyframes will be laid into, while there is time for it."""
        while self._look_ahead_queue:
            area, excluded = self._look_ahead_queue.pop()
            if hybrid_map.has_area(area):
                self._negative_sample(hybrid_map, area, excluded)
                return

    def localize_globally(
        self,
        hybrid_map: HybridMap,
        poses: Mapping[int, Pose],
        before: int,
        clutter: Clutter,
        pose_hint: PoseHint | None = None,
    ) -> PoseDistribution:
        """Where in the map keyframes lie of which the arcs tell nothing.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        :param clutter: what contradicts the robot's map usually.
        :param pose_hint: where the reference is, if somebody says so.
        """
        alike, radius = self._options.aliasing_prior, self._options.place_radius
        known = {area: [k for k in hybrid_map.keyframes(area) if k < before] for area in hybrid_map.area_ids()}
        shares = self._descriptors.area_probabilities(list(poses), {area: own for area, own in known.items() if own})
        return localize_globally(
            self._global_matcher, shares, alike, hybrid_map, poses, before, clutter, pose_hint, radius
        )

    def end_global_localization(self) -> None:
        """It is known where the robot is: what served to look for it everywhere is needed no more."""
        self._global_matcher.forget()

    def _entry_probability(self, place: AreaPlace, candidate: AreaCandidate) -> EntryPrior:
        return entry_prior(place, candidate.prior, stack_poses(candidate.unmatched_poses), self._options.place_radius)

    def _sample_aliasing(self, query: Query, places: Sequence[NegativeSample]) -> None:
        """Compare the keyframes with areas in which they do not lie, once for all hypotheses of an event."""
        newest = max(query.poses)
        if newest != self._newest_sampled:
            self._newest_sampled = newest
            self._aliasing.add_negatives(best_shares(self._grid_cache.grid(query.poses), places, self._settings))

    def _negative_sample(self, hybrid_map: HybridMap, area: int, excluded: Collection[int]) -> NegativeSample:
        """An area's place, and one of its keyframes in the middle of the way through it."""
        poses = stack_poses(hybrid_map.keyframes(area))
        return NegativeSample(self._grid_cache.place(hybrid_map, area, excluded).grid, poses[len(poses) // 2])

    def _modes(self, place: AreaPlace, candidate: AreaCandidate) -> list[MatchMode] | None:
        """How the keyframes lie in the candidate's place; None where they fit best beside every place.

        A robot that comes back to known ground sees it before it is in it.
        """
        query, fresh = self._grid_cache.grid(candidate.unmatched_poses), candidate.unmatched_poses
        bounds = query_bounds(place.positions, query, fresh, self._options.place_radius)
        modes = match_areas(query, place.grid, candidate.prior, self._settings, bounds).modes
        poses = [se2.compose(mode.pose.mean, stack_poses(fresh)) for mode in modes]
        owners = [containing_area(place, at, self._options.place_radius) for at in poses]
        if modes and owners[max(range(len(modes)), key=lambda n: modes[n].log_mass)] is None:
            return None
        return [mode for mode, owner in zip(modes, owners, strict=True) if owner == place.area]

    def _fits(
        self,
        hybrid_map: HybridMap,
        place: AreaPlace,
        candidate: AreaCandidate,
        modes: Sequence[MatchMode],
        entry_probability: EntryPrior,
        pi: float,
    ) -> Iterator[Fit]:
        """The modes share the probability of the candidate's place by their masses.

        The probability of the place is that of all poses in it. A mode that is farther off than these usually are has
        less, as the prior has there. Where a loop that the hypothesis closed has the robot in that place anyway, the
        fit was to be expected even if that loop is none.
        """
        foretold = entry_probability.probability > 0.5 and bool(hybrid_map.pending_closures)
        points = self._grid_cache.grid(candidate.unmatched_poses).points
        whole = np.logaddexp.reduce([mode.log_mass for mode in modes]) if modes else 0.0
        for mode in modes:
            found = place.grid.compare(points, mode.pose.mean)
            same = MAP_IN_MAP.log_likelihood_ratio(found, MAPS_OUTLIER_RATE) + self._aliasing.log_distinctiveness(
                found.matched_share, already_expected=foretold
            )
            away = se2.log(se2.between(candidate.prior.mean, mode.pose.mean))
            distance = float(away @ np.linalg.solve(candidate.prior.covariance, away))
            off = -0.5 * max(0.0, distance - entry_probability.median_mahalanobis2)
            yield Fit(place.area, mode, math.log(pi) + mode.log_mass - float(whole) + same + off)


def _split_heaviest(fits: Sequence[Fit], most: int) -> tuple[tuple[Fit, ...], tuple[Fit, ...]]:
    """The heaviest fits in every area, ``most`` at most, in their order; and the others."""
    heaviest = sorted(range(len(fits)), key=lambda n: (-fits[n].log_weight, n))
    place = Counter[int]()
    kept = set()
    for n in heaviest:
        place[fits[n].area] += 1
        if place[fits[n].area] <= most:
            kept.add(n)
    parts = [tuple(fit for n, fit in enumerate(fits) if (n in kept) == inside) for inside in (True, False)]
    return parts[0], parts[1]
