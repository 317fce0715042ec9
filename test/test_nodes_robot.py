"""The robot node as an OS process over DDS."""

import json
import time
from itertools import pairwise

import numpy as np
import pytest
from logs_for_nodes import LASER, START, Corridor, corridor_bag

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import SetBool

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs import open_log
from hmt_slam_ros.nodes import conversions, qos
from hmt_slam_ros.nodes.topics import DOCUMENTS, ROBOT_STATUS
from hmt_slam_ros.nodes.transforms import TFMessage
from hmt_slam_ros.processes.documents import encode
from hmt_slam_ros.processes.messages import LocalEstimate
from hmt_slam_ros.sensing import Scan

SCANS = [record.measurement for record in Corridor().records() if isinstance(record.measurement, Scan)]


@pytest.fixture
def heard(listener):
    """What comes on /clock, /tf, /scan, /odom and the status.

    The robot waits for those who hear /scan and /odom; DDS announces subscriptions in the order in which they were
    made, so the others are there by then too.
    """
    return {
        "clock": listener.hear(Clock, "/clock", qos.STREAM),
        "tf": listener.hear(TFMessage, "tf", qos.STREAM) if TFMessage else [],
        "scan": listener.hear(LaserScan, "scan", qos.SENSOR),
        "odom": listener.hear(OdometryMessage, "odom", qos.SENSOR),
        "status": listener.hear(String, ROBOT_STATUS, qos.LATCHED),
    }


def last_status(heard):
    return json.loads(heard["status"][-1].data) if heard["status"] else {"state": None, "scans": 0}


def ended(heard):
    return lambda: last_status(heard)["state"] == "ended" and len(heard["scan"]) >= last_status(heard)["scans"]


def test_every_scan_and_odometry_reading_arrives_as_it_is_in_the_log(tmp_path, listener, start, heard):
    robot = start("robot", log=corridor_bag(tmp_path), robot__rate=0.0, robot__paced=False)
    listener.until(lambda: ended(heard)() and len(heard["odom"]) == 45, alive=[robot])
    assert [conversions.stamp_of(message.header.stamp) for message in heard["scan"]] == [scan.stamp for scan in SCANS]
    for message, scan in zip(heard["scan"], SCANS, strict=True):
        assert np.array_equal(conversions.ranges_of(message), scan.ranges)
        assert message.header.frame_id == "laser"
    readings = [conversions.odometry_from(message) for message in heard["odom"]]
    assert np.allclose([reading.pose[0] for reading in readings], 0.025 * np.arange(45))
    assert heard["odom"][0].header.frame_id == "odom"
    status = last_status(heard)
    assert (status["scans"], status["scans_in_log"], status["odometry"]) == (12, 12, 45)
    listener.until(lambda: conversions.stamp_of(heard["clock"][-1].clock) == SCANS[-1].stamp)


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh, which builds it")
def test_the_transforms_come_on_tf_and_tf_static(tmp_path, listener, start, heard):
    moving = heard["tf"]
    start("robot", log=corridor_bag(tmp_path), robot__rate=0.0, robot__paced=False)
    listener.until(lambda: len(moving) == 45)
    # The static ones are latched, for those who come later.
    static = listener.hear(TFMessage, "tf_static", qos.TF_STATIC)
    listener.until(lambda: static)
    (laser,) = static[0].transforms
    assert isinstance(laser, TransformStamped)
    assert (laser.header.frame_id, laser.child_frame_id) == ("base_link", "laser")
    assert laser.transform.translation.x == pytest.approx(LASER[0])
    assert 2 * np.arctan2(laser.transform.rotation.z, laser.transform.rotation.w) == pytest.approx(LASER[2])
    (wheels,) = moving[-1].transforms
    assert (wheels.header.frame_id, wheels.child_frame_id) == ("odom", "base_link")
    assert wheels.transform.translation.x == pytest.approx(1.1)


def test_a_replay_in_real_time_takes_its_time(tmp_path, listener, start, heard):
    start("robot", log=corridor_bag(tmp_path, 6), robot__rate=2.0, robot__paced=False)
    listener.until(lambda: heard["scan"])
    begin = time.monotonic()
    listener.until(ended(heard))
    assert time.monotonic() - begin == pytest.approx(0.5, abs=0.25)


def test_a_pause_stops_the_robot_and_its_end_lets_it_go_on(tmp_path, listener, start, heard):
    start("robot", log=corridor_bag(tmp_path, 200), robot__rate=5.0, robot__paced=False)
    listener.until(lambda: heard["scan"])
    assert listener.call(SetBool, "robot/pause", SetBool.Request(data=True)).success
    listener.spin(0.3)
    count = len(heard["scan"])
    listener.spin(0.5)
    assert len(heard["scan"]) == count < 200
    assert last_status(heard)["state"] == "paused"
    listener.call(SetBool, "robot/pause", SetBool.Request(data=False))
    listener.until(lambda: len(heard["scan"]) > count)


