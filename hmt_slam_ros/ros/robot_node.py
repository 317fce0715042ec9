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
from hmt_slam_ros.messages.messages import Arriving, LocalEstimate, Message
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import Figures
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.outbox import publish_surely
from hmt_slam_ros.ros.parameters import ConfiguredNode, declare_frame
from hmt_slam_ros.ros.player import Player
from hmt_slam_ros.ros.topics import CLOCK, DOCUMENTS, ODOM, ROBOT_STATUS, SCAN
from hmt_slam_ros.ros.transforms import transform_publisher
from hmt_slam_ros.sensors import Odometry, Scan

if TYPE_CHECKING:
    from hmt_slam_ros.ros.driving import Driving

_ANSWERS = DOCUMENTS[LocalEstimate]
_CHANGEABLE = ("robot.rate", "robot.paced", "robot.window")
_STATUS_PERIOD = 0.2  # s
_LONGEST_WAIT = 0.1  # s
_BURST = 20  # measurements between two looks at services and acknowledgements
_SILENCE = 10.0  # s without an acknowledgement before the robot complains

State = Literal["waiting", "playing", "paused", "ended"]


class RobotNode(ConfiguredNode):
    """The node ``robot``."""

    def __init__(self) -> None:
        super().__init__("robot", _CHANGEABLE)
        self._settings = self.configuration.robot
        self._odom, self._base = declare_frame(self, "odom", "odom"), declare_frame(self, "base", "base_link")
        self._laser = declare_frame(self, "laser", "laser")
        self.figures = Figures(self)
        self._driving: Driving | None = None
        self._log = self._open_log()
        self._player = Player(self._log, self._settings)
        self._state: State = "waiting"
        self._lasers: dict[bytes, tuple[str, NDArray[np.float64]]] = {}
        self._begin = self._last_progress = time.monotonic()
        self._scans = self.create_publisher(LaserScan, SCAN, topics.KEPT_SENSOR)
        self._readings = self.create_publisher(OdometryMessage, ODOM, topics.KEPT_SENSOR)
        self._clock_times = self.create_publisher(ClockMessage, CLOCK, topics.STREAM)
        self._statuses = self.create_publisher(String, ROBOT_STATUS, topics.LATCHED)
        self._send_transforms = transform_publisher(self, "tf")
        self._send_static_transforms = transform_publisher(self, "tf_static")
        # The past too: the first answers may come before the two nodes have found each other.
        self._inbox = Inbox(self, (LocalEstimate, Arriving), self._hear, self.figures, topics.CHAIN)
        self.create_service(SetBool, "~/pause", self._pause)
        self.create_timer(_STATUS_PERIOD, self._report, clock=self.figures.steady_clock)

    def _open_log(self) -> Log:
        descriptor = ParameterDescriptor(description="The log to replay, or sim:WORLD.", read_only=True)
        path = str(self.declare_parameter("log", "", descriptor).value)
        if not path:
            raise HmtSlamError("no log is given: set the parameter log, such as -p log:=data/malaga_one_loop")
        if self._settings.drive == "commands":
            # The kernels of the simulation are for those who simulate.
            from hmt_slam_ros.ros.driving import Driving  # noqa: PLC0415

            self._driving = Driving(self, path, self._settings)
            return self._driving
        log = open_log(Path(path), start=self._settings.start, duration=self._settings.duration or None)
        if not log.scan_count:
            raise HmtSlamError(f"{path} has no scans in the part asked for: check robot.start and robot.duration")
        return log

    def configuration_changed(self, configuration: Configuration) -> None:
        """Take note of another rate, window or pace."""
        super().configuration_changed(configuration)
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
            self._await_listeners()
            return _LONGEST_WAIT
        for _ in range(_BURST):
            now = time.monotonic()
            wait = self._player.wait(now)
            if wait is None or wait > 0.0:
                return _LONGEST_WAIT if wait is None else min(wait, _LONGEST_WAIT)
            self._send(self._player.take(now))
        return 0.0

    @property
    def _is_answered(self) -> bool:
        """Whether one of those who hear the scans answers them; a recorder or RViz does not."""
        hear, answer = self.get_subscriptions_info_by_topic(SCAN), self.get_publishers_info_by_topic(_ANSWERS)
        names = [{(end.node_namespace, end.node_name) for end in ends} for ends in (hear, answer)]
        return bool(names[0] & names[1])

    def _await_listeners(self) -> None:
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
        if settings.paced and settings.scan_listeners and not missing and not self._is_answered:
            missing = [SCAN]
        if not missing:
            self._state, self._last_progress = "playing", time.monotonic()
            told = f"replaying {self._log.name}: {self._log.scan_count} scans"
            self.get_logger().info(told if self._driving is None else f"driving through {self._log.name} by cmd_vel")
            return
        if time.monotonic() - self._begin > settings.patience:
            name = "scan" if missing[0] == SCAN else "odometry"
            raise HmtSlamError(
                f"too few subscribers of {' and '.join(missing)} after {settings.patience:g} s: start the slam and rtl "
                f"nodes, or set robot.{name}_listeners to 0"
            )

    def _send(self, measurement: Scan | Odometry) -> None:
        self._last_progress = time.monotonic()
        self._clock_times.publish(ClockMessage(clock=conversions.time_message(measurement.stamp)))
        if isinstance(measurement, Scan):
            publish_surely(self._scans, conversions.laser_scan(measurement, self._laser_frame(measurement)))
        else:
            joint = conversions.transform_message(measurement.stamp, self._odom, self._base, measurement.pose)
            self._send_transforms([joint])
            publish_surely(self._readings, conversions.odometry_message(measurement, self._odom, self._base))
        self.figures.sent[type(measurement).__name__] += 1
        if self._driving is not None:
            self._driving.tell_truth(measurement.stamp)
            self.figures.state["contacts"] = self._driving.contacts
        if self._player.ended:
            self._report()
            self.get_logger().info(f"end of the log after {self._player.scans} scans")

    def _laser_frame(self, scan: Scan) -> str:
        """The frame of a scan's laser; each pose of a laser on the robot is a frame, announced when it first occurs."""
        key = scan.laser_pose.tobytes()
        if key not in self._lasers:
            number = len(self._lasers)
            self._lasers[key] = (f"{self._laser}_{number}" if number else self._laser, scan.laser_pose)
            self._send_static_transforms(
                [
                    conversions.transform_message(scan.stamp, self._base, frame, pose)
                    for frame, pose in self._lasers.values()
                ]
            )
        return self._lasers[key][0]

    def _hear(self, message: Message) -> None:
        if isinstance(message, LocalEstimate):
            self._player.acknowledge(message.stamp)
        elif isinstance(message, Arriving):
            # Scans that waited are passed over.
            self._player.acknowledge(self._player.stamp)
        self._last_progress = time.monotonic()

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._player.paused = request.data
        response.success, response.message = True, "paused" if request.data else "playing"
        self._report()
        return response

    def _report(self) -> None:
        """Publish the status, and complain where the replay is held up."""
        player = self._player
        if self._state != "waiting":
            self._state = "ended" if player.ended else "paused" if player.paused else "playing"
        status = RobotStatus(
            self._state,
            self._log.name,
            player.stamp,
            player.scans,
            self._log.scan_count,
            player.odometry,
            player.acknowledged,
        )
        self._statuses.publish(String(data=encode(status)))
        if self._state == "playing" and player.held and time.monotonic() - self._last_progress > _SILENCE:
            self._last_progress = time.monotonic()
            self.figures.warn(
                f"the robot waits: slam has not answered the last {self._settings.window} scans; start the slam node, "
                "or set robot.paced to false to replay without it"
            )


def main() -> None:
    """Run the node."""
    sys.exit(run(RobotNode, RobotNode.play))


if __name__ == "__main__":
    main()
