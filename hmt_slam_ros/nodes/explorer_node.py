"""The explorer as a node: drives the robot by cmd_vel, or has another program drive to goal_pose."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.compilation import tell_of_compilation
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.nodes import conversions, qos
from hmt_slam_ros.nodes.beginning import Beginning, declare_beginning
from hmt_slam_ros.nodes.inbox import Inbox
from hmt_slam_ros.nodes.managed_node import ManagedNode
from hmt_slam_ros.nodes.parameters import declare_frame, declare_laser_pose
from hmt_slam_ros.nodes.running import run
from hmt_slam_ros.nodes.topics import COMMANDS, ERRANDS, GOALS, HMT_POSE, OUTCOMES, SCAN
from hmt_slam_ros.nodes.transforms import LaserMounting
from hmt_slam_ros.processes.errands import Errand, Heading, Outcome, Steering, errand_of
from hmt_slam_ros.processes.global_poses import GlobalPoses
from hmt_slam_ros.processes.map_parts import AreaPose
from hmt_slam_ros.processes.messages import Accepted, Hypotheses, Keyframe, Message, RealTimePose
from hmt_slam_ros.processes.replica import FIRST_AREA, Replica

if TYPE_CHECKING:
    from hmt_slam_ros.exploration.explorer import Explorer

_AREA_FRAME = "area_"
_NOTHING = PoseGaussian.exactly(np.zeros(3))
# The map's frame is the first area's: known before TLCA has spoken.
_FIRST = AreaPose(FIRST_AREA, _NOTHING)


class ExplorerNode(ManagedNode):
    """The node ``explorer``."""

    def __init__(self) -> None:
        super().__init__("explorer")

    def declare(self) -> None:
        """Declare frames, the laser's pose and the map to begin with."""
        self._map, self._base = declare_frame(self, "map", "map"), declare_frame(self, "base", "base_link")
        self._laser_pose = declare_laser_pose(self)
        self._start_from, self._start_carried = declare_beginning(self)

    def set_up(self) -> None:
        """Make the explorer, and all that it hears and says.

        :raises HmtSlamError: for a map that cannot be.
        """
        from hmt_slam_ros.exploration.explorer import Explorer  # noqa: PLC0415  takes time

        beginning = Beginning(self, self._start_from, carried=self._start_carried)
        known = beginning.map
        self._areas = GlobalPoses((_FIRST,) if known is None else known.area_poses)
        replica = None if known is None else Replica.of(known.replica)
        self._explorer: Explorer = Explorer(self.configuration, replica)
        if self.configuration.explorer.explores:
            self._explorer.handle(Errand("explore"))
        tell_of_compilation(self.get_logger().info)
        self._commands = self.create_publisher(Twist, COMMANDS, qos.STREAM)
        self._goals = self.create_publisher(PoseStamped, GOALS, qos.STREAM)
        self._outcomes = self.create_publisher(String, OUTCOMES, qos.LATCHED)
        self._mounting = LaserMounting(self, self._base, self._laser_pose, _nothing, _nothing)
        self._inbox = Inbox(
            self, (Keyframe, Hypotheses, Accepted), self._hear, self.figures, first=beginning.events, begun=None
        )
        self.create_subscription(PoseWithCovarianceStamped, HMT_POSE, self._hear_pose, qos.NEWEST)
        self.create_subscription(LaserScan, SCAN, self._hear_scan, qos.NEWEST)
        self.create_subscription(String, ERRANDS, self._hear_errand, qos.STREAM)

    def stand_still(self) -> None:
        """Let the robot stand."""
        self._commands.publish(Twist())

    def _hear(self, message: Message) -> None:
        if isinstance(message, Accepted) and message.global_poses:
            self._areas = GlobalPoses(message.global_poses)
        self._explorer.handle(message)

    def _hear_pose(self, message: PoseWithCovarianceStamped) -> None:
        area = message.header.frame_id.removeprefix(_AREA_FRAME)
        belief, stamp = conversions.belief_from(message.pose), conversions.stamp_of(message.header.stamp)
        pose = RealTimePose(stamp, int(area), _NOTHING, belief, _NOTHING, np.zeros(3), np.zeros((3, 3)))
        self._explorer.handle(pose)

    def _hear_scan(self, message: LaserScan) -> None:
        mounted = self._mounting.of(message.header.frame_id)
        if not self.active or mounted is None:
            return
        scan = conversions.scan_from(message, mounted.laser_pose, mounted.side)
        said: list[Message] = []
        with self.figures.timed(scan, said):
            said += self._explorer.handle(scan)
        for answer in said:
            self._say(answer)

    def _hear_errand(self, message: String) -> None:
        try:
            self._explorer.handle(errand_of(message.data))
        except HmtSlamError as fault:
            self.figures.warn(str(fault))

    def _say(self, message: Message) -> None:
        if isinstance(message, Outcome):
            self._outcomes.publish(String(data=message.text))
            self.get_logger().info(message.text)
        elif isinstance(message, Heading):
            self._go(message)
        elif isinstance(message, Steering) and self.configuration.explorer.drive == "velocities":
            command = Twist()
            command.linear.x, command.angular.z = message.speed, message.turn_rate
            self._commands.publish(command)

    def _go(self, heading: Heading) -> None:
        """Tell the goal, as soon as its area has a place in the map."""
        area = self._areas.get(heading.area)
        if area is not None:
            goal = se2.compose(area.mean, heading.goal)
            header = conversions.header(heading.stamp, self._map)
            self._goals.publish(PoseStamped(header=header, pose=conversions.pose_message(goal)))


def _nothing(*_told: object) -> None:
    """What the mounting tells is looked up when it is needed."""


def _spin(node: ExplorerNode) -> None:
    node.begin()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok():
            executor.spin_once()
    finally:
        executor.shutdown()


def main() -> None:
    """Run the node."""
    sys.exit(run(ExplorerNode, _spin))


if __name__ == "__main__":
    main()
