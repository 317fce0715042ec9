"""The robot node's robot where it is driven: what comes on cmd_vel, and where it truly is."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist
from numpy.typing import NDArray
from rclpy.node import Node

from hmt_slam_ros.configuration.robot import RobotParameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.logs.writer import WORLD_FRAME
from hmt_slam_ros.open_log import is_simulated
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.topics import CMD_VEL, GROUND_TRUTH
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.driven_robot import DrivenLog, DrivenRobot
from hmt_slam_ros.simulation.scenario import START

_AGAIN = 10.0  # s, after which a fault is told again


class DrivenRobotSource:
    """A driven robot as a log for the player: each record is made right after the one before it was sent.

    So a command counts from the next odometry reading on, until `driven_robot.COMMAND_TIMEOUT` of simulated time later.
    """

    def __init__(self, node: Node, name: str, settings: RobotParameters) -> None:
        """Put the robot where the scripted drive is after ``robot.start``.

        :param name: ``sim:WORLD,...``.
        :raises HmtSlamError: for a log that is no simulated world, or a world that there is not.
        """
        if not is_simulated(name):
            raise HmtSlamError(f"{name} is no simulated world: give log:=sim:WORLD, or set robot.drive to log")
        simulated = open_simulated(name)
        start = simulated.true_poses(np.array([START + round(NANOSECONDS * settings.start)]))[0]
        self._robot = DrivenRobot(simulated.scenario, start)
        self._log = DrivenLog(simulated.name, self._robot, settings.duration)
        self.name, self.scan_count, self.duration = simulated.name, self._log.scan_count, self._log.duration
        self._true_poses: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._node = node
        self._ground_truth_publisher = node.create_publisher(PoseStamped, GROUND_TRUTH, topics.STREAM)
        node.create_subscription(Twist, CMD_VEL, self._on_command, topics.NEWEST)

    def records(self) -> Iterator[LogRecord]:
        """What the robot measures, for as long as somebody asks."""
        for record in self._log.records():
            if isinstance(record.measurement, Odometry):
                self._true_poses.append((record.measurement.stamp, self._robot.pose))
            yield record

    @property
    def contacts(self) -> int:
        """How often the robot came upon something."""
        return self._robot.contacts

    def publish_ground_truth(self, stamp: int) -> None:
        """Publish where the robot truly was at the odometry readings that are sent.

        :param stamp: of the last one, ns.
        """
        while self._true_poses and self._true_poses[0][0] <= stamp:
            when, pose = self._true_poses.popleft()
            header = conversions.header_message(when, WORLD_FRAME)
            self._ground_truth_publisher.publish(PoseStamped(header=header, pose=conversions.pose_message(pose)))

    def _on_command(self, command: Twist) -> None:
        speed, turn_rate = command.linear.x, command.angular.z
        if not (math.isfinite(speed) and math.isfinite(turn_rate)):
            self._node.get_logger().warning(
                f"cmd_vel has {speed:g} m/s and {turn_rate:g} rad/s, and the robot stops: send finite velocities",
                throttle_duration_sec=_AGAIN,
            )
            speed = turn_rate = 0.0
        self._robot.set_velocity(speed, turn_rate)
