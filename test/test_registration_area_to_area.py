"""Area matching: the search against brute force, modes, evidence."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration import area_to_area, match_modes
from hmt_slam_ros.registration.area_to_area import MatchSettings, find_cells, match_areas
from hmt_slam_ros.registration.branch_and_bound import SearchCells
from hmt_slam_ros.registration.likelihood_grid import AreaGrid, GridModel, build_area_grid
from hmt_slam_ros.registration.position_constraint import constrain_around
from hmt_slam_ros.registration.search_bounds import LogRatioGrid

MODEL = GridModel()
HERE = np.array([True])
SETTINGS = MatchSettings()
ROOM = np.concatenate(
    (box(0.0, 0.0, 8.0, 6.0), box(2.0, 1.5, 3.0, 2.5), box(5.0, 4.0, 6.5, 4.5), np.array([[4.0, 0.0, 4.0, 1.2]]))
)
OTHER_ROOM = np.concatenate((box(0.0, 0.0, 4.0, 9.0), box(1.0, 6.0, 2.0, 8.0)))


def area(walls, poses, seed=0, **laser):
    """The grid of keyframes in the frame of the first."""
    scans = [scan_in(walls, pose, noise=0.01, seed=seed + k, **laser) for k, pose in enumerate(poses)]
    return build_area_grid(scans, se2.between(poses[0], poses), MODEL)


def poses_along(start, end, count, heading):
    x, y = np.linspace(start, end, count).T
    return np.stack((x, y, heading + 0.3 * np.sin(np.arange(count))), axis=1)


KNOWN = poses_along((1.0, 3.2), (6.5, 3.0), 9, 0.0)
VISIT = poses_along((6.0, 3.4), (3.5, 3.5), 6, 2.5)
TRUTH = se2.between(KNOWN[0], VISIT[0])


@pytest.fixture(scope="module")
def known_area():
    return area(ROOM, KNOWN, field_of_view=2 * np.pi, beams=361)


@pytest.fixture(scope="module")
def visit():
    return area(ROOM, VISIT, seed=50, field_of_view=2 * np.pi, beams=361)


def prior_around(truth, sigma, degrees, offset=(0.6, -0.8, 0.5)):
    spread = np.array([sigma, sigma, math.radians(degrees)])
    return PoseGaussian(se2.compose(truth, spread * offset), np.diag(spread**2))


def match_around(visit, known_area, prior, positions, keyframes):
    constraint = constrain_around(positions, HERE, keyframes, 0.5, known_area.cell)
    surface = LogRatioGrid(known_area.log_ratio, known_area.origin, known_area.cell)
    cells = find_cells(visit, surface, known_area.points, prior, SETTINGS, constraint=constraint)
    return match_areas(visit, known_area, prior, SETTINGS, cells=cells)


def test_poses_where_no_keyframe_is_on_the_ground_are_not_searched(known_area, visit):
    prior, at = prior_around(TRUTH, 1.0, 6.0), TRUTH[None, :2]
    keyframes = np.array([[0.0, 0.0], [50.0, 50.0]])
    free = match_areas(visit, known_area, prior, SETTINGS)
    inside = match_around(visit, known_area, prior, at, keyframes)
    assert inside.modes[0].pose.mean == pytest.approx(free.modes[0].pose.mean, abs=1e-9)
    assert inside.log_evidence <= free.log_evidence
    assert inside.work < free.work
    beside = match_around(visit, known_area, prior, at + 0.5, keyframes)
    assert -math.inf < beside.log_evidence < inside.log_evidence - 0.1
    nowhere = match_around(visit, known_area, prior, at + 30.0, keyframes[:1])
    assert nowhere.modes == ()
    assert nowhere.work < 0.1 * inside.work


def test_poses_beyond_the_bounds_are_not_searched(known_area, visit):
    prior, middle = prior_around(TRUTH, 1.0, 6.0), se2.transform(TRUTH, visit.points.mean(axis=0))
    inside = match_areas(visit, known_area, prior, SETTINGS, np.array([middle - 0.5, middle + 0.5]))
    assert np.hypot(*se2.between(inside.modes[0].pose.mean, TRUTH)[:2]) < 0.03
    beside = match_areas(visit, known_area, prior, SETTINGS, np.array([middle + 0.5, middle + 1.0]))
    assert all(np.hypot(*se2.between(mode.pose.mean, TRUTH)[:2]) > 0.3 for mode in beside.modes)
    assert match_areas(visit, known_area, prior, SETTINGS, np.array([middle + 50.0, middle + 51.0])).modes == ()


def test_poses_at_which_the_samples_fit_less_than_required_are_not_searched(known_area, visit):
    prior = prior_around(TRUTH, 1.0, 6.0)
    fits = match_areas(visit, known_area, prior, replace(SETTINGS, min_log_ratio=0.5)).modes
    assert np.hypot(*se2.between(fits[0].pose.mean, TRUTH)[:2]) < 0.03
    assert match_areas(visit, known_area, prior, replace(SETTINGS, min_log_ratio=1.2)).modes == ()


def test_a_visit_is_found_from_a_prior_of_meters(known_area, visit):
    found = match_areas(visit, known_area, prior_around(TRUTH, 1.0, 6.0), SETTINGS)
    best = found.modes[0].pose
    away = se2.log(se2.between(best.mean, TRUTH))
    assert np.hypot(*away[:2]) < 0.03
    assert abs(away[2]) < math.radians(0.5)
    assert away @ np.linalg.solve(best.covariance, away) < 7.8


def test_a_precise_prior_and_the_match_agree_to_a_centimeter(known_area, visit):
    found = match_areas(visit, known_area, prior_around(TRUTH, 0.05, 1.0, (0.0, 0.0, 0.0)), SETTINGS)
    assert np.abs(se2.log(se2.between(found.modes[0].pose.mean, TRUTH))[:2]).max() < 0.01


def test_the_right_room_beats_unknown_space_and_another_room_does_not(known_area, visit):
    stranger = area(OTHER_ROOM, poses_along((1.5, 1.0), (2.5, 7.0), 9, 1.5), field_of_view=2 * np.pi, beams=361)
    prior = prior_around(TRUTH, 1.0, 6.0)
    assert match_areas(visit, known_area, prior, SETTINGS).log_evidence > 5.0
    assert match_areas(visit, stranger, prior, SETTINGS).log_evidence < -2.0


def test_the_evidence_is_the_mean_of_the_likelihood_over_the_prior(known_area, visit):
    """Against plain Monte Carlo, for a prior narrow enough that its samples meet the peak."""
    prior = prior_around(TRUTH, 0.12, 2.0)
    rng = np.random.default_rng(3)
    twists = rng.standard_normal((4000, 3)) @ np.linalg.cholesky(prior.covariance).T
    fine = LogRatioGrid(known_area.fine_log_ratio, known_area.origin, 0.5 * known_area.cell)
    forward = [
        SETTINGS.temper * match_modes.log_ratio_at(fine, visit.points, pose)
        for pose in se2.compose(prior.mean, se2.exp(twists))
    ]
    expected = np.logaddexp.reduce(forward) - math.log(len(forward))
    found = match_areas(visit, known_area, prior, SETTINGS).log_evidence
    # The reverse check, which the samples leave out, can only lower it.
    assert expected - 1.5 < found < expected + 0.2


@pytest.mark.parametrize(
    "root", [np.diag([0.3, 0.2, 0.1]), np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [0.05, -0.03, 0.1]])]
)
def test_where_nothing_is_known_the_prior_stands(visit, root):
    coarse, fine = (np.zeros((size, size), np.float32) for size in (100, 200))
    blank = AreaGrid(np.array([-10.0, -10.0]), 0.1, coarse, fine, coarse > 0.0, np.array([[-9.5, -9.5]]))
    prior = PoseGaussian(np.array([0.5, -0.3, 0.8]), root @ root.T)
    found = match_areas(visit, blank, prior, SETTINGS)
    assert found.log_evidence == pytest.approx(math.log(chi2.cdf(SETTINGS.gate, 3)), abs=0.03)
    (mode,) = found.modes
    assert mode.log_mass == pytest.approx(found.log_evidence, abs=1e-9)
    np.testing.assert_allclose(mode.pose.mean, prior.mean, atol=0.005)
    floor = np.diag([0.01, 0.01, math.radians(0.2)]) ** 2
    scale = np.sqrt(np.outer(*[np.diag(prior.covariance)] * 2))
    np.testing.assert_allclose((mode.pose.covariance - prior.covariance - floor) / scale, 0.0, atol=0.03)
    # Without the prior, a hundredth of its information is left.
    np.testing.assert_allclose((mode.measured.covariance - 100.0 * prior.covariance) / scale, 0.0, atol=3.0)


@pytest.mark.parametrize(("margin", "is_found"), [(0.5, True), (-0.5, False)])
def test_where_no_pose_can_have_a_hundred_thousandth_of_the_mass_there_is_no_evidence(visit, margin, is_found):
    root = np.diag([1.5, 1.0, 0.4])
    prior = PoseGaussian(np.array([0.5, -0.3, 0.8]), root @ root.T)
    turn = area_to_area._turn_step(0.1, visit.points - visit.points.mean(axis=0))
    log_share = math.log(0.1**2 * turn * multivariate_normal(np.zeros(3), prior.covariance).pdf(np.zeros(3)))
    score = math.log(1e-5) - log_share + margin
    assert score < 0.0
    coarse, fine = (
        np.full((size, size), score / len(visit.points) / SETTINGS.temper, np.float32) for size in (300, 600)
    )
    alike = AreaGrid(np.array([-15.0, -15.0]), 0.1, coarse, fine, coarse > 0.0, np.array([[-14.5, -14.5]]))
    assert math.isfinite(match_areas(visit, alike, prior, SETTINGS).log_evidence) == is_found


def test_a_turn_moves_nine_samples_of_ten_by_a_cell_at_most():
    samples = np.random.default_rng(7).uniform(-9.0, 9.0, (500, 2))
    turn = area_to_area._turn_step(0.1, samples)
    moved = np.hypot(*(se2.transform((0.0, 0.0, turn), samples) - samples).T)
    assert np.quantile(moved, 0.9) == pytest.approx(0.1)
    assert area_to_area._turn_step(0.1, 0.1 * samples) == math.radians(2.0)
    assert area_to_area._turn_step(0.1, 100.0 * samples) == math.radians(0.2)


def test_a_wider_prior_costs_evidence(known_area, visit):
    evidence = [
        match_areas(visit, known_area, prior_around(TRUTH, s, 10 * s), SETTINGS).log_evidence for s in (0.2, 0.5, 1.0)
    ]
    assert evidence[0] > evidence[1] > evidence[2]


def test_each_of_three_like_niches_comes_back_as_a_mode():
    """A corridor with equal niches every 3 m: a visit to one of them fits all of them."""
    corridor = np.array([[-2.0, 0.0, 11.0, 0.0]])
    niches = [
        np.array(
            [
                [x, 2.0, x + 2.0, 2.0],
                [x + 2.0, 2.0, x + 2.0, 3.0],
                [x + 2.0, 3.0, x + 3.0, 3.0],
                [x + 3.0, 3.0, x + 3.0, 2.0],
            ]
        )
        for x in (-3.0, 0.0, 3.0, 6.0, 9.0)
    ]
    walls = np.concatenate((corridor, *niches))
    known_area = area(walls, poses_along((0.0, 1.0), (8.0, 1.0), 12, 0.0), field_of_view=2 * np.pi, beams=361)
    poses = poses_along((4.0, 1.0), (5.0, 1.0), 3, 0.0)
    scans = [scan_in(walls, pose, seed=k, field_of_view=2 * np.pi, beams=361) for k, pose in enumerate(poses)]
    visit = build_area_grid(scans, se2.between(poses[0], poses), GridModel(max_range=2.5))
    truth = np.array([4.0, 0.0, 0.0])
    found = match_areas(visit, known_area, prior_around(truth, 1.6, 3.0, (0.0, 0.0, 0.0)), SETTINGS)
    heavy = [mode for mode in found.modes if mode.log_mass > found.modes[0].log_mass - 4.0]
    assert np.allclose(sorted(mode.pose.mean[0] for mode in heavy), [1.0, 4.0, 7.0], atol=0.2)
    assert found.modes[0].pose.mean[0] == pytest.approx(4.0, abs=0.1)


def test_a_corridor_without_features_leaves_the_pose_along_it_open():
    walls = np.array([[-30.0, 0.0, 40.0, 0.0], [-30.0, 2.0, 40.0, 2.0]])
    known_area = area(walls, poses_along((0.0, 1.0), (8.0, 1.0), 12, 0.0))
    visit = area(walls, poses_along((4.0, 1.0), (6.0, 1.0), 5, 0.0), seed=9)
    prior = prior_around(np.array([4.0, 0.0, 0.0]), 0.5, 2.0, (0.0, 0.0, 0.0))
    mode = match_areas(visit, known_area, prior, SETTINGS).modes[0]
    sigma = np.sqrt(np.diag(mode.pose.covariance))
    assert sigma[0] > 0.2
    assert sigma[1] < 0.1


def test_a_wall_of_the_candidate_in_the_free_space_of_the_query_speaks_against_it(known_area):
    """The visit sees through where the known room has a wall, but has no surface of its own there."""
    emptied = np.concatenate((box(0.0, 0.0, 8.0, 6.0), np.array([[4.0, 0.0, 4.0, 1.2]])))
    emptied_visit = area(emptied, VISIT, seed=70, field_of_view=2 * np.pi, beams=361)
    same_visit = area(ROOM, VISIT, seed=70, field_of_view=2 * np.pi, beams=361)
    prior = prior_around(TRUTH, 0.2, 2.0)
    assert match_areas(emptied_visit, known_area, prior, SETTINGS).log_evidence < (
        match_areas(same_visit, known_area, prior, SETTINGS).log_evidence - 2.0
    )


def test_an_empty_query_has_no_information(known_area):
    blank = build_area_grid([], np.zeros((0, 3)), MODEL)
    found = match_areas(blank, known_area, prior_around(TRUTH, 0.2, 2.0), SETTINGS)
    assert (found.log_evidence, found.modes) == (-math.inf, ())


def test_peaks_apart_are_two_clusters_and_ripples_are_one():
    steps = np.arange(40)
    score = -0.5 * np.minimum(np.abs(steps - 8), np.abs(steps - 30)) ** 2 * 0.3 + 0.8 * (steps % 2)
    cells = SearchCells(np.stack((np.zeros(40, int), steps, np.zeros(40, int)), axis=1), score, np.zeros(40))
    labels = match_modes.cluster_cells(cells, 3.0)
    assert labels.max() == 1
    assert labels[8] != labels[30]
    assert labels[6] == labels[8] == labels[10]


def test_the_same_problem_has_the_same_answer_to_the_bit(known_area, visit):
    first, second = (match_areas(visit, known_area, prior_around(TRUTH, 0.5, 4.0), SETTINGS) for _ in range(2))
    assert first.log_evidence == second.log_evidence
    assert all(np.array_equal(a.pose.mean, b.pose.mean) for a, b in zip(first.modes, second.modes, strict=True))


def corridor(pillars, seed):
    """A mapped corridor along x, and another drive through its middle; with pillars on a side at some x."""
    sides = [np.array([[-30.0, y, 30.0, y]]) for y in (-1.0, 1.0)]
    boxes = [box(x - 0.3, 0.7, x + 0.3, 1.2) for x in pillars]
    walls = np.concatenate(sides + boxes)
    known = area(walls, poses_along((-6.0, 0.1), (6.0, -0.1), 14, 0.0), seed, beams=181)
    return known, area(walls, poses_along((-1.0, -0.1), (1.0, 0.2), 4, 0.0), seed + 40, beams=181)


@pytest.mark.parametrize("seed", range(3))
def test_where_noise_alone_tells_where_along_a_corridor_the_match_is_open_and_pillars_close_it(seed):
    def deviation(pillars, *, resampled):
        known, query = corridor(pillars, seed)
        prior = PoseGaussian(np.array([5.0, 0.0, 0.0]), np.diag([1.5, 0.2, 0.05]) ** 2)
        result, _ = area_to_area._search(query, known, prior, replace(SETTINGS, temper=0.3))
        result = area_to_area._resample_surfaces(result) if resampled else result
        shares = np.exp(result.masses - np.logaddexp.reduce(result.masses))
        return float(np.sqrt(shares @ (result.poses[:, 0] - shares @ result.poses[:, 0]) ** 2))

    bare, pillars = (), (-2.5, -0.6, 1.1, 2.9)
    for sides in (bare, pillars):
        assert deviation(sides, resampled=True) > deviation(sides, resampled=False)
    assert deviation(pillars, resampled=True) < 0.5 * deviation(bare, resampled=True)


@pytest.mark.parametrize("most", [20, 2000])
def test_resampled_surfaces_keep_the_sum_of_all_masses(visit, known_area, most, monkeypatch):
    monkeypatch.setattr(area_to_area, "_RESAMPLED_CELLS", most)
    result, _ = area_to_area._search(visit, known_area, prior_around(TRUTH, 0.5, 5.0), SETTINGS)
    resampled = area_to_area._resample_surfaces(result)
    assert np.logaddexp.reduce(resampled.masses) == pytest.approx(np.logaddexp.reduce(result.masses))
    assert np.array_equal(resampled.cells.score, resampled.masses)
    assert (resampled.masses != result.masses).sum() == min(most, len(result.masses))


def test_the_parts_of_stretches_sum_to_the_log_ratio(visit, known_area):
    fine = LogRatioGrid(known_area.fine_log_ratio, known_area.origin, 0.05)
    stretches, count = area_to_area._divide_into_stretches(visit.points)
    parts = match_modes.stretch_log_ratios(fine, visit.points, stretches, count, TRUTH[None])
    assert parts.shape == (1, count)
    assert parts.sum() == pytest.approx(match_modes.log_ratio_at(fine, visit.points, TRUTH))
    for number in range(count):
        spread = np.ptp(visit.points[stretches == number], axis=0)
        assert (spread <= 1.0).all()
