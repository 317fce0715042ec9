"""Node of a simulated robot: publishes a log or a simulated drive as /scan, /odom, /tf, /tf_static and /clock.

With ``robot.drive = commands`` it follows /cmd_vel, and publishes its true pose on /ground_truth.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import Odometry as OdometryMessage
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import SetBool

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.robot import RobotParameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.kernel_loading import COMPILING
from hmt_slam_ros.logs import Log
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.logs.writer import WORLD_FRAME
from hmt_slam_ros.messages.documents import RobotStatus, encode
from hmt_slam_ros.messages.messages import LocalEstimate, Message, TrackingReset
from hmt_slam_ros.open_log import is_simulated, open_configured
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.chain_writer import publish_reliably
from hmt_slam_ros.ros.diagnostics import HARDWARE_ID, KERNELS, LOADING, NodeDiagnostics, is_of_other_namespace
from hmt_slam_ros.ros.message_io import Inbox
from hmt_slam_ros.ros.parameters import ConfiguredNode, declare_frame
from hmt_slam_ros.ros.player import Player
from hmt_slam_ros.ros.precedence_monitor import PrecedenceMonitor
from hmt_slam_ros.ros.topics import (
    CLOCK,
    CMD_VEL,
    DIAGNOSTICS,
    DOCUMENTS,
    GROUND_TRUTH,
    ODOM,
    ROBOT_STATUS,
    SCAN,
    transform_publisher,
)
from hmt_slam_ros.sensors import MarkObservation, Measurement, Odometry, Scan

if TYPE_CHECKING:
    from hmt_slam_ros.simulation.driven_robot import DrivenRobot

_ESTIMATES = DOCUMENTS[LocalEstimate]
_STATUS_PERIOD = 0.2  # s
_LONGEST_WAIT = 0.1
"""Longest time between two checks of subscribers, services and acknowledgements, s."""
_BURST = 20
"""Measurements that are sent between two such checks."""
_ACKNOWLEDGEMENT_TIMEOUT = 10.0
"""Time without an acknowledgement after which that is reported, s."""
_COMPILING_MEMORY = 3.0
"""Time for which a node is assumed to compile after its last diagnostics that report so, s; they come once a second."""
_MAX_VELOCITY = 100.0
"""Magnitude of a velocity command, m/s and rad/s, beyond any robot's."""
_REPEAT_PERIOD = 10.0
"""Time after which a warning about velocity commands is repeated, s."""

PlaybackState = Literal["waiting", "playing", "paused", "ended"]


class DrivenRobotSource:
    """A driven robot as a log for the player: each record is simulated right after the one before it was sent.

    So a command holds from the next odometry reading on, for ``driven_robot.COMMAND_TIMEOUT`` of simulated time.
    """

    def __init__(self, node: Node, name: str, settings: RobotParameters) -> None:
        """Put the robot where the scripted drive is after ``robot.start``.

        :param name: ``sim:WORLD,...``.
        :raises HmtSlamError: for a log that is not simulated, or an unknown world.
        """
        # They compile kernels, which a replay does not need.
        from hmt_slam_ros.simulation import open_simulated  # noqa: PLC0415
        from hmt_slam_ros.simulation.driven_robot import DrivenLog, DrivenRobot  # noqa: PLC0415
        from hmt_slam_ros.simulation.scenario import START  # noqa: PLC0415

        if not is_simulated(name):
            raise HmtSlamError(f"{name} is no simulated world: give log:=sim:WORLD, or set robot.drive to log")
        simulated = open_simulated(name)
        start = simulated.true_poses(np.array([START + round(NANOSECONDS * settings.start)]))[0]
        self._robot: DrivenRobot = DrivenRobot(simulated.scenario, start)
        self._log = DrivenLog(simulated.name, self._robot, settings.duration)
        self.name, self.scan_count, self.duration = simulated.name, self._log.scan_count, self._log.duration
        self._true_poses: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._node = node
        self._ground_truth_publisher = node.create_publisher(PoseStamped, GROUND_TRUTH, topics.STREAM)
        node.create_subscription(Twist, CMD_VEL, self._on_command, topics.NEWEST)

    def records(self) -> Iterator[LogRecord]:
        """The measurements of the robot, each simulated on demand."""
        for record in self._log.records():
            if isinstance(record.measurement, Odometry):
                self._true_poses.append((record.measurement.stamp, self._robot.pose))
            yield record

    @property
    def contacts(self) -> int:
        """Number of times that the robot touched something."""
        return self._robot.contacts

    def publish_ground_truth(self, stamp: int) -> None:
        """Publish the true poses at the odometry readings up to a stamp, ns."""
        while self._true_poses and self._true_poses[0][0] <= stamp:
            pose_stamp, pose = self._true_poses.popleft()
            header = conversions.header_message(pose_stamp, WORLD_FRAME)
            self._ground_truth_publisher.publish(PoseStamped(header=header, pose=conversions.pose_message(pose)))

    def _on_command(self, command: Twist) -> None:
        speed, turn_rate = command.linear.x, command.angular.z
        if not (abs(speed) <= _MAX_VELOCITY and abs(turn_rate) <= _MAX_VELOCITY):  # nor for NaN
            self._node.get_logger().warning(
                f"cmd_vel has {speed:g} m/s and {turn_rate:g} rad/s, and the robot stops: send finite velocities",
                throttle_duration_sec=_REPEAT_PERIOD,
            )
            speed = turn_rate = 0.0
        self._robot.set_velocity(speed, turn_rate)


