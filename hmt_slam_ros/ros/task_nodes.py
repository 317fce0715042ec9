"""Nodes of the explorer and the pilot, which drive the robot on tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import Odometry as OdometryMessage
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.messages.documents import ResetRequest, encode
from hmt_slam_ros.messages.gate import check_belief, decode_of_team
from hmt_slam_ros.messages.map_changes import AreaPose, InitialPose
from hmt_slam_ros.messages.messages import ClosureDecision, Message, PoseReset, RealTimePose
from hmt_slam_ros.messages.replica import FIRST_AREA, GlobalPoses, Replica
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS
from hmt_slam_ros.messages.tasks import (
    EXPLORER_TASKS,
    PILOT_TASKS,
    GoalError,
    GoalPose,
    PlaceEstimate,
    Task,
    TaskError,
    TaskResult,
    VelocityCommand,
)
from hmt_slam_ros.messages.team import TeamGoal
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.execution import spin_until
from hmt_slam_ros.ros.initial_state import InitialState, declare_start_from
from hmt_slam_ros.ros.laser_mountings import LaserMountings
from hmt_slam_ros.ros.map_publisher import MapPublisher
from hmt_slam_ros.ros.message_io import Inbox, subscribe_document
from hmt_slam_ros.ros.odometry_frames import BASE_FRAME, OdometryFrames, declare_odometry_frame
from hmt_slam_ros.ros.parameters import declare_frame, declare_laser_poses, declare_robot_name
from hmt_slam_ros.ros.room_markers import RoomMarkers
from hmt_slam_ros.ros.task_interface import TaskHost, TaskInterface, TaskProcess
from hmt_slam_ros.ros.task_scans import TaskScans
from hmt_slam_ros.ros.topics import (
    CMD_VEL,
    DOCUMENTS,
    GOAL_POSE,
    HMT_POSE,
    INITIAL_POSE,
    ODOM,
    PLACE,
    ROOMS,
)
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.untrusted_input import shorten

if TYPE_CHECKING:
    from hmt_slam_ros.exploration.exploration_map import ExplorationMap

_UNKNOWN_POSE = PoseGaussian.from_pose(np.zeros(3))
_FIRST_AREA_POSE = AreaPose(FIRST_AREA, PoseGaussian.from_pose(np.zeros(3)))
"""Pose of the first area, whose frame is the map's; known before the first closure decision."""
_MAX_GAP_CHECKS = 2
"""Further checks, once a second, that find the same gap in the chain before the node ends."""
_ROOMS_PERIOD = 0.9
"""Least time between two messages of rooms, s; just below whole checks."""


