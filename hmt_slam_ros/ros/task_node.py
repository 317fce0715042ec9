"""What explorer and pilot share: they hear scans, poses and tasks, drive the robot and say how tasks end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.compilation import report_compilation
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import ResetRequest, decode
from hmt_slam_ros.messages.messages import Message, RealTimePose
from hmt_slam_ros.messages.replica import GlobalPoses
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import GoalPose, Task, TaskKind, TaskResult, VelocityCommand, parse_task
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.execution import run, spin_until
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.initial_state import InitialState, declare_start_from
from hmt_slam_ros.ros.lifecycle import ManagedNode
from hmt_slam_ros.ros.parameters import declare_frame, declare_laser_pose
from hmt_slam_ros.ros.topics import CMD_VEL, GOAL_POSE, HMT_POSE, RESET_REQUEST, SCAN, TASK_GOALS, TASK_RESULTS
from hmt_slam_ros.ros.transforms import LaserMountings

_UNKNOWN_POSE = PoseGaussian.from_pose(np.zeros(3))
# Of so many scans a transform is missing before that is told.
_MISSING_TRANSFORMS = 20


class TaskNode(ManagedNode):
    """A node whose process drives the robot on tasks.

    :ivar map_frame: name of the frame.
    :ivar area_poses: where in the map its areas are, from :meth:`configure_node` on.
    """

    area_poses: GlobalPoses

    def __init__(self, name: str, kinds: Sequence[TaskKind], message_types: Sequence[type]) -> None:
        """Declare the parameters.

        :param name: of the node.
        :param kinds: of tasks.
        :param message_types: of messages that it hears of the five processes and the robot, but for scans and poses.
        """
        self._name, self._task_kinds, self._message_types = name, kinds, message_types
        super().__init__(name)

    def declare_own_parameters(self) -> None:
        """Declare frames, the laser's pose and the map to begin with."""
        self.map_frame, self._base_frame = declare_frame(self, "map", "map"), declare_frame(self, "base", "base_link")
        self._laser_pose = declare_laser_pose(self)
        self._start_from = declare_start_from(self)

    @property
    def is_driver(self) -> bool:
        """Whether it gives commands."""
        raise NotImplementedError

    def make_process(self, beginning: InitialState) -> Process:
        """The process that begins with a map or with nothing; :attr:`area_poses` are as they are then.

        :raises HmtSlamError: where it cannot.
        """
        raise NotImplementedError

    def configure_node(self) -> None:
        """Make the process, and all that it hears and says.

        :raises HmtSlamError: for a map that cannot be.
        """
        self._reset_number, self._scans_without_mounting = 0, 0
        beginning = InitialState(self, self._start_from, lost=True)
        self._process = self.make_process(beginning)
        report_compilation(self.get_logger().info)
        self._commands = self.create_publisher(Twist, CMD_VEL, topics.STREAM) if self.is_driver else None
        self._result_publisher = self.create_publisher(String, TASK_RESULTS[self._name], topics.LATCHED)
        self._goals = self.create_publisher(PoseStamped, GOAL_POSE, topics.STREAM)
        self._mountings = LaserMountings(self, self._base_frame, self._laser_pose, _ignore, _ignore)
        self.create_subscription(PoseWithCovarianceStamped, HMT_POSE, self._on_pose, topics.NEWEST)
        self.create_subscription(LaserScan, SCAN, self._on_scan, topics.NEWEST)
        self.create_subscription(String, TASK_GOALS[self._name], self._on_task, topics.STREAM)
        self._inbox = Inbox(
            self, self._message_types, self.on_message, self.diagnostics, first_event=beginning.events, reset_number=0
        )
        self.create_subscription(String, RESET_REQUEST, self._on_reset_request, topics.CHAIN)
        self.create_timer(PERIOD, self._check_chain, clock=self.diagnostics.steady_clock)

    def deactivate_node(self) -> None:
        """Let the robot stand."""
        if self._commands is not None:
            self._commands.publish(Twist())

    def on_message(self, message: Message) -> None:
        """Take in what the inbox delivers."""
        self.process_message(message)

    def process_message(self, message: Message) -> None:
        """Let the process hear a message, and say what it answers."""
        said: list[Message] = []
        with self.diagnostics.measure(message, said):
            said += self._process.handle(message)
        for answer in said:
            self.publish_output(answer)

    def publish_output(self, message: Message) -> None:
        """Publish what the process says; a goal as soon as its area has a place in the map."""
        if isinstance(message, TaskResult):
            self._result_publisher.publish(String(data=message.text))
            self.get_logger().info(message.text)
        elif isinstance(message, VelocityCommand) and self._commands is not None:
            command = Twist()
            command.linear.x, command.angular.z = message.speed, message.turn_rate
            self._commands.publish(command)
        elif isinstance(message, GoalPose):
            self._publish_goal(message)

    def _publish_goal(self, heading: GoalPose) -> None:
        area = self.area_poses.get(heading.area)
        if area is not None:
            goal = conversions.pose_message(se2.compose(area.mean, heading.pose))
            header = conversions.header_message(heading.stamp, self.map_frame)
            self._goals.publish(PoseStamped(header=header, pose=goal))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        try:
            area = conversions.area_from_frame(message.header.frame_id)
        except HmtSlamError as fault:
            self.diagnostics.warn(f"{HMT_POSE}: {fault}")
            return
        belief, stamp = (
            conversions.gaussian_from_message(message.pose),
            conversions.stamp_from_time(message.header.stamp),
        )
        self.process_message(
            RealTimePose(stamp, area, _UNKNOWN_POSE, belief, _UNKNOWN_POSE, np.zeros(3), np.zeros((3, 3)))
        )

    def _on_scan(self, message: LaserScan) -> None:
        if not self.is_active:
            return
        self.diagnostics.received["Scan"] += 1
        mounted = self._mountings.mounting_of(message.header.frame_id)
        if mounted is None:
            self._scans_without_mounting += 1
            if self._scans_without_mounting == _MISSING_TRANSFORMS:
                self.diagnostics.warn(self._mountings.missing_transform_text(message, self._scans_without_mounting))
            return
        self.process_message(conversions.scan_from_message(message, mounted.laser_pose, mounted.angle_sign))

    def _on_reset_request(self, message: String) -> None:
        """Begin anew with the map with which all others do; a task ends with the map that it was in.

        :raises HmtSlamError: where the process cannot go on with that map.
        """
        request = decode(message.data, ResetRequest)
        if request.number <= self._reset_number:
            return
        self.process_message(Task("stop"))
        self.deactivate_node()
        try:
            beginning = InitialState(self, request.folder, lost=True)
            self._process = self.make_process(beginning)
        except HmtSlamError as fault:
            raise HmtSlamError(f"the map was exchanged, and {self._name} cannot go on: {fault}") from fault
        self._reset_number = request.number
        self._inbox.reset(beginning.events, request.number)
        self._inbox.deliver_early()

    def _check_chain(self) -> None:
        """Let the robot stand where the map lacks what others have said.

        :raises HmtSlamError: then, as the node will never have it again.
        """
        if self._inbox.fault is not None:
            self.deactivate_node()
            raise HmtSlamError(self._inbox.fault)

    def _on_task(self, message: String) -> None:
        try:
            task = parse_task(message.data, self._task_kinds)
        except HmtSlamError as fault:
            self.diagnostics.warn(str(fault))
        else:
            self.process_message(task)


def _ignore(*_told: object) -> None:
    """What the mounting tells is looked up when it is needed."""


def _spin(node: TaskNode) -> None:
    node.enter_startup_states()
    spin_until(node)


def run_task_node(make: Callable[[], TaskNode]) -> None:
    """Run such a node, and exit."""
    sys.exit(run(make, _spin))
