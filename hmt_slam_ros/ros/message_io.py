"""Inbox and outbox of a node: messages of the processes on topics, in the order of the chain.

DDS keeps the order within a topic, not across topics: Keyframe(k+1) may overtake ClosureDecision(k). Every process gets
Keyframe(k), AreaEvents(k), Hypotheses(k), ClosureDecision(k), Keyframe(k+1), ... as far as it subscribes to them. So
the nodes take the same decisions as the lock-step run, and a late node catches up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import rclpy
from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import FinalCounts, KeyframeHeader, decode, decode_with_reset, encode
from hmt_slam_ros.messages.messages import (
    AreaEvents,
    ClosureDecision,
    EndOfRun,
    Hypotheses,
    Keyframe,
    LocalEstimate,
    Message,
    ScanPoses,
    TrackingReset,
)
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.sensor_input import SensorSubscription
from hmt_slam_ros.ros.topics import DOCUMENTS, FINISHED, KEYFRAME_SCANS, KEYFRAMES, ODOM, SCAN_POSES
from hmt_slam_ros.sensors import Odometry

ChainMessage = Keyframe | AreaEvents | Hypotheses | ClosureDecision

CHAIN: tuple[type, ...] = (Keyframe, AreaEvents, Hypotheses, ClosureDecision)
"""Messages of a keyframe event in their order."""

RCLError = rclpy_implementation.RCLError


class ChainOrder:
    """Puts the messages of the chain into order, and detects repetitions and gaps.

    :ivar repeated_count: number of repeated messages, which are dropped.
    :ivar fault: sentence about the first gap, None without.
    """

    def __init__(self, message_types: Iterable[type], first_event: int = 0) -> None:
        """Start with a keyframe event.

        :param message_types: of the process; those outside the chain are ignored.
        :param first_event: number of the first keyframe event.
        """
        message_types = tuple(message_types)
        self._kinds = tuple(kind for kind in CHAIN if kind in message_types)
        self._waiting: dict[type, deque[ChainMessage]] = {kind: deque() for kind in self._kinds}
        self._next_sequences = dict.fromkeys(self._kinds, first_event)
        self._delivered_count = first_event * len(self._kinds)
        self.repeated_count = 0
        self.fault: str | None = None

    @property
    def waiting_count(self) -> int:
        """Number of messages that wait for their turn."""
        return sum(len(queue) for queue in self._waiting.values())

    @property
    def events(self) -> int | None:
        """Number of complete keyframe events, None within one."""
        events, begun = divmod(self._delivered_count, len(self._kinds))
        return None if begun else events

    def push(self, message: ChainMessage) -> list[ChainMessage]:
        """Take a message; return those whose turn it is, in order."""
        kind, sequence = type(message), message.sequence
        if sequence < self._next_sequences[kind]:
            self.repeated_count += 1
            return []
        if sequence > self._next_sequences[kind] and self.fault is None:
            self.fault = (
                f"{kind.__name__} {self._next_sequences[kind]} never came, {sequence} did: the node started too late "
                "or lost messages, restart all nodes"
            )
        self._next_sequences[kind] = sequence + 1
        self._waiting[kind].append(message)
        return list(self._pop_due())

    def _pop_due(self) -> Iterable[ChainMessage]:
        while True:
            sequence, turn = divmod(self._delivered_count, len(self._kinds))
            queue = self._waiting[self._kinds[turn]]
            if not queue or queue[0].sequence != sequence:
                return
            self._delivered_count += 1
            yield queue.popleft()


_HELD = "kept until it is active"


class Inbox:
    """Subscriptions of a node to messages of the processes.

    :ivar order: order of the chain, with its complete events and its first gap.
    :ivar final_counts: the counts that slam sends at the end, None before.
    :ivar is_holding: whether messages are kept instead of delivered.
    """

    def __init__(
        self,
        node: Node,
        message_types: Iterable[type],
        deliver: Callable[[Message], None],
        diagnostics: NodeDiagnostics,
        estimate_profile: QoSProfile = topics.VOLATILE_CHAIN,
        first_event: int = 0,
        reset_number: int | None = None,
        resume_stamps: Mapping[str, int] | None = None,
    ) -> None:
        """Subscribe.

        :param message_types: of the node; only those of the chain, documents, ScanPoses, EndOfRun and Odometry count.
        :param deliver: called for each message in its turn.
        :param estimate_profile: profile for LocalEstimate; most nodes do not need the past.
        :param first_event: number of the first keyframe event.
        :param reset_number: number of the node's last reset, 0 before the first; None to accept messages of any.
        :param resume_stamps: {measurement type: stamp, ns} after which past ones are wanted too.
        """
        self._resume_stamps, self._reset_number = resume_stamps or {}, reset_number
        self._early: list[tuple[int, Callable[[], None]]] = []
        self._message_types = message_types = tuple(message_types)
        self._node, self._deliver, self._diagnostics = node, deliver, diagnostics
        self.order = ChainOrder(message_types, first_event)
        self._estimate_profile = estimate_profile
        self.is_holding = False
        self._held: deque[Message] = deque()
        self._headers: deque[KeyframeHeader] = deque()
        self._ranges: deque[tuple[int, Any]] = deque()
        self.final_counts: FinalCounts | None = None
        self._odometry: SensorSubscription | None = None
        for kind in message_types:
            self._subscribe_to(kind)

    def reset_odometry_order(self) -> None:
        """Accept any stamp of the next odometry reading."""
        if self._odometry is not None:
            self._odometry.reset_order()

    def hold(self) -> None:
        """Keep messages from now on."""
        self.is_holding = True

    def release(self) -> None:
        """Deliver the kept messages in the order of arrival, and all from now on."""
        self.is_holding = False
        self._diagnostics.values.pop(_HELD, None)
        while self._held:
            self.receive(self._held.popleft())

    def reset(self, first_event: int, reset_number: int) -> None:
        """Start the chain again, and drop what is kept.

        :param first_event: number of the first keyframe event.
        :param reset_number: number of the reset request.
        """
        self.order, self._reset_number = ChainOrder(self._message_types, first_event), reset_number
        self._held.clear()
        self._headers.clear()
        self._ranges.clear()

    def deliver_early(self) -> None:
        """Take in the messages of nodes that made the reset before this one."""
        early, self._early = self._early, []
        for reset_number, take_in in early:
            self._match_reset(reset_number, take_in)

    def _match_reset(self, reset_number: int, take_in: Callable[[], None]) -> None:
        """Take in what was sent after this node's last reset; keep what was sent after a later one, drop the rest."""
        if self._reset_number is None or reset_number == self._reset_number:
            take_in()
        elif reset_number > self._reset_number:
            self._early.append((reset_number, take_in))

    def _subscribe_to(self, kind: type) -> None:
        if kind is Keyframe:
            self._subscribe(LaserScan, KEYFRAME_SCANS, self._on_ranges)
            self._subscribe(String, KEYFRAMES, self._on_keyframe_header)
        elif kind is ScanPoses:
            self._subscribe(
                Path, SCAN_POSES, lambda message: self.receive(conversions.scan_poses_from_message(message))
            )
        elif kind is EndOfRun:
            self._subscribe(String, FINISHED, self._on_final_counts)
        elif kind is Odometry:
            self._odometry = SensorSubscription(
                self._node,
                self._diagnostics,
                OdometryMessage,
                ODOM,
                lambda message: self.receive(conversions.odometry_from_message(message)),
                self._resume_stamps.get("Odometry"),
            )
            self._odometry.start()
        elif kind in DOCUMENTS:
            profile = self._estimate_profile if kind is LocalEstimate else topics.CHAIN
            self._subscribe(String, DOCUMENTS[kind], lambda message: self._on_document(message, kind), profile)

    def _subscribe(
        self, kind: type, topic: str, callback: Callable[[Any], None], profile: QoSProfile = topics.CHAIN
    ) -> None:
        def guarded_callback(message: object) -> None:
            try:
                callback(message)
            except HmtSlamError as fault:
                self._diagnostics.fail(f"{topic}: {fault}")

        self._node.create_subscription(kind, topic, guarded_callback, profile)

    def _on_document(self, message: String, kind: type[Any]) -> None:
        document, reset_number = decode_with_reset(message.data, kind)
        self._match_reset(reset_number, lambda: self.receive(document))

    def _on_keyframe_header(self, message: String) -> None:
        header, reset_number = decode_with_reset(message.data, KeyframeHeader)

        def take_in() -> None:
            self._headers.append(header)
            self._join_keyframes()

        self._match_reset(reset_number, take_in)

    def _on_ranges(self, message: LaserScan) -> None:
        sequence, reset_number = conversions.keyframe_from_frame(message.header.frame_id)
        ranges = conversions.ranges_from_message(message)

        def take_in() -> None:
            self._ranges.append((sequence, ranges))
            self._join_keyframes()

        self._match_reset(reset_number, take_in)

    def _join_keyframes(self) -> None:
        """Deliver keyframes whose header and ranges are here; a lost half becomes a gap in the chain."""
        while self._headers and self._ranges:
            header, (sequence, ranges) = self._headers[0], self._ranges[0]
            if header.sequence <= sequence:
                self._headers.popleft()
            if sequence <= header.sequence:
                self._ranges.popleft()
            if header.sequence == sequence:
                self.receive(header.to_keyframe(ranges))

    def _on_final_counts(self, message: String) -> None:
        self.final_counts = decode(message.data, FinalCounts)
        self.receive(self.final_counts.totals)

    def receive(self, message: Message) -> None:
        """Count a message and deliver those whose turn it is, or keep it while the inbox is holding."""
        if self.is_holding:
            self._held.append(message)
            self._diagnostics.values[_HELD] = len(self._held)
            return
        self._diagnostics.received[type(message).__name__] += 1
        if isinstance(message, TrackingReset):
            self.reset_odometry_order()
        if not isinstance(message, CHAIN):
            self._deliver(message)
            return
        for due in self.order.push(message):  # type: ignore[arg-type]
            self._deliver(due)
        self._diagnostics.values["waiting for their turn"] = self.order.waiting_count
        self._diagnostics.values["repeated"] = self.order.repeated_count
        if self.order.fault is not None:
            self._diagnostics.fail(self.order.fault)


