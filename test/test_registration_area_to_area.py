"""Area matching: the search against brute force, modes, evidence."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration import match_modes
from hmt_slam_ros.registration.area_to_area import MatchSettings, match_areas
from hmt_slam_ros.registration.branch_and_bound import SearchCells, constrain_around, search_cells
from hmt_slam_ros.registration.likelihood_grid import GridModel, build_area_grid
from hmt_slam_ros.registration.search_bounds import LogRatioGrid, make_search_window

MODEL = GridModel()
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


def brute_force(window, surface, samples, back, back_samples, temper):
    """Score of every cell within the gate, one by one: {(k, i, j): score}."""

    def reads(surface, points, only_negative):
        cells = np.floor((points - surface.origin) / surface.cell).astype(int)
        inside = np.all((cells >= 0) & (cells < surface.log_ratio.shape[::-1]), axis=1)
        values = surface.log_ratio[cells[inside, 1], cells[inside, 0]].astype(float)
        return np.minimum(values, 0.0).sum() if only_negative else values.sum()

    scores = {}
    (left, low), (right, high) = window.first, window.last
    spans = range(window.turns.size), range(left, right + 1), range(low, high + 1)
    for k, i, j in itertools.product(*spans):
        pose = window.mean + np.array([i * window.cell, j * window.cell, window.turns[k]])
        twist = se2.log(se2.between(window.mean, pose))
        exponent = float(np.sum((window.information_root @ twist) ** 2))
        if exponent <= window.gate:
            forward = reads(surface, se2.transform(pose, samples), False)
            backward = reads(back, se2.transform(se2.inverse(pose), back_samples), True)
            scores[k, i, j] = temper * (forward + backward) - 0.5 * exponent
    return scores


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_the_search_finds_exactly_the_cells_that_brute_force_finds(seed, bounded):
    rng = np.random.default_rng(seed)
    grids = [rng.normal(size=(rng.integers(8, 40), rng.integers(8, 40))).astype(np.float32) for _ in range(2)]
    surface, back = (
        LogRatioGrid(g, rng.uniform(-2.5, -1.0, 2), cell) for g, cell in zip(grids, (0.1, 0.13), strict=True)
    )
    samples, back_samples = rng.uniform(-1.5, 1.5, (25, 2)), rng.uniform(-1.5, 1.5, (20, 2))
    root = rng.normal(size=(3, 3)) * [[0.25], [0.25], [0.15]]
    mean, bounds = rng.uniform(-1.0, 1.0, 3), np.array([[-0.6, -1.2], [0.9, 0.5]])
    window = make_search_window(mean, root @ root.T + 1e-4 * np.eye(3), 0.1, 0.05, 9.0, bounds if bounded else None)
    expected = brute_force(window, surface, samples, back, back_samples, 0.5)
    best = max(expected.values())
    expected = {cell: score for cell, score in expected.items() if score >= best - 4.0}
    found = search_cells(window, surface, samples, back, back_samples, 0.5, -100.0, 4.0)
    scores = {tuple(cell): score for cell, score in zip(found.indices.tolist(), found.score, strict=True)}
    # A sample within rounding of a cell's edge may be read one cell off.
    shared = scores.keys() & expected.keys()
    assert len(shared) >= 0.97 * max(len(scores), len(expected))
    differences = np.array([abs(scores[cell] - expected[cell]) for cell in shared])
    assert np.mean(differences < 1e-5) > 0.97


def test_poses_where_no_keyframe_is_on_the_ground_are_not_searched(known_area, visit):
    prior, at = prior_around(TRUTH, 1.0, 6.0), TRUTH[None, :2]
    keyframes = np.array([[0.0, 0.0], [50.0, 50.0]])
    free = match_areas(visit, known_area, prior, SETTINGS)
    inside = match_areas(
        visit, known_area, prior, SETTINGS, constraint=constrain_around(at, keyframes, 0.5, known_area.cell)
    )
    assert inside.modes[0].pose.mean == pytest.approx(free.modes[0].pose.mean, abs=1e-9)
    assert inside.log_evidence <= free.log_evidence
    beside = match_areas(
        visit, known_area, prior, SETTINGS, constraint=constrain_around(at + 1.0, keyframes, 0.5, known_area.cell)
    )
    assert all(np.hypot(*(mode.pose.mean[:2] - TRUTH[:2] - 1.0)) < 0.8 for mode in beside.modes)
    nowhere = constrain_around(at + 30.0, keyframes[:1], 0.5, known_area.cell)
    assert match_areas(visit, known_area, prior, SETTINGS, constraint=nowhere).modes == ()


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
