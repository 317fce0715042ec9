"""Node of the recorder: collects what a run says, for its output folder."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from rclpy.context import Context
from std_msgs.msg import Float64MultiArray, String

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.kernel_loading import COMPILING
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.documents import RobotStatus
from hmt_slam_ros.messages.gate import decode_of_team
from hmt_slam_ros.messages.messages import AreaEvents, Message
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS
from hmt_slam_ros.messages.system_name import SystemName
from hmt_slam_ros.messages.team import TeamPlacement
from hmt_slam_ros.process_table import RECORDER, producer
from hmt_slam_ros.results.recorder import Recorder
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import costs_from_message, stamp_from_time
from hmt_slam_ros.ros.diagnostics import KERNELS, SYSTEM, NodeDiagnostics, is_of_other_namespace
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.message_io import Inbox, subscribe_document
from hmt_slam_ros.ros.topics import COST, DIAGNOSTICS, DOCUMENTS


class RecorderNode(GuardedNode):
    """Node of the recorder, in the process that started the other nodes.

    :ivar recorder: the recorder.
    :ivar message_count: number of messages received, as a sign of progress.
    :ivar robot_status: the last status of the robot, None before the first.
    :ivar diagnostics_stamps: {node: stamp of its last diagnostics, ns}.
    :ivar fault: sentence of a node about a fault that the run does not survive, None without.
    """

    def __init__(self, configuration: Configuration, context: Context, system: str, namespace: str = "") -> None:
        super().__init__(RECORDER.name, context=context, namespace=namespace)
        self.recorder = Recorder(configuration)
        self.message_count = 0
        self.robot_status: RobotStatus | None = None
        self.diagnostics_stamps: dict[str, int] = {}
        self.fault: str | None = None
        self._costs: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
        self.area_event_count = 0
        self.diagnostics = NodeDiagnostics(self, SystemName(system))
        self._inbox = Inbox(
            self, (*SUBSCRIPTIONS[RECORDER.name], AreaEvents), self._on_message, self.diagnostics, topics.CHAIN
        )
        subscribe_document(self, RobotStatus, self._on_robot_status, topics.LATCHED)
        self.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, topics.STREAM)
        self.create_subscription(Float64MultiArray, COST, self._on_cost, topics.COST_HISTORY)

    def note_placements(self, robot: str, on_placement: Callable[[TeamPlacement], None]) -> None:
        """Call ``on_placement`` with each answer of a robot for itself and another one."""

        def on_document(message: String) -> None:
            placement = decode_of_team(message.data, TeamPlacement)
            if placement.robot == robot:
                on_placement(placement)

        self.create_subscription(String, DOCUMENTS[TeamPlacement], on_document, topics.TEAM_HISTORY)

    @property
    def is_complete(self) -> bool:
        """Whether all messages of the run have come."""
        counts = self._inbox.final_counts
        return (
            counts is not None
            and self.recorder.is_complete
            and len(self.recorder.keyframes) >= counts.keyframes
            and len(self.recorder.scan_poses) >= counts.scan_poses
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
        """Computing time of every process for each scan, {process: shape (n,), s}.

        :param stamps: of all scans, shape (n,), ns, increasing.
        """
        seconds = {}
        for name, batches in sorted(self._costs.items()):
            rows = np.concatenate(batches)
            cost_stamps = rows[:, 0].astype(np.int64) * NANOSECONDS + rows[:, 1].astype(np.int64)
            scans = np.clip(np.searchsorted(stamps, cost_stamps, side="left"), 0, stamps.size - 1)
            seconds[name] = np.bincount(scans, rows[:, 2], minlength=stamps.size).astype(np.float64)
        return seconds

    def _on_message(self, message: Message) -> None:
        self.message_count += 1
        self.area_event_count += isinstance(message, AreaEvents)
        self.recorder.handle(message)

    def _on_robot_status(self, status: RobotStatus) -> None:
        if self.robot_status is None or status.scans > self.robot_status.scans:
            self.message_count += 1
        self.robot_status = status

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = KeyValue(key=SYSTEM, value=self.diagnostics.system.name)
        for status in message.status:
            if own not in status.values or is_of_other_namespace(status, self):
                continue
            name = status.name.rsplit("/", 1)[-1]
            self.diagnostics_stamps[name] = stamp_from_time(message.header.stamp)
            # Compilation may take longer than a run may stand still.
            self.message_count += any(v.key == KERNELS and v.value.startswith(COMPILING) for v in status.values)
            if status.level == DiagnosticStatus.ERROR and self.fault is None:
                self.fault = f"{name}: {status.message}"

    def _on_cost(self, message: Float64MultiArray) -> None:
        name, rows = costs_from_message(message, self.diagnostics.system.admit)
        self._costs[name].append(rows)
