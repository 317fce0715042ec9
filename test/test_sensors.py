"""Scans and odometry."""

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import increment_covariance


def test_only_beams_with_a_return_become_points():
    ranges = np.array([np.nan, np.inf, -1.0, 0.0, 0.05, 1.0, 8.0, 9.0], dtype=np.float32)
    scan = Scan(0, ranges, 0.0, 0.1, 0.1, 8.0)
    np.testing.assert_array_equal(scan.valid, [False] * 5 + [True, False, False])
    np.testing.assert_allclose(scan.points, [[np.cos(0.5), np.sin(0.5)]])


def test_points_are_in_the_base_frame():
    walls = box(-3, -3, 3, 3)
    mounted = scan_in(walls, (0.5, 0.2, 0.3), laser_pose=(0.2, -0.1, 1.0))
    world = se2.transform((0.5, 0.2, 0.3), mounted.points)
    np.testing.assert_allclose(np.abs(world).max(axis=1), 3.0, atol=1e-5)


def test_a_laser_mounted_upside_down_turns_the_other_way():
    scan = Scan(0, np.array([1.0, 1.0], dtype=np.float32), 0.0, -0.5, 0.0, 10.0)
    np.testing.assert_allclose(scan.points[1], [np.cos(0.5), -np.sin(0.5)], atol=1e-7)


def test_the_covariance_of_an_increment_grows_with_the_way_and_has_a_floor():
    motion = MotionParameters()
    still = increment_covariance(np.zeros(3), motion)
    near = increment_covariance(np.array([0.5, 0.0, 0.0]), motion)
    turned = increment_covariance(np.array([0.5, 0.0, 1.0]), motion)
    assert np.sqrt(still[0, 0]) == pytest.approx(motion.translation_floor)
    assert np.degrees(np.sqrt(still[2, 2])) == pytest.approx(motion.rotation_floor)
    assert (np.diag(still) < np.diag(near)).all()
    assert (np.diag(near) < np.diag(turned)).all()
