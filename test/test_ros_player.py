"""When the records of a log are due."""

from itertools import pairwise

import pytest
from logs_for_nodes import START, Corridor

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from hmt_slam_ros.configuration.robot import RobotParameters
from hmt_slam_ros.ros.player import Player
from hmt_slam_ros.sensors import Odometry, Scan


def play(player, until, step=0.001, acknowledge=True):
    """(time, measurement) of all that is handed out in ``until`` seconds."""
    out, now = [], 0.0
    while now < until and not player.has_ended:
        while not player.has_ended and (wait := player.seconds_until_due(now)) is not None and wait <= 0.0:
            taken = player.take_next(now)
            out.append((now, taken))
            if acknowledge and isinstance(taken, Scan):
                player.acknowledge(taken.stamp)
        now += step
    return out


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_measurements_come_at_the_rate_of_the_log_times_the_factor(rate):
    out = play(Player(Corridor(5), RobotParameters(rate=rate)), 10.0)
    assert len(out) == 22
    for now, measurement in out:
        assert now == pytest.approx((measurement.stamp - START) / 1e9 / rate, abs=0.002 + 0.001)


def test_rate_0_waits_for_nothing():
    out = play(Player(Corridor(5), RobotParameters(rate=0.0)), 10.0)
    assert len(out) == 22
    assert out[-1][0] == 0.0


def test_no_more_scans_are_under_way_than_the_window_holds():
    player = Player(Corridor(9), RobotParameters(rate=0.0, max_unacknowledged_scans=3))
    out = play(player, 1.0, acknowledge=False)
    scans = [measurement for _, measurement in out if isinstance(measurement, Scan)]
    assert len(scans) == 3
    assert player.is_held_up
    player.acknowledge(scans[1].stamp)
    assert player.scans_acknowledged == 2
    assert len(play(player, 1.0, acknowledge=False)) > 2
    assert player.scans_sent == 5


def test_as_many_scans_are_under_way_as_slam_may_wait_for():
    player = Player(Corridor(30), RobotParameters(rate=0.0, max_unacknowledged_scans=3), patience=1.0)
    scans = [measurement for _, measurement in play(player, 1.0, acknowledge=False) if isinstance(measurement, Scan)]
    assert len(scans) > 3
    assert player.is_held_up
    assert 0.8 < (scans[-1].stamp - scans[0].stamp) * 1e-9 <= 1.0


def test_without_pace_nothing_is_held_back():
    player = Player(Corridor(9), RobotParameters(rate=0.0, flow_control=False, max_unacknowledged_scans=1))
    play(player, 1.0, acknowledge=False)
    assert player.has_ended
    assert (player.scans_sent, player.readings_sent) == (9, 33)


def test_a_pause_does_not_end_in_a_burst():
    player = Player(Corridor(9), RobotParameters(rate=1.0))
    assert play(player, 0.3)
    player.is_paused = True
    assert player.seconds_until_due(5.0) is None
    player.is_paused = False
    player.take_next(5.0)
    assert player.seconds_until_due(5.0) == pytest.approx(0.05, abs=1e-6)


def test_a_log_that_loops_has_stamps_that_go_on_increasing():
    player = Player(Corridor(3), RobotParameters(rate=0.0, loop=True))
    taken = []
    while len(taken) < 40:
        taken.append(player.take_next(0.0))
        player.acknowledge(player.stamp)
    for kind in (Scan, Odometry):
        stamps = [measurement.stamp for measurement in taken if isinstance(measurement, kind)]
        assert all(a < b for a, b in pairwise(stamps))
    assert not player.has_ended
    assert len(taken[0].pose) == 3


def test_an_acknowledgement_of_something_else_changes_nothing():
    player = Player(Corridor(5), RobotParameters(rate=0.0, max_unacknowledged_scans=2))
    play(player, 1.0, acknowledge=False)
    player.acknowledge(START - 1)
    assert player.scans_acknowledged == 0
