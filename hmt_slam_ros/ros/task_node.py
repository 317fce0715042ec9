"""What explorer and pilot share: they hear scans, poses and errands, drive the robot and say how errands end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.compilation import tell_of_compilation
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import BeginRequest, decode
from hmt_slam_ros.messages.messages import Message, RealTimePose
from hmt_slam_ros.messages.replica import GlobalPoses
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import Errand, Heading, Kind, Outcome, Steering, errand_of
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.execution import run, spin_until
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.initial_state import Beginning, declare_map
from hmt_slam_ros.ros.lifecycle import ManagedNode
from hmt_slam_ros.ros.parameters import declare_frame, declare_laser_pose
from hmt_slam_ros.ros.topics import BEGIN, COMMANDS, ERRANDS, GOALS, HMT_POSE, OUTCOMES, SCAN
from hmt_slam_ros.ros.transforms import LaserMounting

_NOTHING = PoseGaussian.exactly(np.zeros(3))
# Of so many scans a transform is missing before that is told.
_UNMOUNTED = 20


class ErrandNode(ManagedNode):
    """A node whose process drives the robot on errands.

    :ivar map_frame: name of the frame.
    :ivar areas: where in the map its areas are, from :meth:`set_up` on.
    """

    areas: GlobalPoses

    def __init__(self, name: str, kinds: Sequence[Kind], heard: Sequence[type]) -> None:
        """Declare the parameters.

        :param name: of the node.
        :param kinds: of errands.
        :param heard: of messages that it hears of the five processes and the robot, but for scans and poses.
        """
        self._name, self._kinds, self._heard = name, kinds, heard
        super().__init__(name)

    def declare(self) -> None:
        """Declare frames, the laser's pose and the map to begin with."""
        self.map_frame, self._base = declare_frame(self, "map", "map"), declare_frame(self, "base", "base_link")
        self._laser_pose = declare_laser_pose(self)
        self._start_from = declare_map(self)

    @property
    def drives(self) -> bool:
        """Whether it gives commands."""
        raise NotImplementedError

    def make(self, beginning: Beginning) -> Process:
        """The process that begins with a map or with nothing; :attr:`areas` are as they are then.

        :raises HmtSlamError: where it cannot.
        """
        raise NotImplementedError

    def set_up(self) -> None:
        """Make the process, and all that it hears and says.

        :raises HmtSlamError: for a map that cannot be.
        """
        self._begun, self._unmounted = 0, 0
        beginning = Beginning(self, self._start_from, carried=True)
        self._process = self.make(beginning)
        tell_of_compilation(self.get_logger().info)
        self._commands = self.create_publisher(Twist, COMMANDS, topics.STREAM) if self.drives else None
        self._outcomes = self.create_publisher(String, OUTCOMES[self._name], topics.LATCHED)
        self._goals = self.create_publisher(PoseStamped, GOALS, topics.STREAM)
        self._mounting = LaserMounting(self, self._base, self._laser_pose, _nothing, _nothing)
        self.create_subscription(PoseWithCovarianceStamped, HMT_POSE, self._hear_pose, topics.NEWEST)
        self.create_subscription(LaserScan, SCAN, self._hear_scan, topics.NEWEST)
        self.create_subscription(String, ERRANDS[self._name], self._hear_errand, topics.STREAM)
        self._inbox = Inbox(self, self._heard, self.receive, self.figures, first=beginning.events, begun=0)
        self.create_subscription(String, BEGIN, self._hear_begin, topics.CHAIN)
        self.create_timer(PERIOD, self._check_chain, clock=self.figures.steady_clock)

    def stand_still(self) -> None:
        """Let the robot stand."""
        if self._commands is not None:
            self._commands.publish(Twist())

    def receive(self, message: Message) -> None:
        """Take in what the inbox delivers."""
        self.hear(message)

    def hear(self, message: Message) -> None:
        """Let the process hear a message, and say what it answers."""
        said: list[Message] = []
        with self.figures.timed(message, said):
            said += self._process.handle(message)
        for answer in said:
            self.say(answer)

    def say(self, message: Message) -> None:
        """Publish what the process says; a goal as soon as its area has a place in the map."""
        if isinstance(message, Outcome):
            self._outcomes.publish(String(data=message.text))
            self.get_logger().info(message.text)
        elif isinstance(message, Steering) and self._commands is not None:
            command = Twist()
            command.linear.x, command.angular.z = message.speed, message.turn_rate
            self._commands.publish(command)
        elif isinstance(message, Heading):
            self._tell_goal(message)

    def _tell_goal(self, heading: Heading) -> None:
        area = self.areas.get(heading.area)
        if area is not None:
            goal = conversions.pose_message(se2.compose(area.mean, heading.goal))
            header = conversions.header(heading.stamp, self.map_frame)
            self._goals.publish(PoseStamped(header=header, pose=goal))

    def _hear_pose(self, message: PoseWithCovarianceStamped) -> None:
        try:
            area = conversions.area_of(message.header.frame_id)
        except HmtSlamError as fault:
            self.figures.warn(f"{HMT_POSE}: {fault}")
            return
        belief, stamp = conversions.belief_from(message.pose), conversions.stamp_of(message.header.stamp)
        self.hear(RealTimePose(stamp, area, _NOTHING, belief, _NOTHING, np.zeros(3), np.zeros((3, 3))))

    def _hear_scan(self, message: LaserScan) -> None:
        if not self.active:
            return
        self.figures.received["Scan"] += 1
        mounted = self._mounting.of(message.header.frame_id)
        if mounted is None:
            self._unmounted += 1
            if self._unmounted == _UNMOUNTED:
                self.figures.warn(self._mounting.complaint(message, self._unmounted))
            return
        self.hear(conversions.scan_from(message, mounted.laser_pose, mounted.side))

    def _hear_begin(self, message: String) -> None:
        """Begin anew with the map with which all others do; an errand ends with the map that it was in.

        :raises HmtSlamError: where the process cannot go on with that map.
        """
        request = decode(message.data, BeginRequest)
        if request.number <= self._begun:
            return
        self.hear(Errand("stop"))
        self.stand_still()
        try:
            beginning = Beginning(self, request.folder, carried=True)
            self._process = self.make(beginning)
        except HmtSlamError as fault:
            raise HmtSlamError(f"the map was exchanged, and {self._name} cannot go on: {fault}") from fault
        self._begun = request.number
        self._inbox.begin_anew(beginning.events, request.number)
        self._inbox.catch_up()

    def _check_chain(self) -> None:
        """Let the robot stand where the map lacks what others have said.

        :raises HmtSlamError: then, as the node will never have it again.
        """
        if self._inbox.fault is not None:
            self.stand_still()
            raise HmtSlamError(self._inbox.fault)

    def _hear_errand(self, message: String) -> None:
        try:
            errand = errand_of(message.data, self._kinds)
        except HmtSlamError as fault:
            self.figures.warn(str(fault))
        else:
            self.hear(errand)


def _nothing(*_told: object) -> None:
    """What the mounting tells is looked up when it is needed."""


def _spin(node: ErrandNode) -> None:
    node.begin()
    spin_until(node)


def run_errands(make: Callable[[], ErrandNode]) -> None:
    """Run such a node, and exit."""
    sys.exit(run(make, _spin))
