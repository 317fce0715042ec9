"""Area to area: all modes of the pose of one area's map in another's, and the evidence integral.

The second factor pair of Eq. (6), integrated over x: the integral of p(x | gamma) p(z | x, gamma) / p(z | unknown).
Blanco et al. take an expectation over samples of the prior; a lattice has no variance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration.topology import InferenceParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, match_moments
from hmt_slam_ros.registration import match_modes
from hmt_slam_ros.registration.branch_and_bound import SearchCells, search_cells
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.registration.position_constraint import PositionConstraint
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.registration.search_window import SearchWindow, make_search_window

_MAX_SADDLE_DEPTH = 3.0
"""Depth of the pass between two peaks of one cluster at most, nats."""

_NEGLIGIBLE_SHARE = 1e-5
"""Share of the prior's mass that a cell could have alone, below which it is dropped."""

_TURN_LIMITS = (math.radians(0.2), math.radians(2.0))
"""Smallest and largest angle between turns of a search, rad."""

_WEAK_PRIOR_SHARE = 0.01
"""Share of the prior's information in the result of matching alone, for directions that a match does not determine."""

_SAME_MODE_GATE = chi_square_gate(0.95)
"""Squared Mahalanobis distance below which two modes are the same."""

_MODES_WORK = 10_000
"""Work for the modes of a match: so many times all samples are looked up, about."""

_STRETCH = 1.0
"""Edge of the squares into which surfaces are divided to be resampled, m: what one wall, box or door shows there."""

_RESAMPLES = 64
"""Number of resampled surfaces."""

_RESAMPLED_CELLS = 2000
"""Cells of a search whose masses are resampled, the heaviest, so that the work is bounded."""

_MARGIN = 20.0
"""Log-mass below that of the best mode down to which modes are used, nats: the best may be in another area's place."""


@dataclass(frozen=True)
class MatchSettings:
    """Settings of a search.

    :ivar temper: exponent on the likelihood of the surface samples, which are not quite independent.
    :ivar gate: largest squared Mahalanobis distance from the prior, 3 degrees of freedom.
    :ivar margin: log-mass below that of the best mode down to which modes are returned, nats.
    :ivar max_modes: largest number of modes, the heaviest; some of them may be merged.
    :ivar sigma_floor: smallest deviation of a mode's translation, m.
    :ivar angle_floor: smallest deviation of a mode's angle, rad.
    :ivar min_log_ratio: smallest mean log-ratio of the samples at a pose, nats.
    :ivar check_reverse: whether surfaces of the candidate in free space of the query count against a pose.
    """

    temper: float = 0.1
    gate: float = 16.27
    margin: float = 10.0
    max_modes: int = 8
    sigma_floor: float = 0.01
    angle_floor: float = math.radians(0.2)
    min_log_ratio: float = -math.inf
    check_reverse: bool = True

    @classmethod
    def from_options(cls, options: InferenceParameters) -> MatchSettings:
        """As configured."""
        return cls(
            options.temper,
            chi_square_gate(options.gate_probability),
            _MARGIN,
            max(cls.max_modes, 2 * options.max_modes),
        )


class MatchMode(NamedTuple):
    """One fit of the query into the candidate.

    :ivar pose: belief over ``candidate_T_query``: prior and match.
    :ivar measured: the same from the match alone, for an arc that is fused with those of the prior.
    :ivar log_mass: log of the mode's part of the evidence integral, nats.
    """

    pose: PoseGaussian
    measured: PoseGaussian
    log_mass: float


@dataclass(frozen=True, eq=False)
class AreaMatch:
    """The fit of a query into a candidate.

    :ivar log_evidence: log of the integral of p(x) (p(z | x, candidate) / p(z | unknown))^temper over the gate, nats;
        -inf where all of it is negligible.
    :ivar work: number of samples that are looked up for the search and for the modes.
    """

    log_evidence: float = -math.inf
    work: int = 0
    _find_modes: Callable[[], tuple[MatchMode, ...]] = tuple

    # On demand: for some comparisons the evidence is enough.
    @cached_property
    def modes(self) -> tuple[MatchMode, ...]:
        """By falling mass."""
        return self._find_modes()


