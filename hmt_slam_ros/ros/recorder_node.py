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
from hmt_slam_ros.messages.routing import HEARD_BY
from hmt_slam_ros.results.recorder import Recorder
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_of
from hmt_slam_ros.ros.diagnostics import Figures
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.topics import COST, DIAGNOSTICS, ROBOT_STATUS

_SECOND = 1_000_000_000


class RecorderNode(Node):
    """Feeds a recorder, and keeps what the nodes tell about themselves.

    :ivar recorder: what was said.
    :ivar messages: number of messages heard.
    :ivar status: the robot's last, None before it.
    :ivar told: {node: time of its last diagnostics, ns}.
    :ivar fault: what a node said of a run that cannot go on, None while all is well.
    """

    def __init__(self, configuration: Configuration, context: Context) -> None:
        super().__init__("recorder", context=context)
        self.recorder = Recorder(configuration)
        self.messages = 0
        self.status: RobotStatus | None = None
        self.told: dict[str, int] = {}
        self.fault: str | None = None
        self._costs: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
        self.area_events = 0
        self._figures = Figures(self)
        self._inbox = Inbox(self, (*HEARD_BY["recorder"], AreaEvents), self._hear, self._figures, topics.CHAIN)
        self.create_subscription(String, ROBOT_STATUS, self._hear_status, topics.LATCHED)
        self.create_subscription(DiagnosticArray, DIAGNOSTICS, self._hear_diagnostics, topics.STREAM)
        self.create_subscription(Float64MultiArray, COST, self._hear_cost, topics.CHAIN)

    @property
    def complete(self) -> bool:
        """Whether everything that slam said before its last word, and every answer to it, is here."""
        closing = self._inbox.closing
        return (
            closing is not None
            and self.recorder.complete
            and len(self.recorder.keyframes) >= closing.keyframes
            and len(self.recorder.trails) >= closing.trails
        )

    def stage(self) -> str:
        """The node from which the next message is due."""
        recorder = self.recorder
        if len(recorder.accepted) < len(recorder.hypotheses):
            return "tlca"
        if len(recorder.hypotheses) < self.area_events:
            return "tsbi"
        if self.area_events < len(recorder.keyframes):
            return "aam"
        if self.status is None or (self.status.state != "ended" and self.status.acknowledged >= self.status.scans):
            return "robot"
        return "slam"

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

    def _hear(self, message: Message) -> None:
        self.messages += 1
        self.area_events += isinstance(message, AreaEvents)
        self.recorder.handle(message)

    def _hear_status(self, message: String) -> None:
        status = decode(message.data, RobotStatus)
        if self.status is None or status.scans > self.status.scans:
            self.messages += 1
        self.status = status

    def _hear_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.rsplit("/", 1)[-1]
            self.told[name] = stamp_of(message.header.stamp)
            if status.level == DiagnosticStatus.ERROR and self.fault is None:
                self.fault = f"{name}: {status.message}"

    def _hear_cost(self, message: Float64MultiArray) -> None:
        rows = np.frombuffer(message.data, dtype=np.float64).reshape(-1, 3)
        self._costs[message.layout.dim[0].label].append(rows)
