"""Evidence and the lattice of a wide search against plain sums, on a map half of which is unknown."""

import itertools

import numpy as np
import pytest
from plain_map import plain_view
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.patches import FAR, PATCH, field_at, odds_at
from hmt_slam_ros.registration.scan_to_map import (
    Lattice,
    Prior,
    _extract_peaks,
    _find_cells,
    _log_ratio_of_cells,
    correlative_search,
    laplace_log_evidence,
    log_prior,
    make_beam_model,
    matched_fraction,
)
from hmt_slam_ros.registration.scan_to_scan import _fit_normals

CELL, RADIUS = 0.05, 0.5
MODEL = make_beam_model(RADIUS, 0.1, 10.0, 0.1)
ROOM = np.concatenate((box(-4.02, -3.03, 5.03, 4.01), box(1.01, 1.02, 2.03, 2.52)))
INFORMATION = np.array([[4.0, 1.0, 0.3], [1.0, 7.0, -0.4], [0.3, -0.4, 60.0]])


@pytest.fixture(scope="module")
def view():
    """The room, of which the ground beyond x = 1.5 and y = 1.2 is unknown."""
    return plain_view(ROOM, (-4.02, -3.03, 1.5, 1.2))


def cells_at(pose, points, view):
    return np.floor(se2.transform(pose, points) / CELL + 0.5 * view.table.shape[0] * PATCH).astype(int)


def plain_log_ratio(cells, view):
    values = [(odds_at(view, c, r) == 0, field_at(view, c, r)) for c, r in cells.tolist()]
    return sum((MODEL.in_unknown if is_unknown else MODEL.in_known)[distance] for is_unknown, distance in values)


@pytest.mark.parametrize("pose", [(0.71, -0.42, 0.4), (-1.3, 0.9, -2.0)])
def test_cells_that_are_shifted_have_the_log_ratio_of_the_shifted_pose(view, pose):
    points = scan_in(ROOM, (0.2, 0.1, 0.3), beams=41).points
    columns, rows = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    _find_cells(points, *pose, view, columns, rows)
    np.testing.assert_array_equal(np.column_stack((columns, rows)), cells_at(pose, points, view))
    for right, up in ((0, 0), (7, 0), (0, -9), (-12, 5)):
        expected = plain_log_ratio(np.column_stack((columns + right, rows + up)), view)
        assert _log_ratio_of_cells(columns, rows, right, up, view, MODEL) == pytest.approx(expected)


@pytest.mark.parametrize("pose", [(0.71, -0.42, 0.4), (0.2, 0.1, 0.3)])
def test_the_matched_share_is_that_of_points_near_surfaces(view, pose):
    points = scan_in(ROOM, (0.2, 0.1, 0.3), beams=41).points
    near = [field_at(view, c, r) < FAR // 4 for c, r in cells_at(pose, points, view).tolist()]
    assert matched_fraction(points, np.array(pose), view, FAR // 4) == pytest.approx(np.mean(near))
    assert matched_fraction(points[:0], np.array(pose), view, FAR // 4) == 0.0


@pytest.mark.parametrize("temper", [0.1, 0.7])
def test_the_evidence_is_laplaces_integral_of_prior_times_likelihood(view, temper):
    points, mode = scan_in(ROOM, (0.2, 0.1, 0.3), beams=41).points, np.array([0.33, -0.12, 0.35])
    prior = Prior(np.array([0.2, 0.1, 0.3 + 2.0 * np.pi]), INFORMATION)
    hessian = np.array([[900.0, -50.0, 20.0], [-50.0, 400.0, 70.0], [20.0, 70.0, 3000.0]])
    difference = mode - [0.2, 0.1, 0.3]
    # The density of a normal times the volume of another one.
    log_density = 0.5 * np.linalg.slogdet(INFORMATION / (2.0 * np.pi))[1] - 0.5 * difference @ INFORMATION @ difference
    log_volume = -0.5 * np.linalg.slogdet((INFORMATION + temper * hessian) / (2.0 * np.pi))[1]
    expected = log_density + log_volume + temper * plain_log_ratio(cells_at(mode, points, view), view)
    assert laplace_log_evidence(points, mode, hessian, prior, view, MODEL, temper) == pytest.approx(expected)


@pytest.mark.parametrize(("stride", "counts"), [(1, (5, 3, 2)), (3, (2, 4, 1))])
def test_correlation_finds_the_highest_peaks_of_likelihood_and_a_correlated_prior(view, stride, counts):
    points = scan_in(ROOM, (0.42, -0.37, 0.2), beams=41).points
    prior, lattice = Prior(np.array([0.61, -0.52, 0.31]), INFORMATION), Lattice(stride, 0.07, np.array(counts))
    scores = np.full([2 * n + 1 for n in counts], -np.inf)
    for steps in itertools.product(*(range(-n, n + 1) for n in counts)):
        pose = prior.mean + np.array(steps) * [stride * CELL, stride * CELL, 0.07]
        start = cells_at([*prior.mean[:2], pose[2]], points, view)
        ratio = plain_log_ratio(start + stride * np.array(steps[:2]), view)
        scores[tuple(np.add(steps, counts))] = log_prior(pose, prior) + 0.3 * ratio
    best = np.array(np.unravel_index(scores.argmax(), scores.shape)) - counts
    found = correlative_search(points, prior, lattice, view, MODEL, 0.3, 4)
    np.testing.assert_allclose(found[0], prior.mean + best * [stride * CELL, stride * CELL, 0.07])
    expected = _extract_peaks(scores, prior.mean, lattice, CELL, 4)
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize("sizes", [(9, 5, 7), (5, 11, 3), (3, 3, 3)])
def test_peaks_are_the_highest_scores_three_steps_apart_in_one_direction(sizes):
    scores = np.random.default_rng(3).normal(size=sizes)
    lattice, center = Lattice(2, 0.07, np.array(sizes) // 2), np.array([0.6, -0.5, 0.3])
    chosen = []
    for place in sorted(np.ndindex(sizes), key=lambda place: -scores[place]):
        if all(max(abs(np.subtract(place, other))) >= 3 for other in chosen):
            chosen.append(place)
    found = _extract_peaks(scores.copy(), center, lattice, CELL, 5)
    steps = (np.array(chosen[:5]) - np.array(sizes) // 2) * [2 * CELL, 2 * CELL, 0.07]
    np.testing.assert_allclose(found, center + steps)


@pytest.mark.parametrize("bearing", np.radians([0.0, 33.0, 90.0, 141.0, 180.0, -60.0, -90.0, -135.0]))
@pytest.mark.parametrize("distance", [0.3, 2.5])
def test_a_normal_points_from_the_wall_to_the_laser(bearing, distance):
    """A wall across the line of sight at a bearing, seen from a laser off the base's origin."""
    ahead, aside = np.array([np.cos(bearing), np.sin(bearing)]), np.array([-np.sin(bearing), np.cos(bearing)])
    laser, along = np.array([1.5, -0.7]), np.linspace(-0.5, 0.5, 41)
    normals, is_flat = _fit_normals(laser + distance * ahead + along[:, None] * aside, laser)
    assert is_flat.all()
    np.testing.assert_allclose(normals, np.tile(-ahead, (41, 1)), atol=1e-6)
