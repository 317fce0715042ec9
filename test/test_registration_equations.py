"""Equations of registration against plain ones, on a map without a pool, so that kernels need not be compiled."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_map import plain_view
from scipy.stats import chi2, norm
from worlds import box, drive, scan_in, two_rooms

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import write_to_array
from hmt_slam_ros.grids.patches import FAR, PATCH, field_at, odds_at
from hmt_slam_ros.registration.dynamic_rejection import _segment_starts, reject_dynamic
from hmt_slam_ros.registration.match_covariance import MatchNoise, estimate_match_error
from hmt_slam_ros.registration.scan_to_map import (
    AlignmentSettings,
    Lattice,
    Prior,
    align,
    correlative_search,
    count_agreement,
    linearize,
    log_prior,
    log_ratio,
    make_beam_model,
    misfit,
)
from hmt_slam_ros.registration.scan_to_scan import Weighting, bin_index, extract_surfaces, normal_equations
from hmt_slam_ros.sensors.scan import extract_surfels

CELL, RADIUS = 0.05, 0.5
MODEL = make_beam_model(RADIUS, 0.1, 10.0, 0.1)
ALIGNMENT = AlignmentSettings(0.1, 0.15, 1.0, 30)
ROOM = np.concatenate((box(-4.02, -3.03, 5.03, 4.01), box(1.01, 1.02, 2.03, 2.52), box(-3.02, 2.03, -2.52, 4.01)))
CORRIDOR = np.array([[-12.0, -1.22, 12.0, -1.22], [-12.0, 1.22, 12.0, 1.22]])
STEP = np.array([0.12, 0.0, 0.0])


def scan_surfels(walls, pose, **laser):
    """The surfels of a scan."""
    scan = scan_in(walls, pose, **laser)
    return extract_surfels(scan.points, scan.origins)


def person(x, y):
    return box(x - 0.2, y - 0.2, x + 0.2, y + 0.2)


@pytest.fixture(scope="module")
def room():
    return plain_view(ROOM, (-4.02, -3.03, 5.03, 4.01))


def plain_log_ratio(points, pose, view):
    total = 0.0
    for x, y in se2.transform(pose, points):
        column, row = (int(v / CELL + 0.5 * view.table.shape[0] * PATCH) for v in (x, y))
        table = MODEL.in_unknown if odds_at(view, column, row) == 0 else MODEL.in_known
        total += table[field_at(view, column, row)]
    return total


@settings(max_examples=30)
@given(st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3)))
def test_the_likelihood_ratio_equals_the_plain_sum(room, pose):
    points = scan_in(ROOM, (0.2, 0.1, 0.3), beams=31).points
    assert log_ratio(points, *pose, room, MODEL) == pytest.approx(plain_log_ratio(points, np.array(pose), room))


def plain_misfit(points, pose, prior, view, settings):
    """Cauchy's cost of bilinear distances, each point by itself."""
    cost, center = 0.0, 0.5 * view.table.shape[0] * PATCH - 0.5
    for point in se2.transform(pose, points[:, :2]):
        distance = plain_distance(point, view)
        if odds_at(view, *np.round(point / CELL + center).astype(int)) == 0:
            distance = min(distance, 0.6 * settings.robust_scale)
        cost += 0.5 * settings.robust_scale**2 * np.log1p((distance / settings.robust_scale) ** 2)
    difference = pose - prior.mean
    return cost / (settings.inflation * settings.sigma**2) + 0.5 * difference @ prior.information @ difference


def plain_distance(point, view):
    """Bilinear distance at a point, m, by the middles of four cells."""
    u, v = point / CELL + 0.5 * view.table.shape[0] * PATCH - 0.5
    corners = [(int(np.floor(u)) + i, int(np.floor(v)) + j) for i in (0, 1) for j in (0, 1)]
    return sum((1 - abs(u - c)) * (1 - abs(v - r)) * field_at(view, c, r) for c, r in corners) * RADIUS / FAR


