"""The live page as a node: listens to what the others publish for people, and serves it to browsers."""

from __future__ import annotations

import math
import sys
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
from hmt_slam_ros.hybrid_map.shortest_path import tells_nothing
from hmt_slam_ros.messages.documents import KeyframeHead, RobotStatus, decode
from hmt_slam_ros.messages.messages import Hypotheses
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import area_of, belief_from, planar_pose, stamp_of
from hmt_slam_ros.ros.diagnostics import Figures
from hmt_slam_ros.ros.execution import run
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
from hmt_slam_ros.view.board import Board, History
from hmt_slam_ros.view.health import Health
from hmt_slam_ros.view.server import LOCAL, PORT, PageServer, grid_png

# Between two looks at what came; what came meanwhile and is older than the newest was never taken out of DDS.
_PERIOD = 0.2  # s
_LONGEST_STEP = 1.0  # s
_MOST_AT_ONCE = 2000  # messages
# What is ready may also be a timer or a service; after so many turns without a message there is none.
_IDLE_TURNS = 3
_SECOND = 1e9
_ADDRESS = ParameterDescriptor(
    description="IP address that the page listens on; 127.0.0.1 for this computer alone, 0.0.0.0 for all.",
    read_only=True,
)
_PORT = ParameterDescriptor(
    description="TCP port of the page; 0 for any that is free.",
    read_only=True,
    integer_range=[IntegerRange(from_value=0, to_value=65535)],
)
_EXPECTED = ("slam", "aam", "tsbi", "tlca", "rtl")
_WHO = {
    POSE: "rtl",
    HMT_POSE: "rtl",
    GRAPH: "tlca",
    MAP: "tlca",
    KEYFRAMES: "slam",
    DOCUMENTS[Hypotheses]: "tsbi",
    IS_LOCALIZED: "tsbi",
    ENTROPY: "tsbi",
    DIAGNOSTICS: "every node",
}


