"""Frames are those of the odometry's messages, and a parameter that contradicts them is a fault."""

from itertools import count

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry as OdometryMessage
from std_msgs.msg import String
from test_ros_mountings import Laser, joint

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import odometry_message
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS, TFMessage
from hmt_slam_ros.sensors import Odometry

WHEELS = {"odom_frame": "wheel_odom", "base_frame": "foot"}


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh")
def test_without_a_parameter_rtl_leads_to_the_frame_of_the_odometry(listener, start):
    transforms = listener.subscribe(TFMessage, "tf", topics.STREAM)
    odometry = listener.node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
    estimates = listener.node.create_publisher(String, DOCUMENTS[LocalEstimate], topics.ESTIMATE_HISTORY)
    numbers = count()

    def drive():
        number = next(numbers)
        reading = Odometry(10**9 + number * 50_000_000, np.zeros(3))
        odometry.publish(odometry_message(reading, *WHEELS.values()))
        belief = PoseGaussian(np.zeros(3), 1e-4 * np.eye(3))
        estimate = LocalEstimate(reading.stamp, number, 0, belief, reading.pose, 0)
        estimates.publish(String(data=encode(estimate)))

    listener.node.create_timer(0.05, drive)
    process = start("rtl")
    listener.until(lambda: transforms, alive=[process])
    (map_T_odom,) = transforms[0].transforms
    assert (map_T_odom.header.frame_id, map_T_odom.child_frame_id) == ("map", "wheel_odom")


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh")
def test_without_a_parameter_the_robot_has_the_child_frame_of_the_odometry(listener, start):
    laser = Laser(listener, start)
    laser.join(joint(parent="foot"))
    laser.drive(2, base_frame="foot")
    laser.until("received Scan", 2)


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
