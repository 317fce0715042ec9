"""Observations of marks on a topic: they come with a keyframe, and what is none is refused."""

import json

import numpy as np
import pytest
from logs_for_nodes import PACE, START
from test_ros_localization import Nodes

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import String

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.topics import KEYFRAMES

MARK = np.array([1.0, 2.0, 0.7])
SECOND = 1_000_000_000
COVARIANCE = np.diag([0.03, 0.03, 0.02]) ** 2


def observation(seconds, name="lift", covariance=COVARIANCE):
    """A message with the pose of the robot of the corridor in the frame of a mark."""
    pose = 20.0 * seconds * PACE
    belief = PoseGaussian(se2.between(MARK, pose), covariance)
    return conversions.pose_with_covariance_message(START + round(seconds * SECOND), name, belief)


def test_a_mark_comes_with_the_next_keyframe_and_what_is_none_is_refused(corridor, listener, start):
    nodes = Nodes(start, listener, marks__topic="marks")
    keyframes = nodes.subscribe(String, KEYFRAMES, topics.CHAIN)
    marks = listener.node.create_publisher(PoseWithCovarianceStamped, "marks", topics.SENSOR)
    nodes.until(lambda: marks.get_subscription_count() == 1)
    marks.publish(observation(1.0, "broken", np.zeros((3, 3))))
    marks.publish(observation(1.03))
    nodes.until(lambda: nodes.diagnosis("slam")["received MarkObservation"] == "1")
    nodes.drive(corridor[0], 0, rate=4.0)
    nodes.until(lambda: any(json.loads(message.data)["marks"] for message in keyframes))
    keyframe = next(found for message in keyframes if (found := json.loads(message.data))["marks"])
    (mark,) = keyframe["marks"]
    assert (mark["name"], mark["stamp"]) == ("lift", START + 1_030_000_000)
    steps = (keyframe["scan"]["stamp"] - START) / 50e6
    assert mark["pose"]["mean"] == pytest.approx(se2.between(MARK, steps * PACE).tolist(), abs=0.05)
    assert nodes.diagnosis("slam")["refused on marks"] == "1"