@pytest.mark.parametrize("pose", [(0.2, 0.1, 0.3), (0.43, -0.57, -1.0), (0.5, 0.4, 2.0)])
@pytest.mark.parametrize("has_normals", [False, True])
def test_the_normal_equations_are_those_of_numeric_derivatives(room, pose, has_normals):
    points = scan_surfels(ROOM, (0.2, 0.1, 0.3), beams=61)
    points[:, 2:] *= has_normals
    information, pull, square = np.zeros((3, 3)), np.zeros(3), 0.0
    for point in points:
        at, turned = se2.transform(pose, point[:2]), se2.transform((0.0, 0.0, pose[2]), point[:2])
        distance, step = plain_distance(at, room), 1e-6
        if distance >= RADIUS * (FAR - 1) / FAR:
            continue
        slope = np.array([plain_distance(at + e, room) - plain_distance(at - e, room) for e in step * np.eye(2)])
        slope /= 2.0 * step
        weight = 1.0 / (1.0 + (distance / ALIGNMENT.robust_scale) ** 2) / ALIGNMENT.sigma**2
        if has_normals and point[2:].any():
            normal = se2.transform((0.0, 0.0, pose[2]), point[2:])
            distance *= abs(slope @ normal)
            slope = (slope @ normal) * normal
        jacobian = np.array([*slope, turned[0] * slope[1] - turned[1] * slope[0]])
        information += weight * np.outer(jacobian, jacobian)
        pull += weight * distance * jacobian
        square += weight * distance**2
    sums, gradient, total = linearize(points, *pose, room, ALIGNMENT)
    found = np.empty((3, 3))
    write_to_array(sums, found)
    np.testing.assert_allclose(found, information, rtol=1e-4, atol=1e-4 * np.abs(information).max())
    np.testing.assert_allclose(gradient, pull, rtol=1e-4, atol=1e-4 * np.abs(pull).max())
    assert total == pytest.approx(square, rel=1e-4)


@pytest.mark.parametrize("inflation", [1.0, 7.0])
@pytest.mark.parametrize("pose", [(0.2, 0.1, 0.3), (0.5, -0.6, -1.0), (6.0, 3.0, 2.0)])
def test_the_misfit_is_cauchys_cost_of_correlated_points_and_that_of_the_prior(room, pose, inflation):
    points = scan_surfels(ROOM, (0.2, 0.1, 0.3), beams=61)
    settings, pose = ALIGNMENT._replace(inflation=inflation), np.array(pose)
    prior = Prior(np.array([0.3, 0.2, 0.1]), np.array([[4.0, 1.0, 0.3], [1.0, 5.0, -0.4], [0.3, -0.4, 6.0]]))
    assert misfit(points, pose, prior, room, settings) == pytest.approx(
        plain_misfit(points, pose, prior, room, settings)
    )
    assert misfit(points[:0], pose, prior, room, settings) == pytest.approx(-log_prior(pose, prior))


def test_correlation_finds_the_best_pose_of_its_grid(room):
    truth = np.array([0.4, -0.4, 0.2])
    points = scan_in(ROOM, truth, beams=61).points
    prior = Prior(truth + np.array([0.3, -0.3, 0.2]), np.diag([0.1, 0.1, 0.1]))
    best, *others = correlative_search(points, prior, Lattice(2, 0.05, np.array([4, 2, 5])), room, MODEL, 0.1, 3)
    scores = {}
    for i in range(-4, 5):
        for j in range(-2, 3):
            for k in range(-5, 6):
                pose = prior.mean + np.array([0.1 * i, 0.1 * j, 0.05 * k])
                offset = pose - prior.mean
                scores[tuple(pose)] = 0.1 * log_ratio(points, *pose, room, MODEL) - 0.05 * offset @ offset
    np.testing.assert_allclose(best, max(scores, key=scores.get), atol=1e-9)
    assert np.hypot(*(best - truth)[:2]) < 0.15
    assert len(others) == 2
    for other in others:
        assert (np.abs(other - best) > [0.25, 0.25, 0.12]).any()


