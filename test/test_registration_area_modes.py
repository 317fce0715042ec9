"""The parts of area matching against plain references: points in reach, peaks, covariances and masses of modes."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import chi2
from test_registration_match_modes import CELL, TEMPER, interpolate, prior_exponent, window_around

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration import area_to_area, match_modes
from hmt_slam_ros.registration.area_to_area import MatchMode, MatchSettings
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.registration.search_window import make_search_window

SETTINGS = MatchSettings(temper=TEMPER)
TO_MIDDLE = PoseGaussian.from_pose(np.array([0.7, -0.4, 0.0]))


@pytest.fixture(scope="module")
def surface():
    rough = np.random.default_rng(4).normal(size=(30, 45))
    return LogRatioGrid((4.0 * gaussian_filter(rough, 2.5)).astype(np.float32), np.array([-2.0, -1.5]), CELL)


def make_problem(surface, mean, deviations=(0.3, 0.2, 0.2)):
    samples = np.random.default_rng(5).uniform([-0.6, -0.5], [0.7, 0.4], (15, 2))
    window = window_around(mean, deviations)
    prior = PoseGaussian(window.mean, np.linalg.inv(window.information_root.T @ window.information_root))
    return area_to_area._MatchProblem(surface, samples, window, prior, SETTINGS, TO_MIDDLE)


def empty_grid(rows, columns, cell, origin):
    coarse, fine = np.zeros((rows, columns), np.float32), np.zeros((2 * rows, 2 * columns), np.float32)
    return AreaGrid(np.array(origin), cell, coarse, fine, coarse > 0.0, np.zeros((1, 2)))


@pytest.mark.parametrize("bounds", [None, np.array([[0.9, -3.4], [9.0, 1.0]]), np.array([[-9.0, -9.0], [2.6, 9.0]])])
@pytest.mark.parametrize("origin", [(-1.0, -1.5), (-4.0, -0.5), (0.5, 0.2)])
def test_points_in_reach_are_those_within_the_farthest_corner_and_shift(bounds, origin):
    """No point that meets the query's grid at any pose is left out, and no point is farther than both can explain."""
    mean = np.array([1.7, -2.6, 2.2])
    window = make_search_window(mean, np.diag([0.3, 0.15, 0.1]) ** 2, 0.1, 0.08, 9.0, bounds)
    query = empty_grid(12, 31, 0.11, origin)
    points = np.random.default_rng(6).uniform(-9.0, 9.0, (4000, 2)) + mean[:2]
    near = area_to_area._reachable_points(points, window, query)
    size = 0.11 * np.array([31, 12])
    corner = max(np.hypot(*(query.origin + size * each)) for each in itertools.product((0, 1), repeat=2))
    shifts = [0.1 * np.array(each) for each in itertools.product(*zip(window.first, window.last, strict=True))]
    assert {tuple(p) for p in near} == {
        tuple(p) for p in points if math.dist(p, mean[:2]) <= corner + np.hypot(*np.abs(shifts).max(axis=0))
    }
    for k, shift in itertools.product(range(window.turns.size), shifts):
        at = se2.transform(se2.inverse([*(mean[:2] + shift), mean[2] + window.turns[k]]), points)
        meets = np.all((at >= query.origin) & (at < query.origin + size), axis=1)
        assert {tuple(p) for p in points[meets]} <= {tuple(p) for p in near}


