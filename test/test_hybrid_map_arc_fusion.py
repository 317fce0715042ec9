"""Fusion of two traversals of one arc, Eq. (10), and its honesty."""

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, fuse
from hmt_slam_ros.hybrid_map.hybrid_map import apply_sigma_floor, fuse_traversals

SPREAD = np.diag([0.1**2, 0.05**2, 0.02**2])
ARC = PoseGaussian(np.array([6.0, 1.0, 0.4]), SPREAD)


def off_by(xi, spread=SPREAD):
    return PoseGaussian(se2.compose(ARC.mean, se2.exp(xi)), spread)


def test_independent_traversals_that_agree_are_the_product_of_gaussians():
    second = off_by([0.05, -0.02, 0.01])
    both, product = fuse_traversals(ARC, second, 0.0), fuse([ARC, second])
    np.testing.assert_allclose(both.mean, product.mean, atol=1e-12)
    np.testing.assert_allclose(both.covariance, product.covariance, atol=1e-15)


def test_the_same_scans_twice_add_no_certainty():
    both = fuse_traversals(ARC, ARC, 1.0)
    np.testing.assert_allclose(both.mean, ARC.mean, atol=1e-12)
    np.testing.assert_allclose(both.covariance, ARC.covariance, atol=1e-15)


def test_scans_shared_in_part_add_certainty_in_part():
    variances = [fuse_traversals(ARC, ARC, shared).covariance[0, 0] for shared in (0.0, 0.3, 0.7, 1.0)]
    np.testing.assert_allclose(variances, np.array([1.0, 1.3, 1.7, 2.0]) / 2.0 * SPREAD[0, 0])


def test_traversals_that_contradict_each_other_make_the_arc_less_certain_than_either():
    second = off_by([1.0, 0.0, 0.0])
    both = fuse_traversals(ARC, second, 0.0)
    # chi-square 1 / 0.02 = 50 (and a little for the lever arm), a third of which scales the product's 0.005
    assert both.covariance[0, 0] == pytest.approx(50 / 3 * 0.005, rel=0.02)
    assert both.covariance[0, 0] > SPREAD[0, 0]
    np.testing.assert_allclose(both.mean, off_by([0.5, 0.0, 0.0]).mean, atol=0.01)


def test_fusion_does_not_depend_on_the_direction_of_the_arc():
    second = off_by([0.3, -0.1, 0.05])
    there, back = fuse_traversals(ARC, second, 0.4), fuse_traversals(ARC.inverse(), second.inverse(), 0.4).inverse()
    np.testing.assert_allclose(there.mean, back.mean, atol=1e-9)
    # The chi-square of their disagreement is first order in it.
    np.testing.assert_allclose(there.covariance, back.covariance, rtol=5e-3)


def test_a_floor_raises_only_the_deviations_below_it():
    raised = apply_sigma_floor(ARC, 0.07, 0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(raised.covariance)), [0.1, 0.07, 0.02])
    np.testing.assert_array_equal(raised.mean, ARC.mean)


def test_a_floored_covariance_stays_positive_definite():
    factor = np.array([[0.01, 0.0, 0.0], [0.009, 0.001, 0.0], [0.002, 0.0, 1e-5]])
    raised = apply_sigma_floor(PoseGaussian(ARC.mean, factor @ factor.T), 0.05, 0.01)
    assert np.linalg.eigvalsh(raised.covariance).min() > 0.0
