"""Entities of a guarded node: which of them have events of the middleware."""

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import String

from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.topics import BETWEEN_NODES, INITIAL_POSE, MAP


@pytest.fixture
def node(listener):
    node = GuardedNode("guarded", context=listener.context)
    yield node
    node.destroy_node()


def test_publishers_and_topics_between_nodes_have_no_events(node):
    before = len(list(node.waitables))
    node.create_publisher(String, MAP, topics.LATCHED)
    for topic in BETWEEN_NODES:
        node.create_subscription(String, topic, print, topics.CHAIN)
    assert len(list(node.waitables)) == before == 0


def test_a_publisher_of_another_program_whose_profile_does_not_match_is_named(node, listener, capfd):
    node.create_subscription(PoseWithCovarianceStamped, INITIAL_POSE, print, topics.STREAM)
    listener.executor.add_node(node)
    listener.node.create_publisher(PoseWithCovarianceStamped, INITIAL_POSE, topics.NEWEST)
    warning, errors = f"on topic '{INITIAL_POSE}', offering incompatible QoS", []
    listener.until(lambda: errors.append(capfd.readouterr().err) or warning in "".join(errors))