@pytest.mark.parametrize("mean", [(0.1, 0.05, 0.6), (-0.3, 0.2, -0.5), (0.4, -0.3, 2.0)])
def test_the_peak_of_a_cluster_is_that_of_its_heaviest_cell_to_an_eighth_of_a_sixth_of_a_cell(surface, mean):
    problem = make_problem(surface, mean)
    poses = se2.compose(np.array(mean), np.array([[0.3, 0.2, 0.1], [0.02, -0.03, 0.01], [-0.3, 0.1, -0.1]]))
    masses = np.array([-3.0, -1.0, -2.0])
    peak = area_to_area._find_peak(problem, masses, poses)
    # An angle moves the samples as far in the quadratic mean.
    lever = math.sqrt(np.mean(problem.samples[:, 0] ** 2 + problem.samples[:, 1] ** 2))
    step = CELL / 6.0 * np.array([1.0, 1.0, 1.0 / lever])
    assert area_to_area._radian_step(problem, 0.02) == pytest.approx(0.02 / lever)
    assert area_to_area._radian_step(problem, 3.0) == 1.0

    def height(pose):
        return TEMPER * interpolate(surface, problem.samples, pose) + prior_exponent(problem.window, pose)

    around = [peak + step / 8.0 * np.array(each) for each in itertools.product((-1.0, 0.0, 1.0), repeat=3)]
    assert max(map(height, around)) <= height(peak) + 1e-6
    assert height(peak) >= height(poses[1])
    # On the lattice of the smallest steps from the heaviest cell.
    steps = (peak - poses[1]) / (step / 8.0)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)
    assert (np.round(steps) % 2 != 0).any()


def test_a_mode_has_the_information_of_prior_and_curvature_and_the_mass_of_its_cells(surface):
    problem = make_problem(surface, (0.1, 0.05, 0.6))
    poses = se2.compose(problem.window.mean, np.array([[0.02, -0.03, 0.01], [0.3, -0.35, 0.1], [-0.35, 0.25, -0.12]]))
    masses = np.array([-1.0, -1.6, -1.3])
    mode = area_to_area._fit_mode(problem, masses, poses)
    peak = area_to_area._find_peak(problem, masses, poses)
    np.testing.assert_allclose(mode.pose.mean, peak)
    np.testing.assert_allclose(mode.measured.mean, peak)
    assert mode.log_mass == pytest.approx(math.log(sum(np.exp(masses))))
    step = 0.3 * CELL * np.array([1.0, 1.0, 1.0 / math.sqrt(np.mean(np.sum(problem.samples**2, axis=1)))])
    curvature = match_modes.curvature(surface, problem.samples, peak, step)
    by_match = plain_positive_part(TEMPER * curvature)
    ad = se2.adjoint(se2.between(peak, problem.prior.mean))
    by_prior = np.linalg.inv(ad @ problem.prior.covariance @ ad.T)
    both = np.linalg.inv(by_match + by_prior)
    offsets, weights = se2.log(se2.between(peak, poses)), np.exp(masses) / np.exp(masses).sum()
    second = sum(w * np.outer(offset, offset) for w, offset in zip(weights, offsets, strict=True))
    lattice = np.diag([CELL, CELL, 0.05]) ** 2 / 12.0
    spread = plain_positive_part(second - both - lattice)
    floor = np.diag([0.01, 0.01, math.radians(0.2)]) ** 2
    assert np.abs(spread).max() > 1e-3
    np.testing.assert_allclose(mode.pose.covariance, both + spread + floor, rtol=1e-9, atol=1e-12)
    alone = np.linalg.inv(by_match + 0.01 * by_prior)
    np.testing.assert_allclose(mode.measured.covariance, alone + spread + floor, rtol=1e-9, atol=1e-12)


def plain_positive_part(matrix):
    """The nearest positive semidefinite matrix, with angles as the meters by which they move a point 10 m away."""
    scaled = np.diag([1.0, 1.0, 10.0]) @ matrix @ np.diag([1.0, 1.0, 10.0])
    values, vectors = np.linalg.eigh(scaled)
    kept = sum(max(0.0, value) * np.outer(vector, vector) for value, vector in zip(values, vectors.T, strict=True))
    return np.diag([1.0, 1.0, 0.1]) @ kept @ np.diag([1.0, 1.0, 0.1])


def test_the_positive_part_leaves_out_the_negative_directions():
    root = np.random.default_rng(7).normal(size=(3, 3))
    positive, mixed = root @ root.T, 0.5 * (root + root.T)
    np.testing.assert_allclose(area_to_area._positive_part(positive), positive)
    np.testing.assert_allclose(area_to_area._positive_part(-positive), 0.0, atol=1e-12)
    np.testing.assert_allclose(area_to_area._positive_part(root), plain_positive_part(mixed))