def test_a_paced_robot_waits_for_the_acknowledgement(tmp_path, listener, start, heard):
    estimates = listener.node.create_publisher(String, DOCUMENTS[LocalEstimate], qos.CHAIN)
    start("robot", log=corridor_bag(tmp_path), robot__rate=0.0, robot__window=4, filter__patience=3)
    listener.until(lambda: len(heard["scan"]) == 4)
    listener.spin(0.5)
    assert len(heard["scan"]) == 4
    answered = 0
    while answered < 12:
        listener.until(lambda: len(heard["scan"]) > answered)  # noqa: B023  called before the next turn
        belief = PoseGaussian(np.zeros(3), np.eye(3))
        stamp = conversions.stamp_of(heard["scan"][answered].header.stamp)
        estimates.publish(String(data=encode(LocalEstimate(stamp, answered, 0, belief, np.zeros(3), 0))))
        answered += 1
        assert len(heard["scan"]) <= answered + 4
    listener.until(lambda: last_status(heard)["state"] == "ended" and last_status(heard)["acknowledged"] == 12)


def test_the_robot_waits_for_those_who_have_to_hear_it_and_answer(tmp_path, listener, start):
    listener.hear(LaserScan, "scan", qos.SENSOR)  # as a recorder does
    robot = start(
        "robot", log=corridor_bag(tmp_path), robot__patience=3.0, robot__scan_listeners=1, robot__odometry_listeners=0
    )
    error = robot.communicate(timeout=40)[1]
    assert robot.returncode == 2
    assert "too few subscribers of scan after 3 s" in error
    assert "robot.scan_listeners" in error
    assert "Traceback" not in error


def test_a_log_that_loops_goes_on_from_the_start_with_later_stamps(tmp_path, listener, start, heard):
    start("robot", log=corridor_bag(tmp_path, 3), robot__rate=0.0, robot__paced=False, robot__loop=True)
    listener.until(lambda: len(heard["scan"]) > 10)
    stamps = [conversions.stamp_of(message.header.stamp) for message in heard["scan"]]
    assert all(a < b for a, b in pairwise(stamps))
    assert np.array_equal(conversions.ranges_of(heard["scan"][3]), SCANS[0].ranges)


def test_start_and_duration_play_a_part(tmp_path, listener, start, heard):
    start(
        "robot", log=corridor_bag(tmp_path), robot__rate=0.0, robot__paced=False, robot__start=0.5, robot__duration=1.0
    )
    listener.until(ended(heard))
    stamps = [(conversions.stamp_of(message.header.stamp) - START) / 1e9 for message in heard["scan"]]
    assert stamps == pytest.approx([0.6, 0.8, 1.0, 1.2, 1.4])


def test_everything_but_the_clock_moves_into_a_namespace(tmp_path, listener, start):
    scans = listener.hear(LaserScan, "tower/scan", qos.SENSOR)
    listener.hear(OdometryMessage, "tower/odom", qos.SENSOR)
    times = listener.hear(Clock, "/clock", qos.STREAM)
    start(
        "robot", "-r", "__ns:=/tower", log=corridor_bag(tmp_path, 3), robot__rate=0.0, robot__paced=False
    )
    listener.until(lambda: len(scans) == 3)
    listener.until(lambda: times and conversions.stamp_of(times[-1].clock) == SCANS[2].stamp)


@pytest.mark.parametrize(
    ("log", "sentence"), [("", "no log is given"), ("/nowhere/at/all.mcap", "/nowhere/at/all.mcap cannot be read")]
)
def test_a_log_that_is_not_there_is_one_sentence(domain, start, log, sentence):
    robot = start("robot", log=f"'{log}'")
    error = robot.communicate(timeout=40)[1]
    assert robot.returncode == 2
    assert sentence in error
    assert len(error.strip().splitlines()) == 1


def test_a_simulated_robot_drives_live(listener, start, heard):
    name = "sim:ring,seed=3,people=2"
    start("robot", log=name, robot__rate=0.0, robot__paced=False, robot__duration=3.0)
    listener.until(ended(heard))
    records = list(open_log(name, duration=3.0).records())
    scans = [record.measurement for record in records if isinstance(record.measurement, Scan)]
    listener.until(lambda: len(heard["odom"]) == len(records) - len(scans))
    assert len(scans) == len(heard["scan"]) == 16
    for message, scan in zip(heard["scan"], scans, strict=True):
        assert conversions.stamp_of(message.header.stamp) == scan.stamp
        assert np.array_equal(conversions.ranges_of(message), scan.ranges)