class RobotNode(ConfiguredNode):
    """The node ``robot``."""

    changeable_parameters = ("robot.rate", "robot.flow_control", "robot.max_unacknowledged_scans")

    def __init__(self, name: str) -> None:
        """Open the log.

        :raises HmtSlamError: for an invalid parameter, or a log that cannot be read.
        """
        super().__init__(name)
        self._settings = self.configuration.robot
        self._odom_frame = declare_frame(self, "odom", "odom")
        self._base_frame = declare_frame(self, "base", "base_link")
        self._laser_frame = declare_frame(self, "laser", "laser")
        self.diagnostics = NodeDiagnostics(self, self.system)
        self._precedence = PrecedenceMonitor(self, self.diagnostics)
        self._driven_robot: DrivenRobotSource | None = None
        self._log = self._open_log()
        self._player = Player(self._log, self._settings, self.configuration.motion.patience)
        self._state: PlaybackState = "waiting"
        self._laser_frames: dict[bytes, tuple[str, NDArray[np.float64]]] = {}
        self._started_at = self._last_progress = time.monotonic()
        self._compiling_at = -_COMPILING_MEMORY
        self._scans = self.create_publisher(LaserScan, SCAN, topics.LATCHED_SENSOR)
        self._readings = self.create_publisher(OdometryMessage, ODOM, topics.LATCHED_SENSOR)
        self._marks: Publisher | None = None
        if topic := self.configuration.marks.topic:
            self._marks = self.create_publisher(PoseWithCovarianceStamped, topic, topics.LATCHED_SENSOR)
        self._clock_times = self.create_publisher(ClockMessage, CLOCK, topics.STREAM)
        self._statuses = self.create_publisher(String, ROBOT_STATUS, topics.LATCHED)
        self._send_transforms = transform_publisher(self, "tf")
        self._send_static_transforms = transform_publisher(self, "tf_static")
        # With the past: the first estimates may come before the two nodes have found each other.
        self._inbox = Inbox(self, (LocalEstimate, TrackingReset), self._on_message, self.diagnostics, topics.CHAIN)
        self.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, topics.STREAM)
        self.create_service(SetBool, "~/pause", self._pause)
        self.create_timer(_STATUS_PERIOD, self._publish_status, clock=self.diagnostics.steady_clock)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Wait for nodes that load their kernels for longer, and for those that compile them as long as they do."""
        for status in message.status:
            is_ours = status.hardware_id == HARDWARE_ID and not is_of_other_namespace(status, self)
            for value in status.values if is_ours else ():
                if value.key == KERNELS and value.value.startswith(LOADING):
                    self._started_at = time.monotonic()
                    if value.value.startswith(COMPILING):
                        self._compiling_at = self._started_at

    @property
    def _is_awaiting_kernels(self) -> bool:
        """Whether a node compiles its kernels."""
        return time.monotonic() - self._compiling_at < _COMPILING_MEMORY

    def _open_log(self) -> Log:
        descriptor = ParameterDescriptor(description="The log to replay, or sim:WORLD.", read_only=True)
        path = str(self.declare_parameter("log", "", descriptor).value)
        if not path:
            raise HmtSlamError("no log is given: set the parameter log, such as -p log:=data/malaga_one_loop")
        if self._settings.drive == "commands":
            self._driven_robot = DrivenRobotSource(self, path, self._settings)
            return self._driven_robot
        return open_configured(Path(path), self.configuration)

    def on_configuration_changed(self, configuration: Configuration) -> None:
        """Apply another rate or flow control."""
        super().on_configuration_changed(configuration)
        self._settings = self._player.settings = configuration.robot

    def spin(self) -> None:
        """Replay the log; then stay for late subscribers until the node is to end."""
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
        """Send what is due, unless an earlier system runs; return the time until the next step, s.

        :raises HmtSlamError: where that does not end, or the subscribers do not come.
        """
        if self._precedence.check():
            self._precedence.check_patience()
            self._started_at = self._last_progress = time.monotonic()
            return _LONGEST_WAIT
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
        """Whether a subscriber of the scans publishes estimates, as a recorder or RViz does not.

        A robot with the name of a system waits for slam of that system, beside which there may be another one.
        """
        if self.system.name and not self._precedence.knows_coordinator:
            return False
        subscribers, publishers = (
            {(endpoint.node_namespace, endpoint.node_name) for endpoint in endpoints}
            for endpoints in (
                self.get_subscriptions_info_by_topic(SCAN),
                self.get_publishers_info_by_topic(_ESTIMATES),
            )
        )
        return bool(subscribers & publishers)

    def _await_subscribers(self) -> None:
        """Start to play when all subscribers are there that need the first scan.

        :raises HmtSlamError: where they do not come in time.
        """
        settings = self._settings
        missing = [
            topic
            for publisher, topic, count in (
                (self._scans, SCAN, settings.scan_listeners),
                (self._readings, ODOM, settings.odometry_listeners),
            )
            if publisher.get_subscription_count() < count
        ]
        if settings.flow_control and settings.scan_listeners and not missing and not self._is_answered:
            missing = [SCAN]
        if not missing and not self._is_awaiting_kernels and not self._precedence.is_unsure:
            self._state, self._last_progress = "playing", time.monotonic()
            if self._driven_robot is None:
                sentence = f"replaying {self._log.name}: {self._log.scan_count} scans"
            else:
                sentence = f"driving through {self._log.name} by cmd_vel"
            self.get_logger().info(sentence)
            return
        if missing and time.monotonic() - self._started_at > settings.discovery_timeout:
            name = "scan" if missing[0] == SCAN else "odometry"
            raise HmtSlamError(
                f"too few subscribers of {' and '.join(missing)} after {settings.discovery_timeout:g} s: start the "
                f"slam and rtl nodes, or set robot.{name}_listeners to 0"
            )

    def _send(self, measurement: Measurement) -> None:
        self._last_progress = time.monotonic()
        self._clock_times.publish(ClockMessage(clock=conversions.time_message(measurement.stamp)))
        if isinstance(measurement, Scan):
            frame = self._announced_laser_frame(measurement)
            publish_reliably(self._scans, conversions.scan_message(measurement, frame), self.context)
        elif isinstance(measurement, MarkObservation):
            self._send_mark(measurement)
        else:
            frames = self._odom_frame, self._base_frame
            self._send_transforms([conversions.transform_message(measurement.stamp, *frames, measurement.pose)])
            publish_reliably(self._readings, conversions.odometry_message(measurement, *frames), self.context)
        self.diagnostics.sent[type(measurement).__name__] += 1
        if self._driven_robot is not None:
            self._driven_robot.publish_ground_truth(measurement.stamp)
            self.diagnostics.values["contacts"] = self._driven_robot.contacts
        if self._player.has_ended:
            self._publish_status()
            self.get_logger().info(f"end of the log after {self._player.scans_sent} scans")

    def _send_mark(self, observation: MarkObservation) -> None:
        if self._marks is not None:
            message = conversions.pose_with_covariance_message(observation.stamp, observation.name, observation.pose)
            publish_reliably(self._marks, message, self.context)

    def _announced_laser_frame(self, scan: Scan) -> str:
        """The frame of a scan's laser; each new pose of a laser on the robot becomes a frame, which is published."""
        key = scan.laser_pose.tobytes()
        if key not in self._laser_frames:
            number = len(self._laser_frames)
            frame = f"{self._laser_frame}_{number}" if number else self._laser_frame
            self._laser_frames[key] = (frame, scan.laser_pose)
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
            # Slam drops the scans that were waiting.
            self._player.acknowledge(self._player.stamp)
        self._last_progress = time.monotonic()

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._player.is_paused = request.data
        response.success, response.message = True, "paused" if request.data else "playing"
        self._publish_status()
        return response

    def _publish_status(self) -> None:
        """Publish the status, and report where acknowledgements are missing."""
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
        self._statuses.publish(String(data=encode(status, system=self.system.name)))
        if self._is_awaiting_kernels:
            self._last_progress = time.monotonic()
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
