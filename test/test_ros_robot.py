"""The robot node as an OS process over DDS."""

import json
import math
import signal
import time
from itertools import pairwise

import numpy as np
import pytest
from logs_for_nodes import LASER, START, Corridor, corridor_bag

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, TransformStamped, Twist
from nav_msgs.msg import Odometry as OdometryMessage
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import SetBool

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS, ROBOT_STATUS, TFMessage
from hmt_slam_ros.sensors import Scan

SCANS = [record.measurement for record in Corridor().records() if isinstance(record.measurement, Scan)]


@pytest.fixture
def received_topics(listener):
    """What comes on /clock, /tf, /scan, /odom and the status.

    The robot waits for subscribers of /scan and /odom; DDS announces subscriptions in the order in which they were
    made, so the others are there by then too.
    """
    return {
        "clock": listener.subscribe(Clock, "/clock", topics.STREAM),
        "tf": listener.subscribe(TFMessage, "tf", topics.STREAM) if TFMessage else [],
        "scan": listener.subscribe(LaserScan, "scan", topics.SENSOR),
        "odom": listener.subscribe(OdometryMessage, "odom", topics.SENSOR),
        "status": listener.subscribe(String, ROBOT_STATUS, topics.LATCHED),
    }


def last_status(received_topics):
    return json.loads(received_topics["status"][-1].data) if received_topics["status"] else {"state": None, "scans": 0}


def has_ended(received_topics):
    return lambda: (
        last_status(received_topics)["state"] == "ended"
        and len(received_topics["scan"]) >= last_status(received_topics)["scans"]
    )


def test_every_scan_and_odometry_reading_arrives_as_it_is_in_the_log(tmp_path, listener, start, received_topics):
    robot = start("robot", log=corridor_bag(tmp_path), robot__rate=0.0, robot__flow_control=False)
    listener.until(lambda: has_ended(received_topics)() and len(received_topics["odom"]) == 45, alive=[robot])
    assert [conversions.stamp_from_time(message.header.stamp) for message in received_topics["scan"]] == [
        scan.stamp for scan in SCANS
    ]
    for message, scan in zip(received_topics["scan"], SCANS, strict=True):
        assert np.array_equal(conversions.ranges_from_message(message), scan.ranges)
        assert message.header.frame_id == "laser"
    readings = [conversions.odometry_from_message(message) for message in received_topics["odom"]]
    assert np.allclose([reading.pose[0] for reading in readings], 0.025 * np.arange(45))
    assert received_topics["odom"][0].header.frame_id == "odom"
    status = last_status(received_topics)
    assert (status["scans"], status["scans_in_log"], status["odometry_readings"]) == (12, 12, 45)
    listener.until(
        lambda: (
            received_topics["clock"]
            and conversions.stamp_from_time(received_topics["clock"][-1].clock) == SCANS[-1].stamp
        )
    )


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh, which builds it")
def test_the_transforms_come_on_tf_and_tf_static(tmp_path, listener, start, received_topics):
    moving = received_topics["tf"]
    start("robot", log=corridor_bag(tmp_path), robot__rate=0.0, robot__flow_control=False)
    listener.until(lambda: len(moving) == 45)
    # The static ones are latched, for those who come later.
    static = listener.subscribe(TFMessage, "tf_static", topics.TF_STATIC)
    listener.until(lambda: static)
    (laser,) = static[0].transforms
    assert isinstance(laser, TransformStamped)
    assert (laser.header.frame_id, laser.child_frame_id) == ("base_link", "laser")
    assert laser.transform.translation.x == pytest.approx(LASER[0])
    assert 2 * np.arctan2(laser.transform.rotation.z, laser.transform.rotation.w) == pytest.approx(LASER[2])
    (wheels,) = moving[-1].transforms
    assert (wheels.header.frame_id, wheels.child_frame_id) == ("odom", "base_link")
    assert wheels.transform.translation.x == pytest.approx(1.1)


