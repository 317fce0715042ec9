"""The order of a sensor's messages, and when none come."""

import time
from types import SimpleNamespace

import pytest

from hmt_slam_ros.ros.sensor_input import MAX_FORWARD_JUMP, MIN_BACKWARD_JUMP, StampOrder

JUMP = 9 * MIN_BACKWARD_JUMP
SILENCE = "silence"
"""Among stamps: for some time no message comes."""


def let_through(stamps, newest=None):
    """The stamps that are let through, and how many are refused."""
    order, passed = StampOrder(newest), []
    for stamp in stamps:
        due = [order.check() for _ in range(4)] if stamp is SILENCE else [order.push(stamp, stamp)]
        passed += [one for batch in due for one in batch]
    return passed, order.rejected_count


@pytest.mark.parametrize(
    ("stamps", "expected", "refused"),
    [
        pytest.param([1, 2, 3], [1, 2, 3], 0, id="in order"),
        pytest.param([1, 3, 2, 4], [1, 3, 4], 1, id="swapped"),
        pytest.param([1, 1, 2, 2, 2, 3], [1, 2, 3], 3, id="repeated"),
        pytest.param([JUMP, 3, JUMP + 1], [JUMP, JUMP + 1], 1, id="one very late"),
        pytest.param([JUMP, 3, 4, 5, JUMP + 1, SILENCE], [JUMP, JUMP + 1], 3, id="a second source"),
        pytest.param([JUMP, 3, SILENCE, 4, JUMP + 1], [JUMP, JUMP + 1], 2, id="a second source, and a break"),
        pytest.param([JUMP, 3, 4, SILENCE, 5], [JUMP, 3, 4, 5], 0, id="time goes back"),
        pytest.param([JUMP, 3, 3, 4, SILENCE], [JUMP, 3, 4], 1, id="time goes back, and the first comes twice"),
        pytest.param([1, 10 * MAX_FORWARD_JUMP, 2, 3], [1, 2, 3], 1, id="one far ahead"),
        pytest.param([1, 10 * MAX_FORWARD_JUMP, 10 * MAX_FORWARD_JUMP + 1, 2, SILENCE], [1, 2], 2, id="two far ahead"),
        pytest.param(
            [1, 10 * MAX_FORWARD_JUMP, 10 * MAX_FORWARD_JUMP + 1, SILENCE],
            [1, 10 * MAX_FORWARD_JUMP, 10 * MAX_FORWARD_JUMP + 1],
            0,
            id="nothing came for long",
        ),
    ],
)
def test_late_repeated_and_stray_stamps_are_refused_and_time_that_jumps_is_not(stamps, expected, refused):
    assert let_through(stamps) == (expected, refused)


def test_the_order_continues_after_earlier_stamps_and_may_restart_at_any_time_on_request():
    assert let_through([4, 5, 6], newest=5) == ([6], 2)
    order = StampOrder(5)
    assert order.push(2, "late") == []
    assert order.last_rejected_stamp == 2
    order.reset()
    assert order.push(1, "of another time") == ["of another time"]


def test_a_restart_keeps_what_waits():
    order = StampOrder(9 * MIN_BACKWARD_JUMP)
    assert order.push(1, "first") == []
    order.reset()
    assert order.push(2, "second") == ["first", "second"]
    order = StampOrder(9 * MIN_BACKWARD_JUMP)
    order.push(1, "alone")
    order.reset()
    assert order.check() == ["alone"]


@pytest.mark.parametrize(
    ("looks", "silent"),
    [
        pytest.param([1.0, 2.0, 3.0, 4.0], True, id="the laser"),
        pytest.param([1.0, 30.0, 31.0, 32.0], False, id="the node was busy"),
        pytest.param([1.0, 30.0, 31.0, 32.0, 33.0, 34.0], True, id="the laser, after the node was busy"),
    ],
)
def test_a_laser_is_silent_only_where_the_node_could_receive_it(monkeypatch, looks, silent):
    pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")
    from hmt_slam_ros.ros.sensor_monitor import SensorMonitor  # noqa: PLC0415  only where there is ROS

    messages = []
    monkeypatch.setattr(time, "monotonic", lambda: 0.0)
    watch = SensorMonitor(SimpleNamespace(warn=messages.append), ["scan"])
    for readings, moment in enumerate(looks, 1):
        monkeypatch.setattr(time, "monotonic", lambda moment=moment: moment)
        watch.check_silence(readings)
    assert bool(messages) == silent
