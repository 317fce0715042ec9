"""Where a look would decide, as tlca publishes it over DDS."""

import json

import numpy as np
import pytest
import worlds

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.ambiguity import Ambiguity
from hmt_slam_ros.messages.documents import KeyframeHeader, decode, encode
from hmt_slam_ros.messages.messages import Hypotheses, Hypothesis, HypothesisEstimate, Keyframe
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import keyframe_frame, pose_from_message, scan_message
from hmt_slam_ros.ros.topics import AMBIGUITY_GOAL, DIAGNOSTICS, DOCUMENTS, KEYFRAME_SCANS, KEYFRAMES

EVENTS = 16
BELIEF = np.diag([0.1, 0.1, 0.02]) ** 2


def test_the_sentence_the_document_and_the_goal_of_an_open_question(listener, start):
    """A robot drove back and forth in a hallway; by one hypothesis it is 4 m farther behind."""
    documents = listener.subscribe(String, DOCUMENTS[Ambiguity], topics.CHAIN)
    goals = listener.subscribe(PoseStamped, AMBIGUITY_GOAL, topics.STREAM)
    health = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    headers = listener.node.create_publisher(String, KEYFRAMES, topics.CHAIN)
    scans = listener.node.create_publisher(LaserScan, KEYFRAME_SCANS, topics.CHAIN)
    answers = listener.node.create_publisher(String, DOCUMENTS[Hypotheses], topics.CHAIN)
    node = start("tlca")
    listener.until(lambda: listener.node.count_publishers(AMBIGUITY_GOAL), alive=[node])

    def publish(event, ids, *hypotheses):
        pose = (float(min(event, EVENTS - event)), 0.0, 0.0)
        belief = PoseGaussian(np.array(pose), BELIEF)
        estimates = tuple(HypothesisEstimate(h, 0, belief, True, 0.0, 0.0, Clutter(), 12.0) for h in ids)
        scan = worlds.scan_at(worlds.HALLWAY, np.array(pose) - (5.0, 0.0, 0.0))
        headers.publish(
            String(data=encode(KeyframeHeader.from_keyframe(Keyframe(event, scan, float(event), estimates))))
        )
        scans.publish(scan_message(scan, keyframe_frame(event)))
        answers.publish(String(data=encode(Hypotheses(event, hypotheses))))

    for event in range(EVENTS):
        publish(event, (0,), Hypothesis(0, 0, 1.0, 0))
    shift = PoseGaussian(np.array([4.0, 0.0, 0.0]), BELIEF)
    publish(EVENTS, (0,), Hypothesis(1, 0, 0.6, 0), Hypothesis(2, 0, 0.4, 0, shift))
    listener.until(lambda: documents and goals, alive=[node])
    found = decode(documents[0].data, Ambiguity)
    assert found.sequence == EVENTS
    assert found.entropy == pytest.approx(0.673, abs=0.001)
    best = found.looks[found.best_look()]
    assert goals[0].header.frame_id == "map"
    np.testing.assert_allclose(pose_from_message(goals[0].pose), best.pose, atol=1e-9)  # the first area is the map
    sentence = values_of(listener, health, node)
    assert sentence == found.text
    assert sentence.startswith("2 hypotheses are probable (0.60 in area 0, 0.40 in area 0): ")

    publish(EVENTS + 1, (1, 2), Hypothesis(1, 1, 1.0, 0))
    listener.until(lambda: len(documents) > 1, alive=[node])
    assert json.loads(documents[1].data)["looks"] == []
    health.clear()
    assert values_of(listener, health, node) == "one hypothesis is probable"
    assert len(goals) == 1


def values_of(listener, health, node):
    """The ambiguity in /diagnostics."""

    def sentences():
        statuses = [status for message in health for status in message.status if status.name == "/tlca"]
        return [value.value for status in statuses for value in status.values if value.key == "ambiguity"]

    listener.until(sentences, alive=[node])
    return sentences()[-1]
