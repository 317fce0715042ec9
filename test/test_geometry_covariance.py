"""Kernels on covariances against numpy."""

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.covariance import inverse, propagate_covariance, rotate_covariance


@pytest.fixture(params=range(20))
def random(request):
    return np.random.default_rng(request.param)


def covariance(random):
    root = random.standard_normal((3, 3)) * [1.0, 0.1, 0.01]
    return root @ root.T + 1e-6 * np.eye(3)


def test_the_inverse_is_the_inverse(random):
    matrix = covariance(random)
    np.testing.assert_allclose(inverse(matrix) @ matrix, np.eye(3), atol=1e-6)
    np.testing.assert_array_equal(inverse(matrix), inverse(matrix).T)


def test_a_turn_is_the_adjoint_of_a_rotation(random):
    matrix, theta = covariance(random), random.uniform(-4.0, 4.0)
    ad = se2.adjoint([0.0, 0.0, theta])
    np.testing.assert_allclose(rotate_covariance(matrix, theta), ad @ matrix @ ad.T, atol=1e-12)


def test_propagated_to_the_end_of_a_motion(random):
    matrix, motion = covariance(random), random.uniform(-3.0, 3.0, 3)
    ad = se2.adjoint(se2.inverse(motion))
    np.testing.assert_allclose(propagate_covariance(matrix, motion), ad @ matrix @ ad.T, atol=1e-12)
