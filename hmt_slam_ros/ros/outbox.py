"""From what a process says to what goes out on the topics."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import rclpy
from nav_msgs.msg import Path
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.messages.documents import FinalCounts, KeyframeHeader, encode
from hmt_slam_ros.messages.messages import EndOfRun, Keyframe, Message, ScanPoses
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.topics import DOCUMENTS, FINISHED, KEYFRAME_SCANS, KEYFRAMES, SCAN_POSES

RCLError = rclpy_implementation.RCLError

Writer = Callable[[Any], None]

_COUNTED = (Keyframe, ScanPoses)
# Beside the documents; for any other kind the node sets a writer of its own.
_PUBLISHED = (Keyframe, ScanPoses, EndOfRun)


class Outbox:
    """Publishers for the kinds of messages that a node says.

    :ivar sent: {kind of message: how many were published}, of those that slam's last word counts.
    :ivar reset_number: number of the request after which the node began anew, 0 before the first.
    """

    def __init__(self, node: Node, message_types: Iterable[type], reset_number: int = 0) -> None:
        """Make the publishers."""
        self._node = node
        self.reset_number = reset_number
        self.sent = dict.fromkeys((kind.__name__ for kind in _COUNTED), 0)
        self._writers: dict[type, Writer] = {
            kind: self._writer(kind) for kind in message_types if kind in _PUBLISHED or kind in DOCUMENTS
        }

    def set_writer(self, kind: type, writer: Writer) -> None:
        """Send messages of a kind by a writer of the node's own."""
        self._writers[kind] = writer

    def send(self, message: Message) -> None:
        """Publish a message."""
        self.resend(message)
        if isinstance(message, _COUNTED):
            self.sent[type(message).__name__] += 1

    def resend(self, message: Message) -> None:
        """Publish a message that was counted before."""
        self._writers[type(message)](message)

    def _writer(self, kind: type) -> Writer:
        if kind is Keyframe:
            return self._keyframe_writer()
        if kind is ScanPoses:
            paths = self._node.create_publisher(Path, SCAN_POSES, topics.CHAIN)
            return lambda trail: publish_reliably(paths, conversions.path_message(trail))
        if kind is EndOfRun:
            closings = self._node.create_publisher(String, FINISHED, topics.CHAIN)
            return lambda totals: publish_reliably(closings, String(data=encode(self._final_counts(totals))))
        documents = self._node.create_publisher(String, DOCUMENTS[kind], topics.CHAIN)
        return lambda message: publish_reliably(documents, String(data=encode(message, self.reset_number)))

    def _keyframe_writer(self) -> Writer:
        scans = self._node.create_publisher(LaserScan, KEYFRAME_SCANS, topics.CHAIN)
        heads = self._node.create_publisher(String, KEYFRAMES, topics.CHAIN)

        def write(keyframe: Keyframe) -> None:
            frame = conversions.keyframe_frame(keyframe.sequence, self.reset_number)
            publish_reliably(scans, conversions.scan_message(keyframe.scan, frame))
            publish_reliably(heads, String(data=encode(KeyframeHeader.from_keyframe(keyframe), self.reset_number)))

        return write

    def _final_counts(self, totals: EndOfRun) -> FinalCounts:
        keyframes, trails = (self.sent[kind.__name__] for kind in _COUNTED)
        return FinalCounts(totals, keyframes, trails)


def publish_reliably(publisher: Any, message: Any) -> None:  # noqa: ANN401  any ROS message
    """Publish; where a reader lags behind by a whole history, wait until it has caught up or is gone.

    :raises ExternalShutdownException: where the node is told to end meanwhile.
    """
    while True:
        try:
            publisher.publish(message)
        except RCLError:
            # DDS waits 0.1 s for room by itself.
            if not rclpy.ok():
                raise ExternalShutdownException from None
        else:
            return
