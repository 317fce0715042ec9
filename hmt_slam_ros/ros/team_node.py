"""Node of a robot in a team: what it shares with the others, and the frame that ties its map to theirs."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Any, get_args

from geometry_msgs.msg import PoseWithCovarianceStamped
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import ResetRequest, encode
from hmt_slam_ros.messages.gate import check_belief, check_message, decode_of_team
from hmt_slam_ros.messages.messages import ClosureDecision, Message
from hmt_slam_ros.messages.team import (
    TeamMessage,
    TeamPlacement,
    TeamRendezvous,
    TeamRequest,
    TeamStatus,
    TeamUpdate,
)
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import gaussian_from_message, stamp_from_time, transform_message
from hmt_slam_ros.ros.initial_state import InitialState
from hmt_slam_ros.ros.message_io import subscribe_document
from hmt_slam_ros.ros.parameters import declare_frame, declare_robot_name
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.topics import DOCUMENTS, RENDEZVOUS, transform_publisher
from hmt_slam_ros.team.standing import StandingTimer

if TYPE_CHECKING:
    from hmt_slam_ros.team.team import Team

_PERIOD = 0.1
"""Time between two transforms, and two looks at the updates that wait, s."""
_STATUS_PERIOD = 5.0
"""Time between two statuses without a change, s: so long a robot waits for what was lost."""
_MAX_WAITING = 64
"""Updates that wait to be sent; more are requested again."""
_PROFILES: dict[type, QoSProfile] = {
    TeamStatus: topics.TEAM_HISTORY,
    TeamRequest: topics.STREAM,
    TeamUpdate: topics.STREAM,
    TeamPlacement: topics.TEAM_HISTORY,
    TeamRendezvous: topics.TEAM_HISTORY,
}
_BANDWIDTH = ParameterDescriptor(
    description="Most bytes a second, on average, of the map that is sent to other robots.",
    read_only=True,
    floating_point_range=[FloatingPointRange(from_value=1e3, to_value=1e9)],
)


class TeamNode(ProcessNode):
    """The node ``team``: nobody waits for it, and it waits for no other robot."""

    process: Team
    team_types = get_args(TeamMessage)

    def declare_own_parameters(self) -> None:
        """As any process node; also declare name, bandwidth and frames.

        :raises HmtSlamError: where the robot has no name.
        """
        super().declare_own_parameters()
        self._map_frame, self._team_frame = declare_frame(self, "map", "map"), declare_frame(self, "team", "team")
        self._bandwidth = float(self.declare_parameter("team_bandwidth", 100_000.0, _BANDWIDTH).value)
        self._robot = declare_robot_name(self)
        if not self._robot:
            raise HmtSlamError("the robot has no name in its team: start its nodes in a namespace, or set robot_name")

    def configure_node(self) -> None:
        """As any process node; also subscribe to the other robots.

        :raises HmtSlamError: as any process node.
        """
        super().configure_node()
        self._waiting: deque[tuple[TeamUpdate, String]] = deque()
        self._budget, self._budget_at = self._bandwidth, time.monotonic()
        self._standing, self._status_at = StandingTimer(), 0.0
        self._sent_bytes = 0
        self._team_publishers = {
            kind: self.create_publisher(String, DOCUMENTS[kind], profile) for kind, profile in _PROFILES.items()
        }
        for kind, profile in _PROFILES.items():
            self.outbox.set_writer(kind, self._enqueue if kind is TeamUpdate else self._publish_to_team)
            self.create_subscription(String, DOCUMENTS[kind], self._team_callback(kind), profile)
        self.create_subscription(PoseWithCovarianceStamped, RENDEZVOUS, self._on_rendezvous, topics.STREAM)
        self._send_transforms = transform_publisher(self, "tf")
        subscribe_document(self, ResetRequest, self._on_reset_request, topics.CHAIN)
        self.create_timer(_PERIOD, self._on_timer, clock=self.diagnostics.steady_clock)
        self._show_team()

    def make_process(self, initial_state: InitialState) -> Team:
        """The process with the map of an initial state; one that no checkpoint has is a new session.

        :raises HmtSlamError: for a map that is damaged.
        """
        from hmt_slam_ros.team.team import Team, TeamState  # noqa: PLC0415  takes time

        document = initial_state.map
        fresh = TeamState(self._robot, f"{time.time_ns()}")
        if document is not None:
            return Team(self.configuration, TeamState(self._robot, fresh.session, document.replica))
        return Team(self.configuration, initial_state.read_part(self._name, TeamState) or fresh)

    def deliver(self, message: Message) -> None:
        """As any process node; while keyframe events come, the robot does not stand."""
        if isinstance(message, ClosureDecision):
            self._standing.note_event(time.monotonic())
        super().deliver(message)

    def publish_views(self, message: Message, outputs: list[Message]) -> None:
        """Show on /diagnostics what has changed."""
        if isinstance(message, TeamMessage) or outputs:
            self._show_team()

    def _show_team(self) -> None:
        values, poses = self.diagnostics.values, self.process.map_poses
        values["robot"] = self._robot
        values["joined with"] = ", ".join(sorted(poses.keys() - {self._robot})) or "none"
        values |= {f"map of {name}": text for name, text in self.process.describe_others().items()}

    def _team_callback(self, kind: type[Any]) -> Any:  # noqa: ANN401  of rclpy
        """Callback of a topic of the team, on which this robot's own messages come, too."""

        def on_document(message: String) -> None:
            document = decode_of_team(message.data, kind)
            if document.robot != self._robot:
                self.diagnostics.received[kind.__name__] += 1
                self.deliver(document)
            elif kind is TeamStatus and document.session != self.process.session:
                raise HmtSlamError(
                    f"robot = {self._robot} is the name of another robot, too: give each a namespace or robot_name of "
                    "its own"
                )

        return on_document

    def _on_rendezvous(self, message: PoseWithCovarianceStamped) -> None:
        """Another robot is observed: the frame is its name, and the pose that of its base in this one's."""
        try:
            belief = gaussian_from_message(message.pose)
            check_belief(belief, "pose")
            stamp, other = stamp_from_time(message.header.stamp), message.header.frame_id
            rendezvous = TeamRendezvous(self._robot, stamp, other, stamp, belief)
            check_message(rendezvous)
        except HmtSlamError as fault:
            self.diagnostics.refuse(RENDEZVOUS, fault)
            return
        self.deliver(rendezvous)

    def _publish_to_team(self, message: TeamMessage) -> None:
        """Publish for all robots, whatever their systems; what a killed node did not send is requested again."""
        if self.is_recovering:
            return
        if isinstance(message, TeamStatus):
            self._status_at = time.monotonic()
        self._team_publishers[type(message)].publish(String(data=encode(message)))

    def _enqueue(self, update: TeamUpdate) -> None:
        """Let an update wait for its turn, unless it waits already."""
        key = (update.after, update.until)
        if self.is_recovering or len(self._waiting) == _MAX_WAITING:
            return
        if all((w.after, w.until) != key for w, _ in self._waiting):
            self._waiting.append((update, String(data=encode(update))))

    def _on_timer(self) -> None:
        now = time.monotonic()
        self._send_waiting(now)
        self._publish_transform()
        if not self.is_active:
            return
        if self._standing.is_due(now, is_searching=self.process.is_searching):
            self._standing.note_status(now)
            self.deliver(self.process.status)
        if now - self._status_at > _STATUS_PERIOD:
            self._publish_to_team(self.process.status)

    def _send_waiting(self, now: float) -> None:
        """Publish the updates that the bandwidth admits; one second of it may be saved."""
        self._budget = min(self._bandwidth, self._budget + self._bandwidth * (now - self._budget_at))
        self._budget_at = now
        while self._waiting and self._budget > 0.0:
            _, document = self._waiting.popleft()
            self._budget -= len(document.data)
            self._sent_bytes += len(document.data)
            self._team_publishers[TeamUpdate].publish(document)
            self.diagnostics.values["sent of the map"] = f"{self._sent_bytes / 1000:.0f} kB"

    def _publish_transform(self) -> None:
        """Publish ``team_frame -> map_frame`` while the map is joined with another one."""
        poses = self.process.map_poses
        if self.is_active and len(poses) > 1:
            stamp = stamp_from_time(self.get_clock().now().to_msg())
            transform = transform_message(stamp, self._team_frame, self._map_frame, poses[self._robot])
            self._send_transforms([transform])

    def _on_reset_request(self, request: ResetRequest) -> None:
        """Start again with the same map as the processes, as a new session."""
        if request.number <= self.reset_number:
            return
        try:
            self.reset(request.folder, request.number)
        except HmtSlamError as fault:
            self.diagnostics.fail(f"the map was exchanged, and team stands still until the next reset: {fault}")
            return
        self._waiting.clear()
        self.inbox.deliver_early()
