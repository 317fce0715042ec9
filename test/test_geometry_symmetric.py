"""Symmetric matrices without arrays, against numpy."""

import numpy as np
import pytest

from hmt_slam_ros.geometry import symmetric


@pytest.fixture(params=range(20))
def random(request):
    return np.random.default_rng(request.param)


def definite(random, rank=3):
    root = random.standard_normal((3, rank)) * np.array([[1.0], [0.1], [10.0]])
    return root @ root.T


def whole(a):
    matrix = np.empty((3, 3))
    symmetric.write_to_array(a, matrix)
    return matrix


def test_sums_and_products(random):
    a, b, v, w = definite(random), definite(random), random.standard_normal(3), random.standard_normal(3)
    one, other = symmetric.symmetric_from_array(a), symmetric.symmetric_from_array(b)
    np.testing.assert_array_equal(whole(one), a)
    np.testing.assert_allclose(whole(symmetric.add_scaled(one, other, -0.5)), a - 0.5 * b)
    np.testing.assert_allclose(symmetric.multiply(one, tuple(v)), a @ v, rtol=1e-9)
    np.testing.assert_allclose(whole(symmetric.sandwich(one, other)), a @ b @ a, rtol=1e-9)
    assert symmetric.dot(tuple(v), tuple(w)) == pytest.approx(v @ w)


def test_inverse_solution_and_determinant(random):
    matrix, v = definite(random) + 1e-3 * np.eye(3), random.standard_normal(3)
    a = symmetric.symmetric_from_array(matrix)
    np.testing.assert_allclose(whole(symmetric.inverse(a)) @ matrix, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(matrix @ symmetric.solve(a, tuple(v)), v, atol=1e-6)
    assert symmetric.determinant(a) == pytest.approx(np.linalg.det(matrix))


@pytest.mark.parametrize("rank", [1, 2])
def test_a_solution_is_as_good_as_that_of_lapack_where_little_is_known(random, rank):
    matrix = definite(random, rank)
    matrix += 1e-9 * np.trace(matrix) * np.eye(3)
    v = matrix @ random.standard_normal(3)
    off = np.abs(matrix @ symmetric.solve(symmetric.symmetric_from_array(matrix), tuple(v)) - v).max()
    assert off < 1e-12 * np.trace(matrix)
