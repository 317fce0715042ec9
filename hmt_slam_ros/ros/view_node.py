"""Node of the live page: collects what the other nodes publish, and serves it to browsers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool, Float64, String
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import ELLIPSE_95
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.documents import KeyframeHeader, RobotStatus, decode
from hmt_slam_ros.messages.messages import Hypotheses
from hmt_slam_ros.process_table import process_names, producer
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import area_from_frame, gaussian_from_message, pose_from_message, stamp_from_time
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.topics import (
    DIAGNOSTICS,
    DOCUMENTS,
    ENTROPY,
    GRAPH,
    HMT_POSE,
    IS_LOCALIZED,
    KEYFRAMES,
    MAP,
    POSE,
    ROBOT_STATUS,
)
from hmt_slam_ros.view.board import Board, KeyframeHistory
from hmt_slam_ros.view.health import SystemHealth
from hmt_slam_ros.view.server import LOCAL, PORT, PageServer, grid_png

_PERIOD = 0.2
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
_PUBLISHERS = {
    POSE: producer("RealTimePose"),
    HMT_POSE: producer("RealTimePose"),
    GRAPH: producer("ClosureDecision"),
    MAP: producer("ClosureDecision"),
    KEYFRAMES: producer("Keyframe"),
    DOCUMENTS[Hypotheses]: producer("Hypotheses"),
    IS_LOCALIZED: producer("Hypotheses"),
    ENTROPY: producer("Hypotheses"),
    DIAGNOSTICS: "every node",
}
"""{topic: its node} on the page."""


class ViewNode(Node):
    """The node ``view``."""

    def __init__(self, name: str) -> None:
        """Start the server.

        :raises HmtSlamError: for an invalid address or port.
        """
        super().__init__(name)
        self.diagnostics = NodeDiagnostics(self)
        self.board = Board()
        self._health, self._history = SystemHealth(process_names()), KeyframeHistory(self.board)
        self._message_times: dict[str, float] = {}
        self._message_count = 0
        # In s; it stands still with the computer, so that no topic seems silent after that.
        self._listening_time = 0.0
        self._map_subscription: Any = None
        self._server = PageServer(self.board, *self._declare_address())
        self.board.put("about", {"namespace": self.get_namespace()})
        self._subscribe(PoseWithCovarianceStamped, POSE, self._on_pose, topics.NEWEST)
        self._subscribe(PoseWithCovarianceStamped, HMT_POSE, self._on_hmt_pose, topics.NEWEST)
        self._subscribe(MarkerArray, GRAPH, self._on_graph, topics.LATCHED)
        self._subscribe(
            String, KEYFRAMES, lambda m: self._history.add(decode(m.data, KeyframeHeader)), topics.CHAIN_HISTORY
        )
        topic = DOCUMENTS[Hypotheses]
        self._subscribe(String, topic, lambda m: self._history.add(decode(m.data, Hypotheses)), topics.CHAIN_HISTORY)
        self._subscribe(Bool, IS_LOCALIZED, self._on_localized, topics.LATCHED)
        self._subscribe(Float64, ENTROPY, lambda m: self.board.put("entropy", round(m.data, 3)), topics.LATCHED)
        self._subscribe(String, ROBOT_STATUS, self._on_robot_status, topics.LATCHED)
        self._subscribe(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, topics.STREAM)
        self._publish_health()
        self.get_logger().info(f"the page is at {self._server.url}")

    def _declare_address(self) -> tuple[str, int]:
        """Declare ``address`` and ``port``, and return them.

        :raises HmtSlamError: for invalid ones.
        """
        try:
            address = self.declare_parameter("address", LOCAL, _ADDRESS).value
            port = self.declare_parameter("port", PORT, _PORT).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as fault:
            raise HmtSlamError(
                f"address or port of the page is none ({fault}): give such as -p address:={LOCAL} -p port:={PORT}"
            ) from fault
        return str(address), int(port)

    def _subscribe(self, kind: type, topic: str, callback: Callable[[Any], None], profile: QoSProfile) -> Any:  # noqa: ANN401
        """Subscribe, and count messages; return rclpy's subscription."""

        def counting_callback(message: object) -> None:
            self._message_count += 1
            self._message_times[topic] = self._listening_time
            self.diagnostics.received[topic] += 1
            try:
                callback(message)
            except HmtSlamError as fault:
                self.diagnostics.warn(f"{topic}: {fault}")

        return self.create_subscription(kind, topic, counting_callback, profile)

    def spin(self) -> None:
        """Update the page a few times a second until the node is to end."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        try:
            last = time.monotonic()
            while rclpy.ok():
                time.sleep(_PERIOD)
                now = time.monotonic()
                self._listening_time, last = self._listening_time + min(now - last, _LONGEST_STEP), now
                self._spin_pending(executor)
                self._history.publish_complete()
                self._publish_health()
                self._update_map_subscription()
        finally:
            executor.shutdown()

    def _spin_pending(self, executor: SingleThreadedExecutor) -> None:
        idle = 0
        for _ in range(_MAX_BATCH):
            before = self._message_count
            executor.spin_once(timeout_sec=0.0)
            idle = idle + 1 if self._message_count == before else 0
            if idle == _IDLE_TURNS:
                return

    def _update_map_subscription(self) -> None:
        """Subscribe to the map while a browser shows the page, since tlca renders it only for subscribers."""
        if self.board.is_watched and self._map_subscription is None:
            self._map_subscription = self._subscribe(OccupancyGrid, MAP, self._on_map, topics.LATCHED)
        elif not self.board.is_watched and self._map_subscription is not None:
            self.destroy_subscription(self._map_subscription)
            self._map_subscription = None

    def _publish_health(self) -> None:
        now = self._listening_time
        self.board.put("verdict", self._health.verdict(now))
        self.board.put("nodes", self._health.rows(now))
        times = self._message_times
        # In whole seconds, so that the page changes once a second.
        ages = {topic: int(now - times[topic]) if topic in times else None for topic in _PUBLISHERS}
        self.board.put("topics", [{"topic": t, "from": _PUBLISHERS[t], "age": age} for t, age in ages.items()])

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._health.last_pose_at = self._listening_time
        belief = gaussian_from_message(message.pose)
        ellipse, (x, y, theta) = belief.position_ellipse(), belief.mean.tolist()
        pose = {
            "time": round(stamp_from_time(message.header.stamp) / NANOSECONDS, 3),
            "pose": [round(x, 3), round(y, 3), round(theta, 4)],
            "ellipse": None if is_uninformative(belief) else [round(value, 4) for value in ellipse],
            "deviation": round(ellipse.semi_major / ELLIPSE_95, 3),
            "turn": round(math.degrees(math.sqrt(max(0.0, belief.covariance[2, 2]))), 2),
        }
        self.board.put("robot", pose)

    def _on_hmt_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.board.put("area", str(area_from_frame(message.header.frame_id)))

    def _on_graph(self, message: MarkerArray) -> None:
        groups: dict[str, dict[int, Marker]] = {}
        for marker in message.markers:
            groups.setdefault(marker.ns, {})[marker.id] = marker
        area_ellipses, arc_ellipses = groups.get("area_uncertainty", {}), groups.get("arc_uncertainty", {})
        areas = [
            {"area": number, "at": _xy(disc.pose.position), **_uncertainty(area_ellipses.get(number))}
            for number, disc in groups.get("areas", {}).items()
        ]
        arcs = [
            {
                "closure": group == "closures",
                "ends": [_xy(p) for p in line.points],
                **_uncertainty(arc_ellipses.get(number)),
            }
            for group in ("arcs", "closures")
            for number, line in groups.get(group, {}).items()
        ]
        self.board.put("graph", {"areas": areas, "arcs": arcs})

    def _on_localized(self, message: Bool) -> None:
        self._health.is_localized = message.data
        self.board.put("localized", message.data)

    def _on_robot_status(self, message: String) -> None:
        status = decode(message.data, RobotStatus)
        self._health.robot_state = status.state
        progress = {"state": status.state, "log": status.log, "done": status.acknowledged, "scans": status.scans_in_log}
        self.board.put("replay", progress)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.hardware_id == "hmt_slam_ros":
                values = {entry.key: entry.value for entry in status.values}
                name, level = status.name.rsplit("/", 1)[-1], int.from_bytes(status.level, "little")
                self._health.update(name, level, status.message, values, self._listening_time)

    def _on_map(self, message: OccupancyGrid) -> None:
        info = message.info
        cells = np.frombuffer(message.data, dtype=np.int8)
        if cells.size != info.height * info.width:
            raise HmtSlamError(f"a map of {info.width} x {info.height} cells has {cells.size}: look who publishes it")
        origin = pose_from_message(info.origin)
        tag = self.board.put_map_image(grid_png(cells.reshape(info.height, info.width)))
        size = [round(info.width * info.resolution, 3), round(info.height * info.resolution, 3)]
        self.board.put("map", {"tag": tag, "origin": origin[:2].tolist(), "size": size})

    def destroy_node(self) -> None:
        """Stop the server, and destroy the node."""
        self._server.close()
        super().destroy_node()


def _uncertainty(marker: Marker | None) -> dict[str, Any]:
    """Half axes and angle of an ellipse, and its text."""
    if marker is None:
        return {"ellipse": None, "text": "It is not known where this is in the map."}
    ellipse = [0.5 * marker.scale.x, 0.5 * marker.scale.y, float(pose_from_message(marker.pose)[2])]
    return {"ellipse": [round(v, 4) for v in ellipse], "text": marker.text}


def _xy(point: Any) -> list[float]:  # noqa: ANN401  a ROS point
    return [round(point.x, 3), round(point.y, 3)]
