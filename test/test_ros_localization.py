"""Nodes that start from a map, or whose robot is kidnapped, do not know where it is until they recognize the place."""

import math
from collections import defaultdict
from itertools import count, groupby, islice

import numpy as np
import pytest
from logs_for_nodes import MAPPED_SCANS as SCANS
from logs_for_nodes import PACE, SECOND, START

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
from std_msgs.msg import Bool, Float64, String
from std_srvs.srv import Trigger

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.messages import LocalEstimate, Notice
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import (
    odometry_message,
    pose_from_message,
    pose_with_covariance_message,
    stamp_from_time,
)
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS, ENTROPY, IS_LOCALIZED, ODOM, POSE
from hmt_slam_ros.sensors import Odometry

NODES = process_names()
CARRIED = "sim:office,seed=3,size=0.7,laps=1,carried=0.35,to=0.08,turned=120"


class Nodes:
    """The five processes, robots one after the other, and their messages, in a namespace such as "/robot"."""

    def __init__(self, start, listener, *arguments, namespace="", **parameters):
        self.start, self.listener, self.namespace = start, listener, namespace
        self.arguments = (*arguments, *(["-r", f"__ns:={namespace}"] if namespace else []))
        self.localized = self.subscribe(Bool, IS_LOCALIZED, topics.LATCHED)
        self.entropies = self.subscribe(Float64, ENTROPY, topics.LATCHED)
        self.estimates = self.subscribe(String, DOCUMENTS[LocalEstimate], topics.CHAIN)
        self.notices = self.subscribe(String, DOCUMENTS[Notice], topics.CHAIN)
        self.poses = self.subscribe(PoseWithCovarianceStamped, POSE, topics.STREAM)
        self.diagnostics = self.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
        self.alive = [start(name, *self.arguments, **parameters) for name in NODES]

    def subscribe(self, kind, topic, profile):
        """What comes on a topic of these nodes."""
        return self.listener.subscribe(kind, f"{self.namespace}/{topic}", profile)

    def until(self, condition):
        self.listener.until(condition, alive=self.alive)

    def drive(self, log, first, rate=0.0, **robot):
        """A robot that begins with a scan of the log, and the scans that it will send."""
        begin = max(0.0, 0.2 * first - 0.001)
        # Also for rtl: a drive as quick as slam is over before DDS has made them known to each other.
        robot = {"robot__start": begin, "robot__odometry_listeners": 2, **robot}
        self.alive.append(self.start("robot", *self.arguments, log=log, robot__rate=rate, **robot))

    def until_at(self, step, map_pose=None, tolerance=0.15):
        """A robot that stands at a step of the corridor goes on to report it, until its pose in the map is right.

        Where the machine is busy, the last odometry of a drive may come before the estimate that it goes with.

        :param map_pose: by default that of the step, shape (3,).
        """
        expected = step * PACE if map_pose is None else map_pose
        steps = count(step)
        odometry = self.listener.node.create_publisher(OdometryMessage, f"{self.namespace}/{ODOM}", topics.STREAM)

        def report():
            reading = Odometry(START + next(steps) * SECOND // 20, step * PACE)
            odometry.publish(odometry_message(reading, "odom", "base_link"))

        timer = self.listener.node.create_timer(0.1, report)
        self.until(
            lambda: self.poses and np.abs(pose_from_message(self.poses[-1].pose.pose) - expected).max() < tolerance
        )
        self.listener.node.destroy_timer(timer)
        self.listener.node.destroy_publisher(odometry)

    def park(self):
        robot = self.alive.pop()
        robot.terminate()
        assert robot.wait(20) == 0

    def is_localized(self):
        return bool(self.localized) and self.localized[-1].data

    def diagnosis(self, node):
        """The last status of a node, {name: value}; values are empty while it was silent."""
        messages = (m.status[0] for m in reversed(self.diagnostics) if m.status[0].name == f"{self.namespace}/{node}")
        return defaultdict(str, {value.key: value.value for status in islice(messages, 1) for value in status.values})


def assert_true(message, begin):
    """A pose in the map is where the robot was.

    :param begin: stamp of the log's first scan, ns.
    """
    k = (stamp_from_time(message.header.stamp) - begin) / 50e6
    assert np.abs(pose_from_message(message.pose.pose) - k * PACE).max() < 0.15


def test_a_robot_that_starts_lost_in_a_saved_map_reports_it_until_it_is_relocalized(corridor, listener, start):
    log, out = corridor
    nodes = Nodes(start, listener, start_from=out)
    nodes.until(lambda: nodes.localized and nodes.entropies)
    assert not nodes.is_localized()
    # One area, or none that is known.
    assert nodes.entropies[-1].data == pytest.approx(-0.8 * math.log(0.8) - 0.2 * math.log(0.2))
    assert not nodes.poses
    nodes.drive(log, first=20)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == SCANS - 20)
    nodes.until_at(4 * (SCANS - 1))
    # Odometry, which is elsewhere than when the map was saved, was not taken for a jump.
    assert not nodes.notices
    nodes.until(lambda: nodes.diagnosis("tsbi")["localized"] == "yes")
    assert nodes.entropies[-1].data < 0.3


