"""Kernels on covariances of geometry.gaussian, with arrays and without, against numpy."""

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import (
    add_scaled,
    determinant,
    dot,
    inverse_pose_covariance,
    matrix_inverse,
    multiply,
    propagate_covariance,
    rotate_covariance,
    sandwich,
    solve,
    symmetric_from_array,
    symmetric_inverse,
    write_to_array,
)


@pytest.fixture(params=range(20))
def random(request):
    return np.random.default_rng(request.param)


def covariance(random):
    root = random.standard_normal((3, 3)) * [1.0, 0.1, 0.01]
    return root @ root.T + 1e-6 * np.eye(3)


def test_the_inverse_is_the_inverse(random):
    matrix = covariance(random)
    np.testing.assert_allclose(matrix_inverse(matrix) @ matrix, np.eye(3), atol=1e-6)
    np.testing.assert_array_equal(matrix_inverse(matrix), matrix_inverse(matrix).T)


def test_a_turn_is_the_adjoint_of_a_rotation(random):
    matrix, theta = covariance(random), random.uniform(-4.0, 4.0)
    ad = se2.adjoint([0.0, 0.0, theta])
    np.testing.assert_allclose(rotate_covariance(matrix, theta), ad @ matrix @ ad.T, atol=1e-12)


def test_a_covariance_at_the_end_of_a_motion(random):
    matrix, motion = covariance(random), random.uniform(-3.0, 3.0, 3)
    ad = se2.adjoint(se2.inverse(motion))
    np.testing.assert_allclose(propagate_covariance(matrix, motion), ad @ matrix @ ad.T, atol=1e-12)


def test_the_covariance_of_an_inverse_pose(random):
    matrix, pose = covariance(random), random.uniform(-3.0, 3.0, 3)
    ad = se2.adjoint(pose)
    np.testing.assert_allclose(inverse_pose_covariance(matrix, pose), ad @ matrix @ ad.T, atol=1e-12)


def definite(random, rank=3):
    root = random.standard_normal((3, rank)) * np.array([[1.0], [0.1], [10.0]])
    return root @ root.T


def whole(a):
    matrix = np.empty((3, 3))
    write_to_array(a, matrix)
    return matrix


def test_sums_and_products(random):
    a, b, v, w = definite(random), definite(random), random.standard_normal(3), random.standard_normal(3)
    one, other = symmetric_from_array(a), symmetric_from_array(b)
    np.testing.assert_array_equal(whole(one), a)
    np.testing.assert_allclose(whole(add_scaled(one, other, -0.5)), a - 0.5 * b)
    np.testing.assert_allclose(multiply(one, tuple(v)), a @ v, rtol=1e-9)
    np.testing.assert_allclose(whole(sandwich(one, other)), a @ b @ a, rtol=1e-9)
    assert dot(tuple(v), tuple(w)) == pytest.approx(v @ w)


def test_inverse_solution_and_determinant(random):
    matrix, v = definite(random) + 1e-3 * np.eye(3), random.standard_normal(3)
    a = symmetric_from_array(matrix)
    np.testing.assert_allclose(whole(symmetric_inverse(a)) @ matrix, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(matrix @ solve(a, tuple(v)), v, atol=1e-6)
    assert determinant(a) == pytest.approx(np.linalg.det(matrix))


@pytest.mark.parametrize("rank", [1, 2])
def test_a_solution_is_as_good_as_that_of_lapack_where_little_is_known(random, rank):
    matrix = definite(random, rank)
    matrix += 1e-9 * np.trace(matrix) * np.eye(3)
    v = matrix @ random.standard_normal(3)
    off = np.abs(matrix @ solve(symmetric_from_array(matrix), tuple(v)) - v).max()
    assert off < 1e-12 * np.trace(matrix)
