"""Modes of a match against scipy: interpolation, quadrature, peak and curvature."""

import itertools
import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, label, map_coordinates

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration import match_modes
from hmt_slam_ros.registration.branch_and_bound import SearchCells
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.registration.search_window import make_search_window

CELL, ORIGIN = 0.1, np.array([-2.0, -1.5])
TEMPER = 0.7


@pytest.fixture(scope="module")
def surface():
    """A smooth surface of 30 x 45 cells."""
    rough = np.random.default_rng(4).normal(size=(30, 45))
    return LogRatioGrid((4.0 * gaussian_filter(rough, 2.5)).astype(np.float32), ORIGIN, CELL)


@pytest.fixture(scope="module")
def samples():
    return np.random.default_rng(5).uniform([-0.6, -0.5], [0.7, 0.4], (15, 2))


def interpolate(surface, samples, pose):
    """The log-ratio by scipy: cells have their values in their middle, and beyond the last middles there is none."""
    at = (se2.transform(pose, samples) - surface.origin) / surface.cell - 0.5
    rows, columns = surface.log_ratio.shape
    inside = np.all((at >= 0.0) & (at < (columns - 1, rows - 1)), axis=1)
    return map_coordinates(surface.log_ratio.astype(float), at[inside, ::-1].T, order=1).sum()


def prior_exponent(window, pose):
    twist = se2.log(se2.between(window.mean, pose))
    return -0.5 * np.sum((window.information_root @ twist) ** 2)


def window_around(mean, deviations, turn=0.05):
    root = np.array([[1.0, 0.0, 0.0], [0.4, 0.8, 0.0], [-0.2, 0.3, 0.9]]) * np.array(deviations)[:, None]
    return make_search_window(np.array(mean), root @ root.T, CELL, turn, 9.0)


@pytest.mark.parametrize("pose", [(0.2, -0.1, 0.4), (0.0, 0.3, -2.0), (-1.9, -1.2, 1.0), (2.2, 1.3, 3.0)])
def test_the_log_ratio_is_interpolated_between_the_middles_of_cells(surface, samples, pose):
    found = match_modes.log_ratio_at(surface, samples, np.array(pose))
    assert found == pytest.approx(interpolate(surface, samples, pose), abs=1e-5)
    assert found != 0.0


