"""Detection of a second system by its diagnostics and by publishers, also where its messages have no name."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray

from hmt_slam_ros.messages.routing import message_types
from hmt_slam_ros.messages.system_name import REMEDY
from hmt_slam_ros.process_table import COORDINATOR, process_row
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.diagnostics import PERIOD, STARTED, SYSTEM, NodeDiagnostics
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS, KEYFRAMES, ODOM, POSE
from hmt_slam_ros.sensors import Odometry

_PATIENCE = 30.0
"""Time after which a second publisher is reported, s; DDS remembers those of a killed node for 20 s."""


class PublisherMonitor:
    """Checks that topics of a process have one publisher, and slam that no other node has its name."""

    def __init__(self, node: GuardedNode, diagnostics: NodeDiagnostics, process: str) -> None:
        """:param process: name of the process."""
        row = process_row(process)
        names = {"Keyframe": KEYFRAMES, "RealTimePose": POSE}
        names |= {kind.__name__: DOCUMENTS[kind] for kind in message_types(row.produces) if kind in DOCUMENTS}
        # The topics of a team have a publisher for each robot.
        self._topics = [topic for name, topic in names.items() if name in row.produces and not topic.startswith("/")]
        if Odometry.__name__ in row.consumes:
            self._topics.append(ODOM)
        self._node, self._diagnostics = node, diagnostics
        self._crowded_since: dict[str, float] = {}
        node.create_timer(PERIOD, self._check, clock=diagnostics.steady_clock)
        if process == COORDINATOR:
            node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, topics.STREAM)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Take note of a node of the same name that started at another time."""
        for status in message.status:
            if status.name != self._node.get_fully_qualified_name():
                continue
            values = {entry.key: entry.value for entry in status.values}
            if values.get(STARTED, self._diagnostics.started) != self._diagnostics.started:
                self._note_other(values.get(SYSTEM, ""))

    def _note_other(self, name: str) -> None:
        self._diagnostics.system.note_other(name)
        if self._diagnostics.is_new_cause(DIAGNOSTICS, name):
            self._diagnostics.warn(self._diagnostics.second_system_text)

    def _check(self) -> None:
        now, crowded = time.monotonic(), ""
        for topic in self._topics:
            count = self._node.count_publishers(topic)
            if count < 2:
                self._crowded_since.pop(topic, None)
            elif now - self._crowded_since.setdefault(topic, now) > _PATIENCE:
                crowded = crowded or f"{count} publishers of {topic}"
                if self._diagnostics.is_new_cause(topic, "publishers"):
                    self._diagnostics.warn(f"{topic} has {count} publishers, so a second system runs here: {REMEDY}")
        self._diagnostics.crowded_topic = crowded
