"""A laser whose transform is known stays where it is, whatever comes on /tf_static, and unknown ones hold up nobody."""

import math

import pytest
from logs_for_nodes import LASER, REAR_LASER, Corridor

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
from sensor_msgs.msg import LaserScan

from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS, SCAN, TFMessage
from hmt_slam_ros.sensors import Scan

pytestmark = pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed: run scripts/test.sh")

HALF = math.sqrt(0.5)


def joint(child="laser", x=0.1, turn=(0.0, 0.0, 0.0, 1.0), parent="base_link"):
    stamped = TransformStamped(child_frame_id=child)
    stamped.header.frame_id, stamped.transform.translation.x = parent, x
    rotation = stamped.transform.rotation
    rotation.x, rotation.y, rotation.z, rotation.w = turn
    return stamped


BAD = [
    joint(turn=(HALF, 0.0, 0.0, HALF)),
    joint(turn=(math.nan, 0.0, 0.0, 1.0)),
    joint(turn=(0.0, 0.0, 0.0, 0.0)),
    joint(x=math.nan),
    joint(x=5000.0),
    joint(parent="somewhere"),
]


class Laser:
    """Driver of a robot with slam alone, and what slam reports."""

    def __init__(self, listener, start, *words, topic=SCAN):
        node = listener.node
        self._listener = listener
        self._scans = node.create_publisher(LaserScan, topic, topics.SENSOR)
        self._odom = node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
        self._static = node.create_publisher(TFMessage, "tf_static", topics.CHAIN_HISTORY)
        self._reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
        self.process = start("slam", *words)
        listener.until(lambda: self._scans.get_subscription_count() and self._odom.get_subscription_count())
        self._measurements = iter(record.measurement for record in Corridor(60).records())

    def drive(self, scans, frame="laser", base_frame="base_link"):
        """Send scans, and the odometry between."""
        for _ in range(scans):
            while not isinstance(one := next(self._measurements), Scan):
                self._odom.publish(conversions.odometry_message(one, "odom", base_frame))
            self._scans.publish(conversions.scan_message(one, frame))

    def join(self, *transforms):
        self._static.publish(TFMessage(transforms=list(transforms)))

    def tick(self):
        """Send the next scan, and the odometry before it; returns slam's last error."""
        self.drive(1)
        self._listener.spin(0.3)
        last = self._reports[-1].status[0]
        return next((one.value for one in last.values if one.key == "last error"), "")

    def value(self, name):
        """A number of slam's diagnostics, 0 where it has none."""
        for report in reversed(self._reports):
            if report.status[0].name == "/slam":
                return int(next((one.value for one in report.status[0].values if one.key == name), 0))
        return 0

    def until(self, name, number):
        self._listener.until(lambda: self.value(name) == number, seconds=40.0, alive=[self.process])


def test_a_known_laser_stays_where_it_is(listener, start):
    laser = Laser(listener, start)
    laser.join(joint())
    laser.drive(2)
    laser.until("received Scan", 2)
    for number, bad in enumerate(BAD, 1):
        laser.join(bad)
        laser.drive(1)
        laser.until("received Scan", 2 + number)
    # A frame that leaves the robot is a loss, and no transform of the laser; all others are refused.
    laser.until("refused on tf_static", len(BAD) - 1)
    assert laser.value("refused on scan") == 0


def test_a_transform_that_is_none_leaves_those_beside_it(listener, start):
    laser = Laser(listener, start)
    laser.join(joint(child="other", turn=(0.0, 0.0, 0.0, 0.0)), joint(child=""), joint())
    laser.drive(1)
    laser.until("received Scan", 1)
    laser.until("refused on tf_static", 2)


@pytest.mark.long
def test_scans_of_unknown_frames_hold_up_those_of_known_ones_for_a_while_only(listener, start):
    laser = Laser(listener, start)
    laser.join(joint())
    laser.drive(1)
    laser.until("received Scan", 1)
    for number in range(6):
        laser.drive(1, frame=f"unknown_{number}")
    laser.drive(3)
    laser.until("received Scan", 4)
    laser.until("refused on scan", 6)
    # What is known later counts from then on.
    laser.join(joint(child="unknown_5"))
    laser.drive(1, frame="unknown_5")
    laser.until("received Scan", 5)


def test_scans_of_two_topics_are_those_of_one_robot_and_a_silent_one_is_named(listener, start):
    poses = f"laser_pose:={[*LASER.tolist(), *REAR_LASER.tolist()]}"
    laser = Laser(listener, start, "-p", "sensors.scan_topics:=front,rear", "-p", poses, topic="front")
    rear = listener.node.create_publisher(LaserScan, "rear", topics.SENSOR)
    listener.until(rear.get_subscription_count)
    scans = (record.measurement for record in Corridor(3, has_rear_laser=True).records())
    of_rear = [scan for scan in scans if isinstance(scan, Scan) and scan.laser_pose is REAR_LASER]
    laser.drive(1)
    laser.until("received Scan", 1)
    rear.publish(conversions.scan_message(of_rear[0], ""))
    listener.spin(0.5)
    laser.drive(2)
    rear.publish(conversions.scan_message(of_rear[1], ""))
    # The last scan of the front laser waits, as the rear one may still send an earlier one.
    laser.until("received Scan", 4)
    assert (laser.value("refused on front"), laser.value("refused on rear")) == (0, 0)
    listener.until(lambda: "rear; meanwhile the pose goes on by the other scans" in laser.tick(), alive=[laser.process])
