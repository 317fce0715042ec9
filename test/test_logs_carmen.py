"""CARMEN logs: geometry, odometry, the sensor's maximum, the laser's pose, and files that are cut off."""

import gzip
import lzma

import numpy as np
import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.carmen import no_return_threshold
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan


def flaser(ranges, pose=(0, 0, 0), odometry=(0, 0, 0), stamp="1.5"):
    fields = [len(ranges), *ranges, *pose, *odometry]
    return f"FLASER {' '.join(map(str, fields))} {stamp} host 0.25\n"


def odom(pose, stamp):
    return f"ODOM {' '.join(map(str, pose))} 0 0 0 {stamp} host 0.5\n"


def robotlaser(ranges, laser=(0, 0, 0), robot=(0, 0, 0), maximum=30.0, remissions=()):
    fields = [0, -1.0, 2.0, 0.5, maximum, 0.01, 0, len(ranges), *ranges, len(remissions), *remissions, *laser, *robot]
    return f"ROBOTLASER1 {' '.join(map(str, fields))} 0 0 0 0 0 2.5 host 0.25\n"


def log_of(tmp_path, *lines):
    path = tmp_path / "robot.clf"
    path.write_text("PARAM robot_use_laser on nohost 0\n" + "".join(lines))
    return open_log(path)


def scans_of(log):
    return [record.measurement for record in log.records() if isinstance(record.measurement, Scan)]


def odometry_of(log):
    return [record.measurement for record in log.records() if isinstance(record.measurement, Odometry)]


def angles(scan):
    return scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size)


@pytest.mark.parametrize(("beams", "last"), [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0)])
def test_flaser_beams_begin_at_minus_90_degrees(tmp_path, beams, last):
    (scan,) = scans_of(log_of(tmp_path, flaser([1.0] * beams)))
    assert np.rad2deg(angles(scan)[[0, -1]]) == pytest.approx([-90.0, last], abs=1e-5)


def test_flaser_gives_its_own_odometry_just_before_the_scan(tmp_path):
    log = log_of(tmp_path, odom((1, 2, 3), "1.25"), flaser([1.0, 2.0], (9, 9, 9), (4, 5, 0.5), "1.5"))
    first, second, third = log.records()
    assert (first.source_stamp, first.measurement.pose.tolist()) == (1_250_000_000, [1, 2, 3])
    assert second.measurement.pose.tolist() == [4, 5, 0.5]
    assert isinstance(third.measurement, Scan)
    assert second.measurement.stamp == third.measurement.stamp == third.source_stamp == 1_500_000_000


def test_stamps_that_jump_back_leave_the_file_order(tmp_path):
    log = log_of(tmp_path, *(flaser([k, k], stamp=stamp) for k, stamp in enumerate(["1.5", "1.2", "1.6"], start=1)))
    records = [record for record in log.records() if isinstance(record.measurement, Scan)]
    assert [record.source_stamp for record in records] == [1_500_000_000, 1_200_000_000, 1_600_000_000]
    assert [record.measurement.stamp for record in records] == [1_500_000_000, 1_500_001_000, 1_600_000_000]
    assert [record.measurement.ranges[0] for record in records] == [1.0, 2.0, 3.0]


def test_beam_counts_nan_inf_and_zero_are_kept(tmp_path):
    log = log_of(tmp_path, flaser([0.0, "nan", "inf", 2.5]), flaser([1.0, 0.0]), flaser([]))
    first, second, third = scans_of(log)
    np.testing.assert_array_equal(first.ranges, np.array([0.0, np.nan, np.inf, 2.5], dtype=np.float32))
    assert first.valid.tolist() == [False, False, False, True]
    assert (second.ranges.size, third.ranges.size) == (2, 0)


def test_robotlaser_tells_geometry_and_mounting(tmp_path):
    robot = np.array([3.0, 4.0, 2.0])
    laser = se2.compose(robot, [0.22, -0.04, 0.1])
    (scan,) = scans_of(log_of(tmp_path, robotlaser([1.0, 30.0, 2.0], laser, robot, remissions=(7, 8, 9))))
    assert (scan.angle_min, scan.angle_increment, scan.range_max) == (-1.0, 0.5, 30.0)
    assert scan.laser_pose == pytest.approx([0.22, -0.04, 0.1], abs=1e-4)
    assert scan.valid.tolist() == [True, False, True]