def test_a_replay_in_real_time_takes_its_time(tmp_path, listener, start, received_topics):
    arrivals = []
    take = lambda scan: arrivals.append((time.monotonic(), conversions.stamp_from_time(scan.header.stamp)))  # noqa: E731
    listener.node.create_subscription(LaserScan, "scan", take, topics.SENSOR)
    start("robot", log=corridor_bag(tmp_path, 21), robot__rate=2.0, robot__flow_control=False)
    listener.until(has_ended(received_topics))
    listener.until(lambda: len(arrivals) == 21)
    times, stamps = np.array(arrivals).T
    late = times - times[0] - (stamps - stamps[0]) / 1e9 / 2.0
    # The machine may be busy for a while.
    assert late.min() > -0.5
    assert np.median(late) < 0.5
    assert np.ptp(stamps) == pytest.approx(4e9)


def test_a_pause_stops_the_robot_and_its_end_lets_it_go_on(tmp_path, listener, start, received_topics):
    start("robot", log=corridor_bag(tmp_path, 200), robot__rate=5.0, robot__flow_control=False)
    listener.until(lambda: received_topics["scan"])
    assert listener.call(SetBool, "robot/pause", SetBool.Request(data=True)).success
    listener.spin(0.3)
    count = len(received_topics["scan"])
    listener.spin(0.5)
    assert len(received_topics["scan"]) == count < 200
    assert last_status(received_topics)["state"] == "paused"
    listener.call(SetBool, "robot/pause", SetBool.Request(data=False))
    listener.until(lambda: len(received_topics["scan"]) > count)


def test_a_paced_robot_waits_for_the_acknowledgement(tmp_path, listener, start, received_topics):
    estimates = listener.node.create_publisher(String, DOCUMENTS[LocalEstimate], topics.CHAIN)
    start(
        "robot",
        log=corridor_bag(tmp_path),
        robot__rate=0.0,
        robot__max_unacknowledged_scans=4,
        filter__max_scans_waiting_for_odometry=3,
        motion__patience=0.0,
    )
    listener.until(lambda: len(received_topics["scan"]) == 4)
    listener.spin(0.5)
    assert len(received_topics["scan"]) == 4
    answered = 0
    while answered < 12:
        listener.until(lambda: len(received_topics["scan"]) > answered)  # noqa: B023  called before the next turn
        belief = PoseGaussian(np.zeros(3), np.eye(3))
        stamp = conversions.stamp_from_time(received_topics["scan"][answered].header.stamp)
        estimates.publish(String(data=encode(LocalEstimate(stamp, answered, 0, belief, np.zeros(3), 0))))
        answered += 1
        assert len(received_topics["scan"]) <= answered + 4
    listener.until(
        lambda: last_status(received_topics)["state"] == "ended" and last_status(received_topics)["acknowledged"] == 12
    )


def test_the_robot_waits_for_those_who_subscribe_to_it_and_answer(tmp_path, listener, start):
    listener.subscribe(LaserScan, "scan", topics.SENSOR)  # as a recorder does
    robot = start(
        "robot",
        log=corridor_bag(tmp_path),
        robot__discovery_timeout=3.0,
        robot__scan_listeners=1,
        robot__odometry_listeners=0,
    )
    error = robot.communicate(timeout=40)[1]
    assert robot.returncode == 2
    assert "too few subscribers of scan after 3 s" in error
    assert "robot.scan_listeners" in error
    assert "Traceback" not in error


