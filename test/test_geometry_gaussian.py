"""Gaussian poses against Monte Carlo, closed forms and changes of frame."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import chi2

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, chi_square_quantile, fuse, match_moments

SAMPLES = 200_000


def covariance(rng, sigma_xy=0.05, sigma_theta=0.02):
    factor = rng.normal(size=(3, 3)) * np.array([sigma_xy, sigma_xy, sigma_theta])[:, None]
    return factor @ factor.T + np.diag([1e-4, 1e-4, 1e-5])


def draw(belief, rng, count=SAMPLES):
    xi = rng.multivariate_normal(np.zeros(3), belief.covariance, size=count)
    return se2.compose(belief.mean, se2.exp(xi))


def moments(samples, mean):
    """Mean and covariance of samples in the right tangent space of ``mean``."""
    xi = se2.log(se2.between(mean, samples))
    return xi.mean(axis=0), np.cov(xi.T)


def two_beliefs(seed):
    rng = np.random.default_rng(seed)
    a = PoseGaussian(np.array([2.0, -1.0, 0.8]), covariance(rng))
    b = PoseGaussian(np.array([-1.0, 3.0, -2.5]), covariance(rng))
    return a, b, rng


def assert_moments_match(belief, samples):
    mean, spread = moments(samples, belief.mean)
    sigma = np.sqrt(np.diag(belief.covariance))
    # First order: the mean stays within a few per cent of a deviation, the covariance within 2 %.
    np.testing.assert_allclose(mean / sigma, 0.0, atol=0.05)
    scaled = spread / np.outer(sigma, sigma)
    np.testing.assert_allclose(scaled, belief.covariance / np.outer(sigma, sigma), atol=0.02)


def test_the_composed_covariance_is_that_of_composed_samples():
    a, b, rng = two_beliefs(11)
    assert_moments_match(a.compose(b), se2.compose(draw(a, rng), draw(b, rng)))


def test_the_inverse_covariance_is_that_of_inverted_samples():
    a, _, rng = two_beliefs(12)
    assert_moments_match(a.inverse(), se2.inverse(draw(a, rng)))


def test_variances_of_translations_without_rotation_add():
    step = PoseGaussian(np.array([1.0, 0.0, 0.0]), np.diag([0.04, 0.01, 0.0]))
    whole = step.compose(step)
    np.testing.assert_allclose(whole.mean, [2.0, 0.0, 0.0])
    np.testing.assert_allclose(whole.covariance, np.diag([0.08, 0.02, 0.0]), atol=1e-15)


def test_a_heading_error_before_a_long_step_is_a_sideways_error_after_it():
    turn = PoseGaussian(np.zeros(3), np.diag([0.0, 0.0, 0.01**2]))
    step = PoseGaussian(np.array([20.0, 0.0, 0.0]), np.zeros((3, 3)))
    expected = np.array([[0.0, 0.0, 0.0], [0.0, 0.2**2, 0.2 * 0.01], [0.0, 0.2 * 0.01, 0.01**2]])
    np.testing.assert_allclose(turn.compose(step).covariance, expected, atol=1e-15)


def test_the_inverse_of_the_inverse_is_the_belief_itself():
    a, _, _ = two_beliefs(13)
    again = a.inverse().inverse()
    np.testing.assert_allclose(again.mean, a.mean, atol=1e-12)
    np.testing.assert_allclose(again.covariance, a.covariance, atol=1e-15)


def test_the_inverse_of_a_composition_is_the_composition_of_inverses():
    a, b, _ = two_beliefs(14)
    left, right = a.compose(b).inverse(), b.inverse().compose(a.inverse())
    np.testing.assert_allclose(left.mean, right.mean, atol=1e-12)
    np.testing.assert_allclose(left.covariance, right.covariance, atol=1e-14)


def test_the_mahalanobis_distance_of_translations_is_the_textbook_one():
    a = PoseGaussian(np.zeros(3), np.diag([0.04, 0.09, 0.01]))
    b = PoseGaussian(np.array([1.0, 2.0, 0.0]), np.diag([0.05, 0.16, 0.01]))
    # 1 / (0.04 + 0.05) + 4 / (0.09 + 0.16), and the lever arm of a's heading error at b's place
    lever = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    ad = np.eye(3) - lever
    spread = ad @ a.covariance @ ad.T + b.covariance
    difference = np.array([1.0, 2.0, 0.0])
    assert a.mahalanobis2(b) == pytest.approx(difference @ np.linalg.inv(spread) @ difference)
    exact = PoseGaussian(a.mean, np.diag([0.04, 0.09, 1e-18]))
    assert exact.mahalanobis2(PoseGaussian(b.mean, np.diag([0.05, 0.16, 1e-18]))) == pytest.approx(1 / 0.09 + 4 / 0.25)


def test_a_belief_is_at_distance_nought_from_itself():
    a, _, _ = two_beliefs(15)
    assert a.mahalanobis2(a) == pytest.approx(0.0, abs=1e-18)


offsets = arrays(np.float64, 3, elements=st.floats(-20.0, 20.0))


@given(offsets, offsets)
def test_the_gate_depends_neither_on_the_frame_nor_on_the_point_described(before, after):
    rng = np.random.default_rng(16)
    a = PoseGaussian(np.array([2.0, -1.0, 0.8]), covariance(rng))
    b = PoseGaussian(se2.compose(a.mean, [0.1, -0.1, 0.05]), covariance(rng))
    left, right = (PoseGaussian(np.append(o[:2], se2.wrap(o[2])), np.zeros((3, 3))) for o in (before, after))
    moved = left.compose(a).compose(right).mahalanobis2(left.compose(b).compose(right))
    assert moved == pytest.approx(a.mahalanobis2(b), rel=1e-6)


def test_the_gate_is_symmetric():
    a, _, rng = two_beliefs(17)
    b = PoseGaussian(se2.compose(a.mean, [0.2, 0.1, -0.3]), covariance(rng))
    assert a.mahalanobis2(b) == pytest.approx(b.mahalanobis2(a), rel=1e-9)


def test_distances_of_true_pairs_are_chi_square_with_three_degrees_of_freedom():
    rng = np.random.default_rng(18)
    truth = np.array([3.0, 1.0, -1.2])
    first, second = covariance(rng), covariance(rng)
    inside = [
        PoseGaussian(se2.compose(truth, se2.exp(rng.multivariate_normal(np.zeros(3), first))), first).mahalanobis2(
            PoseGaussian(se2.compose(truth, se2.exp(rng.multivariate_normal(np.zeros(3), second))), second)
        )
        < chi2.ppf(0.9, 3)
        for _ in range(2000)
    ]
    # Binomial deviation of 2000 draws at 0.9 is 0.0067.
    assert np.mean(inside) == pytest.approx(0.9, abs=0.021)


def test_fused_translations_are_the_closed_form_product():
    tight = 1e-14
    first = PoseGaussian(np.array([1.0, 2.0, 0.0]), np.diag([0.04, 0.01, tight]))
    second = PoseGaussian(np.array([2.0, 4.0, 0.0]), np.diag([0.01, 0.01, tight]))
    both = fuse([first, second])  # Eq. (10)
    np.testing.assert_allclose(both.mean, [1.8, 3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(np.diag(both.covariance)[:2], [0.008, 0.005], rtol=1e-6)


def test_fusing_equal_beliefs_divides_the_covariance_by_their_number():
    a, _, _ = two_beliefs(19)
    both = fuse([a] * 4)
    np.testing.assert_allclose(both.mean, a.mean, atol=1e-12)
    np.testing.assert_allclose(both.covariance, a.covariance / 4.0, atol=1e-15)


def test_fusion_of_one_belief_is_that_belief():
    a, _, _ = two_beliefs(20)
    one = fuse([a])
    np.testing.assert_allclose(one.mean, a.mean, atol=1e-12)
    np.testing.assert_allclose(one.covariance, a.covariance, atol=1e-15)


def test_fusion_does_not_depend_on_the_order():
    a, _, rng = two_beliefs(21)
    b = PoseGaussian(se2.compose(a.mean, [0.05, -0.04, 0.03]), covariance(rng))
    c = PoseGaussian(se2.compose(a.mean, [-0.02, 0.06, -0.05]), covariance(rng))
    forward, backward = fuse([a, b, c]), fuse([c, b, a])
    np.testing.assert_allclose(forward.mean, backward.mean, atol=1e-9)
    np.testing.assert_allclose(forward.covariance, backward.covariance, atol=1e-9)


def test_fusion_does_not_depend_on_the_direction_of_the_poses():
    a, _, rng = two_beliefs(22)
    b = PoseGaussian(se2.compose(a.mean, [0.05, -0.04, 0.03]), covariance(rng))
    there, back = fuse([a, b]), fuse([a.inverse(), b.inverse()]).inverse()
    np.testing.assert_allclose(there.mean, back.mean, atol=1e-9)
    np.testing.assert_allclose(there.covariance, back.covariance, atol=1e-9)


def test_headings_on_both_sides_of_half_a_turn_fuse_between_them():
    spread = np.diag([0.01, 0.01, 0.01])
    both = fuse(
        [
            PoseGaussian(np.array([0.0, 0.0, math.radians(179.0)]), spread),
            PoseGaussian(np.array([0.0, 0.0, math.radians(-177.0)]), spread),
        ]
    )
    assert math.degrees(both.mean[2]) == pytest.approx(-179.0, abs=1e-6)


@given(st.integers(0, 10_000))
def test_fusion_never_adds_uncertainty(seed):
    rng = np.random.default_rng(seed)
    a = PoseGaussian(rng.normal(size=3), covariance(rng))
    b = PoseGaussian(se2.compose(a.mean, rng.normal(size=3) * 0.02), covariance(rng))
    both = fuse([a, b])
    volumes = [np.linalg.det(belief.covariance) for belief in (a, b)]
    assert np.linalg.det(both.covariance) < min(volumes)


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.999])
def test_the_gate_is_the_quantile_of_chi_square(probability):
    assert chi_square_gate(probability) == pytest.approx(chi2.ppf(probability, 3), rel=1e-12)


@pytest.mark.parametrize("probability", [0.95, 0.99, 0.999])
def test_the_gates_that_are_constants_are_those_that_scipy_computes(probability):
    assert chi_square_gate(probability) == pytest.approx(chi_square_quantile(probability, 3), rel=1e-15)


def test_the_ellipse_holds_95_percent_of_the_positions_in_the_outer_axes():
    rng = np.random.default_rng(11)
    belief = PoseGaussian(np.array([3.0, -2.0, 0.8]), np.diag([0.2, 0.01, 0.0]) ** 2)
    ellipse = belief.position_ellipse()
    assert ellipse.semi_major > 10.0 * ellipse.semi_minor
    assert math.sin(ellipse.angle - 0.8) == pytest.approx(0.0, abs=1e-9)
    away = draw(belief, rng)[:, :2] - belief.mean[:2]
    sin, cos = math.sin(ellipse.angle), math.cos(ellipse.angle)
    along, across = away @ [cos, sin] / ellipse.semi_major, away @ [-sin, cos] / ellipse.semi_minor
    assert (along**2 + across**2 < 1.0).mean() == pytest.approx(0.95, abs=0.003)


def test_the_moments_of_a_mixture_are_those_of_its_samples():
    a, _, rng = two_beliefs(23)
    others = [
        PoseGaussian(se2.compose(a.mean, shift), covariance(rng)) for shift in ([0.3, -0.1, 0.04], [-0.2, 0.4, 0])
    ]
    # Weights 1, 2 and 3 of 6; the scale of the weights does not matter.
    weighted = [(belief, math.log(7.0 * weight)) for belief, weight in zip([*others, a], (1, 2, 3), strict=True)]
    mixed = match_moments(weighted)
    np.testing.assert_array_equal(mixed.mean, a.mean)
    samples = np.concatenate(
        [draw(belief, rng, weight * 60_000) for belief, weight in zip([*others, a], (1, 2, 3), strict=True)]
    )
    xi = se2.log(se2.between(a.mean, samples))
    sigma = np.sqrt(np.diag(mixed.covariance))
    # To first order: headings differ by up to 0.04 rad.
    np.testing.assert_allclose((xi.T @ xi / len(xi) - mixed.covariance) / np.outer(sigma, sigma), 0.0, atol=0.04)


def test_the_moments_of_two_points_are_their_squared_distance_by_the_weight_of_the_lighter():
    first, second = (PoseGaussian.from_pose(np.array([x, 1.0, 0.0])) for x in (2.0, 5.0))
    mixed = match_moments([(first, math.log(0.8)), (second, math.log(0.2))])
    np.testing.assert_allclose(mixed.covariance, np.diag([0.2 * 9.0, 0.0, 0.0]), atol=1e-12)