def test_the_mass_of_a_cell_is_the_density_at_the_mean_times_its_volume():
    root = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [0.05, -0.03, 0.1]])
    prior = PoseGaussian(np.array([0.5, -0.3, 0.8]), root @ root.T)
    density = 1.0 / math.sqrt((2.0 * math.pi) ** 3 * np.linalg.det(prior.covariance))
    assert area_to_area._log_cell_mass(prior, 0.2, 0.03) == pytest.approx(math.log(density * 0.2**2 * 0.03))


@pytest.mark.parametrize(("configured", "most"), [(2, 8), (4, 8), (5, 10), (7, 14)])
def test_a_search_has_the_options_and_twice_the_modes_but_no_fewer_than_eight(configured, most):
    options = replace(Configuration().tsbi, temper=0.23, gate_probability=0.98, max_modes=configured)
    found = MatchSettings.from_options(options)
    assert (found.temper, found.max_modes, found.margin) == (0.23, most, 20.0)
    assert found.gate == pytest.approx(chi2.ppf(0.98, 3))


def mode_at(x, log_mass, sigma=0.1):
    pose = np.array([x, -0.2, 0.4])
    measured = PoseGaussian(pose, 2.0 * sigma**2 * np.eye(3))
    return MatchMode(PoseGaussian(pose, sigma**2 * np.eye(3)), measured, log_mass)


@pytest.mark.parametrize(("share", "count"), [(0.99, 2), (1.01, 3)])
def test_modes_within_the_gate_of_each_other_are_one(share, count):
    """The third mode is the same as the second, or just beyond its gate, which is at 95 of 100."""
    apart = share * math.sqrt(2.0 * 0.1**2 * chi2.ppf(0.95, 3))
    first, second = mode_at(0.0, -0.5), mode_at(5.0, -1.0)
    third = mode_at(5.0 + apart * math.cos(0.4), -1.7)
    third = third._replace(
        pose=PoseGaussian(se2.compose(second.pose.mean, [apart, 0.0, 0.0]), third.pose.covariance),
        measured=PoseGaussian(se2.compose(second.pose.mean, [apart, 0.0, 0.0]), third.measured.covariance),
    )
    modes = []
    for mode in (first, second, third):
        area_to_area._add_or_merge(modes, mode)
    assert len(modes) == count
    assert modes[0] is first
    if count == 2:
        merged, weights = modes[1], np.exp([-1.0, -1.7]) / np.exp([-1.0, -1.7]).sum()
        assert merged.log_mass == pytest.approx(math.log(math.exp(-1.0) + math.exp(-1.7)))
        np.testing.assert_array_equal(merged.pose.mean, second.pose.mean)
        for belief, variance in ((merged.pose, 0.01), (merged.measured, 0.02)):
            ad = se2.adjoint([apart, 0.0, 0.0])
            spread = weights[0] * np.eye(3) * variance + weights[1] * variance * ad @ ad.T
            spread[0, 0] += weights[1] * apart**2
            np.testing.assert_allclose(belief.covariance, spread, atol=1e-9)


def test_modes_are_in_the_frame_of_the_query():
    mode = area_to_area._mode_in_query_frame(mode_at(1.0, -0.5), TO_MIDDLE)
    np.testing.assert_allclose(se2.compose(mode.pose.mean, TO_MIDDLE.mean), [1.0, -0.2, 0.4])
    ad = se2.adjoint(TO_MIDDLE.mean)
    np.testing.assert_allclose(mode.pose.covariance, 0.01 * ad @ ad.T)
    np.testing.assert_allclose(mode.measured.mean, mode.pose.mean)
    np.testing.assert_allclose(mode.measured.covariance, 2.0 * mode.pose.covariance)
    assert mode.log_mass == -0.5
