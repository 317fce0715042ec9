"""The chain of a robot of a team, recorded in lock-step, and played to its node ``team`` over DDS."""

from __future__ import annotations

from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.documents import KeyframeHeader, encode
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.process_table import TEAM
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import keyframe_frame, scan_message
from hmt_slam_ros.ros.topics import DOCUMENTS, KEYFRAME_SCANS, KEYFRAMES


class _ChainRecorder:
    """Keeps the messages of the chain."""

    def __init__(self) -> None:
        self.messages: list[Message] = []

    def handle(self, message: Message) -> list[Message]:
        """Keep a message."""
        self.messages.append(message)
        return []


def record_chain(configuration: Configuration, world: str, lap: int) -> list[Message]:
    """What the process team of a robot receives that drives one of two laps.

    :param lap: 0 or 1.
    """
    recorder, half = _ChainRecorder(), 0.5 * open_log(world).duration
    run = LockStepRun(configuration, observers={TEAM.name: recorder})
    for record in run.unread_records(open_log(world, start=lap * half, duration=half)):
        run.process_record(record)
    return recorder.messages


class ChainPublisher:
    """Publishes the chain of a robot in its namespace."""

    def __init__(self, node: Node, robot: str) -> None:
        """:param robot: its name, also that of its system."""
        self._robot = robot
        types = {KEYFRAMES: String, KEYFRAME_SCANS: LaserScan}
        types |= {DOCUMENTS[kind]: String for kind in (Hypotheses, ClosureDecision)}
        self._publishers = {
            topic: node.create_publisher(kind, f"/{robot}/{topic}", topics.CHAIN_HISTORY)
            for topic, kind in types.items()
        }

    def publish(self, message: Message) -> None:
        """Publish a message of the chain."""
        if isinstance(message, Keyframe):
            frame = keyframe_frame(message.sequence, 0, self._robot)
            self._publishers[KEYFRAME_SCANS].publish(scan_message(message.scan, frame))
            self._publish_document(KEYFRAMES, KeyframeHeader.from_keyframe(message))
        else:
            self._publish_document(DOCUMENTS[type(message)], message)

    def _publish_document(self, topic: str, document: object) -> None:
        self._publishers[topic].publish(String(data=encode(document, system=self._robot)))
