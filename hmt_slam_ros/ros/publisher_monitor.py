"""Detection of a second system by its publishers, also where its messages have no name."""

from __future__ import annotations

import time

from hmt_slam_ros.messages.routing import message_types
from hmt_slam_ros.messages.system_name import REMEDY
from hmt_slam_ros.process_table import process_row
from hmt_slam_ros.ros.diagnostics import PERIOD, NodeDiagnostics
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.topics import DOCUMENTS, KEYFRAMES, ODOM, POSE
from hmt_slam_ros.sensors import Odometry

_PATIENCE = 30.0
"""Time after which a second publisher is reported, s; DDS remembers those of a killed node for 20 s."""


class PublisherMonitor:
    """Checks that topics of a process have one publisher."""

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
