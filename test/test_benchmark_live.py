"""Latency of the nodes by the stamps of DDS."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from benchmark.live import BUSY, FAST, SLOW_TSBI, MessageTimes, count_unanswered, measure_scans


def test_a_delay_is_that_from_a_message_to_its_answer():
    times = MessageTimes({1: 10.0, 2: 11.0, 3: 12.0}, {2: 11.5, 3: 12.25, 9: 13.0})
    np.testing.assert_allclose(times.delays, [0.5, 0.25])


def test_messages_before_the_first_answer_are_not_missing():
    assert count_unanswered(MessageTimes({1: 10.0, 2: 11.0, 3: 12.0, 4: 13.0}, {2: 11.5, 4: 13.5})) == 1


@pytest.mark.long
def test_a_laser_with_forty_scans_a_second_is_kept_up_with():
    times = measure_scans(FAST, seconds=6.0).final
    assert len(times.sent) == len(times.delays) == 241
    # What waited while kernels were compiled or loaded is worked off; a laser too fast would let the delays grow.
    assert times.delays[-20:].min() < max(0.3, times.delays.max() - 0.5), times.delays


@pytest.mark.long
def test_estimates_do_not_wait_for_slow_topology():
    times = measure_scans(BUSY, 6.0, SLOW_TSBI)
    assert len(times.first.sent) == len(times.final.delays) == len(times.first.delays)
    assert np.median(times.final.delays - times.first.delays) > 0.5
