"""Frames are those of the odometry's messages, and a parameter that contradicts them is a fault."""

import pytest
from logs_for_nodes import corridor_bag

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry as OdometryMessage

from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import odometry_message
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS, TFMessage
from hmt_slam_ros.sensors import Odometry

WHEELS = {"odom_frame": "wheel_odom", "base_frame": "foot"}


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh")
def test_without_parameters_the_transforms_are_one_tree(listener, start, tmp_path):
    transforms = listener.subscribe(TFMessage, "tf", topics.STREAM)
    nodes = [start("slam"), start("rtl")]
    # Rtl goes by the first estimate, after which slam waits for topology.
    estimates = DOCUMENTS[LocalEstimate]
    listener.until(lambda: listener.node.count_publishers(estimates) and listener.node.count_subscribers(estimates))
    robot = {"robot__flow_control": False, "robot__odometry_listeners": 2, "robot__rate": 1.0}
    nodes.append(start("robot", log=corridor_bag(tmp_path, 40), **robot, **WHEELS))

    def joints():
        return {(each.header.frame_id, each.child_frame_id) for message in transforms for each in message.transforms}

    listener.until(lambda: any(parent == "map" for parent, _ in joints()), alive=nodes)
    assert joints() == {("map", "wheel_odom"), ("wheel_odom", "foot")}


@pytest.mark.parametrize(("node", "parameter"), [("rtl", "odom_frame"), ("slam", "base_frame")])
def test_a_parameter_that_contradicts_the_messages_is_an_error(listener, start, node, parameter):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    odometry = listener.node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
    process = start(node, **{parameter: "robot1/frame"})
    listener.until(odometry.get_subscription_count, alive=[process])
    odometry.publish(odometry_message(Odometry(10**9, np.zeros(3)), *WHEELS.values()))
    listener.until(lambda: reports and reports[-1].status[0].level == DiagnosticStatus.ERROR, alive=[process])
    field = {"odom_frame": "frame_id", "base_frame": "child_frame_id"}[parameter]
    assert reports[-1].status[0].message == (
        f"{parameter} = robot1/frame contradicts {field} = {WHEELS[parameter]} of odom, so that the tree of transforms "
        f"is in two parts: leave {parameter} empty, or set it to {WHEELS[parameter]}"
    )


def test_odometry_of_two_sources_is_reported(listener, start):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    odometry = listener.node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
    process = start("rtl")
    listener.until(odometry.get_subscription_count, alive=[process])
    for number, frame in enumerate(("odom", "/odom", "", "x" * 5000, "wheel_odom"), 1):
        odometry.publish(odometry_message(Odometry(number * 10**7, np.zeros(3)), frame, "foot"))

    def values():
        return {each.key: each.value for each in reports[-1].status[0].values} if reports else {}

    listener.until(lambda: "wheel_odom" in values().get("last error", ""), alive=[process])
    assert values()["last error"] == (
        "odom comes with frame_id = wheel_odom and with odom, which came first: look for a second publisher"
    )
    assert values()["refused on odom"] == "1"