def match_areas(
    query: AreaGrid,
    candidate: AreaGrid,
    prior: PoseGaussian,
    settings: MatchSettings,
    bounds: Float64 | None = None,
    cells: SearchCells | None = None,
) -> AreaMatch:
    """All poses of the query in the candidate that the prior admits.

    :param query: the map of the keyframes in question, in the frame of their reference keyframe.
    :param candidate: the map of the candidate and its surroundings.
    :param prior: belief over ``candidate_T_query``.
    :param bounds: shape (2, 2), the smallest and the largest (x, y) in the candidate for the middle of the query's
        points, m.
    :param cells: those of :func:`find_cells` with the same arguments, if they are known.
    """
    result, work = _search(query, candidate, prior, settings, bounds, cells)
    if result is None:
        return AreaMatch(work=work)
    work += _MODES_WORK * len(query.points)
    return AreaMatch(float(np.logaddexp.reduce(result.masses)), work, lambda: tuple(_modes(_resample_surfaces(result))))


def find_cells(
    query: AreaGrid,
    candidate: LogRatioGrid,
    candidate_points: Float64,
    prior: PoseGaussian,
    settings: MatchSettings,
    bounds: Float64 | None = None,
    constraint: PositionConstraint | None = None,
) -> SearchCells:
    """The cells of the lattice of poses that matter; :func:`match_areas` makes modes of them.

    The other arguments are those of :func:`match_areas`.

    :param candidate: log-ratios of the candidate's map.
    :param candidate_points: its surface points, shape (n, 2), m, for the reverse check.
    :param constraint: limits on the positions of the query's keyframes, if any.
    """
    if not query.points.size:
        return SearchCells(np.empty((0, 3), dtype=np.int64), np.empty(0), np.empty(0))
    centered = _center(query, candidate.cell, prior, settings, bounds)
    back_points = candidate_points[: None if settings.check_reverse else 0]
    if constraint is not None:
        constraint = constraint._replace(keyframes=constraint.keyframes - centered.to_middle.mean[:2])
    least_ratio = settings.temper * settings.min_log_ratio * len(query.points)
    return search_cells(
        centered.window,
        candidate,
        centered.query.points,
        _coarse_grid(centered.query),
        _reachable_points(back_points, centered.window, centered.query),
        settings.temper,
        max(math.log(_NEGLIGIBLE_SHARE) - min(0.0, centered.log_cell), least_ratio),
        settings.margin,
        constraint,
    )


def best_pose(
    query: AreaGrid, candidate: AreaGrid, prior: PoseGaussian, settings: MatchSettings
) -> tuple[tuple[Float64, float] | None, int]:
    """The peak ``candidate_T_query`` of the heaviest mode of :func:`match_areas`, and its log-mass; None without modes.

    It costs a fraction of the mode with its covariance.

    :returns: beside that, the number of samples that were looked up for the search.
    """
    result, work = _search(query, candidate, prior, settings)
    if result is None:
        return None, work
    labels, totals = _cluster(result)
    inside = labels == totals.argmax()
    peak = _find_peak(result.problem, result.masses[inside], result.poses[inside])
    return (se2.compose(peak, se2.inverse(result.problem.to_middle.mean)), float(totals.max())), work


def _search(
    query: AreaGrid,
    candidate: AreaGrid,
    prior: PoseGaussian,
    settings: MatchSettings,
    bounds: Float64 | None = None,
    cells: SearchCells | None = None,
) -> tuple[_SearchResult | None, int]:
    """The cells of a search, None without any, and the number of samples that it looked up."""
    if not query.points.size or not candidate.points.size:
        return None, 0
    if cells is None:
        cells = find_cells(query, _coarse_grid(candidate), candidate.points, prior, settings, bounds)
    if not cells.score.size:
        return None, cells.work
    centered, surface = _center(query, candidate.cell, prior, settings, bounds), _fine_grid(candidate)
    samples, window = centered.query.points, centered.window
    problem = _MatchProblem(surface, samples, window, centered.prior, settings, centered.to_middle)
    masses, poses = match_modes.integrate_cells(surface, samples, window, cells, settings.temper)
    return _SearchResult(problem, cells, masses + centered.log_cell, poses), cells.work


def _center(
    query: AreaGrid, cell: float, prior: PoseGaussian, settings: MatchSettings, bounds: Float64 | None
) -> _CenteredQuery:
    """The search of a query, not empty, in a grid with cells of an edge, m."""
    # In the middle of the samples turns and shifts are least correlated, and the lattice of turns is coarsest.
    middle = query.points.mean(axis=0)
    to_middle = PoseGaussian.from_pose(np.array([*middle, 0.0]))
    centered, prior = query.shift_origin(middle), prior.compose(to_middle)
    turn = _turn_step(cell, centered.points)
    window = make_search_window(prior.mean, prior.covariance, cell, turn, settings.gate, bounds)
    return _CenteredQuery(centered, window, prior, to_middle, _log_cell_mass(prior, cell, turn))