# Where the prior is narrower than a cell, few divisions lie in its peak.
@pytest.mark.parametrize(
    ("deviations", "error"), [((0.3, 0.3, 0.2), 0.02), ((0.05, 0.08, 0.2), 0.1), ((0.3, 0.3, 0.03), 0.1)]
)
def test_a_cell_has_the_mean_of_likelihood_times_prior_and_the_best_pose_in_it(surface, samples, deviations, error):
    window = window_around((0.1, 0.05, 0.6), deviations)
    indices = np.array([[window.turns.size // 2 + k, i, j] for k, i, j in ((0, 0, 0), (1, 0, -1), (-1, 1, 0))])
    cells = SearchCells(indices, np.array([3.0, 1.0, 2.0]), np.array([0.0, -0.25, 0.0]))
    masses, poses = match_modes.integrate_cells(surface, samples, window, cells, TEMPER)
    shares = (np.arange(12) + 0.5) / 12.0 - 0.5
    for n, (k, i, j) in enumerate(indices):
        center = window.mean + np.array([i * CELL, j * CELL, window.turns[k]])
        fine = [center + np.array([CELL, CELL, 0.05]) * each for each in itertools.product(shares, repeat=3)]
        scores = np.array([TEMPER * interpolate(surface, samples, p) + prior_exponent(window, p) for p in fine])
        expected = np.logaddexp.reduce(scores) - math.log(len(scores)) + cells.contradiction[n]
        assert masses[n] == pytest.approx(expected, abs=error)
        assert (np.abs(poses[n] - center) <= np.array([0.5 * CELL, 0.5 * CELL, 0.025])).all()
        own = TEMPER * interpolate(surface, samples, poses[n]) + prior_exponent(window, poses[n])
        # Of a few dozen poses the best is hardly below the best of 1728.
        assert np.mean(scores <= own + 1e-9) > 0.9


def test_cells_beyond_the_divided_ones_count_by_their_center(surface, samples):
    window = window_around((0.1, 0.05, 0.6), (0.5, 0.5, 0.3))
    indices = np.array(list(itertools.product((5, 6, 7), range(-6, 6), range(-6, 6))))
    scores = np.arange(len(indices), dtype=float)
    masses, poses = match_modes.integrate_cells(
        surface, samples, window, SearchCells(indices, scores, np.zeros(len(indices))), TEMPER
    )
    low = scores < len(indices) - 400
    assert low.sum() == 32
    np.testing.assert_array_equal(masses[low], scores[low])
    assert not np.isin(masses[~low], scores).any()
    np.testing.assert_allclose(poses[low, :2], window.mean[:2] + CELL * indices[low, 1:])
    np.testing.assert_allclose(poses[low, 2], window.mean[2] + window.turns[indices[low, 0]])


def test_a_single_turn_has_no_step():
    several = window_around((0.0, 0.0, 0.0), (0.3, 0.3, 0.2))
    assert match_modes.turn_step(several) == pytest.approx(0.05)
    assert match_modes.turn_step(several._replace(turns=np.zeros(1))) == 0.0


def test_the_divisions_are_no_wider_than_one_and_a_half_deviations_where_seven_do():
    ratios = np.arange(0.5, 14.0, 0.5)
    counts = [match_modes._division_count(ratio) for ratio in ratios]
    assert counts == [next((n for n in (3, 5, 7) if ratio / n <= 1.5), 7) for ratio in ratios]


@pytest.mark.parametrize("start", [(0.1, 0.05, 0.6), (-0.3, 0.2, -0.5), (0.4, -0.3, 2.0)])
def test_the_peak_is_no_lower_than_all_its_neighbors(surface, samples, start):
    window, step, finest = window_around(start, (0.3, 0.3, 0.2)), np.array([0.02, 0.03, 0.04]), 1.0 / 8.0
    peak = match_modes.climb_to_peak(surface, samples, window, TEMPER, np.array(start), step, finest)

    def height(pose):
        return TEMPER * interpolate(surface, samples, pose) + prior_exponent(window, pose)

    around = [peak + finest * step * np.array(each) for each in itertools.product((-1.0, 0.0, 1.0), repeat=3)]
    assert max(map(height, around)) <= height(peak) + 1e-5
    assert height(peak) > height(np.array(start)) + 0.01


@pytest.mark.parametrize("each", [each for each in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(each)])
def test_the_first_step_leads_to_whichever_neighbor_is_highest(each):
    """A prior alone, which is wide along one direction: a step in any other one leads down."""
    flat, step = LogRatioGrid(np.zeros((5, 5), np.float32), ORIGIN, CELL), np.array([0.02, 0.03, 0.04])
    start = np.array([0.3, -0.2, -0.04 * each[2]])
    covariance = np.diag(step) @ (0.02 * np.eye(3) + 4.0 * np.outer(each, each)) @ np.diag(step)
    window = make_search_window(start + step * each, covariance, CELL, 0.05, 1e6)
    peak = match_modes.climb_to_peak(flat, np.zeros((1, 2)), window, TEMPER, start, step, 1.0)
    np.testing.assert_allclose(peak, window.mean, atol=1e-12)


@pytest.mark.parametrize("pose", [(0.2, -0.1, 0.4), (0.0, 0.3, -2.0)])
def test_the_curvature_is_that_of_finite_differences_along_the_manifold(surface, samples, pose):
    step = np.array([0.03, 0.04, 0.05])
    found = match_modes.curvature(surface, samples, np.array(pose), step)

    def height(twist):
        return interpolate(surface, samples, se2.compose(pose, se2.exp(np.array(twist))))

    for a, b in itertools.product(range(3), repeat=2):
        one, other = np.eye(3)[a] * step[a], np.eye(3)[b] * step[b]
        mixed = height(one + other) - height(one - other) - height(other - one) + height(-one - other)
        # To second order in the twist.
        expected = -mixed / (4.0 * step[a] * step[b])
        assert found[a, b] == pytest.approx(expected, rel=0.02, abs=0.02 * np.abs(found).max())


@pytest.mark.parametrize("seed", range(6))
def test_clusters_are_the_connected_parts_where_no_pass_is_low_and_each_peak_has_its_own_where_all_are(seed):
    rng = np.random.default_rng(seed)
    filled = rng.random((5, 9, 8)) < 0.2
    indices = np.argwhere(filled) - [2, 4, 4]
    score = rng.normal(size=len(indices))
    parts = label(filled, np.ones((3, 3, 3)))[0][filled]
    labels = match_modes.cluster_cells(SearchCells(indices, score, np.zeros(len(indices))), 1e9)
    tops = [score[labels == k].max() for k in range(labels.max() + 1)]
    assert tops == sorted(tops, reverse=True)
    assert len({*zip(labels.tolist(), parts.tolist(), strict=True)}) == len(set(parts.tolist())) == labels.max() + 1
    # Where each peak is a cluster: as many as cells without a higher neighbor.
    near = np.abs(indices[:, None] - indices).max(axis=2) <= 1
    peaks = [k for k in range(len(indices)) if score[k] == score[near[k]].max()]
    alone = match_modes.cluster_cells(SearchCells(indices, score, np.zeros(len(indices))), 0.0)
    assert sorted(alone[peaks].tolist()) == list(range(alone.max() + 1))
