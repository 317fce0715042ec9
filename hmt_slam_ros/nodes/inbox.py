"""From what comes in on the topics to messages, in the order in which a process has to hear them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes import conversions, qos
from hmt_slam_ros.nodes.chain_order import CHAIN, ChainOrder
from hmt_slam_ros.nodes.figures import Figures
from hmt_slam_ros.nodes.sensor_subscription import SensorSubscription
from hmt_slam_ros.nodes.topics import DOCUMENTS, FINISHED, KEYFRAME_SCANS, KEYFRAMES, ODOM, TRAIL
from hmt_slam_ros.processes.documents import Closing, KeyframeHead, decode
from hmt_slam_ros.processes.messages import Finished, Keyframe, LocalEstimate, Message, Trail
from hmt_slam_ros.sensing import Odometry

Deliver = Callable[[Message], None]


class Inbox:
    """Subscriptions for the kinds of messages that a node hears.

    :ivar closing: slam's last word with its counts, None before it.
    """

    def __init__(
        self,
        node: Node,
        heard: Iterable[type],
        deliver: Deliver,
        figures: Figures,
        estimates: QoSProfile = qos.CHAIN_FROM_NOW,
        first: int = 0,
    ) -> None:
        """Subscribe.

        :param heard: kinds of messages; Scan and EndOfLog are left to the node.
        :param deliver: called for each message in its turn.
        :param estimates: profile for LocalEstimate, of which most nodes have no use for the past.
        :param first: keyframe event with which the chain begins.
        """
        self._heard = heard = tuple(heard)
        self._node, self._deliver, self._figures = node, deliver, figures
        self._order = ChainOrder(heard, first)
        self._estimates = estimates
        self._heads: deque[KeyframeHead] = deque()
        self._ranges: deque[tuple[int, Any]] = deque()
        self.closing: Closing | None = None
        for kind in heard:
            self._subscribe(kind)

    def begin_anew(self, first: int) -> None:
        """The chain begins once more, when all of it so far was heard.

        :param first: keyframe event with which it begins.
        """
        self._order = ChainOrder(self._heard, first)

    def _subscribe(self, kind: type) -> None:
        if kind is Keyframe:
            self._listen(LaserScan, KEYFRAME_SCANS, self._hear_ranges)
            self._listen(String, KEYFRAMES, self._hear_head)
        elif kind is Trail:
            self._listen(Path, TRAIL, lambda message: self._receive(conversions.trail_from(message)))
        elif kind is Finished:
            self._listen(String, FINISHED, self._hear_closing)
        elif kind is Odometry:
            SensorSubscription(
                self._node, OdometryMessage, ODOM, lambda message: self._receive(conversions.odometry_from(message))
            )
        elif kind in DOCUMENTS:
            profile = self._estimates if kind is LocalEstimate else qos.CHAIN
            self._listen(String, DOCUMENTS[kind], lambda message: self._receive(decode(message.data, kind)), profile)

    def _listen(self, kind: type, topic: str, hear: Callable[[Any], None], profile: QoSProfile = qos.CHAIN) -> None:
        def callback(message: object) -> None:
            try:
                hear(message)
            except HmtSlamError as error:
                self._figures.fail(f"{topic}: {error}")

        self._node.create_subscription(kind, topic, callback, profile)

    def _hear_head(self, message: String) -> None:
        self._heads.append(decode(message.data, KeyframeHead))
        self._pair()

    def _hear_ranges(self, message: LaserScan) -> None:
        self._ranges.append((conversions.keyframe_of(message.header.frame_id), conversions.ranges_of(message)))
        self._pair()

    def _pair(self) -> None:
        """Join heads and ranges of the same keyframe; one without its other half is a loss, which the order tells."""
        while self._heads and self._ranges:
            head, (sequence, ranges) = self._heads[0], self._ranges[0]
            if head.sequence <= sequence:
                self._heads.popleft()
            if sequence <= head.sequence:
                self._ranges.popleft()
            if head.sequence == sequence:
                self._receive(head.with_ranges(ranges))

    def _hear_closing(self, message: String) -> None:
        self.closing = decode(message.data, Closing)
        self._receive(self.closing.totals)

    def _receive(self, message: Message) -> None:
        self._figures.received[type(message).__name__] += 1
        if not isinstance(message, CHAIN):
            self._deliver(message)
            return
        for due in self._order.arrive(message):  # type: ignore[arg-type]
            self._deliver(due)
        self._figures.state["waiting for their turn"] = self._order.waiting
        self._figures.state["repeated"] = self._order.repeated
        if self._order.fault is not None:
            self._figures.fail(self._order.fault)