class _CenteredQuery(NamedTuple):
    """A query in the frame of the middle of its samples.

    :ivar prior: over ``candidate_T_middle``.
    :ivar to_middle: ``query_T_middle``.
    :ivar log_cell: log of the prior's mass in a cell of the lattice at its mean.
    """

    query: AreaGrid
    window: SearchWindow
    prior: PoseGaussian
    to_middle: PoseGaussian
    log_cell: float


@dataclass(frozen=True, eq=False)
class _MatchProblem:
    surface: LogRatioGrid
    samples: Float64
    window: SearchWindow
    prior: PoseGaussian
    settings: MatchSettings
    to_middle: PoseGaussian


class _SearchResult(NamedTuple):
    """Cells of a search, the log-mass of each, (n,), and the best pose in it, (n, 3)."""

    problem: _MatchProblem
    cells: SearchCells
    masses: Float64
    poses: Float64


def _coarse_grid(grid: AreaGrid) -> LogRatioGrid:
    return LogRatioGrid(grid.log_ratio, grid.origin, grid.cell)


def _fine_grid(grid: AreaGrid) -> LogRatioGrid:
    return LogRatioGrid(grid.fine_log_ratio, grid.origin, 0.5 * grid.cell)


def _turn_step(cell: float, samples: Float64) -> float:
    """The turn that moves nine samples of ten by less than a cell (the pixel rule of Hess et al. 2016)."""
    radius = max(cell, float(np.quantile(np.hypot(samples[:, 0], samples[:, 1]), 0.9)))
    turn = math.acos(max(-1.0, 1.0 - cell**2 / (2.0 * radius**2)))
    return min(max(turn, _TURN_LIMITS[0]), _TURN_LIMITS[1])


def _log_cell_mass(prior: PoseGaussian, cell: float, turn: float) -> float:
    """Log of the prior's density at its mean times the volume of a cell."""
    log_determinant = float(np.linalg.slogdet(prior.covariance)[1])
    return math.log(cell * cell * turn) - 1.5 * math.log(2.0 * math.pi) - 0.5 * log_determinant


def _reachable_points(points: Float64, window: SearchWindow, query: AreaGrid) -> Float64:
    """The candidate's points that can meet the query's grid at a pose of the window."""
    rows, columns = query.log_ratio.shape
    corners = query.origin + query.cell * np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]])
    farthest = np.hypot(*np.maximum(-window.first, window.last)) * window.cell
    radius = np.hypot(corners[:, 0], corners[:, 1]).max() + farthest
    near = np.hypot(points[:, 0] - window.mean[0], points[:, 1] - window.mean[1]) <= radius
    return points[near]


def _resample_surfaces(result: _SearchResult) -> _SearchResult:
    """The result with the mean posterior over resampled surfaces (BayesBag, Huggins and Miller 2023).

    Where a few stretches of wall alone prefer one pose to another, their noise does, and resampling has no preference.
    A preference that most stretches share, or a niche, stays. The sum of all masses is the same.
    """
    problem, cells, masses, poses = result
    heaviest = np.sort(np.argsort(-masses, kind="stable")[:_RESAMPLED_CELLS])
    stretches, count = _divide_into_stretches(problem.samples)
    parts = match_modes.stretch_log_ratios(problem.surface, problem.samples, stretches, count, poses[heaviest])
    weights = count * np.random.default_rng(0).dirichlet(np.ones(count), _RESAMPLES)
    resampled = masses[heaviest] + problem.settings.temper * ((weights - 1.0) @ parts.T)
    shares = resampled - np.logaddexp.reduce(resampled, axis=1, keepdims=True)
    mean = np.logaddexp.reduce(shares, axis=0) - math.log(_RESAMPLES)
    total = np.logaddexp.reduce(masses[heaviest])
    masses = masses.copy()
    masses[heaviest] = mean + total
    return _SearchResult(problem, cells._replace(score=masses), masses, poses)


def _divide_into_stretches(samples: Float64) -> tuple[Int64, int]:
    """The stretch of every sample, shape (n,), and their number."""
    squares = np.floor(samples / _STRETCH).astype(np.int64)
    _, stretches = np.unique(squares, axis=0, return_inverse=True)
    return stretches.reshape(-1), int(stretches.max()) + 1


def _cluster(result: _SearchResult) -> tuple[Int64, Float64]:
    """The cluster of every cell, and the log-mass of every cluster."""
    labels = match_modes.cluster_cells(result.cells, _MAX_SADDLE_DEPTH)
    totals = np.full(labels.max() + 1, -np.inf)
    np.logaddexp.at(totals, labels, result.masses)
    return labels, totals