def segments_of(points):
    """The points of each run without a gap of 0.1 m and 5 % of the range."""
    gaps = np.hypot(*np.diff(points[:, :2], axis=0).T) > 0.1 + 0.05 * np.hypot(*points[1:, :2].T)
    return np.split(np.arange(len(points)), np.flatnonzero(gaps) + 1)


def draw_chi_square(information, gradient, covariance, shift):
    """Chi-square of the gradient of a segment at a pose with an error of N(shift, covariance)."""
    draw = gradient + information @ shift
    return draw @ np.linalg.solve(information @ covariance @ information + information + 1e-6 * np.eye(3), draw)


def plain_rejection(points, pose, prior, view, settings):
    """The points that stay; for each segment, all else is summed from the start."""
    plain, gate = AlignmentSettings(settings.sigma * np.sqrt(settings.inflation), np.inf, 1.0, 1), chi2.ppf(0.999, 3)
    segments, equations = segments_of(points), []
    for own in segments:
        information = np.empty((3, 3))
        sums, gradient, _ = linearize(points[own], *pose, view, plain)
        write_to_array(sums, information)
        equations.append((information, np.array(gradient)))
    off = prior.mean - pose
    suspects = [
        k for k, each in enumerate(equations) if draw_chi_square(*each, np.linalg.inv(prior.information), off) > gate
    ]
    kept = set(range(len(segments)))
    while True:
        found = {}
        for k in kept.intersection(suspects):
            others = [equations[n] for n in kept - {k}]
            covariance = np.linalg.inv(prior.information + sum(information for information, _ in others))
            pull = prior.information @ off - sum(gradient for _, gradient in others)
            found[k] = draw_chi_square(*equations[k], covariance, covariance @ pull)
        worst = max(found, key=found.get, default=None)
        if worst is None or found[worst] <= gate:
            return points[np.concatenate([segments[k] for k in sorted(kept)])]
        kept.remove(worst)


@pytest.mark.parametrize("away", [(0.0, 0.0, 0.0), (0.01, -0.005, 0.004)])
@pytest.mark.parametrize("slip", [1.0, 8.0])
@pytest.mark.parametrize("seed", range(5))
def test_the_points_that_stay_are_those_of_the_equations(seed, slip, away):
    random = np.random.default_rng(seed)
    places = random.uniform([1.0, -0.7], [6.0, 0.7], (6, 2))
    moved = places + random.choice([0.0, 0.15, 0.3], (6, 1)) * random.choice([-1.0, 1.0], (6, 2))
    before, after = (np.concatenate((CORRIDOR, *(person(x, y) for x, y in each))) for each in (places, moved))
    view, alignment = plain_view(before, (-9.0, -1.2, 9.0, 1.2)), AlignmentSettings(0.05, 0.15, 5.0, 30)
    points = scan_surfels(after, STEP, noise=0.01, seed=seed)
    information = np.array([[2500.0, 300.0, 100.0], [300.0, 2500.0, -200.0], [100.0, -200.0, 10000.0]])
    prior = Prior(STEP + slip * random.normal(size=3) * [0.02, 0.02, 0.01], information)
    pose = prior.mean + away
    expected = plain_rejection(points, pose, prior, view, alignment)
    np.testing.assert_array_equal(reject_dynamic(points, pose, prior, view, alignment), expected)


def test_a_single_point_that_informs_of_one_direction_alone_is_judged_along_it():
    """Chi-square of a point straight beside the robot is its squared distance in deviations, if the pose is certain."""
    view = plain_view(CORRIDOR, (-9.0, -1.2, 9.0, 1.2))
    prior, alignment = Prior(np.zeros(3), np.diag([1e8, 1e8, 1e8])), AlignmentSettings(0.05, 0.15, 1.0, 30)
    wall = 1.225
    for distance in (0.1, 0.15, 0.25, 0.3):
        point = np.array([[0.0, wall - distance, 0.0, 0.0]])
        is_static = (distance / alignment.sigma) ** 2 <= chi2.ppf(0.999, 3)
        assert len(reject_dynamic(point, np.zeros(3), prior, view, alignment)) == is_static