def test_a_robot_that_stayed_where_it_was_is_localized_at_once_with_an_initial_pose(corridor, listener, start):
    nodes = Nodes(start, listener, start_from=corridor[1], start_lost=False)
    nodes.until(lambda: nodes.localized and nodes.entropies)
    assert nodes.is_localized()
    assert nodes.entropies[-1].data == 0.0


def test_a_robot_that_is_kidnapped_while_the_nodes_run_is_recognized_elsewhere(corridor, listener, start):
    log, out = corridor
    nodes = Nodes(start, listener, start_from=out, start_lost=False)
    nodes.until(nodes.is_localized)
    answer = listener.call(Trigger, "slam/relocalize", Trigger.Request())
    assert answer.success
    nodes.until(lambda: not nodes.is_localized())
    # Back in time, which an odometry and a clock that restart are.
    nodes.drive(log, first=40, rate=8.0)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == SCANS - 40)
    nodes.park()
    again = listener.call(Trigger, "slam/relocalize", Trigger.Request())
    assert again.success
    nodes.until(lambda: not nodes.is_localized())
    messages = len(nodes.poses)
    nodes.drive(log, first=0, rate=8.0)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == SCANS - 40 + SCANS)
    nodes.until_at(4 * (SCANS - 1))
    assert len(nodes.poses) > messages


def test_a_robot_that_is_kidnapped_while_it_drives_notices_and_is_recognized(listener, start):
    nodes = Nodes(start, listener)
    nodes.until(nodes.is_localized)
    nodes.drive(CARRIED, first=0, robot__duration=84.0)
    nodes.until(lambda: len(nodes.estimates) == 420 and nodes.is_localized())
    assert [known for known, _ in groupby(message.data for message in nodes.localized)][-3:] == [True, False, True]
    nodes.until(lambda: nodes.diagnosis("tsbi")["localized"] == "yes")


def initial_pose(at, frame="map", deviations=(0.5, 0.5, 0.26)):
    """As RViz sends it, for a robot at a pose (3,) in the map."""
    return pose_with_covariance_message(0, frame, PoseGaussian(at, np.diag(deviations) ** 2))


def test_a_person_says_where_the_robot_is_and_where_it_cannot_be(corridor, listener, start):
    log, out = corridor
    nodes = Nodes(start, listener, start_from=out)
    publisher = listener.node.create_publisher(PoseWithCovarianceStamped, "initialpose", topics.STREAM)
    listener.until(lambda: publisher.get_subscription_count() == 1)
    nodes.until(lambda: nodes.localized and any(m.status[0].name == "/slam" for m in nodes.diagnostics))
    publisher.publish(initial_pose(np.array([100.0, 50.0, 0.0])))
    nodes.until(lambda: "outside of the map" in nodes.diagnosis("slam")["last error"])
    complaint = nodes.diagnosis("slam")["last error"]
    assert "initialpose is left out: (100.00, 50.00) is outside of the map" in complaint
    publisher.publish(initial_pose(np.zeros(3), frame="odom"))
    nodes.until(lambda: "the pose is in the frame 'odom', not in 'map'" in nodes.diagnosis("slam")["last error"])
    # Lost, and with an initial pose 0.4 m beside where it is: a keyframe later it is recognized, else it takes five.
    nodes.drive(log, first=20, robot__duration=2.5)
    nodes.until(lambda: len(nodes.estimates) == 13)
    assert not nodes.is_localized()
    publisher.publish(initial_pose(4 * 32 * PACE + [0.3, -0.25, 0.1]))
    listener.spin(1.0)
    nodes.park()
    nodes.drive(log, first=33, robot__duration=2.0)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == 13 + 10)
    nodes.park()
    # While it is localized, it is put to another place with an initial pose.
    publisher.publish(initial_pose(4 * 80 * PACE + [0.3, -0.25, 0.1]))
    nodes.until(lambda: not nodes.is_localized())
    # As slowly as odometry comes, which rtl answers.
    nodes.drive(log, first=80, rate=2.0, robot__duration=6.0)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == 13 + 10 + 30)
    nodes.until_at(4 * 109, tolerance=0.2)


def test_an_initial_pose_that_is_given_as_a_parameter_is_where_the_robot_is_looked_for(corridor, listener, start):
    log, out = corridor
    x, y, heading = (4 * 80 * PACE + [0.3, -0.25, 0.1]).tolist()
    nodes = Nodes(start, listener, start_from=out, initial_pose=f"[{x}, {y}, {heading}]")
    nodes.drive(log, first=80, robot__duration=1.5)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == 8)


def test_an_initial_pose_without_a_map_is_refused(start):
    node = start("slam", initial_pose="[1.0, 2.0, 0.0]")
    assert "initial_pose is set, but no map that it is a pose in: set start_from" in node.communicate(timeout=40)[1]
    assert node.returncode == 2