class TaskNode(TaskHost):
    """A node whose process drives the robot on tasks.

    :ivar map_frame: name of the map's frame.
    :ivar area_poses: ``map_T_area`` of the areas, from :meth:`configure_node` on.
    :ivar tasks: how tasks are given and followed, from then on.
    """

    area_poses: GlobalPoses
    tasks: TaskInterface

    def __init__(self, name: str) -> None:
        """Declare the parameters."""
        self._name = name
        super().__init__(name)

    def declare_own_parameters(self) -> None:
        """Declare frames, the lasers' poses and ``start_from``."""
        self.map_frame, self._base_frame = declare_frame(self, "map", "map"), declare_odometry_frame(self, BASE_FRAME)
        self._laser_poses = declare_laser_poses(self, self.configuration.sensors.topics)
        self._start_from = declare_start_from(self)

    def spin(self) -> None:
        """Run until the node is to end."""
        self.enter_startup_states()
        spin_until(self)

    def make_process(self, initial_state: InitialState) -> TaskProcess:
        """The process in an initial state; also sets :attr:`area_poses`.

        :raises HmtSlamError: where it cannot start from that.
        """
        raise NotImplementedError

    def configure_node(self) -> None:
        """Make the process, publishers and subscriptions.

        :raises HmtSlamError: for a map that is damaged or does not match.
        """
        self._reset_number = 0
        self._last_gap: str | None = None
        self._gap_checks = 0
        initial_state = InitialState(self, self._start_from, lost=True)
        self._process = self.make_process(initial_state)
        self._robot_pose: RealTimePose | None = None
        self._commands = self.create_publisher(Twist, CMD_VEL, topics.STREAM) if self.is_driver else None
        self.tasks = TaskInterface(self, self._name, self._process)
        self._goals = self.create_publisher(PoseStamped, GOAL_POSE, topics.STREAM)
        frames = OdometryFrames(self.diagnostics, base_frame=self._base_frame)
        if Odometry not in SUBSCRIPTIONS[self._name]:
            self.create_subscription(OdometryMessage, ODOM, frames.note, topics.NEWEST)
        self.create_subscription(PoseWithCovarianceStamped, HMT_POSE, self._on_pose, topics.NEWEST)
        TaskScans(self, LaserMountings(self, self.diagnostics, frames, self._laser_poses), self._process_scan)
        self._inbox = Inbox(
            self,
            [kind for kind in SUBSCRIPTIONS[self._name] if kind is not TeamGoal],
            self.on_message,
            self.diagnostics,
            first_event=initial_state.events,
            reset_number=0,
            odometry_frames=frames,
        )
        subscribe_document(self, ResetRequest, self._on_reset_request, topics.CHAIN)
        self.create_timer(PERIOD, self._check_chain, clock=self.diagnostics.steady_clock)
        self._room_markers = RoomMarkers(self.map_frame)
        self._room_publisher = MapPublisher(self, MarkerArray, ROOMS[self._name], self._make_rooms, _ROOMS_PERIOD)
        self.create_timer(PERIOD, self._publish_rooms, clock=self.diagnostics.steady_clock)

    def deactivate_node(self) -> None:
        """Stop the robot, and end the drive to a pose."""
        self.tasks.end_navigation()
        self.stop_robot()

    def clean_up_node(self) -> None:
        """Also destroy the action server."""
        self.tasks.destroy()

    def destroy_node(self) -> None:
        """Destroy the node with its action server, which rclpy does not count to the node."""
        if self.is_configured:
            self.tasks.destroy()
        super().destroy_node()

    def stop_robot(self) -> None:
        """Publish a velocity of 0."""
        if self._commands is not None:
            self._commands.publish(Twist())

    def on_message(self, message: Message) -> None:
        """Handle a message of the inbox, and update the poses of the areas."""
        if isinstance(message, ClosureDecision) and message.global_poses:
            self.area_poses = GlobalPoses(message.global_poses)
        self.process_message(message)

    def process_message(self, message: Message) -> None:
        """Let the process handle a message, and publish its outputs."""
        outputs: list[Message] = []
        try:
            with self.diagnostics.measure(message, outputs):
                outputs += self._process.handle(message)
            for output in outputs:
                self.publish_output(output)
        except (ArithmeticError, LookupError, TypeError, ValueError) as fault:
            kind = type(message).__name__
            self.diagnostics.count_refused(f"{kind}, set aside")
            self.diagnostics.warn(
                f"{self._name} could not handle a {kind} ({shorten(repr(fault))}) and goes on without it: report the "
                "fault with the log"
            )
        self.tasks.follow(self._process)

    def publish_output(self, message: Message) -> None:
        """Publish an output of the process; a goal only where its area has a pose in the map."""
        if isinstance(message, TaskResult):
            self.tasks.publish_result(message)
        elif isinstance(message, VelocityCommand) and self._commands is not None:
            self.tasks.speed = message.speed
            command = Twist()
            command.linear.x, command.angular.z = message.speed, message.turn_rate
            self._commands.publish(command)
        elif isinstance(message, GoalPose) and (area := self.area_poses.get(message.area)) is not None:
            pose = conversions.pose_message(se2.compose(area.mean, message.pose))
            header = conversions.header_message(message.stamp, self.map_frame)
            self._goals.publish(PoseStamped(header=header, pose=pose))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        try:
            area = conversions.area_from_frame(message.header.frame_id)
            belief = conversions.gaussian_from_message(message.pose)
            check_belief(belief, "pose")
        except HmtSlamError as fault:
            self.diagnostics.refuse(HMT_POSE, fault)
            return
        stamp = conversions.stamp_from_time(message.header.stamp)
        self._robot_pose = RealTimePose(
            stamp, area, _UNKNOWN_POSE, belief, _UNKNOWN_POSE, np.zeros(3), np.zeros((3, 3))
        )
        self.process_message(self._robot_pose)

    def _process_scan(self, scan: Scan) -> None:
        self.tasks.stamp = scan.stamp
        self.process_message(scan)

    def _on_reset_request(self, request: ResetRequest) -> None:
        """Start again with the same map as the processes; a task ends with its map."""
        if request.number <= self._reset_number:
            return
        self.stop_robot()
        try:
            initial_state = InitialState(self, request.folder, lost=True)
            self._process = self.make_process(initial_state)
        except HmtSlamError as fault:
            self.process_message(Task("stop"))
            self.diagnostics.fail(f"the map was exchanged, and {self._name} stands still until the next reset: {fault}")
            return
        self.tasks.follow(self._process)
        self._reset_number = request.number
        self._inbox.reset(initial_state.events, request.number)
        self._inbox.deliver_early()
        self._room_markers.forget()
        self._room_publisher.invalidate()

    def _publish_rooms(self) -> None:
        if self.is_active:
            self._room_publisher.publish_if_due(self._process.exploration_map)

    def _make_rooms(self, exploration_map: ExplorationMap) -> MarkerArray | None:
        """The names of rooms where they are in the map; None where nothing changed."""
        known = {area: pose for area, pose in self.area_poses.items() if not is_uninformative(pose)}
        return self._room_markers.make(exploration_map.positions_in_map(known, self._process.named_rooms()))

    def _check_chain(self) -> None:
        """Stop the robot where messages of the chain were lost.

        :raises HmtSlamError: then, since the map stays incomplete.
        """
        fault = self._inbox.order.fault
        self._gap_checks = self._gap_checks + 1 if fault is not None and fault == self._last_gap else 0
        self._last_gap = fault
        if fault is not None and self._gap_checks == _MAX_GAP_CHECKS:
            self.deactivate_node()
            raise HmtSlamError(fault)

    def make_pose_task(self, message: PoseStamped) -> Task:
        """The task to drive to a pose in the frame of the map or of an area.

        :raises GoalError: where there is no such frame or pose.
        """
        try:
            pose = conversions.pose_from_message(message.pose)
        except HmtSlamError as fault:
            raise GoalError(f"the goal is no pose: {fault}", TaskError.TRANSFORM_ERROR) from fault
        pose = se2.compose(self._frame_pose(message.header.frame_id), pose)
        goal = self._process.exploration_map.anchor(self.area_poses, pose)
        return Task("navigate", f"to ({pose[0]:.2f}, {pose[1]:.2f})", goal)

    def _frame_pose(self, frame: str) -> Float64:
        """``map_T_frame`` (3,) of the map or of an area.

        :raises GoalError: for another frame.
        """
        if frame == self.map_frame:
            return np.zeros(3)
        try:
            return self.area_poses[conversions.area_from_frame(frame)].mean
        except (HmtSlamError, KeyError):
            sentence = f"the map has no frame '{shorten(frame)}': give the goal in {self.map_frame}"
            raise GoalError(sentence, TaskError.TRANSFORM_ERROR) from None

    def pose_in_map(self, stamp: int) -> PoseStamped:
        """The last pose of the robot in the map; before the first, the map's origin at a stamp, ns."""
        known = self._robot_pose
        area = None if known is None else self.area_poses.get(known.area)
        if known is None or area is None:
            return PoseStamped(header=conversions.header_message(stamp, self.map_frame))
        pose = conversions.pose_message(se2.compose(area.mean, known.pose_in_area.mean))
        return PoseStamped(header=conversions.header_message(known.stamp, self.map_frame), pose=pose)