def _modes(result: _SearchResult) -> list[MatchMode]:
    """The modes by falling mass, without duplicates."""
    problem, _, masses, poses = result
    labels, totals = _cluster(result)
    floor = totals.max() - problem.settings.margin
    modes: list[MatchMode] = []
    for label in np.argsort(-totals, kind="stable")[: problem.settings.max_modes]:
        if totals[label] >= floor:
            inside = labels == label
            _add_or_merge(modes, _fit_mode(problem, masses[inside], poses[inside]))
    return [_mode_in_query_frame(mode, problem.to_middle) for mode in sorted(modes, key=lambda mode: -mode.log_mass)]


def _add_or_merge(modes: list[MatchMode], mode: MatchMode) -> None:
    """Append a mode, or merge it with the same mode, which is heavier and keeps its mean."""
    for place, other in enumerate(modes):
        if other.pose.mahalanobis2(mode.pose) < _SAME_MODE_GATE:
            pair = (other, mode)
            modes[place] = MatchMode(
                match_moments([(member.pose, member.log_mass) for member in pair]),
                match_moments([(member.measured, member.log_mass) for member in pair]),
                float(np.logaddexp(other.log_mass, mode.log_mass)),
            )
            return
    modes.append(mode)


def _fit_mode(problem: _MatchProblem, masses: Float64, poses: Float64) -> MatchMode:
    """Peak, covariances and mass of a cluster of cells.

    The curvature at the peak gives the covariance of a sharp mode. Cells farther away than that, as along a corridor,
    widen it.
    """
    settings, window = problem.settings, problem.window
    peak = _find_peak(problem, masses, poses)
    span = 0.3 * window.cell
    step = np.array([span, span, _radian_step(problem, span)])
    curvature = match_modes.curvature(problem.surface, problem.samples, peak, step)
    by_match = _positive_part(settings.temper * curvature)
    by_prior = np.linalg.inv(problem.prior.covariance_at(peak))
    posterior = np.linalg.inv(by_match + by_prior)
    spread = _excess_covariance(problem, peak, masses, poses, posterior)
    floor = np.diag([settings.sigma_floor**2, settings.sigma_floor**2, settings.angle_floor**2])
    peak = np.array([peak[0], peak[1], float(se2.wrap(peak[2]))])
    return MatchMode(
        PoseGaussian(peak, posterior + spread + floor),
        PoseGaussian(peak, np.linalg.inv(by_match + _WEAK_PRIOR_SHARE * by_prior) + spread + floor),
        float(np.logaddexp.reduce(masses)),
    )


def _find_peak(problem: _MatchProblem, masses: Float64, poses: Float64) -> Float64:
    """The pose at which a cluster of cells is highest, shape (3,)."""
    window, heaviest = problem.window, poses[int(np.argmax(masses))]
    step = np.array([window.cell / 6.0, window.cell / 6.0, _radian_step(problem, window.cell / 6.0)])
    return match_modes.climb_to_peak(
        problem.surface, problem.samples, window, problem.settings.temper, heaviest, step, 1.0 / 8.0
    )


def _radian_step(problem: _MatchProblem, distance: float) -> float:
    """The angle by which the samples move by ``distance`` in the quadratic mean."""
    radius = math.sqrt(float(np.mean(np.sum(problem.samples**2, axis=1))))
    return distance / max(radius, distance)


def _excess_covariance(
    problem: _MatchProblem, peak: Float64, masses: Float64, poses: Float64, explained: Float64
) -> Float64:
    """The covariance of the cells of a cluster around the peak, beyond ``explained`` and that of the lattice."""
    offsets = se2.log(se2.between(peak, poses))
    weights = np.exp(masses - np.logaddexp.reduce(masses))
    second_moment = np.einsum("n,ni,nj->ij", weights, offsets, offsets)
    cell, turn = problem.window.cell, match_modes.turn_step(problem.window)
    lattice = np.diag([cell**2, cell**2, turn**2]) / 12.0
    return _positive_part(second_moment - explained - lattice)


def _positive_part(matrix: Float64) -> Float64:
    """The nearest positive semidefinite matrix to a symmetric one, both (3, 3) over (m, m, rad).

    Angles are scaled to the meters by which they move a point ten meters away, so that the axes compare.
    """
    scale = np.array([1.0, 1.0, 10.0])
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T) * np.outer(scale, scale))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(scale, scale), dtype=np.float64)


def _mode_in_query_frame(mode: MatchMode, to_middle: PoseGaussian) -> MatchMode:
    """The mode in the query's own frame, from that in its middle."""
    from_middle = to_middle.inverse()
    return MatchMode(mode.pose.compose(from_middle), mode.measured.compose(from_middle), mode.log_mass)
