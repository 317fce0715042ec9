"""Observations of marks and statements on topics: they come with a keyframe, and what is none is refused."""

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
from hmt_slam_ros.messages.messages import Hypotheses, Notice
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.topics import DOCUMENTS, KEYFRAMES, STATEMENT

NOTICES, HYPOTHESES = DOCUMENTS[Notice], DOCUMENTS[Hypotheses]
MARK = np.array([1.0, 2.0, 0.7])
SECOND = 1_000_000_000
COVARIANCE = np.diag([0.03, 0.03, 0.02]) ** 2


def observation(seconds, name="lift", covariance=COVARIANCE):
    """A message with the pose of the robot of the corridor in the frame of a mark."""
    pose = 20.0 * seconds * PACE
    belief = PoseGaussian(se2.between(MARK, pose), covariance)
    return conversions.pose_with_covariance_message(START + round(seconds * SECOND), name, belief)


def test_marks_and_statements_come_with_the_next_keyframe_and_what_is_none_is_refused(corridor, listener, start):
    nodes = Nodes(start, listener, marks__topic="marks")
    keyframes = nodes.subscribe(String, KEYFRAMES, topics.CHAIN)
    marks = listener.node.create_publisher(PoseWithCovarianceStamped, "marks", topics.SENSOR)
    nodes.until(lambda: marks.get_subscription_count() == 1)
    marks.publish(observation(1.0, "broken", np.zeros((3, 3))))
    marks.publish(observation(1.03))
    nodes.until(lambda: nodes.diagnosis("slam")["received MarkObservation"] == "1")
    notices, hypotheses = (
        nodes.subscribe(String, NOTICES, topics.CHAIN),
        nodes.subscribe(String, HYPOTHESES, topics.CHAIN),
    )
    statements = listener.node.create_publisher(String, STATEMENT, topics.STREAM)
    nodes.until(lambda: statements.get_subscription_count() == 1)
    for text in ("same 0 and 1", "same 0 99"):
        statements.publish(String(data=text))
    nodes.until(lambda: nodes.diagnosis("tsbi").get("received PlaceStatement") == "1")
    nodes.drive(corridor[0], 0, rate=4.0)
    nodes.until(lambda: any(json.loads(message.data)["marks"] for message in keyframes))
    keyframe = next(found for message in keyframes if (found := json.loads(message.data))["marks"])
    (mark,) = keyframe["marks"]
    assert (mark["name"], mark["stamp"]) == ("lift", START + 1_030_000_000)
    steps = (keyframe["scan"]["stamp"] - START) / 50e6
    assert mark["pose"]["mean"] == pytest.approx(se2.between(MARK, steps * PACE).tolist(), abs=0.05)
    assert nodes.diagnosis("slam")["refused on marks"] == "1"
    assert nodes.diagnosis("tsbi")["refused on statement"] == "1"
    nodes.until(lambda: any("the map has no area 99" in notice.data for notice in notices))
    assert all(json.loads(message.data)["statements"] == [] for message in hypotheses)
