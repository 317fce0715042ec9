"""hmt_slam doctor --live, as a process of its own, over real DDS."""

import itertools
import json
import math
import re
import subprocess
import time

import preloaded
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan
from test_ros_states import SHUTDOWN, Manager

from hmt_slam_ros.cli.main import main
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.ros import conversions
from hmt_slam_ros.ros.topics import TFMessage
from hmt_slam_ros.sensors import Odometry, Scan

WORLD = "sim:office,seed=3,beams=181"
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def doctor(listener):
    """Runs it for some seconds, meanwhile spins the test's own nodes, and returns status and findings."""

    def run_doctor(seconds, *arguments, meanwhile=lambda: None):
        words = ("doctor", "--live", "--json", "--seconds", seconds, *arguments)
        process = preloaded.start(preloaded.COMMAND, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while process.poll() is None:
            meanwhile()
            listener.executor.spin_once(timeout_sec=0.02)
        messages, error = process.communicate()
        assert not [line for line in error.splitlines() if "compiling kernels" not in line]  # in a new environment
        return process.returncode, json.loads(messages)["findings"]

    return run_doctor


def texts(findings, *severities):
    return [f"{one['subject']}: {one['text']}" for one in findings if one["severity"] in severities]


def test_a_sound_robot_gets_a_clean_bill(listener, doctor, start):
    parameters = {
        "robot__rate": 6.0,
        "robot__flow_control": False,
        "robot__scan_listeners": 0,
        "robot__odometry_listeners": 0,
    }
    scans = listener.subscribe(LaserScan, "scan", BEST_EFFORT)
    robot = start("robot", log=WORLD, **parameters)
    listener.until(lambda: scans, alive=[robot])
    status, findings = doctor(4.0)
    assert status == 0, texts(findings, "wrong", "doubtful")
    assert texts(findings, "wrong") == []
    fine = texts(findings, "fine")
    assert "nodes: None of the nodes of hmt_slam_ros runs, so only the sensors were checked." in fine
    assert "frames: Odometry is odom -> base_link, scans are in laser." in fine
    assert any("were compared with odometry" in text for text in fine)


def test_what_is_silent_missing_or_does_not_fit_is_reported(listener, doctor):
    listener.node.create_publisher(LaserScan, "scan", BEST_EFFORT)
    listener.node.create_subscription(LaserScan, "scan", lambda _: None, 10)
    simulated = Node("slam", context=listener.context, parameter_overrides=[Parameter("use_sim_time", value=True)])
    for _ in range(2):
        simulated.create_publisher(OdometryMessage, "odom", 10)
    listener.executor.add_node(simulated)
    status, findings = doctor(4.0)
    listener.executor.remove_node(simulated)
    simulated.destroy_node()
    assert status == 1
    wrong = texts(findings, "wrong")
    for begin in (
        "nodes: Of the nodes, aam, rtl, tlca and tsbi are missing",
        "scan silent: Nothing came on scan for 4 s, though listener publishes it",
        "odom silent: Nothing came on odom for 4 s, though slam publishes it",
        "QoS mismatch: listener does not hear scan of listener: ",
        "two publishers: odom has 2 publishers, slam",
        "use_sim_time: slam has use_sim_time, and nobody publishes /clock",
    ):
        assert any(text.startswith(begin) for text in wrong), (begin, wrong)
    assert len(wrong) == 6, wrong


def test_all_lasers_that_slam_has_are_examined_and_compared(listener, doctor):
    """The mounting of the second one is stated 8 degrees off; of a third one nothing comes."""
    stated = [0.2, 0.0, 0.0, -0.2, 0.0, math.pi - math.radians(8.0), 0.0, 0.0, 0.0]
    parameters = {"sensors.scan_topics": "front,rear,left", "laser_pose": stated}
    slam = Node(
        "slam",
        context=listener.context,
        parameter_overrides=[Parameter(name, value=value) for name, value in parameters.items()],
        automatically_declare_parameters_from_overrides=True,
    )
    readings = listener.node.create_publisher(OdometryMessage, "odom", 100)
    publishers = [listener.node.create_publisher(LaserScan, topic, 100) for topic in ("front", "rear")]
    records = iter(list(open_log(f"{WORLD},lasers=2,forward=0.2", duration=70.0).records()))

    def publish():
        is_heard = all(publisher.get_subscription_count() for publisher in (readings, *publishers))
        for record in itertools.islice(records, 10 if is_heard else 0):
            measurement = record.measurement
            if isinstance(measurement, Scan):
                is_rear = measurement.laser_pose[0] < 0.0
                publishers[int(is_rear)].publish(conversions.scan_message(measurement, f"laser_{int(is_rear)}"))
            else:
                readings.publish(conversions.odometry_message(measurement, "odom", "base_link"))

    listener.executor.add_node(slam)
    _, findings = doctor(4.0, meanwhile=publish)
    listener.executor.remove_node(slam)
    slam.destroy_node()
    wrong = texts(findings, "wrong")
    assert any(text.startswith("left silent: Nobody publishes left: ") for text in wrong), wrong
    assert not any(text.startswith(("front silent", "rear silent", "scan silent", "laser transform")) for text in wrong)
    (compared,) = [text for text in texts(findings, "wrong", "doubtful") if text.startswith("two lasers: ")]
    assert "The laser at (-0.20 m, 0.00 m, 172 degrees)" in compared
    assert float(re.search(r"([0-9.]+) degrees apart", compared).group(1)) == pytest.approx(8.0, abs=1.0)


def test_frames_that_contradict_and_two_systems_are_reported(listener, doctor):
    odom_frame = Parameter("odom_frame", value="odom")
    one = Node("rtl", context=listener.context, parameter_overrides=[odom_frame])
    one.declare_parameter("odom_frame", "")
    odometry = one.create_publisher(OdometryMessage, "odom", 10)
    reports = one.create_publisher(DiagnosticArray, "diagnostics", 10)

    def publish():
        now = time.time_ns()
        odometry.publish(conversions.odometry_message(Odometry(now, np.zeros(3)), "wheel_odom", "base_link"))
        for system in ("one", "two"):
            values = [KeyValue(key="system", value=system)]
            reports.publish(
                DiagnosticArray(status=[DiagnosticStatus(name="/rtl", hardware_id="hmt_slam_ros", values=values)])
            )
            values = [KeyValue(key="system", value="three")]
            reports.publish(
                DiagnosticArray(status=[DiagnosticStatus(name="/a/rtl", hardware_id="hmt_slam_ros", values=values)])
            )

    listener.executor.add_node(one)
    _, findings = doctor(4.0, meanwhile=publish)
    listener.executor.remove_node(one)
    one.destroy_node()
    wrong = texts(findings, "wrong")
    assert (
        "frames contradict: /rtl has odom_frame = odom, and the odometry is that of wheel_odom, so that the tree of "
        "transforms is in two parts: leave odom_frame empty, or set it to wheel_odom."
    ) in wrong
    assert (
        "two systems: 2 systems run in this namespace, one and two: end all but one, or give each system a namespace "
        "or a ROS_DOMAIN_ID of its own."
    ) in wrong


def test_nodes_in_another_namespace_are_not_taken_for_those_of_this_one(listener, doctor):
    others = [Node("slam", context=listener.context, namespace=namespace) for namespace in ("/robot1", "/robot2")]
    for other in others:
        listener.executor.add_node(other)
    status, findings = doctor(2.0)
    for other in others:
        listener.executor.remove_node(other)
        other.destroy_node()
    assert status == 1
    assert (
        "nodes: None of the nodes of hmt_slam_ros runs in this namespace, but some do in /robot1 and /robot2: hmt_slam "
        "doctor --live --ros-args -r __ns:=/robot1 examines those, and likewise /robot2."
    ) in texts(findings, "wrong")


def test_nodes_that_are_not_active_are_named_with_what_makes_them_so(listener, start, doctor):
    for name in ("aam", "rtl", "slam", "tlca", "tsbi"):
        start(name, "-r", "__ns:=/robot1", autostart=name == "tsbi")
    manager = Manager(listener)
    assert manager.change("/robot1/rtl", "configure")
    assert manager.change("/robot1/slam", SHUTDOWN["unconfigured"])
    manager.until("/robot1/tsbi", "active")
    assert [manager.state(f"/robot1/{name}") for name in ("aam", "tlca")] == ["unconfigured"] * 2
    status, findings = doctor(4.0, "--ros-args", "-r", "__ns:=/robot1")
    assert status == 1
    assert [text for text in texts(findings, "wrong") if text.startswith("states: ")] == [
        "states: /robot1/aam and /robot1/tlca are unconfigured and take no part: ros2 lifecycle set /robot1/aam "
        "configure and then activate, and likewise /robot1/tlca, or start with autostart:=true.",
        "states: /robot1/rtl is inactive and takes no part: ros2 lifecycle set /robot1/rtl activate, or start with "
        "autostart:=true.",
        "states: /robot1/slam is finalized and takes no part: end /robot1/slam and start it again, since no transition "
        "leads out of that.",
    ]
    assert not any(text.startswith("nodes: All nodes") for text in texts(findings, "fine"))


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh, which builds it")
def test_stamps_frames_and_doubled_transforms_are_reported_under_a_namespace(listener, doctor):
    records = iter(list(open_log(WORLD, duration=90.0).records()))
    scans = listener.node.create_publisher(LaserScan, "robot1/scan", 10)
    readings = listener.node.create_publisher(OdometryMessage, "robot1/base/odom", 10)
    transforms = listener.node.create_publisher(TFMessage, "robot1/tf", 10)

    def publish():
        measurement = next(records).measurement
        # On today's clock, three seconds late.
        shift = time.time_ns() - 3 * 10**9 - measurement.stamp
        if isinstance(measurement, Scan):
            message = conversions.scan_message(measurement, "laser")
            message.header.stamp = conversions.time_message(measurement.stamp + shift)
            scans.publish(message)
            return
        stamp = measurement.stamp + shift
        readings.publish(conversions.odometry_message(Odometry(stamp, measurement.pose), "odom", "base_link"))
        for pose in (measurement.pose, measurement.pose + 0.1):
            joint = conversions.transform_message(stamp, "odom", "base_link", pose)
            transforms.publish(TFMessage(transforms=[joint]))

    status, findings = doctor(4.0, "--ros-args", "-r", "__ns:=/robot1", "-r", "odom:=base/odom", meanwhile=publish)
    assert status == 1
    wrong = texts(findings, "wrong")
    assert any(
        text.startswith("laser transform: No transform leads from 'base_link' to the scans' frame 'laser'")
        for text in wrong
    ), wrong
    assert any(text.startswith("two transforms: The transform odom -> base_link had different") for text in wrong)
    doubtful = texts(findings, "doubtful")
    assert any(text.startswith("stamps against clock: The stamps of scan are 3.0") for text in doubtful), doubtful


@pytest.mark.parametrize(
    "arguments", (("--seconds", "0"), ("--ros-args", "-r", "nonsense"), ("--ros-args", "--nonsense"))
)
def test_arguments_that_cannot_be_are_refused(domain, arguments, capsys):
    assert main(["doctor", "--live", *arguments]) == 2
    assert capsys.readouterr().err.startswith("hmt_slam doctor: --")
