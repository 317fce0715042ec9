"""The motion between two scans."""

import numpy as np
import pytest

from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion, is_jump


def spread(random, scale):
    root = scale * random.standard_normal((3, 3))
    return root @ root.T + 1e-4 * np.eye(3)


@pytest.mark.parametrize("distance", [0.05, 0.5, 3.0])
def test_a_jump_is_beyond_the_gate_of_the_distance_of_two_beliefs(distance):
    random = np.random.default_rng(0)
    jumps = 0
    for _ in range(300):
        first = random.standard_normal(3)
        odometry = RelativeMotion(first, spread(random, 0.2))
        inertia = RelativeMotion(first + distance * random.standard_normal(3), spread(random, 0.1))
        expected = PoseGaussian(*odometry).mahalanobis2(PoseGaussian(*inertia)) > chi_square_gate(0.999)
        assert is_jump(odometry, inertia) == expected
        jumps += expected
    assert jumps > 0 or distance < 0.1
    assert jumps < 300


def test_motions_without_uncertainty_compare():
    assert not is_jump(NO_MOTION, NO_MOTION)
    assert is_jump(RelativeMotion(np.array([0.0, 0.0, 0.1]), np.zeros((3, 3))), NO_MOTION)
