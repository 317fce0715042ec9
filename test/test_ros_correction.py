"""A node that is in time; a correction reaches those who steer by it at one stroke, or little by little."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.real_time_localization.correction import CorrectionSmoother
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS

STEP = 10_000_000  # ns
ORDINARY = ("setpriv", "--bounding-set=-sys_nice")
FAR = np.array([300.0, -200.0, 1.2])
KNOWN, CORRECTED = np.array([0.0, 0.0, 0.0]), np.array([0.4, -0.2, 0.02])


def drive_poses(time, corrected=CORRECTED, steps=100):
    """Poses in the map as they are shown and known while the robot drives, corrected before the first step."""
    correction = CorrectionSmoother()
    correction.smooth(0, KNOWN, FAR, time)
    shown, known = [], []
    for k in range(1, steps + 1):
        odom_T_base = se2.compose(FAR, np.array([0.006 * k, 0.0, 0.0]))
        map_T_odom = correction.smooth(k * STEP, corrected, odom_T_base, time)
        shown.append(se2.compose(map_T_odom, odom_T_base))
        known.append(se2.compose(corrected, odom_T_base))
    return np.array(shown), np.array(known)


def test_a_correction_is_made_at_once_where_no_time_is_given():
    shown, known = drive_poses(time=0.0)
    np.testing.assert_allclose(shown, known, atol=1e-9)


def test_a_correction_falls_to_a_third_in_its_time_without_a_jump():
    near = np.array([1e-3, 2e-3, 1e-5])
    shown, known = drive_poses(time=0.5, corrected=near)
    left = se2.log(se2.between(known, shown))
    first = se2.log(se2.between(se2.compose(near, FAR), FAR))
    # What is left turns with the robot: by 1e-5 on 0.3 m.
    np.testing.assert_allclose(left[49], first * math.exp(-1.0), atol=5e-6)
    steps = np.linalg.norm(np.diff(shown[:, :2], axis=0), axis=1)
    assert steps.max() < 0.006 + 0.03 * np.linalg.norm(first[:2])


def test_what_is_no_correction_but_another_place_is_shown_at_once():
    # A turn of 1.1 degrees about odometry's origin, 360 m away, moves the robot by 7 m.
    shown, known = drive_poses(time=0.5)
    np.testing.assert_allclose(shown, known, atol=1e-6)


def test_time_that_jumps_back_restarts():
    correction = CorrectionSmoother()
    correction.smooth(100 * STEP, KNOWN, FAR, 0.5)
    near = np.array([1e-3, 2e-3, 1e-5])
    np.testing.assert_array_equal(correction.smooth(0, near, FAR, 0.5), near)


@pytest.mark.parametrize(
    ("before", "messages"), [((), "yes"), (ORDINARY, "not permitted")], ids=["permitted", "ordinary"]
)
def test_rtl_comes_before_what_computes_for_long_where_that_is_permitted(listener, start, before, messages):
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    process = start("rtl", before=before)

    def answer():
        values = [value for message in reported for status in message.status for value in status.values]
        return next((value.value for value in values if value.key == "real-time scheduling"), None)

    listener.until(answer, alive=[process])
    if before == () and answer() == "not permitted":
        pytest.skip("the system does not permit it: it needs root or an rtprio limit")
    assert answer() == messages
    threads = [int(thread.name) for thread in Path(f"/proc/{process.pid}/task").iterdir()]
    policies = {os.sched_getscheduler(thread) for thread in threads}
    assert policies == {os.SCHED_RR if messages == "yes" else os.SCHED_OTHER}