def test_robotlaser_poses_that_differ_by_rounding_are_one_mounting(tmp_path):
    lines = [robotlaser([1.0], np.round([k + 0.1, 0, 0], 6) + 1e-6 * (k % 2), (k, 0, 0)) for k in range(5)]
    assert len({scan.laser_pose.tobytes() for scan in scans_of(log_of(tmp_path, *lines))}) == 1


def _drive(count, laser_of):
    for k in range(count):
        robot = np.array([0.1 * k, 0.01 * k, 0.05 * k])
        yield flaser([1.0 + 0.01 * k, 2.0], np.round(laser_of(robot, k), 6), np.round(robot, 6), stamp=str(k))


def test_a_constant_offset_between_the_flaser_poses_is_the_mounting(tmp_path):
    log = log_of(tmp_path, *_drive(20, lambda robot, k: se2.compose(robot, [-0.04, 0.0, 0.0])))
    assert all(scan.laser_pose == pytest.approx([-0.04, 0.0, 0.0], abs=1e-4) for scan in scans_of(log))


def test_corrected_flaser_poses_are_neither_mounting_nor_odometry(tmp_path):
    log = log_of(tmp_path, *_drive(20, lambda robot, k: se2.compose(robot, [0.02 * k, 0.0, 0.01 * k])))
    assert all(scan.laser_pose.tolist() == [0, 0, 0] for scan in scans_of(log))
    assert odometry_of(log)[-1].pose == pytest.approx([1.9, 0.19, 0.95])


def test_the_parameter_tells_the_mounting_where_the_poses_do_not(tmp_path):
    log = log_of(tmp_path, "PARAM robot_frontlaser_offset 0.22 nohost 0\n", *_drive(20, lambda robot, k: robot))
    assert all(scan.laser_pose.tolist() == [0.22, 0, 0] for scan in scans_of(log))


@pytest.mark.parametrize("maximum", [50.0, 51.16, 81.83, 81.91, 80.0, 8.19])
def test_the_sensors_maximum_is_no_return_whatever_it_is(maximum):
    real = np.linspace(0.5, maximum, 5000)
    ranges = np.concatenate([real, np.full(4000, maximum), np.full(20, maximum - 0.01)]).astype(np.float32)
    limit = no_return_threshold(ranges)
    assert limit <= np.float32(maximum - 0.01)
    assert limit >= 0.99 * maximum - 1e-5


def test_a_log_that_never_reaches_the_maximum_has_no_saturated_beam():
    ranges = np.round(np.random.default_rng(1).uniform(0.5, 7.5, 20000), 2).astype(np.float32)
    assert np.all(ranges < no_return_threshold(ranges))


def test_a_stray_reading_beyond_the_maximum_does_not_hide_it():
    ranges = np.concatenate([np.linspace(0.5, 20.0, 1000), np.full(300, 50.0), [655.35]]).astype(np.float32)
    assert no_return_threshold(ranges) == 50.0


@pytest.mark.parametrize(("compress", "suffix"), [(gzip.compress, ".gz"), (lzma.compress, ".xz")])
def test_compressed_text_is_read_as_it_is(tmp_path, compress, suffix):
    path = tmp_path / f"robot.clf{suffix}"
    path.write_bytes(compress(flaser([1.0, 2.0]).encode()))
    assert (open_log(path).name, open_log(path).scan_count) == ("robot", 1)


@pytest.mark.parametrize("lost", [3, 10, 22, 40])
def test_a_last_line_that_is_cut_off_is_refused_on_opening(tmp_path, lost):
    path = tmp_path / "cut.clf"
    text = flaser([1.0, 2.0, 3.0]) + flaser([1.0, 2.0, 3.0])
    path.write_text(text[: -lost - len(" 0.25\n")])
    with pytest.raises(HmtSlamError, match=r"^line 2 \(the last one\) of cut.clf is cut off or malformed: .*\.$"):
        open_log(path)


def test_a_compressed_file_that_is_cut_off_is_refused(tmp_path):
    for compress in (gzip.compress, lzma.compress):
        path = tmp_path / "cut.clf"
        path.write_bytes(compress(flaser([1.0, 2.0]).encode() * 50)[:-20])
        with pytest.raises(HmtSlamError, match="truncated or damaged"):
            open_log(path)


def test_a_log_without_scans_is_refused(tmp_path):
    with pytest.raises(HmtSlamError, match="holds no laser scan"):
        log_of(tmp_path, odom((0, 0, 0), "1.0"))


def test_a_log_can_be_read_again_and_again(tmp_path):
    log = log_of(tmp_path, flaser([1.0, 2.0]))
    assert [r.source_stamp for r in log.records()] == [r.source_stamp for r in log.records()]