class ExplorerNode(TaskNode):
    """The node ``explorer``: drives by cmd_vel, or publishes goal_pose for another program."""

    task_kinds = EXPLORER_TASKS

    @property
    def is_driver(self) -> bool:
        """Whether it publishes velocity commands."""
        return self.configuration.explorer.drive == "velocities"

    def declare_own_parameters(self) -> None:
        """As any task node; also declare the name in the team."""
        super().declare_own_parameters()
        self._robot = declare_robot_name(self)

    def configure_node(self) -> None:
        """As any task node; in a team, also exchange goals with the other explorers.

        :raises HmtSlamError: as any task node.
        """
        super().configure_node()
        self._team_goals = self.create_publisher(String, DOCUMENTS[TeamGoal], topics.TEAM_HISTORY)
        self.create_subscription(String, DOCUMENTS[TeamGoal], self._on_team_goal, topics.TEAM_HISTORY)

    def _on_team_goal(self, message: String) -> None:
        """Let the explorer know where another one drives; its own goals come here, too."""
        goal = decode_of_team(message.data, TeamGoal)
        if goal.robot != self._robot:
            self.process_message(goal)

    def publish_output(self, message: Message) -> None:
        """As any task node; a goal goes to the other explorers."""
        if isinstance(message, TeamGoal):
            self._team_goals.publish(String(data=encode(message)))
        else:
            super().publish_output(message)

    def make_process(self, initial_state: InitialState) -> TaskProcess:
        """The explorer of a map, or of an unknown building."""
        from hmt_slam_ros.exploration.explorer import Explorer  # noqa: PLC0415  takes time

        document = initial_state.map
        self.area_poses = GlobalPoses((_FIRST_AREA_POSE,) if document is None else document.area_poses)
        known = None if document is None else Replica.from_state(document.replica)
        explorer = Explorer(self.configuration, known, self._robot)
        if self.configuration.explorer.explores:
            explorer.handle(Task("explore"))
        return explorer