class ViewNode(Node):
    """The node ``view``."""

    def __init__(self) -> None:
        super().__init__("view")
        self.figures = Figures(self)
        self.board = Board()
        self._health, self._history = Health(_EXPECTED), History(self.board)
        self._heard: dict[str, float] = {}
        self._taken = 0
        # Seconds in which this node listened: where the computer stood still, nobody fell silent.
        self._now = 0.0
        self._grids: Any = None
        self._server = PageServer(self.board, *self._declared())
        self.board.put("about", {"namespace": self.get_namespace()})
        self._listen(PoseWithCovarianceStamped, POSE, self._hear_pose, topics.NEWEST)
        self._listen(PoseWithCovarianceStamped, HMT_POSE, self._hear_hmt_pose, topics.NEWEST)
        self._listen(MarkerArray, GRAPH, self._hear_graph, topics.LATCHED)
        self._listen(String, KEYFRAMES, lambda m: self._history.hear(decode(m.data, KeyframeHead)), topics.LOOK_BACK)
        topic = DOCUMENTS[Hypotheses]
        self._listen(String, topic, lambda m: self._history.hear(decode(m.data, Hypotheses)), topics.LOOK_BACK)
        self._listen(Bool, IS_LOCALIZED, self._hear_localized, topics.LATCHED)
        self._listen(Float64, ENTROPY, lambda m: self.board.put("entropy", round(m.data, 3)), topics.LATCHED)
        self._listen(String, ROBOT_STATUS, self._hear_status, topics.LATCHED)
        self._listen(DiagnosticArray, DIAGNOSTICS, self._hear_diagnostics, topics.STREAM)
        self._tell_health()
        self.get_logger().info(f"the page is at {self._server.url}")

    def _declared(self) -> tuple[str, int]:
        """Address and port from the node's parameters.

        :raises HmtSlamError: where they are something else.
        """
        try:
            address = self.declare_parameter("address", LOCAL, _ADDRESS).value
            port = self.declare_parameter("port", PORT, _PORT).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as fault:
            raise HmtSlamError(
                f"address or port of the page is none ({fault}): give such as -p address:={LOCAL} -p port:={PORT}"
            ) from fault
        return str(address), int(port)

    def _listen(self, kind: type, topic: str, hear: Callable[[Any], None], profile: QoSProfile) -> Any:  # noqa: ANN401
        """Subscribe; return rclpy's subscription."""

        def callback(message: object) -> None:
            self._taken += 1
            self._heard[topic] = self._now
            self.figures.received[topic] += 1
            try:
                hear(message)
            except HmtSlamError as fault:
                self.figures.warn(f"{topic}: {fault}")

        return self.create_subscription(kind, topic, callback, profile)

    def look(self) -> None:
        """Spin until the node is told to end, a few times a second."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        try:
            last = time.monotonic()
            while rclpy.ok():
                time.sleep(_PERIOD)
                now = time.monotonic()
                self._now, last = self._now + min(now - last, _LONGEST_STEP), now
                self._take_all(executor)
                self._history.tell()
                self._tell_health()
                self._follow_map()
        finally:
            executor.shutdown()

    def _take_all(self, executor: SingleThreadedExecutor) -> None:
        idle = 0
        for _ in range(_MOST_AT_ONCE):
            before = self._taken
            executor.spin_once(timeout_sec=0.0)
            idle = idle + 1 if self._taken == before else 0
            if idle == _IDLE_TURNS:
                return

    def _follow_map(self) -> None:
        """Ask for the map while somebody looks at the page, since tlca draws it only for those who ask."""
        if self.board.watched and self._grids is None:
            self._grids = self._listen(OccupancyGrid, MAP, self._hear_map, topics.LATCHED)
        elif not self.board.watched and self._grids is not None:
            self.destroy_subscription(self._grids)
            self._grids = None

    def _tell_health(self) -> None:
        now = self._now
        self.board.put("verdict", self._health.verdict(now))
        self.board.put("nodes", self._health.rows(now))
        # Whole seconds, so that a page is not told anew five times a second.
        ages = {topic: int(now - self._heard[topic]) if topic in self._heard else None for topic in _WHO}
        self.board.put("topics", [{"topic": t, "from": _WHO[t], "age": age} for t, age in ages.items()])

    def _hear_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._health.pose_heard = self._now
        belief = belief_from(message.pose)
        ellipse, (x, y, theta) = belief.ellipse(), belief.mean.tolist()
        pose = {
            "time": round(stamp_of(message.header.stamp) / _SECOND, 3),
            "pose": [round(x, 3), round(y, 3), round(theta, 4)],
            "ellipse": None if tells_nothing(belief) else [round(value, 4) for value in ellipse],
            "deviation": round(ellipse.longer / ELLIPSE_95, 3),
            "turn": round(math.degrees(math.sqrt(max(0.0, belief.covariance[2, 2]))), 2),
        }
        self.board.put("robot", pose)

    def _hear_hmt_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.board.put("area", str(area_of(message.header.frame_id)))

    def _hear_graph(self, message: MarkerArray) -> None:
        groups: dict[str, dict[int, Marker]] = {}
        for marker in message.markers:
            groups.setdefault(marker.ns, {})[marker.id] = marker
        around, between = groups.get("area_uncertainty", {}), groups.get("arc_uncertainty", {})
        areas = [
            {"area": number, "at": _xy(disc.pose.position), **_uncertainty(around.get(number))}
            for number, disc in groups.get("areas", {}).items()
        ]
        arcs = [
            {"closure": group == "closures", "ends": [_xy(p) for p in line.points], **_uncertainty(between.get(number))}
            for group in ("arcs", "closures")
            for number, line in groups.get(group, {}).items()
        ]
        self.board.put("graph", {"areas": areas, "arcs": arcs})

    def _hear_localized(self, message: Bool) -> None:
        self._health.localized = message.data
        self.board.put("localized", message.data)

    def _hear_status(self, message: String) -> None:
        status = decode(message.data, RobotStatus)
        self._health.robot_state = status.state
        told = {"state": status.state, "log": status.log, "done": status.acknowledged, "scans": status.scans_in_log}
        self.board.put("replay", told)

    def _hear_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.hardware_id == "hmt_slam_ros":
                values = {entry.key: entry.value for entry in status.values}
                name, level = status.name.rsplit("/", 1)[-1], int.from_bytes(status.level, "little")
                self._health.hear(name, level, status.message, values, self._now)

    def _hear_map(self, message: OccupancyGrid) -> None:
        info = message.info
        cells = np.frombuffer(message.data, dtype=np.int8)
        if cells.size != info.height * info.width:
            raise HmtSlamError(f"a map of {info.width} x {info.height} cells has {cells.size}: look who publishes it")
        origin = planar_pose(info.origin)
        tag = self.board.put_picture(grid_png(cells.reshape(info.height, info.width)))
        size = [round(info.width * info.resolution, 3), round(info.height * info.resolution, 3)]
        self.board.put("map", {"tag": tag, "origin": origin[:2].tolist(), "size": size})

    def destroy_node(self) -> None:
        """Close the page, then as any node."""
        self._server.close()
        super().destroy_node()


def _uncertainty(marker: Marker | None) -> dict[str, Any]:
    """Half axes and angle of an ellipse, and what it says."""
    if marker is None:
        return {"ellipse": None, "text": "It is not known where this is in the map."}
    ellipse = [0.5 * marker.scale.x, 0.5 * marker.scale.y, float(planar_pose(marker.pose)[2])]
    return {"ellipse": [round(v, 4) for v in ellipse], "text": marker.text}


def _xy(point: Any) -> list[float]:  # noqa: ANN401  a ROS point
    return [round(point.x, 3), round(point.y, 3)]


def main() -> None:
    """Run the node."""
    sys.exit(run(ViewNode, ViewNode.look))


if __name__ == "__main__":
    main()
