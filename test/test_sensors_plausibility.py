"""Measurements that no process may see: NaN, infinities, zero angles, wild clocks."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.plausibility import check_odometry, check_quaternion, check_scan, find_invalid_covariance

SCAN = Scan(10**18, np.ones(181, dtype=np.float32), -1.5, 0.0175, 0.1, 30.0)


def test_a_usual_scan_passes_whatever_its_ranges_are():
    ranges = np.array([np.nan, np.inf, -np.inf, 0.0, -1.0, 3e38], dtype=np.float32)
    for scan in (
        SCAN,
        replace(SCAN, ranges=ranges),
        replace(SCAN, angle_increment=-0.0175),
        replace(SCAN, range_max=np.inf),
    ):
        assert check_scan(scan) is scan
    single = replace(SCAN, ranges=ranges[:1], angle_increment=0.0)
    assert check_scan(single) is single


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("stamp", -1),
        ("stamp", 2**63),
        ("ranges", np.ones(100_001, dtype=np.float32)),
        ("angle_min", np.nan),
        ("angle_min", 1e30),
        ("angle_increment", np.inf),
        ("angle_increment", 0.0),
        ("angle_increment", 1e-30),
        ("angle_increment", 1.0),
        ("range_min", np.nan),
        ("range_min", -1.0),
        ("range_max", np.nan),
        ("range_max", 0.05),
        ("time_increment", np.nan),
        ("time_increment", -1e-3),
        ("time_increment", 1.0),
        ("laser_pose", np.array([0.0, np.nan, 0.0])),
        ("laser_pose", np.array([0.0, 0.0, np.inf])),
        ("laser_pose", np.array([1e4, 0.0, 0.0])),
    ],
)
def test_a_scan_with_an_impossible_field_is_refused_by_its_name(field, value):
    name = "the laser's pose" if field == "laser_pose" else field
    with pytest.raises(HmtSlamError, match=f"^{name} = .*: correct the driver"):
        check_scan(replace(SCAN, **{field: value}))


@pytest.mark.parametrize("pose", [(np.nan, 0, 0), (0, np.inf, 0), (0, 0, np.nan), (1e308, 0, 0), (0, -2e7, 0)])
def test_an_odometry_reading_that_is_no_pose_is_refused(pose):
    with pytest.raises(HmtSlamError, match=r"^pose = .*: correct the driver"):
        check_odometry(Odometry(1, np.array(pose, dtype=float)))


def test_a_usual_odometry_reading_passes():
    reading = Odometry(1, np.array([1e6, -1e6, 700.0]))
    assert check_odometry(reading) is reading


@pytest.mark.parametrize(
    "quaternion", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (0, 0, 0, np.inf), (0, 0, 1, 1), (1e-30, 0, 0, 0), (1e200,) * 4]
)
def test_what_is_no_rotation_is_refused(quaternion):
    with pytest.raises(HmtSlamError, match=r"^orientation = .* quaternion of norm 1"):
        check_quaternion(quaternion)


def test_a_rotation_in_float32_passes():
    check_quaternion(tuple(np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)], dtype=np.float32).tolist()))


TILTED = np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    "matrix",
    [
        -TILTED,
        TILTED + np.triu(np.full((3, 3), 2e-6), 1),
        np.diag([1.0, 1.0, -2e-6]),
        np.diag([1.0, 1.0, np.nan]),
        np.diag([1.0, 1.0, np.inf]),
        np.diag([1.0, 1.0, 1.01e14]),
    ],
)
def test_the_matrix_that_is_no_covariance_is_found_among_others(matrix):
    assert find_invalid_covariance(np.array([TILTED, 1e6 * TILTED, matrix, TILTED])) == 2


def test_a_covariance_may_be_singular_up_to_rounding_unless_a_variance_is_wanted():
    rounded = np.array([np.zeros((3, 3)), np.diag([1.0, 1.0, -5e-7]), TILTED + np.triu(np.full((3, 3), 5e-7), 1)])
    assert find_invalid_covariance(rounded) is None
    assert find_invalid_covariance(np.diag([1.0, 1.0, 1e-12])[None], 1e-12) is None
    assert find_invalid_covariance(np.diag([1.0, 1.0, 9e-13])[None], 1e-12) == 0
