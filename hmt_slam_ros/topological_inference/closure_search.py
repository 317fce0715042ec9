"""Prior and evidence of the known areas in which keyframes may lie, Eq. (6)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import (
    AreaPlace,
    GridCache,
    GridCacheState,
    Neighborhood,
    containing_area,
    keyframe_positions,
    min_distance,
    stack_poses,
)
from hmt_slam_ros.registration.area_to_area import MatchMode, MatchSettings, match_areas
from hmt_slam_ros.registration.consistency import (
    MAP_IN_MAP,
    MAPS_OUTLIER_RATE,
    SCAN_IN_STORED_MAP,
    Agreement,
)
from hmt_slam_ros.registration.likelihood_grid import GridModel, build_area_grid, surface_points
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import is_wide
from hmt_slam_ros.topological_inference.area_comparison import (
    AreaComparison,
    ComparisonKind,
    ExaminedArea,
    Fit,
    OngoingComparison,
)
from hmt_slam_ros.topological_inference.candidate_gating import (
    AreaCandidate,
    CandidateGating,
    EntryPrior,
    Query,
    entry_prior,
    transition_model,
)
from hmt_slam_ros.topological_inference.event_work import CELL_WORK, EventWork
from hmt_slam_ros.topological_inference.global_scan_matching import (
    query_bounds,
)
from hmt_slam_ros.topological_inference.marks import (
    AreaMark,
    MarkEntry,
    fuse_with_mark,
    mix_transition,
    total_gain,
)
from hmt_slam_ros.topological_inference.place_recognition import (
    MIN_LOG_RATIO,
    NegativeSample,
    PerceptualAliasing,
    best_share,
)

Pose = Float64

_OLD_EVENTS = 30
"""Keyframe events after which a keyframe counts as known ground (docs/decisions/0018-scans-count-once.md)."""

_OLD_STEP = 20
"""Keyframe events between two changes of that known ground, so that its grid stays cached."""


class PlaceAhead(NamedTuple):
    """A place in which keyframes do not lie, whose map is made ahead.

    :ivar area: the area.
    :ivar excluded: areas that its map leaves out.
    """

    area: int
    excluded: frozenset[int]


@dataclass(frozen=True)
class SearchState:
    """What the search learned of the building by comparing its places.

    :ivar negative_shares: matched shares of keyframes in places where they do not lie, the latest.
    :ivar newest_sampled: the newest keyframe of the last sample, -1 before the first.
    :ivar place_maps: the maps that comparisons hold: their work does not count again.
    :ivar region_maps: the maps that the search of the whole map holds.
    :ivar places_ahead: places whose maps are made at events without other work, the last one first.
    """

    negative_shares: tuple[float, ...] = ()
    newest_sampled: int = -1
    place_maps: GridCacheState = field(default_factory=GridCacheState)
    region_maps: GridCacheState = field(default_factory=GridCacheState)
    places_ahead: tuple[PlaceAhead, ...] = ()


class ClosureSearch:
    """Compares keyframes with the areas of a hybrid map.

    :ivar gating: the areas that the arcs admit.
    :ivar submap_radius: the areas that count as around another.
    :ivar work: of the event, which comparisons and searches share.
    """

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        """:param scans: {keyframe: scan}, which may grow."""
        self._options = options = configuration.tsbi
        self._filter = configuration.filter
        self.gating = CandidateGating(options)
        self.submap_radius = Neighborhood(options.local_sigma, options.local_reach)
        self._settings = MatchSettings.from_options(options)
        self._model = GridModel.from_configuration(configuration)
        self.work = EventWork()
        self._grid_cache = GridCache(scans, self._model, self.submap_radius, count_cells=self._count_cells)
        self._aliasing = PerceptualAliasing(options.aliasing_prior)
        self._newest_sampled = -1
        self._places_ahead: list[PlaceAhead] = []

    @property
    def state(self) -> SearchState:
        """What was learned."""
        return SearchState(
            tuple(self._aliasing.negative_shares),
            self._newest_sampled,
            self._grid_cache.state,
            places_ahead=tuple(self._places_ahead),
        )

    def restore(self, state: SearchState) -> None:
        """Start from a saved state."""
        self._aliasing.add_negatives(state.negative_shares)
        self._newest_sampled = state.newest_sampled
        self._grid_cache.restore(state.place_maps)
        self._places_ahead = list(state.places_ahead)

    def _count_cells(self, cells: int) -> None:
        self.work.add(CELL_WORK * cells)

    def forget_scans(self) -> None:
        """Drop what was computed from scans, of which some have changed."""
        self._grid_cache.clear()

    def tracked_area(self, hybrid_map: HybridMap, area: int, around: Mapping[int, Pose], poses: Float64) -> int | None:
        """The area in whose place most of the poses lie, among areas of certain position; None for no area.

        :param area: the area in whose frame the poses are.
        :param around: {other area: ``area_T_other``}.
        :param poses: shape (n, 3), ``area_T_base``.
        """
        radius = self._options.place_radius
        distances = (
            min_distance(poses[:, :2], keyframe_positions(hybrid_map, other, pose)) for other, pose in around.items()
        )
        if min(distances, default=math.inf) > radius:
            return None
        return containing_area(self._grid_cache.place_among(hybrid_map, area, around), poses, radius)

    def is_same_place(self, hybrid_map: HybridMap, area: int, other: int, pose: Pose) -> bool:
        """Whether the surfaces of two areas are more probably one place than two similar ones.

        :param pose: ``area_T_other``, shape (3,).
        """
        known = self._grid_cache.place(hybrid_map, area, (other,)).grid
        points = self._grid_cache.grid(hybrid_map.keyframes(other)).points
        return MAP_IN_MAP.log_likelihood_ratio(known.compare(points, pose), MAPS_OUTLIER_RATE) > 0.0

    def measure_pose(
        self, hybrid_map: HybridMap, other: int, excluded: int, scan: Scan, prior: PoseGaussian
    ) -> PoseGaussian | None:
        """The belief over ``other_T_base`` of a scan from its match with a known area, or None without a match.

        :param excluded: an area that is left out of the map.
        :param prior: over ``other_T_base``.
        """
        place = self._grid_cache.place(hybrid_map, other, (excluded,))
        query = build_area_grid([scan], np.zeros((1, 3)), self._model)
        modes = match_areas(query, place.grid, prior, self._settings).modes
        return modes[0].measured if modes else None

    def surface_points(self, scan: Scan) -> Float64:
        """Surface points of a scan, shape (n, 2), m, base frame."""
        return surface_points(scan, self._model)

    def known_ground_agreement(
        self, hybrid_map: HybridMap, poses: Mapping[int, Pose], points: Float64, pose: Pose, before: int
    ) -> Agreement:
        """The agreement of a scan with what the keyframes before one saw.

        :param poses: {area: ``area_T_other``} of the areas that the robot is in or beside.
        :param points: of :meth:`surface_points`.
        :param pose: ``area_T_base`` of the scan.
        :param before: of :func:`first_new_keyframe`, or the first one after a kidnapping.
        """
        return self._grid_cache.grid_before(hybrid_map, poses, before).compare(points, pose)

    def begin_comparison(
        self,
        hybrid_map: HybridMap,
        area: int,
        query: Query,
        compared: Mapping[int, Collection[int]],
        excluded: Collection[int],
        most: int,
        kind: ComparisonKind = "recheck",
        only: Collection[int] = (),
        marks: Mapping[int, AreaMark] | None = None,
    ) -> OngoingComparison:
        """The comparison of keyframes with all admitted areas, before the first one.

        :param area: the area that the keyframes are in.
        :param compared: {known area: keyframes that were compared with it}.
        :param excluded: areas that are neither candidates nor part of a candidate's map.
        :param most: at most this many areas are examined, the most probable.
        :param only: the only areas to examine; all if empty.
        :param marks: {area: mark that puts them there}; these areas are examined first.
        """
        within, unexamined, elsewhere = self.gating.classify_areas(hybrid_map, area, query, excluded)
        if only:
            within, unexamined = {known: prior for known, prior in within.items() if known in only}, {}
        self._places_ahead = [PlaceAhead(other, frozenset(excluded)) for other in elsewhere if within]
        marks = {} if marks is None or kind == "retry" else marks
        within |= {known: mark.prior for known, mark in marks.items() if known not in within}
        candidates = self.gating.candidates(hybrid_map, query, compared, within, set(marks))
        ranked = sorted(candidates, key=lambda known: (-candidates[known].max_probability, known))
        return OngoingComparison(
            query,
            frozenset(excluded),
            kind,
            {known: candidates[known] for known in ranked[:most]},
            {known: candidates[known].max_probability for known in ranked[most:]} | unexamined,
            tuple(known for known in elsewhere if known not in marks),
            marks={known: mark for known, mark in marks.items() if known in candidates},
        )

    def continue_comparison(
        self, hybrid_map: HybridMap, comparison: OngoingComparison
    ) -> OngoingComparison | AreaComparison:
        """The comparison after this event, or its result if it ended within the work of the event.

        Candidates that the map lacks by now are dropped.
        """
        comparison = replace(
            comparison,
            candidates={known: c for known, c in comparison.candidates.items() if hybrid_map.has_area(known)},
            examined=tuple(one for one in comparison.examined if hybrid_map.has_area(one.area)),
            elsewhere=tuple(area for area in comparison.elsewhere if hybrid_map.has_area(area)),
        )
        while (area := self._next_area(comparison)) is not None and self.work.admits_comparison:
            if comparison.prepared != area:
                self._grid_cache.place(hybrid_map, area, comparison.excluded)
                comparison = replace(comparison, prepared=area)
            elif area in comparison.candidates:
                comparison = self._examine(hybrid_map, comparison, area)
            else:
                comparison = self._sample_negative(hybrid_map, comparison, area)
        return self._conclude(hybrid_map, comparison) if area is None else comparison

    def _next_area(self, comparison: OngoingComparison) -> int | None:
        """The candidate that is next, or after those the next place where the keyframes do not lie; None at the end.

        These are matched once for all hypotheses.
        """
        if comparison.candidates:
            return next(iter(comparison.candidates))
        is_in_some = any(one.is_possible for one in comparison.examined)
        is_sampled = max(comparison.query.poses) == self._newest_sampled
        return next(iter(comparison.elsewhere), None) if is_in_some and not is_sampled else None

    def _examine(self, hybrid_map: HybridMap, comparison: OngoingComparison, known: int) -> OngoingComparison:
        """The comparison after that with one area."""
        candidate = comparison.candidates[known]
        place = self._grid_cache.place(hybrid_map, known, comparison.excluded)
        mark, modes = comparison.marks.get(known), None
        examined = ExaminedArea(known, candidate.prior, self._entry_probability(place, candidate))
        if mark is not None:
            candidate = self._narrow(candidate, mark)
            by_mark = self._entry_probability(place, candidate._replace(prior=mark.joint_belief)).probability
            examined = examined._replace(mark=MarkEntry(mark.belief, mark.mark_gain, by_mark))
        if examined.is_possible:
            modes = self._modes(place, candidate)
            examined = examined._replace(is_pending=modes is None)
        if modes is not None:
            points = self._grid_cache.grid(candidate.unmatched_poses).points
            agreements = tuple(place.grid.compare(points, mode.pose.mean) for mode in modes)
            examined = examined._replace(modes=tuple(modes), agreements=agreements)
        candidates = {area: c for area, c in comparison.candidates.items() if area != known}
        return replace(comparison, candidates=candidates, examined=(*comparison.examined, examined), prepared=None)

    def _sample_negative(self, hybrid_map: HybridMap, comparison: OngoingComparison, area: int) -> OngoingComparison:
        """The comparison after a match into an area in which the keyframes do not lie."""
        query = self._grid_cache.grid(comparison.query.poses)
        sample = self._negative_sample(hybrid_map, area, comparison.excluded)
        share, work = best_share(query, sample, self._settings)
        self.work.add(work)
        elsewhere = tuple(other for other in comparison.elsewhere if other != area)
        shares = (*comparison.negative_shares, share)
        return replace(comparison, elsewhere=elsewhere, negative_shares=shares, prepared=None)

    def _conclude(self, hybrid_map: HybridMap, comparison: OngoingComparison) -> AreaComparison:
        """Prior and evidence of all areas that were examined."""
        examined = [one for one in comparison.examined if one.is_possible]
        priors = {one.area: one.entry.probability for one in examined}
        by_arcs = transition_model(priors | dict(comparison.skipped), self._options.new_probability)
        marks = {one.area: one.mark for one in examined if one.mark is not None}
        transition = mix_transition(by_arcs, marks, self._options.new_probability)
        newest = max(comparison.query.poses)
        if priors and newest != self._newest_sampled:
            self._newest_sampled = newest
            self._aliasing.add_negatives(comparison.negative_shares)
        in_order = sorted(examined, key=lambda one: (-one.entry.probability, one.area))
        total = total_gain(marks)
        fits = [
            fit
            for one in in_order
            for fit in self._fits(hybrid_map, one, transition.known[one.area], by_arcs.known[one.area] / total)
        ]
        kept, dropped = _split_heaviest(fits, self._options.max_modes)
        skipped_weight = sum(transition.known[known] for known in comparison.skipped)
        skipped_weight += sum(math.exp(fit.log_weight) for fit in dropped)
        pending = tuple(one.area for one in examined if one.is_pending)
        compared = tuple(one.area for one in examined if not one.is_pending)
        return AreaComparison(transition, kept, compared, pending, skipped_weight)

    def look_ahead(self, hybrid_map: HybridMap) -> None:
        """Build the grid of one area of the next negative sample, at an event without a search."""
        while self._places_ahead and not self.work.done:
            area, excluded = self._places_ahead.pop()
            if hybrid_map.has_area(area):
                self._negative_sample(hybrid_map, area, excluded)
                return

    def _entry_probability(self, place: AreaPlace, candidate: AreaCandidate) -> EntryPrior:
        return entry_prior(place, candidate.prior, stack_poses(candidate.unmatched_poses), self._options.place_radius)

    def _narrow(self, candidate: AreaCandidate, mark: AreaMark) -> AreaCandidate:
        """A candidate that is searched by its mark, where the arcs to it are wide."""
        is_wide_prior = is_wide(candidate.prior.covariance, self._filter)
        return candidate._replace(prior=mark.joint_belief) if is_wide_prior else candidate

    def _negative_sample(self, hybrid_map: HybridMap, area: int, excluded: Collection[int]) -> NegativeSample:
        """An area's grid, and the pose of its middle keyframe."""
        poses = stack_poses(hybrid_map.keyframes(area))
        return NegativeSample(self._grid_cache.place(hybrid_map, area, excluded).grid, poses[len(poses) // 2])

    def _modes(self, place: AreaPlace, candidate: AreaCandidate) -> list[MatchMode] | None:
        """The modes in the candidate's place; None where the heaviest lies beside every place.

        A robot that returns to known ground sees it before it is in it. A wide prior admits poses that fit by chance,
        and takes longest: of these, those count only with which more surfaces match than anywhere.
        """
        query, radius = self._grid_cache.grid(candidate.unmatched_poses), self._options.place_radius
        bounds = query_bounds(place.positions, query, candidate.unmatched_poses, radius)
        settings = self._settings
        if is_wide(candidate.prior.covariance, self._filter):
            settings = replace(settings, min_log_ratio=MIN_LOG_RATIO)
        match = match_areas(query, place.grid, candidate.prior, settings, bounds)
        modes = match.modes
        self.work.add(match.work)
        poses = stack_poses(candidate.unmatched_poses)
        areas = [containing_area(place, se2.compose(mode.pose.mean, poses), radius) for mode in modes]
        if modes and areas[max(range(len(modes)), key=lambda n: modes[n].log_mass)] is None:
            return None
        return [mode for mode, area in zip(modes, areas, strict=True) if area == place.area]

    def _fits(self, hybrid_map: HybridMap, examined: ExaminedArea, pi: float, by_arcs: float = 0.0) -> Iterator[Fit]:
        """The weights of a candidate's modes.

        The modes share the probability of the place by their masses. A mode farther from the prior's mean than poses in
        the place usually are has less. Where a pending closure already puts the robot there, the fit was to be expected
        even if that closure is false. What a mark adds to the probability of the place the modes share by it.

        :param pi: prior of the place in the transition model, beside that by itself.
        :param by_arcs: the part of it that no mark adds.
        """
        area, prior, entry, modes, agreements = examined[:5]
        mark = examined.mark
        mark_shares = [0.0] * len(modes) if mark is None else mark.shares(modes)
        is_expected = entry.probability > 0.5 and bool(hybrid_map.pending_closures)
        log_total_mass = float(np.logaddexp.reduce([mode.log_mass for mode in modes]) if modes else 0.0)
        for mode, agreement, share in zip(modes, agreements, mark_shares, strict=True):
            log_evidence = MAP_IN_MAP.log_likelihood_ratio(agreement, MAPS_OUTLIER_RATE)
            log_evidence += self._aliasing.log_distinctiveness(agreement.matched_share, already_expected=is_expected)
            difference = se2.log(se2.between(prior.mean, mode.pose.mean))
            distance = float(difference @ np.linalg.solve(prior.covariance, difference))
            log_offset = -0.5 * max(0.0, distance - entry.median_mahalanobis2)
            if mark is None:
                log_weight = math.log(pi) + mode.log_mass - log_total_mass + log_evidence + log_offset
                yield Fit(area, mode, log_weight, pi, agreement)
                continue
            weight = by_arcs * math.exp(mode.log_mass - log_total_mass + log_offset) + (pi - by_arcs) * share
            if weight > 0.0:
                yield Fit(area, fuse_with_mark(mode, mark.belief), math.log(weight) + log_evidence, pi, agreement)


def known_ground_log_ratio(agreement: Agreement, clutter: float) -> float:
    """log p(scan | the robot is there) / p(scan | it is in a similar place), nats.

    :param agreement: of the scan with known ground.
    :param clutter: usual rate of beams that contradict the robot's map, where that is above the rate of maps.
    """
    return SCAN_IN_STORED_MAP.log_likelihood_ratio(agreement, max(MAPS_OUTLIER_RATE, clutter))


def first_new_keyframe(keyframe: int) -> int:
    """The first keyframe that is no known ground yet when ``keyframe`` is the newest."""
    return (keyframe - _OLD_EVENTS) // _OLD_STEP * _OLD_STEP


def _split_heaviest(fits: Sequence[Fit], count: int) -> tuple[tuple[Fit, ...], tuple[Fit, ...]]:
    """The heaviest fits in every area, ``count`` at most, in their order; and the others."""
    heaviest = sorted(range(len(fits)), key=lambda n: (-fits[n].log_weight, n))
    rank = Counter[int]()
    kept = set()
    for n in heaviest:
        rank[fits[n].area] += 1
        if rank[fits[n].area] <= count:
            kept.add(n)
    parts = [tuple(fit for n, fit in enumerate(fits) if (n in kept) == inside) for inside in (True, False)]
    return parts[0], parts[1]