def test_the_error_is_that_of_the_equations_in_the_frame_of_the_pose(room):
    view, settings = room, ALIGNMENT._replace(inflation=6.0)
    pose = np.array([0.03, -0.02, 0.4])
    points = scan_surfels(ROOM, pose)
    hessian, scatter = np.empty((3, 3)), np.zeros((3, 3))
    write_to_array(linearize(points, *pose, view, settings)[0], hessian)
    for k in range(0, len(points), 16):
        gradient = np.array(linearize(points[k : k + 16], *pose, view, settings)[1])
        scatter += np.outer(gradient, gradient)
    prior = np.array([[400.0, 30.0, -20.0], [30.0, 300.0, 50.0], [-20.0, 50.0, 1600.0]])
    found = estimate_match_error(points, pose, hessian, prior, view, settings, MatchNoise(2.0, 0.3, 5.0))
    spread = np.linalg.inv(prior + hessian / 6.0)
    covariance = spread @ (prior + (2.0 * hessian + 0.3 * scatter) / 36.0) @ spread
    gain = spread @ hessian / 6.0
    remaining = np.linalg.inv(np.eye(3) + 4.0 * gain)
    turn = se2.adjoint((0.0, 0.0, pose[2]))  # from the frame of the pose to that of the map
    np.testing.assert_allclose(turn @ found.pose_covariance @ turn.T, covariance, rtol=1e-6)
    np.testing.assert_allclose(turn @ found.drift_covariance @ turn.T, remaining @ covariance @ remaining.T, rtol=1e-6)
    np.testing.assert_allclose(turn @ found.gain @ turn.T, gain, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 7, 360, 1440])
def test_bins_divide_the_circle_from_straight_ahead_on(count: int) -> None:
    bearings = np.random.default_rng(1).uniform(-np.pi, np.pi, 2000)
    place = np.array([bin_index(3.0 * np.cos(b), 3.0 * np.sin(b), count) for b in bearings])
    share = bearings * count / (2.0 * np.pi)
    # The bearing is exact to 1e-5 rad; half a turn is in the last bin where the count is odd, or in the middle one.
    clear = (np.abs(share - np.floor(share) - 0.5) > 2e-5 * count) & (share > 0.5 - 0.5 * count)
    expected = np.minimum(np.round(share) % count, count - 1)
    np.testing.assert_array_equal(place[clear], expected[clear])
    assert clear.mean() > 0.4
    assert bin_index(0.0, 0.0, count) == 0
    near = [bin_index(0.3 * np.cos(b), 0.3 * np.sin(b), count) for b in bearings[clear]]
    np.testing.assert_array_equal(near, expected[clear])


def test_normals_are_those_of_the_walls_and_point_to_the_laser() -> None:
    seen = extract_surfaces([scan_in(box(-2.0, -1.5, 3.0, 1.0), (0.0, 0.0, 0.0), beams=361)], 30.0, 400)
    assert seen.is_flat.mean() > 0.9
    for (x, y), normal in zip(seen.points[seen.is_flat], seen.normals[seen.is_flat], strict=True):
        corner = min(abs(x - 3.0) + abs(y - 1.0), abs(x - 3.0) + abs(y + 1.5))
        expected = [-1.0, 0.0] if abs(x - 3.0) < 1e-3 else [0.0, -np.sign(y)]
        assert corner < 0.3 or np.abs(normal - expected).max() < 1e-3


