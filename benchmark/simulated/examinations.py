"""TSBI's comparisons of keyframes with known areas, with the truth of each: data to fit the model."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.scripted import UnboundedWork
from benchmark.simulated.truth import RADIUS, TOLERANCE, Pose, Truth
from hmt_slam_ros import composition
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.hybrid_map.surroundings import GridCache
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.registration.match_modes import log_ratio_at
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.area_comparison import AreaComparison, Fit, OngoingComparison
from hmt_slam_ros.topological_inference.branches import Branches, Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.candidate_gating import Query, entry_prior
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch
from hmt_slam_ros.topological_inference.place_recognition import ScanDescriptors, descriptor_log_ratio

_Comparison = tuple[Query, frozenset[int], AreaComparison]
_VIEWS = 3
_NAN = math.nan
_NO_MATCH = (0, _NAN, 0, 0)


@dataclass(frozen=True, eq=False)
class Examination:
    """The comparison of a hypothesis's keyframes with its known areas.

    :ivar kind: "cut" or "recheck".
    :ivar parent: the hypothesis before the event.
    :ivar query: its keyframes in question.
    :ivar compared: {known area: keyframes that were compared with it before}.
    :ivar excluded: areas that are neither candidates nor part of a candidate's map.
    :ivar found: result of the comparison.
    :ivar views: grids of keyframes and areas of the search.
    :ivar descriptors: of keyframes.
    """

    kind: str
    parent: Parent
    query: Query
    compared: Mapping[int, Collection[int]]
    excluded: frozenset[int]
    found: AreaComparison
    views: GridCache
    descriptors: ScanDescriptors

    @property
    def hybrid_map(self) -> HybridMap:
        """The map of the hypothesis."""
        return self.parent.hybrid_map

    @property
    def keyframes(self) -> list[int]:
        """The keyframes in question."""
        return list(self.query.poses)

    @property
    def known_areas(self) -> list[int]:
        """All areas in which the keyframes could have been found."""
        return [area for area in self.hybrid_map.area_ids() if area not in self.excluded]

    def unmatched_keyframes(self, area: int) -> dict[int, Pose]:
        """{keyframe: ``reference_T_base``} of those not compared with an area before."""
        return {k: pose for k, pose in self.query.poses.items() if k not in self.compared.get(area, ())}

    def grid_of(self, area: int) -> AreaGrid:
        """The map of a known area and its surroundings."""
        return self.views.place(self.hybrid_map, area, self.excluded).grid


ExaminationListener = Callable[[Examination], None]


class ObservedBranching(Branching):
    """A branching that passes its examinations to a listener."""

    def __init__(
        self, configuration: Configuration, replica: Replica, listener: ExaminationListener, *, is_bounded: bool = True
    ) -> None:
        """:param is_bounded: whether comparisons go on at the next event, which needs an area abstraction."""
        super().__init__(configuration, replica, composition.landmark_evidence)
        self.search = self._observed_search = _ObservedSearch(configuration, replica.scans, is_bounded=is_bounded)
        self._descriptors = ScanDescriptors(replica.scans)
        self._listener = listener

    def cut(self, parent: Parent, keyframes: Sequence[int]) -> Branches:
        """As of the base class, with the listener."""
        return self._report("cut", parent, super().cut(parent, keyframes))

    def continue_comparison(self, parent: Parent, comparison: OngoingComparison) -> Branches:
        """As of the base class, with the listener."""
        return self._report("recheck", parent, super().continue_comparison(parent, comparison))

    def _report(self, kind: str, parent: Parent, branches: Branches) -> Branches:
        if (comparison := self._observed_search.take()) is not None:
            query, excluded, found = comparison
            views, compared = self._observed_search.views, parent.state.matched_keyframes
            self._listener(Examination(kind, parent, query, compared, excluded, found, views, self._descriptors))
        return branches


class _ObservedSearch(ClosureSearch):
    """A closure search that keeps its last comparison that ended."""

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan], *, is_bounded: bool) -> None:
        super().__init__(configuration, scans)
        if not is_bounded:
            self.work = UnboundedWork()
        self._last: _Comparison | None = None

    @property
    def views(self) -> GridCache:
        """Cached grids."""
        return self._grid_cache

    def continue_comparison(
        self, hybrid_map: HybridMap, comparison: OngoingComparison
    ) -> OngoingComparison | AreaComparison:
        """As of the base class, with the listener."""
        found = super().continue_comparison(hybrid_map, comparison)
        if isinstance(found, AreaComparison):
            self._last = comparison.query, comparison.excluded, found
        return found

    def take(self) -> _Comparison | None:
        """Return and forget the last comparison."""
        last, self._last = self._last, None
        return last


class Match(NamedTuple):
    """The match of surface samples with a map.

    :ivar samples: number of samples.
    :ivar score: sum of their log-ratios, not tempered, nats.
    :ivar on: samples on known surfaces.
    :ivar free: samples in space that is known to be free.
    """

    samples: int
    score: float
    on: int
    free: int


class Row(NamedTuple):
    """A mode in a known area; ``mode`` is -1 if there is none.

    :ivar event: the keyframe event.
    :ivar kind: 0 for a cut, 1 for a re-check.
    :ivar hypothesis: parent; ``log_probability``, its own, including the newest scan.
    :ivar area: of the keyframes.
    :ivar known: area that they are compared with.
    :ivar mode: number of the mode, the heaviest first.
    :ivar traveled: path length since the start, m.
    :ivar loop: path driven since the known area's newest keyframe, m.
    :ivar query_size: number of keyframes that were not compared with the area before.
    :ivar keyframes: number of the known area's own.
    :ivar share: pi of the area by itself; ``pi``, in the transition model; ``new``, of new ground there.
    :ivar descriptor: log p(phi), nats, which is not part of the weight.
    :ivar log_mass: log of the mode's part of the evidence integral, nats.
    :ivar log_weight: of the fit, relative to new ground.
    :ivar prior_x: deviation of the prior by the arcs along its axes, widened; likewise ``prior_y`` (m), ``prior_turn``
        (rad).
    :ivar log_prior: log density of the prior at the mode.
    :ivar mahalanobis2: squared, of the mode under the prior.
    :ivar mode_x: deviation of the mode from the match alone; likewise ``mode_y`` (m), ``mode_turn`` (rad).
    :ivar log_volume: half the log determinant of its covariance.
    :ivar samples: to ``free``: the keyframes' samples in the area's map at the mode, as :class:`Match`.
    :ivar reverse_samples: to ``back_free``: the area's samples in the keyframes' map there.
    :ivar true_score: to ``true_free``: as ``score``, at the true pose; NaN where the places are not the same.
    :ivar right: 1 for a true mode, 0 for a false one.
    :ivar apart: to ``error_turn``: of its error, m, m, degrees.
    :ivar in_place: share of the keyframes that truly are in the area's place.
    :ivar known_right: whether "in the area" is a right answer; ``new_right``, whether "new ground" is.
    :ivar view: share of the middle keyframe's view that the nearest ones of the area have too.
    """

    event: int
    kind: int
    hypothesis: int
    log_probability: float
    area: int
    known: int
    mode: int
    traveled: float
    loop: float
    query_size: int
    keyframes: int
    share: float
    pi: float
    new: float
    descriptor: float
    log_mass: float
    log_weight: float
    prior_x: float
    prior_y: float
    prior_turn: float
    log_prior: float
    mahalanobis2: float
    mode_x: float
    mode_y: float
    mode_turn: float
    log_volume: float
    samples: int
    score: float
    on: int
    free: int
    back_samples: int
    back_score: float
    back_on: int
    back_free: int
    true_score: float
    true_on: float
    true_free: float
    right: int
    apart: float
    error: float
    error_turn: float
    in_place: float
    known_right: int
    new_right: int
    view: float


def examination_rows(
    examination: Examination, truth: Truth, configuration: Configuration, event: int, traveled: dict[int, float]
) -> Iterator[Row]:
    """The rows of an examination.

    :param traveled: {keyframe: path length since the start, m}.
    """
    new = int(new_is_right(examination, truth))
    for known in examination.found.examined_areas:
        fits = [fit for fit in examination.found.fits if fit.area == known]
        candidate = _Candidate(examination, truth, configuration, known)
        loop = traveled[event] - max(traveled[k] for k in examination.hybrid_map.keyframes(known))
        head = (
            event,
            int(examination.kind == "recheck"),
            examination.parent.hypothesis,
            examination.parent.log_weight,
            examination.parent.area,
            known,
        )
        middle = (traveled[event], loop, len(candidate.unmatched), len(candidate.known), *candidate.transition())
        for mode, fit in enumerate(fits) if fits else [(-1, None)]:
            yield Row._make(
                (*head, mode, *middle, *candidate.mode_values(fit), *candidate.place_truth(), new, candidate.view())
            )


def new_is_right(examination: Examination, truth: Truth) -> bool:
    """Whether new ground is a right answer, because most of the keyframes lie in no known place."""
    known = [k for area in examination.known_areas for k in examination.hybrid_map.keyframes(area)]
    return 2.0 * truth.share_in(examination.keyframes, known, (1.0 - TOLERANCE) * RADIUS) < 1.0


def known_is_right(examination: Examination, truth: Truth, area: int) -> bool:
    """Whether a known area is a right answer, because most of the keyframes lie in its place."""
    known = list(examination.hybrid_map.keyframes(area))
    return 2.0 * truth.share_in(examination.keyframes, known, (1.0 + TOLERANCE) * RADIUS) >= 1.0


class _Candidate:
    """A known area that the keyframes were compared with, and its columns."""

    def __init__(self, examination: Examination, truth: Truth, configuration: Configuration, area: int) -> None:
        self._examination, self._truth, self._options, self._area = examination, truth, configuration.tsbi, area
        self.unmatched = examination.unmatched_keyframes(area)
        self.known = examination.hybrid_map.keyframes(area)
        belief = shortest_path_beliefs(examination.hybrid_map, examination.parent.area)[area]
        prior = belief.inverse().compose(examination.query.belief)
        self._prior = PoseGaussian(prior.mean, self._options.prior_scale**2 * prior.covariance)
        self._place = examination.views.place(examination.hybrid_map, area, examination.excluded)
        self._grid = examination.views.grid(self.unmatched)

    def transition(self) -> tuple[float, float, float]:
        """Share, pi and the probability of new ground."""
        poses = np.array(list(self.unmatched.values()))
        share = entry_prior(self._place, self._prior, poses, self._options.place_radius).probability
        model = self._examination.found.transition
        return share, model.known[self._area], model.new

    def mode_values(self, fit: Fit | None) -> tuple[float, ...]:
        """The columns of a mode."""
        deviations = np.sqrt(np.diag(self._prior.covariance))
        descriptor = self._descriptor_log_ratio()
        if fit is None:
            no_weights = [_NAN] * 2
            no_shapes = [_NAN] * 6
            return (
                descriptor,
                *no_weights,
                *deviations,
                *no_shapes,
                *_NO_MATCH,
                *_NO_MATCH,
                *self._at_truth(),
                0,
                *[_NAN] * 3,
            )
        at = fit.mode.pose.mean
        offset = se2.log(se2.between(self._prior.mean, at))
        mahalanobis2 = float(offset @ np.linalg.solve(self._prior.covariance, offset))
        log_determinant = float(np.linalg.slogdet(self._prior.covariance)[1])
        log_prior = -0.5 * (mahalanobis2 + log_determinant) - 1.5 * math.log(2.0 * math.pi)
        measured = fit.mode.measured.covariance
        return (
            descriptor,
            fit.mode.log_mass,
            fit.log_weight,
            *deviations,
            log_prior,
            mahalanobis2,
            *np.sqrt(np.diag(measured)),
            0.5 * float(np.linalg.slogdet(measured)[1]),
            *_match(self._grid.points, at, self._place.grid),
            *_match(self._place.grid.points, se2.inverse(at), self._grid),
            *self._at_truth(),
            *self._assessment(fit),
        )

    def _assessment(self, fit: Fit) -> tuple[float, ...]:
        query = {k: se2.compose(fit.mode.pose.mean, pose) for k, pose in self._examination.query.poses.items()}
        measured = fit.mode.measured
        assessment = self._truth.assess(self.known, query, measured.covariance, measured.mean)
        return int(assessment.true), assessment.apart, assessment.translation, assessment.rotation

    def _at_truth(self) -> tuple[float, float, float]:
        """Score, samples on surfaces and in free space at the true pose."""
        nearest, pose = self._nearest()
        if not self._truth.same_place(list(self.unmatched), [nearest], RADIUS).any():
            return _NAN, _NAN, _NAN
        return _match(self._grid.points, pose, self._place.grid)[1:]

    def _nearest(self) -> tuple[int, Pose]:
        """The area's keyframe nearest to the reference, and ``area_T_reference`` by that keyframe."""
        reference = self._truth.poses[self._examination.keyframes[0]]
        nearest = min(self.known, key=lambda k: float(np.hypot(*(self._truth.poses[k] - reference)[:2])))
        return nearest, se2.compose(self.known[nearest], se2.between(self._truth.poses[nearest], reference))

    def place_truth(self) -> tuple[float, int]:
        """Share of the keyframes in the area's place, and whether the area is a right answer."""
        share = self._truth.share_in(self._examination.keyframes, list(self.known), RADIUS)
        return share, int(known_is_right(self._examination, self._truth, self._area))

    def view(self) -> float:
        """Largest share of the middle keyframe's view that one of the area's nearest keyframes has too."""
        keyframes = list(self.unmatched)
        middle = keyframes[len(keyframes) // 2]
        here = self._truth.poses[middle]
        near = sorted(self.known, key=lambda k: float(np.hypot(*(self._truth.poses[k] - here)[:2])))[:_VIEWS]
        return float(self._truth.shared_view(middle, near).max())

    def _descriptor_log_ratio(self) -> float:
        """log p(phi), nats, relative to the other known areas."""
        areas = [self._area, *(area for area in self._examination.known_areas if area != self._area)]
        keyframes = [self._examination.hybrid_map.keyframes(area) for area in areas]
        return float(descriptor_log_ratio(self._examination.descriptors.similarity(self.unmatched, keyframes)[0]))


def _match(points: NDArray[np.float64], pose: Pose, grid: AreaGrid) -> Match:
    """The match of samples at ``grid_T_points`` with a grid."""
    found = grid.compare(points, pose)
    score = log_ratio_at(LogRatioGrid(grid.fine_log_ratio, grid.origin, 0.5 * grid.cell), points, pose)
    return Match(found.samples, score, found.on_surface, found.in_free_space)