class PilotNode(TaskNode):
    """The node ``pilot``: localizes by the belief over places, resets slam at doors, and drives to rooms."""

    task_kinds = PILOT_TASKS

    @property
    def is_driver(self) -> bool:
        """Whether it publishes velocity commands."""
        return self.configuration.pilot.drives

    def configure_node(self) -> None:
        """As any task node; also publish place estimates and initial poses.

        :raises HmtSlamError: where there is no map, or one without places.
        """
        super().configure_node()
        self._estimates = self.create_publisher(String, PLACE, topics.LATCHED)
        self._initial_pose_publisher = self.create_publisher(PoseWithCovarianceStamped, INITIAL_POSE, topics.STREAM)

    def make_process(self, initial_state: InitialState) -> TaskProcess:
        """The pilot of a map.

        :raises HmtSlamError: where there is no map, or one without places.
        """
        from hmt_slam_ros.exploration.pilot import PilotProcess  # noqa: PLC0415  takes time

        document = initial_state.map
        if document is None:
            raise HmtSlamError("the pilot goes by the places of a map, and there is none: set start_from")
        self.area_poses = GlobalPoses(document.area_poses)
        pilot = PilotProcess(self.configuration, document.replica)
        rooms = ", ".join(f"{name} behind door {room.node}" for name, room in pilot.rooms.items())
        self.diagnostics.values["rooms"] = rooms or "none"
        self.get_logger().info(f"rooms to go to: {rooms or 'none'}")
        return pilot

    def on_message(self, message: Message) -> None:
        """Handle a message of the inbox; an inactive pilot ignores odometry."""
        if self.is_active or not isinstance(message, Odometry):
            super().on_message(message)

    def publish_output(self, message: Message) -> None:
        """Publish an output of the pilot; a pose reset as an initial pose in the map."""
        super().publish_output(message)
        if isinstance(message, PlaceEstimate):
            self._estimates.publish(String(data=encode(message, system=self.system.name)))
            self.diagnostics.values["place"] = f"{message.place or 'unknown'}, {message.probability:.3f}"
        elif isinstance(message, PoseReset) and message.initial_pose is not None:
            self._publish_initial_pose(message.initial_pose)

    def _publish_initial_pose(self, initial_pose: InitialPose) -> None:
        pose = se2.compose(self.area_poses[initial_pose.area].mean, initial_pose.pose.mean)
        belief = PoseGaussian(pose, initial_pose.pose.covariance)
        self._initial_pose_publisher.publish(
            conversions.pose_with_covariance_message(self.tasks.stamp, self.map_frame, belief)
        )