def subscribe_document(
    node: Node, diagnostics: NodeDiagnostics, kind: type[Any], callback: Callable[[Any], None], profile: QoSProfile
) -> None:
    """Subscribe to a type of documents; one that cannot be decoded is a fault in the diagnostics."""

    def on_document(message: String) -> None:
        try:
            document = decode(message.data, kind)
        except HmtSlamError as fault:
            diagnostics.fail(f"{DOCUMENTS[kind]}: {fault}")
        else:
            callback(document)

    node.create_subscription(String, DOCUMENTS[kind], on_document, profile)


Writer = Callable[[Any], None]

_COUNTED = (Keyframe, ScanPoses)
# Beside the documents; for any other message type the node sets a writer.
_PUBLISHED = (Keyframe, ScanPoses, EndOfRun)


class Outbox:
    """Publishers of the messages of a process.

    :ivar sent: {message type: number sent}, for FinalCounts.
    :ivar reset_number: number of the node's last reset, 0 before the first.
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
        """Send messages of a type by a function of the node."""
        self._writers[kind] = writer

    def send(self, message: Message) -> None:
        """Publish and count a message."""
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
            return lambda scan_poses: publish_reliably(paths, conversions.path_message(scan_poses))
        if kind is EndOfRun:
            finals = self._node.create_publisher(String, FINISHED, topics.CHAIN)
            return lambda totals: publish_reliably(finals, String(data=encode(self._final_counts(totals))))
        documents = self._node.create_publisher(String, DOCUMENTS[kind], topics.CHAIN)
        return lambda message: publish_reliably(documents, String(data=encode(message, self.reset_number)))

    def _keyframe_writer(self) -> Writer:
        scans = self._node.create_publisher(LaserScan, KEYFRAME_SCANS, topics.CHAIN)
        headers = self._node.create_publisher(String, KEYFRAMES, topics.CHAIN)

        def write(keyframe: Keyframe) -> None:
            frame = conversions.keyframe_frame(keyframe.sequence, self.reset_number)
            publish_reliably(scans, conversions.scan_message(keyframe.scan, frame))
            publish_reliably(headers, String(data=encode(KeyframeHeader.from_keyframe(keyframe), self.reset_number)))

        return write

    def _final_counts(self, totals: EndOfRun) -> FinalCounts:
        keyframes, scan_poses = (self.sent[kind.__name__] for kind in _COUNTED)
        return FinalCounts(totals, keyframes, scan_poses)


def publish_reliably(publisher: Any, message: Any) -> None:  # noqa: ANN401  any ROS message
    """Publish; where a reader lags by a whole history, wait until it has caught up or is gone.

    :raises ExternalShutdownException: where the node is to shut down meanwhile.
    """
    while True:
        try:
            publisher.publish(message)
        except RCLError:
            # DDS itself waits 0.1 s for room.
            if not rclpy.ok():
                raise ExternalShutdownException from None
        else:
            return
