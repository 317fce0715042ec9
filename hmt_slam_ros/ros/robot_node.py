"""A simulated robot: replays a log, or drives through a world, as /scan, /odom, /tf, /tf_static and /clock.

Where `robot.drive` says so it is driven by what comes on /cmd_vel, and tells where it is on /ground_truth.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import rclpy
from nav_msgs.msg import Odometry as OdometryMessage
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import SetBool

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs import Log
from hmt_slam_ros.messages.documents import RobotStatus, encode
from hmt_slam_ros.messages.messages import LocalEstimate, Message, TrackingReset
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.outbox import publish_reliably
from hmt_slam_ros.ros.parameters import ConfiguredNode, declare_frame
from hmt_slam_ros.ros.player import Player
from hmt_slam_ros.ros.topics import CLOCK, DOCUMENTS, ODOM, ROBOT_STATUS, SCAN
from hmt_slam_ros.ros.transforms import transform_publisher
from hmt_slam_ros.sensors import Odometry, Scan

if TYPE_CHECKING:
    from hmt_slam_ros.ros.driving import DrivenRobotSource

_ESTIMATES = DOCUMENTS[LocalEstimate]
_CHANGEABLE = ("robot.rate", "robot.flow_control", "robot.max_unacknowledged_scans")
_STATUS_PERIOD = 0.2  # s
_LONGEST_WAIT = 0.1  # s
_BURST = 20  # measurements between two looks at services and acknowledgements
_ACKNOWLEDGEMENT_TIMEOUT = 10.0  # s without an acknowledgement before the robot complains

PlaybackState = Literal["waiting", "playing", "paused", "ended"]


class RobotNode(ConfiguredNode):
    """The node ``robot``."""

    def __init__(self) -> None:
        super().__init__("robot", _CHANGEABLE)
        self._settings = self.configuration.robot
        self._odom_frame, self._base_frame = (
            declare_frame(self, "odom", "odom"),
            declare_frame(self, "base", "base_link"),
        )
        self._laser_frame = declare_frame(self, "laser", "laser")
        self.diagnostics = NodeDiagnostics(self)
        self._driven_robot: DrivenRobotSource | None = None
        self._log = self._open_log()
        self._player = Player(self._log, self._settings)
        self._state: PlaybackState = "waiting"
        self._laser_frames: dict[bytes, tuple[str, NDArray[np.float64]]] = {}
        self._started_at = self._last_progress = time.monotonic()
        self._scans = self.create_publisher(LaserScan, SCAN, topics.LATCHED_SENSOR)
        self._readings = self.create_publisher(OdometryMessage, ODOM, topics.LATCHED_SENSOR)
        self._clock_times = self.create_publisher(ClockMessage, CLOCK, topics.STREAM)
        self._statuses = self.create_publisher(String, ROBOT_STATUS, topics.LATCHED)
        self._send_transforms = transform_publisher(self, "tf")
        self._send_static_transforms = transform_publisher(self, "tf_static")
        # The past too: the first answers may come before the two nodes have found each other.
        self._inbox = Inbox(self, (LocalEstimate, TrackingReset), self._on_message, self.diagnostics, topics.CHAIN)
        self.create_service(SetBool, "~/pause", self._pause)
        self.create_timer(_STATUS_PERIOD, self._publish_status, clock=self.diagnostics.steady_clock)

    def _open_log(self) -> Log:
        descriptor = ParameterDescriptor(description="The log to replay, or sim:WORLD.", read_only=True)
        path = str(self.declare_parameter("log", "", descriptor).value)
        if not path:
            raise HmtSlamError("no log is given: set the parameter log, such as -p log:=data/malaga_one_loop")
        if self._settings.drive == "commands":
            # The kernels of the simulation are for those who simulate.
            from hmt_slam_ros.ros.driving import DrivenRobotSource  # noqa: PLC0415

            self._driven_robot = DrivenRobotSource(self, path, self._settings)
            return self._driven_robot
        log = open_log(Path(path), start=self._settings.start, duration=self._settings.duration or None)
        if not log.scan_count:
            raise HmtSlamError(f"{path} has no scans in the part asked for: check robot.start and robot.duration")
        return log

    def on_configuration_changed(self, configuration: Configuration) -> None:
        """Take note of another rate, window or pace."""
        super().on_configuration_changed(configuration)
        self._settings = self._player.settings = configuration.robot

    def play(self) -> None:
        """Replay the log, then stay until told to end, for those who still listen."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        try:
            while rclpy.ok():
                executor.spin_once(timeout_sec=self._step())
        except ExternalShutdownException:
            pass
        finally:
            executor.shutdown()

    def _step(self) -> float:
        """Send what is due; return the seconds until there is more to do."""
        if self._state == "waiting":
            self._await_subscribers()
            return _LONGEST_WAIT
        for _ in range(_BURST):
            now = time.monotonic()
            wait = self._player.seconds_until_due(now)
            if wait is None or wait > 0.0:
                return _LONGEST_WAIT if wait is None else min(wait, _LONGEST_WAIT)
            self._send(self._player.take_next(now))
        return 0.0

    @property
    def _is_answered(self) -> bool:
        """Whether one of those who hear the scans answers them; a recorder or RViz does not."""
        hear, answer = self.get_subscriptions_info_by_topic(SCAN), self.get_publishers_info_by_topic(_ESTIMATES)
        names = [{(end.node_namespace, end.node_name) for end in ends} for ends in (hear, answer)]
        return bool(names[0] & names[1])

    def _await_subscribers(self) -> None:
        """Begin when everybody who needs the first scan is there.

        :raises HmtSlamError: where they do not come.
        """
        settings = self._settings
        missing = [
            topic
            for publisher, topic, wanted in (
                (self._scans, SCAN, settings.scan_listeners),
                (self._readings, ODOM, settings.odometry_listeners),
            )
            if publisher.get_subscription_count() < wanted
        ]
        if settings.flow_control and settings.scan_listeners and not missing and not self._is_answered:
            missing = [SCAN]
        if not missing:
            self._state, self._last_progress = "playing", time.monotonic()
            told = f"replaying {self._log.name}: {self._log.scan_count} scans"
            self.get_logger().info(
                told if self._driven_robot is None else f"driving through {self._log.name} by cmd_vel"
            )
            return
        if time.monotonic() - self._started_at > settings.discovery_timeout:
            name = "scan" if missing[0] == SCAN else "odometry"
            raise HmtSlamError(
                f"too few subscribers of {' and '.join(missing)} after {settings.discovery_timeout:g} s: start the "
                f"slam and rtl nodes, or set robot.{name}_listeners to 0"
            )

    def _send(self, measurement: Scan | Odometry) -> None:
        self._last_progress = time.monotonic()
        self._clock_times.publish(ClockMessage(clock=conversions.time_message(measurement.stamp)))
        if isinstance(measurement, Scan):
            publish_reliably(
                self._scans, conversions.scan_message(measurement, self._announced_laser_frame(measurement))
            )
        else:
            joint = conversions.transform_message(
                measurement.stamp, self._odom_frame, self._base_frame, measurement.pose
            )
            self._send_transforms([joint])
            publish_reliably(
                self._readings, conversions.odometry_message(measurement, self._odom_frame, self._base_frame)
            )
        self.diagnostics.sent[type(measurement).__name__] += 1
        if self._driven_robot is not None:
            self._driven_robot.publish_ground_truth(measurement.stamp)
            self.diagnostics.values["contacts"] = self._driven_robot.contacts
        if self._player.has_ended:
            self._publish_status()
            self.get_logger().info(f"end of the log after {self._player.scans_sent} scans")

    def _announced_laser_frame(self, scan: Scan) -> str:
        """The frame of a scan's laser; each pose of a laser on the robot is a frame, announced when it first occurs."""
        key = scan.laser_pose.tobytes()
        if key not in self._laser_frames:
            number = len(self._laser_frames)
            self._laser_frames[key] = (
                f"{self._laser_frame}_{number}" if number else self._laser_frame,
                scan.laser_pose,
            )
            self._send_static_transforms(
                [
                    conversions.transform_message(scan.stamp, self._base_frame, frame, pose)
                    for frame, pose in self._laser_frames.values()
                ]
            )
        return self._laser_frames[key][0]

    def _on_message(self, message: Message) -> None:
        if isinstance(message, LocalEstimate):
            self._player.acknowledge(message.stamp)
        elif isinstance(message, TrackingReset):
            # Scans that waited are passed over.
            self._player.acknowledge(self._player.stamp)
        self._last_progress = time.monotonic()

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._player.is_paused = request.data
        response.success, response.message = True, "paused" if request.data else "playing"
        self._publish_status()
        return response

    def _publish_status(self) -> None:
        """Publish the status, and complain where the replay is held up."""
        player = self._player
        if self._state != "waiting":
            self._state = "ended" if player.has_ended else "paused" if player.is_paused else "playing"
        status = RobotStatus(
            self._state,
            self._log.name,
            player.stamp,
            player.scans_sent,
            self._log.scan_count,
            player.readings_sent,
            player.scans_acknowledged,
        )
        self._statuses.publish(String(data=encode(status)))
        if (
            self._state == "playing"
            and player.is_held_up
            and time.monotonic() - self._last_progress > _ACKNOWLEDGEMENT_TIMEOUT
        ):
            self._last_progress = time.monotonic()
            self.diagnostics.warn(
                f"the robot waits: slam has not answered the last {self._settings.max_unacknowledged_scans} scans; "
                "start the slam node, or set robot.flow_control to false to replay without it"
            )


def main() -> None:
    """Run the node."""
    sys.exit(run(RobotNode, RobotNode.play))


if __name__ == "__main__":
    main()
