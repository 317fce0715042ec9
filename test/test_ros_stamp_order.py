"""The order of a sensor's messages, and when none come."""

import time
from types import SimpleNamespace

import pytest

from hmt_slam_ros.ros.sensor_input import MIN_BACKWARD_JUMP, StampOrder


def let_through(stamps, newest=None):
    """The stamps that are let through, and how many are refused."""
    order = StampOrder(newest)
    return [one for stamp in stamps for one in order.push(stamp, stamp)], order.rejected_count


@pytest.mark.parametrize(
    ("stamps", "expected", "refused"),
    [
        pytest.param([1, 2, 3], [1, 2, 3], 0, id="in order"),
        pytest.param([1, 3, 2, 4], [1, 3, 4], 1, id="swapped"),
        pytest.param([1, 1, 2, 2, 2, 3], [1, 2, 3], 3, id="repeated"),
        pytest.param(
            [9 * MIN_BACKWARD_JUMP, MIN_BACKWARD_JUMP, 10 * MIN_BACKWARD_JUMP],
            [9 * MIN_BACKWARD_JUMP, 10 * MIN_BACKWARD_JUMP],
            1,
            id="one very late",
        ),
        pytest.param(
            [9 * MIN_BACKWARD_JUMP, 3, MIN_BACKWARD_JUMP, 10 * MIN_BACKWARD_JUMP],
            [9 * MIN_BACKWARD_JUMP, 3, MIN_BACKWARD_JUMP, 10 * MIN_BACKWARD_JUMP],
            0,
            id="time goes back",
        ),
        pytest.param(
            [9 * MIN_BACKWARD_JUMP, 3, 3, 4],
            [9 * MIN_BACKWARD_JUMP, 3, 4],
            1,
            id="time goes back, and the first comes twice",
        ),
        pytest.param(
            [9 * MIN_BACKWARD_JUMP, 5 * MIN_BACKWARD_JUMP, 3, 4],
            [9 * MIN_BACKWARD_JUMP, 3, 4],
            1,
            id="time goes back twice",
        ),
        pytest.param(
            [-1, 9 * MIN_BACKWARD_JUMP, MIN_BACKWARD_JUMP, 8 * MIN_BACKWARD_JUMP],
            [-1, 9 * MIN_BACKWARD_JUMP, MIN_BACKWARD_JUMP, 8 * MIN_BACKWARD_JUMP],
            0,
            id="it goes back for long",
        ),
    ],
)
def test_late_and_repeated_stamps_are_refused_and_time_that_jumps_back_is_not(stamps, expected, refused):
    assert let_through(stamps) == (expected, refused)


def test_the_order_continues_after_earlier_stamps_and_may_restart_at_any_time_on_request():
    assert let_through([4, 5, 6], newest=5) == ([6], 2)
    order = StampOrder(5)
    assert order.push(2, "late") == []
    assert order.last_rejected_stamp == 2
    order.reset()
    assert order.push(1, "of another time") == ["of another time"]


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
    from hmt_slam_ros.ros.sensor_input import SensorMonitor  # noqa: PLC0415  only where there is ROS

    messages = []
    monkeypatch.setattr(time, "monotonic", lambda: 0.0)
    watch = SensorMonitor(SimpleNamespace(warn=messages.append))
    for readings, moment in enumerate(looks, 1):
        monkeypatch.setattr(time, "monotonic", lambda moment=moment: moment)
        watch.check_silence(readings)
    assert bool(messages) == silent
