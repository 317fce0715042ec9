"""Scans taken while the robot moves, corrected by the odometry."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.configuration.robot import RealTimeParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.odometry import OdometryBuffer, deskew_scan
from hmt_slam_ros.sensors.scan import SweepCheck

ROOM = box(-3, -4, 5, 4)
START = np.array([0.5, -0.3, 0.4])
LIMITS = RealTimeParameters()
MS = 1_000_000
SWEEP = 0.1
MOUNTINGS = {
    "upright": {"laser_pose": (0.2, -0.1, 0.3)},
    "upside down": {"laser_pose": (0.2, -0.1, 0.3), "field_of_view": -1.5 * np.pi},
}


def sweeping(twist, **settings):
    """A scan of 0.1 s from ``START`` on, with a constant twist per second, and the readings of the odometry."""
    beams = settings.get("beams", 181)
    poses = se2.compose(START, se2.exp(SWEEP * np.linspace(0.0, 1.0, beams)[:, None] * np.asarray(twist)))
    buffer = OdometryBuffer()
    for ms in range(-40, 141, 20):
        buffer.add(Odometry(ms * MS, se2.exp(0.001 * ms * np.asarray(twist))))
    return scan_in(ROOM, poses, sweep=SWEEP, **settings), buffer


def off_the_walls(points):
    """Distance of world points from the walls of the room."""
    x, y = points.T
    return np.abs([x + 3, x - 5, y + 4, y - 4]).min(axis=0)


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_the_points_of_a_scan_on_the_move_lie_on_the_walls(mounting):
    scan, buffer = sweeping((1.0, 0.1, np.pi / 2), **MOUNTINGS[mounting])
    assert np.sign(scan.angle_increment) == (1.0 if mounting == "upright" else -1.0)
    corrected = deskew_scan(scan, buffer, LIMITS)
    assert off_the_walls(se2.transform(START, scan.points)).max() > 0.3
    assert off_the_walls(se2.transform(START, corrected.points)).max() < 1e-5


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_every_beam_starts_where_the_laser_was(mounting):
    scan, buffer = sweeping((1.0, 0.1, np.pi / 2), **MOUNTINGS[mounting])
    corrected = deskew_scan(scan, buffer, LIMITS)
    np.testing.assert_array_equal(corrected.origins[0], scan.laser_pose[:2])
    end = se2.compose(se2.exp(SWEEP * np.array([1.0, 0.1, np.pi / 2])), scan.laser_pose)
    np.testing.assert_allclose(corrected.origins[-1], end[:2], atol=1e-9)
    np.testing.assert_allclose(np.hypot(*corrected.beams.T), scan.ranges[scan.valid], rtol=1e-6)


def test_beams_without_a_return_take_their_time_too():
    scan, buffer = sweeping((1.0, 0.1, np.pi / 2))
    ranges = scan.ranges.copy()
    ranges[::3] = np.nan
    seen = np.isfinite(ranges)
    corrected = deskew_scan(replace(scan, ranges=ranges), buffer, LIMITS)
    np.testing.assert_array_equal(corrected.points, deskew_scan(scan, buffer, LIMITS).points[seen])


@pytest.mark.parametrize("increment", [0.0, SWEEP / 180])
def test_a_scan_without_motion_is_unchanged_to_the_last_bit(increment):
    scan, buffer = sweeping((0.0, 0.0, 0.0), laser_pose=(0.2, -0.1, 0.3))
    corrected = deskew_scan(replace(scan, time_increment=increment), buffer, LIMITS)
    assert corrected.points.tobytes() == scan.points.tobytes()
    assert corrected.beams.tobytes() == (scan.points - scan.laser_pose[:2]).tobytes()


def test_motion_without_time_changes_nothing():
    scan, buffer = sweeping((1.0, 0.1, np.pi / 2))
    instant = replace(scan, time_increment=0.0)
    assert deskew_scan(instant, buffer, LIMITS) is instant


def test_without_odometry_a_scan_stays_as_it_is():
    scan, _ = sweeping((1.0, 0.1, np.pi / 2))
    np.testing.assert_array_equal(deskew_scan(scan, OdometryBuffer(), LIMITS).motion, 0.0)


def test_a_reset_of_the_odometry_is_no_motion():
    scan, buffer = sweeping((0.0, 0.0, 0.0))
    buffer.add(Odometry(160 * MS, np.zeros(3)))
    buffer.add(Odometry(180 * MS, np.array([30.0, 0.0, 0.0])))
    late = replace(scan, stamp=100 * MS)
    assert deskew_scan(late, buffer, LIMITS) is late


def steady(*stamps):
    """Odometry at 1 m/s with readings at these times, ms."""
    buffer = OdometryBuffer()
    for ms in stamps:
        buffer.add(Odometry(ms * MS, np.array([0.001 * ms, 0.0, 0.0])))
    return buffer


@pytest.mark.parametrize(
    ("stamps", "start", "end", "traveled"),
    [
        ((0, 20, 40, 60, 80, 100), 10, 90, 0.08),
        ((0, 100), 0, 100, 0.1),
        ((0, 100), 100, 190, 0.09),  # goes on
        ((0, 20, 40), 30, 130, 0.03),  # no longer than the readings lie apart
        ((0, 20, 40), 300, 400, 0.0),
        ((50, 100), 0, 100, 0.05),  # nothing is known before the first reading
        ((50,), 0, 100, 0.0),
        ((), 0, 100, 0.0),
    ],
)
def test_motion_is_interpolated_and_goes_on_for_a_while_after_the_last_reading(stamps, start, end, traveled):
    buffer = steady(*stamps)
    buffer.pose_at(start * MS)
    np.testing.assert_allclose(buffer.twist_between(start * MS, end * MS), (traveled, 0.0, 0.0), atol=1e-12)


def blank(stamp, increment, beams=101):
    return Scan(stamp, np.ones(beams, dtype=np.float32), 0.0, 0.01, 0.0, 10.0, time_increment=increment)


@pytest.mark.parametrize(
    ("increment", "sentence"),
    [
        (np.nan, "time_increment = nan s, which is no time"),
        (np.inf, "time_increment = inf s, which is no time"),
        (-1e-4, "time_increment = -0.0001 s, which is no time"),
        (0.05, "its 101 beams would take 5.00 s, more than 1 s"),
    ],
)
def test_an_impossible_time_increment_is_reported_and_left_out(increment, sentence):
    scan, fault = SweepCheck().check(blank(7, increment))
    assert scan.time_increment == 0.0
    assert scan.end_stamp == 7
    assert sentence in fault


def test_a_sweep_longer_than_the_time_between_scans_is_reported_once_that_time_is_known():
    check = SweepCheck()
    verdicts = [check.check(blank(50 * k * MS, 0.001)) for k in range(10)]
    assert [fault is None for _, fault in verdicts] == [True] * 5 + [False] * 5
    assert [scan.time_increment > 0.0 for scan, _ in verdicts] == [True] * 5 + [False] * 5
    assert "101 beams would take 0.100 s, longer than the 0.050 s from one scan to the next" in verdicts[-1][1]


def test_a_stamp_that_jitters_makes_no_sweep_too_long():
    check, random = SweepCheck(), np.random.default_rng(0)
    stamps = [round((100 * k + random.uniform(-20, 20)) * MS) for k in range(200)]
    assert [fault for stamp in stamps if (fault := check.check(blank(stamp, 0.00099))[1])] == []
