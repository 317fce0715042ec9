"""Conversions to ROS messages and back."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import LaserScan

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.occupancy_map import FREE, OCCUPIED, UNKNOWN, OccupancyImage
from hmt_slam_ros.messages.messages import Hypotheses, Hypothesis, ScanPoses
from hmt_slam_ros.ros import conversions
from hmt_slam_ros.ros.map_view import grid_message
from hmt_slam_ros.ros.publishing_nodes import pmf_message
from hmt_slam_ros.sensors import Odometry, Scan

STAMPS = st.integers(0, 2**31 * 10**9 - 1)
# Half of the smallest doubles cannot be represented.
ANGLES = st.floats(-math.pi, math.pi, exclude_max=True).map(lambda angle: angle if abs(angle) > 1e-300 else 0.0)
METRES = st.floats(-1e6, 1e6)


def transmit(message):
    """The message as it arrives on the other side."""
    return deserialize_message(serialize_message(message), type(message))


@given(STAMPS)
def test_a_stamp_comes_back_to_the_nanosecond(stamp):
    assert conversions.stamp_from_time(transmit(conversions.time_message(stamp))) == stamp


@given(STAMPS, METRES, METRES, ANGLES)
def test_an_odometry_reading_comes_back_bit_for_bit(stamp, x, y, theta):
    reading = Odometry(stamp, np.array([x, y, theta]))
    back = conversions.odometry_from_message(transmit(conversions.odometry_message(reading, "odom", "base_link")))
    assert back.stamp == stamp
    assert np.array_equal(back.pose, reading.pose)


@pytest.mark.parametrize("ranges", [[], [1.5], [0.0, np.nan, np.inf, -1.0, 80.0]])
def test_a_scan_comes_back_with_all_its_beams(ranges):
    laser = np.array([0.2, -0.1, 0.3])
    angles = [float(np.float32(value)) for value in (-1.5, 0.01, 0.1, 81.9, 1e-5)]
    scan = Scan(123456789123, np.array(ranges, dtype=np.float32), *angles[:4], laser, angles[4])
    back = conversions.scan_from_message(transmit(conversions.scan_message(scan, "laser")), laser)
    assert back.ranges.tobytes() == scan.ranges.tobytes()
    for name in ("stamp", "angle_min", "angle_increment", "range_min", "range_max", "time_increment"):
        assert getattr(back, name) == getattr(scan, name), name


def test_the_angles_of_a_laser_that_hangs_upside_down_count_the_other_way():
    message = LaserScan(angle_min=0.0, angle_increment=0.5, range_min=0.1, range_max=10.0, ranges=[1.0, 2.0])
    scan = conversions.scan_from_message(message, np.zeros(3), angle_sign=-1.0)
    assert np.allclose(scan.points[1], [2 * math.cos(0.5), -2 * math.sin(0.5)], atol=1e-6)


def test_the_covariance_is_turned_into_the_axes_of_the_frame():
    # The robot looks along y and is unsure in its own forward direction, so the pose is unsure in y.
    belief = PoseGaussian(np.array([1.0, 2.0, math.pi / 2]), np.diag([0.5, 0.1, 0.02]))
    message = transmit(conversions.pose_with_covariance_message(5, "map", belief))
    covariance = np.reshape(message.pose.covariance, (6, 6))
    assert np.allclose(np.diag(covariance), [0.1, 0.5, 0, 0, 0, 0.02])
    back = conversions.gaussian_from_message(message.pose)
    assert np.array_equal(back.mean, belief.mean)
    assert np.allclose(back.covariance, belief.covariance, atol=1e-15)


@given(
    st.lists(st.tuples(STAMPS, st.integers(-(10**6), 10**6), METRES, METRES, ANGLES), max_size=5), st.integers(0, 10**6)
)
def test_a_trail_comes_back_bit_for_bit(rows, first):
    trail = ScanPoses(
        7,
        first,
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=np.int64),
        np.array([row[2:] for row in rows], dtype=np.float64).reshape(-1, 3),
    )
    back = conversions.scan_poses_from_message(transmit(conversions.path_message(trail)))
    assert (back.hypothesis, back.first_scan) == (7, first)
    for name in ("stamps", "keyframes", "poses"):
        assert np.array_equal(getattr(back, name), getattr(trail, name))
        assert getattr(back, name).dtype == getattr(trail, name).dtype


@pytest.mark.parametrize("frame", ["", "map", "hypothesis_1", "hypothesis_1/scan_x"])
def test_a_path_with_other_frames_is_no_trail(frame):
    message = conversions.path_message(ScanPoses(0, 0, np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3))))
    message.header.frame_id = frame
    with pytest.raises(HmtSlamError, match="is not of the form"):
        conversions.scan_poses_from_message(message)


def test_the_grid_has_its_first_row_at_the_smallest_y():
    pixels = np.array([[OCCUPIED, FREE, FREE], [UNKNOWN, UNKNOWN, FREE]])
    message = transmit(grid_message(1, "map", OccupancyImage(pixels, 0.05, np.array([-1.0, 2.0]))))
    assert (message.info.width, message.info.height) == (3, 2)
    assert list(message.data) == [-1, -1, 0, 100, 0, 0]
    assert (message.info.origin.position.x, message.info.origin.position.y) == (-1.0, 2.0)


def test_the_distribution_names_the_most_probable_path_first_and_what_was_not_examined_last():
    message = transmit(pmf_message(Hypotheses(3, (Hypothesis(4, 4, 0.2, 1), Hypothesis(5, 4, 0.7, 2)), 0.1)))
    assert np.reshape(message.data, (-1, 3)).tolist() == [[5, 2, 0.7], [4, 1, 0.2], [-1, -1, 0.1]]
