"""Rigid motions of the plane against hand-computed answers, matrices, and numeric derivatives."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from hmt_slam_ros.geometry import se2

QUARTER = math.pi / 2.0

lengths = st.floats(-50.0, 50.0)
angles = st.floats(-math.pi, math.pi, exclude_max=True)
poses = st.builds(lambda x, y, theta: np.array([x, y, theta]), lengths, lengths, angles)


def matrix(pose):
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def twist_matrix(xi):
    return np.array([[0.0, -xi[2], xi[0]], [xi[2], 0.0, xi[1]], [0.0, 0.0, 0.0]])


def assert_same_pose(actual, expected, atol=1e-9):
    np.testing.assert_allclose(actual[..., :2], np.asarray(expected)[..., :2], atol=atol)
    np.testing.assert_allclose(se2.wrap(actual[..., 2] - np.asarray(expected)[..., 2]), 0.0, atol=atol)


@pytest.mark.parametrize(
    ("angle", "expected"),
    [(0.0, 0.0), (math.pi, -math.pi), (-math.pi, -math.pi), (1.5 * math.pi, -0.5 * math.pi), (7.0, 7.0 - 2 * math.pi)],
)
def test_an_angle_is_brought_into_the_half_open_turn(angle, expected):
    assert float(se2.wrap(angle)) == pytest.approx(expected, abs=1e-12)


@given(st.floats(-1e6, 1e6))
def test_a_wrapped_angle_lies_in_the_half_open_turn_and_points_the_same_way(angle):
    wrapped = float(se2.wrap(angle))
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_the_doubles_next_to_half_a_turn_wrap_inside_the_interval():
    for turns in range(-6, 7, 2):
        for edge in (-math.pi, math.pi):
            angle = edge + turns * math.pi
            for neighbor in (np.nextafter(angle, -np.inf), angle, np.nextafter(angle, np.inf)):
                assert -math.pi <= float(se2.wrap(neighbor)) < math.pi


@given(angles)
def test_an_angle_inside_the_interval_keeps_its_bits(angle):
    assert float(se2.wrap(angle)) == angle
    # Also beside one that does not.
    assert se2.wrap(np.array([angle, 7.0])).tolist() == [angle, float(se2.wrap(7.0))]


def test_a_motion_is_done_in_the_frame_that_the_first_one_leads_to():
    np.testing.assert_allclose(se2.compose([1.0, 2.0, QUARTER], [3.0, 4.0, QUARTER]), [-3.0, 5.0, -math.pi], atol=1e-12)


def test_the_inverse_of_a_quarter_turn_away_from_the_origin():
    np.testing.assert_allclose(se2.inverse([1.0, 2.0, QUARTER]), [-2.0, 1.0, -QUARTER], atol=1e-12)


def test_the_pose_of_one_frame_in_another_from_a_common_one():
    np.testing.assert_allclose(se2.between([1.0, 1.0, QUARTER], [1.0, 3.0, math.pi]), [2.0, 0.0, QUARTER], atol=1e-12)


def test_points_are_turned_and_then_shifted():
    np.testing.assert_allclose(
        se2.transform([1.0, 2.0, QUARTER], [[1.0, 0.0], [0.0, 2.0]]), [[1.0, 3.0], [-1.0, 2.0]], atol=1e-12
    )


def test_a_twist_of_a_quarter_turn_follows_its_arc():
    # Forward speed v at turn rate w follows a circle of radius v / w.
    np.testing.assert_allclose(se2.exp([QUARTER, 0.0, QUARTER]), [1.0, 1.0, QUARTER], atol=1e-12)


def test_a_twist_without_rotation_is_a_straight_line():
    np.testing.assert_array_equal(se2.exp([3.0, -2.0, 0.0]), [3.0, -2.0, 0.0])


@given(poses, poses)
def test_composition_is_the_product_of_matrices(a, b):
    np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-9)


@given(poses)
def test_a_pose_composed_with_its_inverse_is_the_identity(pose):
    assert_same_pose(se2.compose(pose, se2.inverse(pose)), np.zeros(3))
    assert_same_pose(se2.compose(se2.inverse(pose), pose), np.zeros(3))


@given(poses, poses, poses)
def test_composition_is_associative(a, b, c):
    assert_same_pose(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))


@given(poses, poses)
def test_between_undoes_compose(a, b):
    assert_same_pose(se2.between(a, se2.compose(a, b)), b)


@given(poses, lengths, lengths)
def test_a_transformed_point_is_a_composed_translation(pose, x, y):
    np.testing.assert_allclose(se2.transform(pose, [[x, y]])[0], se2.compose(pose, [x, y, 0.0])[:2], atol=1e-9)


@given(lengths, lengths, angles)
def test_exp_is_the_matrix_exponential(x, y, omega):
    xi = np.array([x, y, omega])
    np.testing.assert_allclose(matrix(se2.exp(xi)), expm(twist_matrix(xi)), atol=1e-8)


def test_log_is_the_matrix_logarithm():
    pose = np.array([1.3, -0.4, 2.1])
    np.testing.assert_allclose(twist_matrix(se2.log(pose)), logm(matrix(pose)).real, atol=1e-9)


@given(poses)
def test_exp_undoes_log(pose):
    assert_same_pose(se2.exp(se2.log(pose)), pose, atol=1e-8)


@given(lengths, lengths, st.floats(-3.1, 3.1))
def test_log_undoes_exp(x, y, omega):
    np.testing.assert_allclose(se2.log(se2.exp([x, y, omega])), [x, y, omega], atol=1e-8)


@pytest.mark.parametrize("omega", [9.99e-6, 1.0e-5, 1.01e-5, -9.99e-6, 3e-5])
def test_exp_is_accurate_where_its_series_takes_over(omega):
    # The displacement of a unit forward twist is (sin w, 1 - cos w) / w, here by its series to the fifth order.
    expected = [1.0 - omega**2 / 6.0, omega / 2.0 - omega**3 / 24.0]
    np.testing.assert_allclose(se2.exp([1.0, 0.0, omega])[:2], expected, rtol=1e-11)


@given(poses, st.tuples(lengths, lengths, st.floats(-0.5, 0.5)))
def test_the_adjoint_moves_a_twist_to_the_other_side(pose, xi):
    left = se2.compose(pose, se2.exp(xi))
    right = se2.compose(se2.exp(se2.adjoint(pose) @ np.array(xi)), pose)
    assert_same_pose(left, right, atol=1e-7)


@given(poses, poses)
def test_the_adjoint_of_a_composition_is_the_product(a, b):
    np.testing.assert_allclose(se2.adjoint(se2.compose(a, b)), se2.adjoint(a) @ se2.adjoint(b), atol=1e-8)


def numeric_jacobian(function, step=1e-6):
    columns = [(function(step * unit) - function(-step * unit)) / (2.0 * step) for unit in np.eye(3)]
    return np.stack(columns, axis=1)


def test_the_derivative_of_a_composition_in_right_tangents_is_the_adjoint_of_the_inverse_and_the_identity():
    a, b = np.array([1.0, -2.0, 0.7]), np.array([0.4, 3.0, -2.0])
    whole = se2.compose(a, b)

    def change(pose):
        return se2.log(se2.between(whole, pose))

    of_a = numeric_jacobian(lambda xi: change(se2.compose(se2.compose(a, se2.exp(xi)), b)))
    of_b = numeric_jacobian(lambda xi: change(se2.compose(a, se2.compose(b, se2.exp(xi)))))
    np.testing.assert_allclose(of_a, se2.adjoint(se2.inverse(b)), atol=1e-8)
    np.testing.assert_allclose(of_b, np.eye(3), atol=1e-8)


@pytest.mark.parametrize("omega", [0.0, 1e-7, -0.009, 0.011, 0.5, -2.0, 3.0])
def test_the_derivative_of_log_is_the_inverse_right_jacobian(omega):
    xi = np.array([1.5, -0.7, omega])
    jacobian = numeric_jacobian(lambda delta: se2.log(se2.compose(se2.exp(xi), se2.exp(delta))))
    np.testing.assert_allclose(se2.right_jacobian_inverse(xi), jacobian, atol=1e-8)


def test_the_derivative_of_the_inverse_in_right_tangents_is_minus_the_adjoint():
    pose = np.array([1.0, -2.0, 0.7])
    base = se2.inverse(pose)
    jacobian = numeric_jacobian(lambda xi: se2.log(se2.between(base, se2.inverse(se2.compose(pose, se2.exp(xi))))))
    np.testing.assert_allclose(jacobian, -se2.adjoint(pose), atol=1e-8)


def test_halfway_along_a_quarter_circle_lies_on_the_circle():
    half = se2.interpolate([0.0, 0.0, 0.0], [1.0, 1.0, QUARTER], 0.5)
    np.testing.assert_allclose(half, [math.sqrt(0.5), 1.0 - math.sqrt(0.5), math.pi / 4.0], atol=1e-12)


def test_interpolation_goes_the_short_way_round_half_a_turn():
    half = se2.interpolate([0.0, 0.0, math.radians(170.0)], [0.0, 0.0, math.radians(-170.0)], 0.5)
    assert abs(math.degrees(half[2])) == pytest.approx(180.0)


@given(poses, poses)
def test_interpolation_starts_and_ends_where_it_should(start, end):
    ends = se2.interpolate(start, end, np.array([0.0, 1.0]))
    assert_same_pose(ends, np.stack((start, end)), atol=1e-7)


def test_every_function_broadcasts_over_leading_dimensions():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(4, 1, 3)), rng.normal(size=(5, 3))
    assert se2.compose(a, b).shape == (4, 5, 3)
    assert se2.between(a, b).shape == (4, 5, 3)
    np.testing.assert_array_equal(se2.compose(a, b)[2, 3], se2.compose(a[2, 0], b[3]))
    np.testing.assert_array_equal(se2.inverse(b)[3], se2.inverse(b[3]))
    np.testing.assert_array_equal(se2.exp(b)[3], se2.exp(b[3]))
    np.testing.assert_array_equal(se2.log(b)[3], se2.log(b[3]))
    np.testing.assert_array_equal(se2.adjoint(b)[3], se2.adjoint(b[3]))
    np.testing.assert_array_equal(se2.right_jacobian_inverse(b)[3], se2.right_jacobian_inverse(b[3]))


@given(poses, poses)
def test_one_pose_by_itself_is_moved_as_it_is_among_many(a, b):
    assert_same_pose(se2.compose(a, b), se2.compose(a[None], b[None])[0])
    assert_same_pose(se2.inverse(a), se2.inverse(a[None])[0])
    assert_same_pose(se2.exp(a), se2.exp(a[None])[0])
    np.testing.assert_allclose(se2.log(a), se2.log(a[None])[0], atol=1e-9)


def test_the_best_fit_is_the_motion_between_equal_constellations_and_minds_noise_little():
    rng = np.random.default_rng(4)
    motion = np.array([3.0, -2.0, 2.9])
    a = np.column_stack((rng.uniform(-5.0, 5.0, (20, 2)), rng.uniform(-np.pi, np.pi, 20)))
    np.testing.assert_allclose(se2.best_fit(a, se2.compose(motion, a)), motion, atol=1e-12)
    np.testing.assert_allclose(se2.best_fit(a[:1], se2.compose(motion, a[:1])), motion, atol=1e-12)
    noisy = se2.compose(se2.compose(motion, a), se2.exp(0.05 * rng.standard_normal((20, 3))))
    assert np.abs(se2.between(motion, se2.best_fit(a, noisy))).max() < 0.05