def test_each_bin_has_the_nearest_point_in_its_direction() -> None:
    scans = [
        scan_in(two_rooms(), pose, beams=300, laser_pose=(0.1, 0.2, 0.3)) for pose in drive((2.0, 2.0), (5.0, 3.0))[:2]
    ]
    seen = extract_surfaces(scans, 30.0, 150)
    for scan in range(2):
        first, last = seen.starts[scan : scan + 2]
        begin, end = seen.bin_starts[scan : scan + 2]
        assert last - first == 150
        assert end - begin == int(2.0 * np.pi / (2.0 * scans[scan].angle_increment))
        beams = seen.points[first:last] - seen.lasers[scan]
        places = np.array([bin_index(x, y, end - begin) for x, y in beams])
        for place in range(end - begin):
            own = np.flatnonzero(places == place)
            nearest = first + own[np.hypot(*beams[own].T).argmin()] if len(own) else -1
            assert seen.bins[begin + place] == nearest


def plain_equations(seen, pose: np.ndarray, gate: float, weights: Weighting, every: int):
    """Pairs by the distances of all points, derivatives along the manifold by differences."""
    information, pull, matched = np.zeros((3, 3)), np.zeros(3), 0
    binned = seen.bins[seen.bin_starts[1] : seen.bin_starts[2]]
    binned = binned[binned >= 0]
    own = range(seen.starts[0], seen.starts[1], every)
    for k in own:
        place = se2.transform(pose, seen.points[k])
        distances = np.hypot(*(seen.points[binned] - place).T)
        q = binned[distances.argmin()]
        alike = se2.transform((0.0, 0.0, pose[2]), seen.normals[k]) @ seen.normals[q]
        if distances.min() >= gate or not seen.is_flat[q] or (seen.is_flat[k] and alike < 0.7):
            continue
        matched += 1

        def error(twist: np.ndarray, k: int = k, q: int = q) -> float:
            moved = se2.transform(se2.compose(pose, se2.exp(twist)), seen.points[k])
            return seen.normals[q] @ (moved - seen.points[q])

        step = 1e-6
        jacobian = np.array([error(step * e) - error(-step * e) for e in np.eye(3)]) / (2.0 * step)
        off = error(np.zeros(3))
        weight = every * weights.temper / weights.sigma**2 / (1.0 + (off / weights.robust_scale) ** 2)
        information += weight * np.outer(jacobian, jacobian)
        pull += weight * off * jacobian
    return information, pull, matched / len(own)


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.06, -0.04, 0.03), (-0.1, 0.08, -0.05)])
def test_the_equations_are_those_of_the_errors_along_the_normals(off: tuple[float, float, float], every: int) -> None:
    truth = np.array([[2.0, 2.0, 0.2], [2.6, 2.5, 0.9]])
    laser = {"beams": 361, "laser_pose": (0.1, -0.2, 0.3), "noise": 0.01}
    seen = extract_surfaces([scan_in(two_rooms(), pose, seed=k, **laser) for k, pose in enumerate(truth)], 30.0, 400)
    pose, weights = se2.compose(se2.between(truth[1], truth[0]), se2.exp(off)), Weighting(0.03, 0.05, 0.2)
    information, gradient, share = normal_equations(
        seen, np.array([0]), seen, np.array([1]), pose[None], 0.3, weights, every
    )
    expected, pull, matched = plain_equations(seen, pose, 0.3, weights, every)
    assert share[0] == pytest.approx(matched, abs=1e-9)
    np.testing.assert_allclose(information[0], expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(gradient[0], pull, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["right", "left"])
def test_points_near_the_edge_of_known_space_contradict_nothing(quarters, side):
    """Of a known box whose corner is the origin, in each of the quarters."""
    pose = np.array([0.0, 0.0, 0.5 * np.pi * quarters])
    corner = se2.transform(pose, np.array([[0.0, 0.0], [8.0, 8.0 * side]]))
    view = plain_view(np.zeros((0, 4)), (*corner.min(axis=0), *corner.max(axis=0)))
    along = np.column_stack((np.arange(2.0, 7.0, 0.2), np.zeros(25)))
    for aside, free in ((-0.08, 0), (0.02, 0), (0.12, 0), (0.18, 25), (0.5, 25), (7.82, 25), (7.88, 0), (8.3, 0)):
        points = along + np.array([0.0, side * aside])
        assert count_agreement(points, pose, view, FAR // 3, FAR // 2) == (0, free)


def test_points_are_on_surfaces_in_free_space_or_neither(room):
    points = scan_surfels(ROOM, (0.2, 0.1, 0.3), beams=121)
    assert count_agreement(points, np.array([0.2, 0.1, 0.3]), room, FAR // 5, FAR // 2) == (len(points), 0)
    short = points * [[0.7, 0.7, 1.0, 1.0]]
    on, free = count_agreement(short, np.array([0.2, 0.1, 0.3]), room, FAR // 5, FAR // 2)
    assert on < 5
    assert free > 0.9 * len(points)


@pytest.mark.parametrize("off", [(0.1, -0.05, 0.03), (-0.15, 0.1, -0.05)])
def test_alignment_ends_where_the_gradient_of_points_and_prior_is_zero(room, off):
    points, truth = scan_surfels(ROOM, (0.5, -0.4, 0.7), beams=181), np.array([0.5, -0.4, 0.7])
    prior = Prior(truth + off, np.array([[400.0, 30.0, -20.0], [30.0, 300.0, 50.0], [-20.0, 50.0, 1600.0]]))
    settings = ALIGNMENT._replace(inflation=4.0, iterations=60)
    pose, information = align(points, prior.mean, prior, room, settings)
    sums, gradient, _ = linearize(points, *pose, room, settings)
    total = np.array(gradient) / 4.0 + prior.information @ (pose - prior.mean)
    found = np.empty((3, 3))
    write_to_array(sums, found)
    step = np.linalg.solve(found / 4.0 + prior.information, total)
    assert np.abs(step).max() < 2e-3
    np.testing.assert_allclose(information, found, rtol=0.2, atol=0.1 * np.abs(found).max())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_alignment_goes_on_while_a_single_number_of_the_pose_still_changes(room, axis):
    """The information of the prior leaves one number free."""
    points, truth = scan_surfels(ROOM, (0.5, -0.4, 0.0), beams=181), np.array([0.5, -0.4, 0.0])
    start = truth - 0.25 * np.eye(3)[axis]
    prior = Prior(start, np.diag(np.where(np.arange(3) == axis, 1e-6, 1e12)))

    def remaining_step(iterations):
        pose, _ = align(points, start, prior, room, ALIGNMENT._replace(iterations=iterations))
        assert np.abs(np.delete(pose - start, axis)).max() < 1e-4
        sums, gradient, _ = linearize(points, *pose, room, ALIGNMENT)
        information = np.empty((3, 3))
        write_to_array(sums, information)
        return abs(gradient[axis] / information[axis, axis])

    assert remaining_step(30) < 5e-5
    assert remaining_step(1) > 4e-4


@pytest.mark.parametrize("turn", [0.0, 1.2])
def test_segments_begin_behind_gaps_of_a_tenth_of_a_meter_and_a_twentieth_of_the_range(turn):
    random = np.random.default_rng(5)
    ranges = np.concatenate([random.uniform(1.0, 9.0) + random.normal(0.0, 0.05, 7) for _ in range(12)])
    angles = np.linspace(-1.5, 1.5, len(ranges)) + turn
    points = np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles), np.zeros((len(ranges), 2))))
    expected = [int(own[0]) for own in segments_of(points)]
    assert len(expected) > 8
    assert _segment_starts(points).tolist() == [*expected, len(points)]
    assert _segment_starts(points[:1]).tolist() == [0, 1]
    assert _segment_starts(points[:0]).tolist() == [0]


def test_tables_of_the_beam_model_are_a_normal_around_surfaces_beside_random_returns():
    model, distance = make_beam_model(0.5, 0.08, 12.0, 0.15), np.linspace(0.0, 0.5, 256)
    hit = 0.85 * norm(0.0, 0.08).pdf(distance) * 12.0
    np.testing.assert_allclose(np.exp(model.in_unknown), hit + 1.0)
    np.testing.assert_allclose(np.exp(model.in_known), hit + 0.15)
