"""Rigid motions in kernels against those of arrays."""

import math

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2


@pytest.fixture(params=range(10))
def random(request):
    return np.random.default_rng(request.param)


def test_a_point_is_transformed_as_in_arrays(random):
    pose, point = random.uniform(-3.0, 3.0, 3), random.uniform(-5.0, 5.0, 2)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    found = se2.transform_point(pose[0], pose[1], cos, sin, point[0], point[1])
    np.testing.assert_array_equal(found, se2.transform(pose, point))


def test_the_position_of_an_inverse_is_that_of_arrays(random):
    pose = random.uniform(-3.0, 3.0, 3)
    found = se2.inverse_position(math.cos(pose[2]), math.sin(pose[2]), pose[0], pose[1])
    np.testing.assert_array_equal(found, se2.inverse(pose)[:2])


def test_rotating_back_undoes_a_rotation(random):
    angle, vector = random.uniform(-4.0, 4.0), random.uniform(-5.0, 5.0, 2)
    cos, sin = math.cos(angle), math.sin(angle)
    turned = se2.rotate(cos, sin, vector[0], vector[1])
    np.testing.assert_allclose(turned, se2.transform([0.0, 0.0, angle], vector), atol=1e-12)
    np.testing.assert_allclose(se2.rotate_back(cos, sin, turned[0], turned[1]), vector, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-17, 3.0, -math.pi, math.pi, 7.0, -7.0, math.nextafter(-math.pi, -4.0)])
def test_all_ways_to_wrap_an_angle_agree(angle):
    wrapped = se2.wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert wrapped == se2.wrap(angle)
    for other in (se2.wrap_by_modulus(angle), se2.wrap_by_turns(angle)):
        off = abs(wrapped - other)
        assert min(off, abs(off - 2.0 * math.pi)) < 1e-14
