"""Which process computes when."""

import os
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from benchmark.timeline import draw_timeline, record_samples


def test_a_process_that_computes_is_on_a_core_and_one_that_sleeps_is_not():
    with record_samples({"own": os.getpid()}) as samples:
        while not samples:
            time.sleep(0.01)
        begin = time.thread_time()
        while time.thread_time() - begin < 0.3:
            pass
    own = np.array(samples)[:, 1]
    assert 0.2 < np.ptp(own) < 0.5
    with record_samples({"own": os.getpid()}) as samples:
        time.sleep(0.3)
    assert np.ptp(np.array(samples)[:, 1]) < 0.1


def test_the_picture_has_a_line_for_each_node(tmp_path):
    times = np.linspace(-5.0, 5.0, 1001)
    draw_timeline(tmp_path / "timeline.png", times, {"slam": np.abs(np.sin(times)), "rtl": 0.0 * times}, [0.0])
    assert (tmp_path / "timeline.png").stat().st_size > 5000
