"""While topology does not answer, the robot's pose goes on; afterwards no scan is missing."""

import json
import os
import signal

import pytest
from logs_for_nodes import MAPPED_SCANS as SCANS
from logs_for_nodes import PACE, START
from test_ros_localization import NODES, Nodes, assert_true

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from std_msgs.msg import String

from hmt_slam_ros.messages.messages import EarlyEstimate
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DOCUMENTS

HALTED = 25
"""Scans that come while topology does not answer."""


def test_poses_go_on_while_topology_does_not_answer(corridor, listener, start):
    nodes = Nodes(start, listener)
    early = nodes.subscribe(String, DOCUMENTS[EarlyEstimate], topics.STREAM)
    nodes.drive(corridor[0], 0, rate=2.0, robot__flow_control="false")
    nodes.until(lambda: len(nodes.estimates) >= 5)
    tsbi = nodes.alive[NODES.index("tsbi")]
    os.kill(tsbi.pid, signal.SIGSTOP)
    try:
        known = len(early)
        nodes.until(lambda: len(early) >= known + HALTED)
        answered, posed = len(nodes.estimates), len(nodes.poses)
        nodes.until(lambda: len(early) >= known + HALTED + 5 and len(nodes.poses) > posed + 5)
    finally:
        os.kill(tsbi.pid, signal.SIGCONT)
    estimates = [json.loads(message.data) for message in early[known:]]
    numbers = [estimate["scan_index"] for estimate in estimates]
    # One for every scan, long before those that follow when topology answers.
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert numbers[HALTED] > answered + HALTED // 2
    for estimate in estimates:
        assert_true_pose(estimate)
    for message in nodes.poses[posed : posed + 5]:
        assert_true(message, START)
    nodes.until(lambda: len(nodes.estimates) == SCANS)
    assert [json.loads(message.data)["scan_index"] for message in nodes.estimates] == list(range(SCANS))
    nodes.until(lambda: not nodes.diagnosis("slam")["early estimates"].startswith(("0", "1,")))
    count, _, rest = nodes.diagnosis("slam")["early estimates"].partition(", ")
    assert int(count) >= HALTED
    assert rest.startswith("0 of them then in another area")


def assert_true_pose(estimate):
    """An estimate in the first area, whose frame is that of the map, is where the robot was."""
    steps = (estimate["stamp"] - START) / 50e6
    assert estimate["pose"]["mean"] == pytest.approx((steps * PACE).tolist(), abs=0.15)
