"""TUM files and the look-up of a pose by its time."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import StampedPoses, read_odometry_poses, read_tum, write_tum
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry

MALAGA = Path(__file__).parents[1] / "data" / "malaga_one_loop"


def trajectory(stamps):
    stamps = np.array(stamps, dtype=np.int64)
    return StampedPoses(stamps, np.column_stack((np.arange(stamps.size), stamps, np.zeros(stamps.size))))


def test_stamps_survive_to_the_nanosecond_and_poses_to_the_nanometer(tmp_path):
    stamps = [976_052_857_337_284_001, 976_052_857_337_284_000, 1, 0, -1, 1_137_834_225_713_385_600]
    poses = np.array([[1.5, -2.25, theta] for theta in (0.0, np.pi / 2, -np.pi, 3.0, -1e-9, 0.25)])
    write_tum(tmp_path / "t.tum", StampedPoses(np.array(stamps), poses))
    again = read_tum(tmp_path / "t.tum")
    assert again.stamps.tolist() == stamps
    np.testing.assert_allclose(again.poses[:, :2], poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * again.poses[:, 2]), np.exp(1j * poses[:, 2]), atol=1e-11)


def test_the_file_is_plain_tum(tmp_path):
    write_tum(tmp_path / "t.tum", StampedPoses(np.array([1_500_000_000]), np.array([[1.0, -2.0, np.pi / 2]])))
    expected = "1.500000000 1.000000000 -2.000000000 0 0 0 0.707106781187 0.707106781187\n"
    assert (tmp_path / "t.tum").read_text() == expected


def test_comments_and_empty_lines_are_passed_over(tmp_path):
    (tmp_path / "t.tum").write_text("# t x y z qx qy qz qw\n\n1 2 3 9 0 0 1 0\n")
    read = read_tum(tmp_path / "t.tum")
    assert (read.stamps.tolist(), read.poses[0, :2].tolist()) == ([10**9], [2.0, 3.0])
    assert abs(read.poses[0, 2]) == pytest.approx(np.pi)


@pytest.mark.parametrize("text", ["", "# nothing\n", "1 2 3\n", "1 2 3 4 5 6 7 8 9\n", "x 2 3 9 0 0 1 0\n"])
def test_what_is_no_trajectory_is_one_sentence(tmp_path, text):
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(HmtSlamError, match=r"holds no pose|line 1 of .* is not"):
        read_tum(tmp_path / "t.tum")


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(HmtSlamError, match="cannot be read"):
        read_tum(tmp_path / "missing.tum")


@given(
    st.lists(st.integers(0, 30), min_size=1, max_size=12),
    st.lists(st.integers(-5, 35), min_size=1, max_size=12),
)
def test_the_nearest_pose_is_found_in_any_order_as_by_trying_all(stamps, wanted):
    found = trajectory(stamps).nearest_indices(np.array(wanted, dtype=np.int64))
    for index, stamp in zip(found.tolist(), wanted, strict=True):
        best = min(range(len(stamps)), key=lambda k: (abs(stamps[k] - stamp), stamps[k], k))
        assert index == best


def test_all_odometry_of_a_log_is_a_trajectory():
    log = open_log(MALAGA)
    odometry = read_odometry_poses(log)
    readings = [record for record in log.records() if isinstance(record.measurement, Odometry)]
    assert odometry.stamps.tolist() == [record.source_stamp for record in readings]
    np.testing.assert_array_equal(odometry.poses, [record.measurement.pose for record in readings])
