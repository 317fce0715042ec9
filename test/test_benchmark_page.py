"""The measurement of the live page's cost, in short."""

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from benchmark.page import measure_cost


def test_the_cost_of_a_page_is_measured_with_a_browser():
    cost = measure_cost(1, 4.0, areas=20, rate=5.0)
    assert 0.0 < cost.share < 1.0
    assert 20e6 < cost.memory < 1e9
    assert cost.stream > 1000.0
