"""While topology does not answer, the robot's pose goes on; afterwards no scan is missing."""

import json
import os
import signal

import numpy as np
import pytest
from logs_for_nodes import LASER, PACE, START, WALLS
from logs_for_nodes import MAPPED_SCANS as SCANS
from test_ros_localization import NODES, Nodes, assert_true
from worlds import scan_in

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from nav_msgs.msg import Odometry as OdometryMessage
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.messages.messages import EarlyEstimate
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.topics import DOCUMENTS, ODOM, SCAN
from hmt_slam_ros.sensors import Odometry

HALTED = 25
"""Scans that come while topology does not answer."""
WAITING = 200
"""Scans of a live laser that wait at most."""
SPACINGS = [1, 2, 4, 8]
"""Which scan is accepted next, for each quarter of these."""


class LiveRobot:
    """A robot that stands in the corridor; its driver does not repeat what is lost.

    :ivar sent: number of scans.
    """

    PERIOD = 50_000_000
    BURST = 5

    def __init__(self, listener):
        self.scans = listener.node.create_publisher(LaserScan, SCAN, topics.LIVE_SENSOR)
        self.odometry = listener.node.create_publisher(OdometryMessage, ODOM, topics.LIVE_SENSOR)
        self.sent = 0

    def is_heard(self):
        return self.scans.get_subscription_count() == 1 and self.odometry.get_subscription_count() == 2

    def send(self):
        """Send some scans with their odometry; the number of those that were sent."""
        for _ in range(self.BURST):
            stamp = START + self.sent * self.PERIOD
            scan = scan_in(WALLS, np.zeros((91, 3)), stamp, beams=91, laser_pose=LASER)
            self.odometry.publish(conversions.odometry_message(Odometry(stamp, np.zeros(3)), "odom", "base_link"))
            self.scans.publish(conversions.scan_message(scan, "laser"))
            self.sent += 1
        return self.sent


def scan_counts(nodes):
    """The scans that slam had accepted and dropped, by status."""
    statuses = (message.status[0] for message in nodes.diagnostics if message.status[0].name == "/slam")
    return [
        [entry.value for entry in status.values if entry.key in ("received Scan", "dropped scans")]
        for status in statuses
    ]


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


@pytest.mark.long
def test_of_a_live_laser_fewer_scans_are_accepted_the_more_wait_for_topology(listener, start):
    nodes = Nodes(start, listener, laser_pose=LASER.tolist())
    early = nodes.subscribe(String, DOCUMENTS[EarlyEstimate], topics.STREAM)
    robot = LiveRobot(listener)
    nodes.until(lambda: robot.is_heard() and nodes.diagnosis("tsbi"))
    tsbi = nodes.alive[NODES.index("tsbi")]
    os.kill(tsbi.pid, signal.SIGSTOP)
    try:
        nodes.until(lambda: robot.send() and int(nodes.diagnosis("slam")["waiting scans"] or 0) >= WAITING - 1)
        posed, known = len(nodes.poses), len(early)
        nodes.until(lambda: robot.send() and len(nodes.poses) > posed + 5)
        nodes.until(lambda: any(m.status[0].message.startswith("scans wait for topology") for m in nodes.diagnostics))
        # What DDS still holds is accepted or dropped before topology goes on, which would make room for it.
        before = len(scan_counts(nodes))
        nodes.until(lambda: len(counts := scan_counts(nodes)) > before + 1 and counts[-1] == counts[-2])
    finally:
        os.kill(tsbi.pid, signal.SIGCONT)
    nodes.until(lambda: nodes.diagnosis("slam")["waiting scans"] == "0")
    accepted = len(nodes.estimates)
    assert WAITING <= accepted <= WAITING + 2
    assert known > WAITING // 2
    estimates = [json.loads(message.data) for message in nodes.estimates]
    assert [estimate["scan_index"] for estimate in estimates] == list(range(accepted))
    steps = np.diff([estimate["stamp"] for estimate in estimates]) // robot.PERIOD
    least = np.array([part[4:].min() for part in np.split(steps[: WAITING - 4], 4)])
    assert (least >= SPACINGS).all(), least
    # Every second one at most was lost by DDS.
    assert (least <= 2 * np.array(SPACINGS)).all(), least
    # It has caught up, and accepts all.
    nodes.until(lambda: robot.send() and len(nodes.estimates) > accepted + 20)
    stamps = [json.loads(message.data)["stamp"] for message in nodes.estimates[accepted + 1 :]]
    assert np.diff(stamps).min() <= 2 * robot.PERIOD


def assert_true_pose(estimate):
    """An estimate in the first area, whose frame is that of the map, is where the robot was."""
    steps = (estimate["stamp"] - START) / 50e6
    assert estimate["pose"]["mean"] == pytest.approx((steps * PACE).tolist(), abs=0.15)
