"""The histories of the chain's topics: bounded in a long run, and whole for a reader that is there."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from worlds import box, scan_in

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.messages import HypothesisEstimate, Keyframe, LocalEstimate, ScanPoses
from hmt_slam_ros.messages.system_name import SystemName
from hmt_slam_ros.process_memory import current_rss
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.chain_writer import ChainWriter
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.message_io import Outbox

HISTORY = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
READER = """
import rclpy
from std_msgs.msg import String
from hmt_slam_ros.ros import topics

rclpy.init()
node = rclpy.create_node("reader")
node.create_subscription(String, "numbers", lambda message: print(message.data, flush=True), topics.CHAIN)
rclpy.spin(node)
"""
HOUR = 3600
"""Keyframe events in an hour of driving in rooms, one a second."""
SCANS_PER_EVENT = 5
EVENTS_PER_COST = 10
"""Keyframe events between two messages on hmt/cost, in a replay at ten times real time."""
COVARIANCE = np.diag([1e-4, 1e-4, 1e-5])


def test_a_reader_that_stops_for_longer_than_the_history_loses_nothing(listener):
    writer = ChainWriter(listener.node, String, "numbers", HISTORY)
    reader = subprocess.Popen([sys.executable, "-c", READER], stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    try:
        listener.until(lambda: listener.node.count_subscribers("numbers") == 1, alive=[reader])
        writer.publish(String(data="first"))
        assert reader.stdout.readline() == "first\n"
        reader.send_signal(signal.SIGSTOP)
        published = []

        def publish():
            for number in range(5 * HISTORY.depth):
                writer.publish(String(data=str(number)))
                published.append(number)

        thread = threading.Thread(target=publish)
        thread.start()
        listener.until(lambda: len(published) >= HISTORY.depth - 1)
        time.sleep(1.0)
        assert len(published) <= HISTORY.depth
        reader.send_signal(signal.SIGCONT)
        thread.join(60.0)
        assert [reader.stdout.readline() for _ in range(5 * HISTORY.depth)] == [
            f"{k}\n" for k in range(5 * HISTORY.depth)
        ]
    finally:
        reader.kill()
        reader.communicate()
        thread.join(60.0)


def test_a_late_reader_gets_the_last_messages(listener):
    writer = ChainWriter(listener.node, String, "numbers", HISTORY)
    for number in range(3 * HISTORY.depth):
        writer.publish(String(data=str(number)))
    received = listener.subscribe(String, "numbers", topics.CHAIN)
    listener.until(lambda: len(received) >= HISTORY.depth)
    listener.spin(0.2)
    assert [int(message.data) for message in received] == list(range(2 * HISTORY.depth, 3 * HISTORY.depth))


@pytest.fixture
def sender(listener):
    """A node with diagnostics, as those of processes have."""
    node = GuardedNode("sender", context=listener.context)
    node.diagnostics = NodeDiagnostics(node, SystemName(""))
    yield node
    node.destroy_node()


def test_after_an_hour_in_known_rooms_the_memory_of_what_was_sent_does_not_grow(sender):
    outbox, diagnostics = Outbox(sender, (Keyframe, LocalEstimate, ScanPoses)), sender.diagnostics
    scan = scan_in(box(-3, -3, 12, 3), np.zeros((361, 3)), 0, beams=361)
    belief = PoseGaussian(np.array([1.0, 2.0, 0.5]), COVARIANCE)
    estimate = HypothesisEstimate(3, 7, belief, False, 0.1, 0.2, Clutter(), 12.0)

    def drive(events):
        for event in events:
            outbox.send(Keyframe(event, scan, 0.5 * event, (estimate,)))
            rows = np.arange(SCANS_PER_EVENT)
            outbox.send(ScanPoses(3, SCANS_PER_EVENT * event, rows, rows, np.ones((SCANS_PER_EVENT, 3))))
            for row in rows.tolist():
                sent = LocalEstimate(row, SCANS_PER_EVENT * event + row, 7, belief, belief.mean, 0)
                outbox.send(sent)
                with diagnostics.measure(sent, []):
                    pass
            if event % EVENTS_PER_COST == 0:
                diagnostics.publish()
        return current_rss()

    hour = drive(range(HOUR))
    assert drive(range(HOUR, 2 * HOUR)) - hour < 500_000