def test_the_robot_waits_for_nodes_that_compile_their_kernels(tmp_path, listener, start, received_topics):
    reports = listener.node.create_publisher(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    kernels = "compiling kernels, 40 s left"

    def report():
        value = KeyValue(key="kernels", value=kernels)
        reports.publish(
            DiagnosticArray(status=[DiagnosticStatus(name="/tlca", hardware_id="hmt_slam_ros", values=[value])])
        )

    listener.node.create_timer(0.1, report)
    parameters = {"robot__flow_control": False, "robot__scan_listeners": 2, "robot__odometry_listeners": 0}
    robot = start("robot", log=corridor_bag(tmp_path, 3), robot__rate=0.0, **parameters)
    listener.until(reports.get_subscription_count, alive=[robot])
    listener.spin(1.0)
    listener.subscribe(LaserScan, "scan", topics.SENSOR)
    listener.spin(1.5)
    assert last_status(received_topics)["state"] == "waiting"
    kernels = "63 loaded"
    listener.until(has_ended(received_topics), alive=[robot])


def test_a_log_that_loops_goes_on_from_the_start_with_later_stamps(tmp_path, listener, start, received_topics):
    start("robot", log=corridor_bag(tmp_path, 3), robot__rate=0.0, robot__flow_control=False, robot__loop=True)
    listener.until(lambda: len(received_topics["scan"]) > 10)
    stamps = [conversions.stamp_from_time(message.header.stamp) for message in received_topics["scan"]]
    assert all(a < b for a, b in pairwise(stamps))
    assert np.array_equal(conversions.ranges_from_message(received_topics["scan"][3]), SCANS[0].ranges)


def test_start_and_duration_play_a_part(tmp_path, listener, start, received_topics):
    start(
        "robot",
        log=corridor_bag(tmp_path),
        robot__rate=0.0,
        robot__flow_control=False,
        robot__start=0.5,
        robot__duration=1.0,
    )
    listener.until(has_ended(received_topics))
    stamps = [(conversions.stamp_from_time(message.header.stamp) - START) / 1e9 for message in received_topics["scan"]]
    assert stamps == pytest.approx([0.6, 0.8, 1.0, 1.2, 1.4])


def test_everything_but_the_clock_moves_into_a_namespace(tmp_path, listener, start):
    scans = listener.subscribe(LaserScan, "tower/scan", topics.SENSOR)
    listener.subscribe(OdometryMessage, "tower/odom", topics.SENSOR)
    times = listener.subscribe(Clock, "/clock", topics.STREAM)
    start("robot", "-r", "__ns:=/tower", log=corridor_bag(tmp_path, 3), robot__rate=0.0, robot__flow_control=False)
    listener.until(lambda: len(scans) == 3)
    listener.until(lambda: times and conversions.stamp_from_time(times[-1].clock) == SCANS[2].stamp)


@pytest.mark.parametrize(
    ("log", "sentence"), [("", "no log is given"), ("/nowhere/at/all.mcap", "/nowhere/at/all.mcap cannot be read")]
)
def test_a_log_that_is_not_there_is_one_sentence(domain, start, log, sentence):
    robot = start("robot", log=f"'{log}'")
    error = robot.communicate(timeout=40)[1]
    assert robot.returncode == 2
    assert sentence in error
    assert len(error.strip().splitlines()) == 1


def test_a_simulated_robot_drives_live(listener, start, received_topics):
    name = "sim:ring,seed=3,people=2"
    start("robot", log=name, robot__rate=0.0, robot__flow_control=False, robot__duration=3.0)
    listener.until(has_ended(received_topics))
    records = list(open_log(name, duration=3.0).records())
    scans = [record.measurement for record in records if isinstance(record.measurement, Scan)]
    listener.until(lambda: len(received_topics["odom"]) == len(records) - len(scans))
    assert len(scans) == len(received_topics["scan"]) == 16
    for message, scan in zip(received_topics["scan"], scans, strict=True):
        assert conversions.stamp_from_time(message.header.stamp) == scan.stamp
        assert np.array_equal(conversions.ranges_from_message(message), scan.ranges)


class Driver:
    """Drives the robot node's robot and listens to where it truly is."""

    def __init__(self, listener, received_topics):
        self.truths = listener.subscribe(PoseStamped, "ground_truth", topics.STREAM)
        self._publisher = listener.node.create_publisher(Twist, "cmd_vel", 1)
        self._listener, self._heard = listener, received_topics

    @property
    def poses(self):
        return np.array([conversions.pose_from_message(message.pose) for message in self.truths])

    def until(self, condition, speed, turn_rate=0.0, **options):
        """Command velocities until a condition holds."""

        def is_reported():
            command = Twist()
            command.linear.x, command.angular.z = speed, turn_rate
            self._publisher.publish(command)
            return condition()

        self._listener.until(self._publisher.get_subscription_count)
        self._listener.until(is_reported, **options)

    def stands(self):
        """Whether it has not moved for a second of its time, in which there were scans."""
        return len(self.truths) > 15 and len(self._heard["scan"]) > 5 and not np.ptp(self.poses[-15:], axis=0).any()


@pytest.fixture
def driver(listener, received_topics):
    return Driver(listener, received_topics)


def start_driven(start, log="sim:institute,seed=3,people=0,beams=90", rate=2.0, **parameters):
    return start("robot", log=log, robot__drive="commands", robot__rate=rate, robot__flow_control=False, **parameters)


def test_commands_drive_the_robot_and_silence_stops_it(listener, start, received_topics, driver):
    robot = start_driven(start)
    listener.until(driver.stands, alive=[robot])
    begin = driver.poses[-1]
    driver.until(lambda: np.hypot(*(driver.poses[-1] - begin)[:2]) > 0.5, 0.3, alive=[robot])
    ahead = se2.between(begin, driver.poses[-1])
    assert ahead[0] > 0.5
    assert abs(ahead[1]) < 0.01
    driver.until(lambda: se2.between(begin, driver.poses[-1])[2] > 0.5, 0.0, 0.6, alive=[robot])
    listener.until(driver.stands, alive=[robot])
    # Half a second after the last command it begins to brake.
    moved = se2.between(begin, driver.poses[-1])
    assert moved[0] < 1.5
    readings = [conversions.odometry_from_message(message) for message in received_topics["odom"]]
    assert all(a < b for a, b in pairwise([reading.stamp for reading in readings]))
    wheels = {reading.stamp: reading.pose for reading in readings}
    stamps = [conversions.stamp_from_time(message.header.stamp) for message in driver.truths]
    shared = [(wheels[stamp], pose) for stamp, pose in zip(stamps, driver.poses, strict=True) if stamp in wheels]
    assert len(shared) > 20
    errors = se2.between(se2.between(shared[0][0], shared[-1][0]), se2.between(shared[0][1], shared[-1][1]))
    assert 0.0 < np.abs(errors).max() < 0.5
    assert driver.truths[0].header.frame_id == "world"
    assert received_topics["clock"]


def test_the_driven_robot_does_not_pass_a_wall(listener, start, driver):
    # It begins a meter before the end of a hallway, with its back to it.
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    contacts = lambda: [v.value for r in reports[-1:] for v in r.status[0].values if v.key == "contacts"]  # noqa: E731
    robot = start_driven(start)
    listener.until(driver.stands, alive=[robot])
    begin = driver.poses[-1]
    back = lambda: -se2.between(begin, driver.poses[-1])[0]  # noqa: E731
    driver.until(lambda: back() > 1.0 - 0.25 - 0.02, -0.4, alive=[robot])
    count = len(driver.truths)
    driver.until(lambda: len(driver.truths) > count + 20, -0.4, alive=[robot])
    assert back() <= 1.0 - 0.25
    listener.until(lambda: contacts() == ["1"], alive=[robot])


def test_a_command_that_is_no_number_stops_the_robot_and_is_reported(listener, start, driver):
    robot = start_driven(start)
    listener.until(driver.stands, alive=[robot])
    begin, count = driver.poses[-1], len(driver.truths)
    driver.until(lambda: len(driver.truths) > count + 10, math.nan, alive=[robot])
    np.testing.assert_array_equal(driver.poses[-1], begin)
    robot.send_signal(signal.SIGINT)
    error = robot.communicate()[1]
    assert error.count("cmd_vel has nan m/s and 0 rad/s, and the robot stops: send finite velocities") == 1


def test_a_driven_robot_ends_after_its_duration_and_begins_where_the_drive_is_after_its_start(
    listener, start, received_topics, driver
):
    robot = start_driven(start, rate=20.0, robot__duration=2.0, robot__start=30.0)
    listener.until(has_ended(received_topics), alive=[robot])
    assert last_status(received_topics)["scans"] == 11
    simulated = open_log("sim:institute,seed=3,people=0,beams=90")
    there = simulated.true_poses(np.array([simulated.scenario.stamps[0] + 30_000_000_000]))[0]
    np.testing.assert_allclose(driver.poses, np.tile(there, (len(driver.truths), 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"log": "data/malaga_one_loop"}, "is no simulated world"),
        ({"log": "sim:busy"}, "has no setting moved: set moved=0"),
        ({"rate": 0.0}, "robot.drive is commands and robot.rate is 0"),
    ],
)
def test_what_cannot_be_driven_is_one_sentence(domain, start, parameters, sentence):
    robot = start_driven(start, **parameters)
    error = robot.communicate(timeout=40)[1]
    assert robot.returncode == 2
    assert sentence in error
    assert len(error.strip().splitlines()) == 1
