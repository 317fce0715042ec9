"""Listens to a run of the nodes: the recorder's node, which lives in the process that started the others."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray, String

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.documents import RobotStatus, decode
from hmt_slam_ros.messages.messages import AreaEvents, Message
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS
from hmt_slam_ros.process_table import RECORDER, producer
from hmt_slam_ros.results.recorder import Recorder
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_from_time
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.topics import COST, DIAGNOSTICS, ROBOT_STATUS

_SECOND = 1_000_000_000


class RecorderNode(Node):
    """Feeds a recorder, and keeps what the nodes tell about themselves.

    :ivar recorder: what was said.
    :ivar message_count: number of messages heard.
    :ivar robot_status: the robot's last, None before it.
    :ivar diagnostics_stamps: {node: time of its last diagnostics, ns}.
    :ivar fault: what a node said of a run that cannot go on, None while all is well.
    """

    def __init__(self, configuration: Configuration, context: Context) -> None:
        super().__init__(RECORDER.name, context=context)
        self.recorder = Recorder(configuration)
        self.message_count = 0
        self.robot_status: RobotStatus | None = None
        self.diagnostics_stamps: dict[str, int] = {}
        self.fault: str | None = None
        self._costs: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
        self.area_event_count = 0
        self._diagnostics = NodeDiagnostics(self)
        self._inbox = Inbox(
            self, (*SUBSCRIPTIONS[RECORDER.name], AreaEvents), self._on_message, self._diagnostics, topics.CHAIN
        )
        self.create_subscription(String, ROBOT_STATUS, self._on_robot_status, topics.LATCHED)
        self.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, topics.STREAM)
        self.create_subscription(Float64MultiArray, COST, self._on_cost, topics.CHAIN)

    @property
    def is_complete(self) -> bool:
        """Whether everything that slam said before its last word, and every answer to it, is here."""
        closing = self._inbox.closing
        return (
            closing is not None
            and self.recorder.is_complete
            and len(self.recorder.keyframes) >= closing.keyframes
            and len(self.recorder.scan_poses) >= closing.scan_poses
        )

    def awaited_node(self) -> str:
        """The node from which the next message is due."""
        recorder = self.recorder
        if len(recorder.decisions) < len(recorder.hypotheses):
            return producer("ClosureDecision")
        if len(recorder.hypotheses) < self.area_event_count:
            return producer("Hypotheses")
        if self.area_event_count < len(recorder.keyframes):
            return producer("AreaEvents")
        if self.robot_status is None or (
            self.robot_status.state != "ended" and self.robot_status.acknowledged >= self.robot_status.scans
        ):
            return "robot"
        return producer("Keyframe")

    def seconds_per_scan(self, stamps: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
        """Seconds of computing of every process for each scan.

        :param stamps: shape (n,), of all scans, ns, increasing.
        :returns: {process: shape (n,)}.
        """
        seconds = {}
        for name, batches in sorted(self._costs.items()):
            rows = np.concatenate(batches)
            moments = rows[:, 0].astype(np.int64) * _SECOND + rows[:, 1].astype(np.int64)
            scan = np.clip(np.searchsorted(stamps, moments, side="left"), 0, stamps.size - 1)
            seconds[name] = np.bincount(scan, rows[:, 2], minlength=stamps.size).astype(np.float64)
        return seconds

    def _on_message(self, message: Message) -> None:
        self.message_count += 1
        self.area_event_count += isinstance(message, AreaEvents)
        self.recorder.handle(message)

    def _on_robot_status(self, message: String) -> None:
        status = decode(message.data, RobotStatus)
        if self.robot_status is None or status.scans > self.robot_status.scans:
            self.message_count += 1
        self.robot_status = status

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.rsplit("/", 1)[-1]
            self.diagnostics_stamps[name] = stamp_from_time(message.header.stamp)
            if status.level == DiagnosticStatus.ERROR and self.fault is None:
                self.fault = f"{name}: {status.message}"

    def _on_cost(self, message: Float64MultiArray) -> None:
        rows = np.frombuffer(message.data, dtype=np.float64).reshape(-1, 3)
        self._costs[message.layout.dim[0].label].append(rows)
