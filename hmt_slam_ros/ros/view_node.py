"""Node of the live page: collects what the other nodes publish, and serves it to browsers."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool, Float64, String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import KeyframeHeader, RobotStatus
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.process_table import TEAM, process_names, producer
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.diagnostics import HARDWARE_ID, SYSTEM, NodeDiagnostics, is_of_other_namespace
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.map_layers import MapLayers
from hmt_slam_ros.ros.message_io import document_callback
from hmt_slam_ros.ros.parameters import declare_system
from hmt_slam_ros.ros.team_view import TeamView
from hmt_slam_ros.ros.topics import (
    DIAGNOSTICS,
    DOCUMENTS,
    ENTROPY,
    HMT_POSE,
    INCIDENTS,
    IS_LOCALIZED,
    KEYFRAMES,
    MAP,
    POSE,
)
from hmt_slam_ros.ros.view_controls import ViewControls
from hmt_slam_ros.ros.view_conversions import (
    area_section,
    finite,
    incident_message,
    map_cells,
    map_section,
    robot_section,
)
from hmt_slam_ros.untrusted_input import shorten
from hmt_slam_ros.view.board import Board, KeyframeHistory
from hmt_slam_ros.view.commands import Commands
from hmt_slam_ros.view.health import SystemHealth
from hmt_slam_ros.view.incidents import IncidentLog
from hmt_slam_ros.view.run_events import RunEvents
from hmt_slam_ros.view.server import LOCAL, PORT, PageServer, grid_png

PERIOD = 0.2
"""Time between two updates, s; DDS keeps only the newest message of a stream meanwhile."""
_LONGEST_STEP = 1.0
"""Most listening time that an update counts, s; more means that the computer stood still."""
_MAX_BATCH = 2000
"""Most messages of one update."""
_IDLE_TURNS = 3
"""Turns of the executor without a message, such as timers and services, after which an update ends."""
_ADDRESS = ParameterDescriptor(
    description="IP address that the page listens on; 127.0.0.1 for this computer alone, 0.0.0.0 for all.",
    read_only=True,
)
_PORT = ParameterDescriptor(
    description="TCP port of the page; 0 for any that is free.",
    read_only=True,
    integer_range=[IntegerRange(from_value=0, to_value=65535)],
)
_ALLOWED_HOSTS = ParameterDescriptor(
    description="Host names, separated by commas, under which the page is served, beside those of this computer.",
    read_only=True,
)
_CONTROLS = ParameterDescriptor(
    description="Whether the page has buttons and takes statements, from those who have its token.",
    read_only=True,
)
_PUBLISHERS = {
    POSE: producer("RealTimePose"),
    HMT_POSE: producer("RealTimePose"),
    DOCUMENTS[Topology]: producer("ClosureDecision"),
    MAP: producer("ClosureDecision"),
    KEYFRAMES: producer("Keyframe"),
    DOCUMENTS[Hypotheses]: producer("Hypotheses"),
    IS_LOCALIZED: producer("Hypotheses"),
    ENTROPY: producer("Hypotheses"),
    DIAGNOSTICS: "every node",
}
"""{topic: its node} on the page."""


class ViewNode(GuardedNode):
    """The node ``view``."""

    def __init__(self, name: str, **options: Any) -> None:  # noqa: ANN401  Node's own
        """Start the server.

        :raises HmtSlamError: for an invalid address or port.
        """
        super().__init__(name, **options)
        self.diagnostics = NodeDiagnostics(self, declare_system(self))
        self.board = Board()
        self._health, self._history = SystemHealth(process_names()), KeyframeHistory(self.board, self._begin_run)
        self._events = RunEvents()
        self._incidents = IncidentLog()
        self._incident_publisher = self.create_publisher(DiagnosticArray, INCIDENTS, topics.INCIDENT_HISTORY)
        self._message_times: dict[str, float] = {}
        self._message_count = 0
        # In s; it stands still with the computer, so that no topic seems silent after that.
        self._listening_time = 0.0
        self._map_subscription: Any = None
        commands = Commands(is_allowed=self._declare_controls())
        self._server = PageServer(self.board, *self._declare_address(), commands)
        self.board.put("about", {"namespace": self.get_namespace()})
        self._subscribe(PoseWithCovarianceStamped, POSE, self._on_pose, topics.NEWEST)
        self._subscribe(
            PoseWithCovarianceStamped, HMT_POSE, lambda m: self.board.put("area", area_section(m)), topics.NEWEST
        )
        for kind, callback in (
            (KeyframeHeader, self._on_keyframe),
            (Hypotheses, self._on_hypotheses),
            (ClosureDecision, self._events.add),
        ):
            on_document = document_callback(self.diagnostics, kind, callback)
            self._subscribe(String, DOCUMENTS[kind], on_document, topics.CHAIN_HISTORY)
        self._subscribe(Bool, IS_LOCALIZED, self._on_localized, topics.LATCHED)
        self._subscribe(
            Float64, ENTROPY, lambda m: self.board.put("entropy", round(finite(m.data, "entropy"), 3)), topics.LATCHED
        )
        on_status = document_callback(self.diagnostics, RobotStatus, self._on_robot_status, may_be_unnamed=True)
        self._subscribe(String, DOCUMENTS[RobotStatus], on_status, topics.LATCHED)
        self._subscribe(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, topics.STREAM)
        self._team = TeamView(self.board, self._subscribe, self.destroy_subscription)
        self._layers = MapLayers(self.board, self._subscribe, self.destroy_subscription, self.diagnostics)
        self._controls = ViewControls(self, self.board, commands, lambda: self._layers.sections.frame)
        self._publish_health(time.time())
        key = f"#token={commands.token}" if commands.token else ""
        self.get_logger().info(f"the page is at {self._server.url}{key}")

    def _declare_address(self) -> tuple[str, int, list[str]]:
        """Declare ``address``, ``port`` and ``allowed_hosts``, and return them.

        :raises HmtSlamError: for invalid ones.
        """
        try:
            address = self.declare_parameter("address", LOCAL, _ADDRESS).value
            port = self.declare_parameter("port", PORT, _PORT).value
            allowed_hosts = self.declare_parameter("allowed_hosts", "", _ALLOWED_HOSTS).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as fault:
            raise HmtSlamError(
                f"address or port of the page is none ({fault}): give such as -p address:={LOCAL} -p port:={PORT}"
            ) from fault
        return str(address), int(port), str(allowed_hosts).split(",")

    def _declare_controls(self) -> bool:
        """Declare ``controls``, and return it.

        :raises HmtSlamError: for an invalid value.
        """
        try:
            return bool(self.declare_parameter("controls", False, _CONTROLS).value)
        except InvalidParameterTypeException as fault:
            raise HmtSlamError(f"controls is true or false ({fault}): give -p controls:=true") from fault

    def _subscribe(self, kind: type, topic: str, callback: Callable[[Any], None], profile: QoSProfile) -> Any:  # noqa: ANN401
        """Subscribe, and count messages; return rclpy's subscription."""

        def counting_callback(message: object) -> None:
            self._message_count += 1
            self._message_times[topic] = self._listening_time
            self.diagnostics.received[topic] += 1
            callback(message)

        return self.create_subscription(kind, topic, counting_callback, profile)

    def spin(self) -> None:
        """Update the page a few times a second until the node is to end."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        try:
            last = time.monotonic()
            while rclpy.ok():
                time.sleep(PERIOD)
                now = time.monotonic()
                self._listening_time, last = self._listening_time + min(now - last, _LONGEST_STEP), now
                self._spin_pending(executor)
                self.update_page(time.time())
        finally:
            executor.shutdown()

    def update_page(self, time_of_day: float) -> None:
        """Show what came since the last update.

        :param time_of_day: s since the epoch.
        """
        self._history.publish_complete()
        self._update_layers()
        self._publish_health(time_of_day)
        self._update_map_subscription()
        self._team.update()

    def _spin_pending(self, executor: SingleThreadedExecutor) -> None:
        idle = 0
        for _ in range(_MAX_BATCH):
            before = self._message_count
            executor.spin_once(timeout_sec=0.0)
            idle = idle + 1 if self._message_count == before else 0
            if idle == _IDLE_TURNS:
                return

    def _update_layers(self) -> None:
        """Show the map as data with its layers and events, and execute commands."""
        self._layers.update(self._listening_time)
        self._controls.update()
        self.board.put("events", self._events.rows())

    def _update_map_subscription(self) -> None:
        """Subscribe to the map while a browser shows the page, since tlca renders it only for subscribers."""
        if self.board.is_watched and self._map_subscription is None:
            self._map_subscription = self._subscribe(OccupancyGrid, MAP, self._on_map, topics.LATCHED)
        elif not self.board.is_watched and self._map_subscription is not None:
            self.destroy_subscription(self._map_subscription)
            self._map_subscription = None

    def _publish_health(self, time_of_day: float) -> None:
        now = self._listening_time
        self._health.second_system = self.diagnostics.system.other
        self.board.put("verdict", self._health.verdict(now))
        self.board.put("nodes", self._health.rows(now))
        for incident in self._incidents.update(self._health.nodes, now, time_of_day):
            self.get_logger().info(f"{incident.node}: {incident.text}")
            self._events.add_incident(f"{incident.node}: {incident.text}")
            self._incident_publisher.publish(incident_message(incident, self.get_namespace()))
        self.board.put("incidents", self._incidents.rows())
        times = self._message_times
        # In whole seconds, so that the page changes once a second.
        ages = {topic: int(now - times[topic]) if topic in times else None for topic in _PUBLISHERS}
        self.board.put("topics", [{"topic": t, "from": _PUBLISHERS[t], "age": age} for t, age in ages.items()])

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.board.put("robot", robot_section(message))
        self._health.last_pose_at = self._listening_time

    def _on_keyframe(self, header: KeyframeHeader) -> None:
        self._history.add(header)
        self._layers.sections.add_keyframe(header)

    def _on_hypotheses(self, hypotheses: Hypotheses) -> None:
        self._history.add(hypotheses)
        self._events.add(hypotheses)

    def _begin_run(self) -> None:
        self._events.clear()
        self._layers.sections.clear()

    def _on_localized(self, message: Bool) -> None:
        self._health.is_localized = message.data
        self.board.put("localized", message.data)

    def _on_robot_status(self, status: RobotStatus) -> None:
        self._health.robot_state = status.state
        log = shorten(status.log)
        progress = {"state": status.state, "log": log, "done": status.acknowledged, "scans": status.scans_in_log}
        self.board.put("replay", progress)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.hardware_id == HARDWARE_ID and not is_of_other_namespace(status, self):
                values = {entry.key: entry.value for entry in status.values}
                if SYSTEM in values:  # a node that has received no document yet has none
                    self.diagnostics.system.admit(values[SYSTEM])
                name, level = status.name.rsplit("/", 1)[-1], int.from_bytes(status.level, "little")
                self._health.update(name, level, status.message, values, self._listening_time)
                if name == TEAM.name and "robot" in values:
                    self._team.note_name(values["robot"])

    def _on_map(self, message: OccupancyGrid) -> None:
        section, cells = map_section(message), map_cells(message)
        self.board.put("map", {"tag": self.board.put_map_image(grid_png(cells)), **section})

    def destroy_node(self) -> None:
        """Stop the server, and destroy the node."""
        self._server.close()
        super().destroy_node()
