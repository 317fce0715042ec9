"""Inbox and outbox of a node: messages of the processes on topics."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
from rclpy.qos import QoSProfile
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import FinalCounts, KeyframeHeader, encode
from hmt_slam_ros.messages.gate import ChainGate, check_message, decode_checked
from hmt_slam_ros.messages.messages import (
    EarlyEstimate,
    EndOfRun,
    Keyframe,
    LocalEstimate,
    Message,
    ScanPoses,
    TrackingReset,
)
from hmt_slam_ros.messages.system_name import ForeignDocumentError
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.chain_order import CHAIN, ChainMessage, ChainOrder
from hmt_slam_ros.ros.chain_writer import ChainWriter
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.odometry_frames import OdometryFrames
from hmt_slam_ros.ros.sensor_input import SensorSubscription
from hmt_slam_ros.ros.topics import DOCUMENTS, FINISHED, KEYFRAME_SCANS, KEYFRAMES, ODOM, SCAN_POSES
from hmt_slam_ros.sensors import Odometry

_MAX_EARLY = 10_000
"""Messages of after a reset that are kept until this node makes it, and unmatched halves of keyframes."""
_HELD = "kept until it is active"


class Inbox:
    """Subscriptions of a node to messages of the processes.

    :ivar gate: checks of the chain.
    :ivar order: order of the chain, with its complete events and its first gap.
    :ivar final_counts: the counts that slam sends at the end, None before.
    :ivar is_holding: whether messages are kept instead of delivered.
    """

    def __init__(
        self,
        node: GuardedNode,
        message_types: Iterable[type],
        deliver: Callable[[Message], None],
        diagnostics: NodeDiagnostics,
        estimate_profile: QoSProfile = topics.VOLATILE_CHAIN,
        first_event: int = 0,
        reset_number: int | None = None,
        resume_stamps: Mapping[str, int] | None = None,
        gate: ChainGate | None = None,
        odometry_frames: OdometryFrames | None = None,
    ) -> None:
        """Subscribe.

        :param message_types: of the node; only those of the chain, documents, ScanPoses, EndOfRun and Odometry count.
        :param deliver: called for each message in its turn.
        :param estimate_profile: profile for LocalEstimate; most nodes do not need the past.
        :param first_event: number of the first keyframe event.
        :param reset_number: number of the node's last reset, 0 before the first; None to accept messages of any.
        :param resume_stamps: {measurement type: stamp, ns} after which past ones are wanted too.
        :param gate: with the hypotheses that are alive; without one they are not known yet.
        :param odometry_frames: take note of the odometry's frames, where the node needs them.
        """
        self._odometry_frames = odometry_frames
        self._resume_stamps, self._reset_number = resume_stamps or {}, reset_number
        self._early: list[tuple[int, Callable[[], None]]] = []
        self._message_types = message_types = tuple(message_types)
        self._node, self._deliver, self._diagnostics, self._system = node, deliver, diagnostics, diagnostics.system
        self.gate = gate or ChainGate()
        self.order = ChainOrder(message_types, first_event, self._is_admitted)
        self._estimate_profile = estimate_profile
        self.is_holding = False
        self._held: deque[Message] = deque()
        self._headers: dict[int, KeyframeHeader] = {}
        self._ranges: dict[int, Any] = {}
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

    def reset(self, first_event: int, reset_number: int, gate: ChainGate | None = None) -> None:
        """Start the chain again, and drop what is kept.

        :param first_event: number of the first keyframe event.
        :param reset_number: number of the reset request.
        :param gate: with the hypotheses that are alive; without one they are not known yet.
        """
        self.gate, self._reset_number = gate or ChainGate(), reset_number
        self.order = ChainOrder(self._message_types, first_event, self._is_admitted)
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
        elif reset_number > self._reset_number and len(self._early) < _MAX_EARLY:
            self._early.append((reset_number, take_in))

    def withdraw(self, message: Message) -> None:
        """Take back the last message that was delivered, which its process could not handle."""
        if isinstance(message, CHAIN):
            self.gate.withdraw()
            self.order.withdraw(message)  # type: ignore[arg-type]

    def _is_admitted(self, message: ChainMessage) -> bool:
        """Whether a message whose turn it is fits to the hypotheses that are alive; else it is reported."""
        try:
            self.gate.check(message)
        except HmtSlamError as fault:
            self._diagnostics.refuse(DOCUMENTS.get(type(message), KEYFRAMES), fault)
            return False
        self.gate.note(message)
        return True

    def _subscribe_to(self, kind: type) -> None:
        if kind is Keyframe:
            self._subscribe(LaserScan, KEYFRAME_SCANS, self._on_ranges)
            self._subscribe(String, KEYFRAMES, self._on_keyframe_header)
        elif kind is ScanPoses:
            self._subscribe(Path, SCAN_POSES, self._on_scan_poses)
        elif kind is EndOfRun:
            self._subscribe(String, FINISHED, self._on_final_counts)
        elif kind is Odometry:
            self._odometry = SensorSubscription(
                self._node,
                self._diagnostics,
                OdometryMessage,
                ODOM,
                self._convert_odometry,
                self.receive,
                self._resume_stamps.get("Odometry"),
            )
            self._odometry.start()
        elif kind in DOCUMENTS:
            profile = {LocalEstimate: self._estimate_profile, EarlyEstimate: topics.STREAM}.get(kind, topics.CHAIN)
            self._subscribe(String, DOCUMENTS[kind], lambda message: self._on_document(message, kind), profile)

    def _subscribe(
        self, kind: type, topic: str, callback: Callable[[Any], None], profile: QoSProfile = topics.CHAIN
    ) -> None:
        self._node.create_subscription(kind, topic, callback, profile)

    def _convert_odometry(self, message: OdometryMessage) -> Odometry:
        reading = conversions.odometry_from_message(message)
        if self._odometry_frames is not None:
            self._odometry_frames.note(message)
        return reading

    def _on_scan_poses(self, message: Path) -> None:
        self.receive(conversions.scan_poses_from_message(message, self._system.admit))

    def _on_document(self, message: String, kind: type[Any]) -> None:
        document, reset_number = decode_checked(message.data, kind, self._system)
        self._match_reset(reset_number, lambda: self.receive(document))

    def _on_keyframe_header(self, message: String) -> None:
        header, reset_number = decode_checked(message.data, KeyframeHeader, self._system)

        def take_in() -> None:
            _keep(self._headers, header.sequence, header)
            self._join_keyframe(header.sequence)

        self._match_reset(reset_number, take_in)

    def _on_ranges(self, message: LaserScan) -> None:
        sequence, reset_number, system = conversions.keyframe_from_frame(message.header.frame_id)
        self._system.admit(system)
        ranges = conversions.ranges_from_message(message)

        def take_in() -> None:
            _keep(self._ranges, sequence, ranges)
            self._join_keyframe(sequence)

        self._match_reset(reset_number, take_in)

    def _join_keyframe(self, sequence: int) -> None:
        """Deliver a keyframe whose header and ranges are here; a lost half becomes a gap in the chain."""
        if sequence in self._headers and sequence in self._ranges:
            keyframe = self._headers.pop(sequence).to_keyframe(self._ranges.pop(sequence))
            check_message(keyframe)
            self.receive(keyframe)

    def _on_final_counts(self, message: String) -> None:
        final_counts, _ = decode_checked(message.data, FinalCounts, self._system)
        self.final_counts = final_counts
        self.receive(final_counts.totals)

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
        order = self.order
        try:
            order.push(message)  # type: ignore[arg-type]
        finally:
            if order.fault is not None:
                self._diagnostics.fail(order.fault)
        for due in order.pop_due():
            self._deliver(due)
        self._diagnostics.values["waiting for their turn"] = self.order.waiting_count
        self._diagnostics.values["repeated"] = self.order.repeated_count


def _keep(halves: dict[int, Any], sequence: int, half: Any) -> None:  # noqa: ANN401  header or ranges
    """Keep a half of a keyframe; of too many, the oldest is dropped."""
    halves[sequence] = half
    if len(halves) > _MAX_EARLY:
        del halves[next(iter(halves))]


def subscribe_document(
    node: GuardedNode,
    kind: type[Any],
    callback: Callable[[Any], None],
    profile: QoSProfile,
    *,
    may_be_unnamed: bool = False,
) -> None:
    """Subscribe to a type of documents; parameters are those of :func:`document_callback`."""
    on_document = document_callback(node.diagnostics, kind, callback, may_be_unnamed=may_be_unnamed)
    node.create_subscription(String, DOCUMENTS[kind], on_document, profile)


def document_callback(
    diagnostics: NodeDiagnostics, kind: type[Any], callback: Callable[[Any], None], *, may_be_unnamed: bool = False
) -> Callable[[String], None]:
    """Callback of a subscription to a type of documents.

    It raises an error for one that is malformed, of another system or makes no sense.

    :param callback: called with each document.
    :param may_be_unnamed: whether senders may not know yet which system they belong to; until then they are ignored.
    """

    def on_document(message: String) -> None:
        try:
            document, _ = decode_checked(message.data, kind, diagnostics.system)
        except ForeignDocumentError as fault:
            if fault.system or not may_be_unnamed:
                raise
            diagnostics.count_refused(DOCUMENTS[kind])
        else:
            callback(document)

    return on_document


Writer = Callable[[Any], None]

_COUNTED = (Keyframe, ScanPoses)
# Beside the documents; for any other message type the node sets a writer.
_PUBLISHED = (Keyframe, ScanPoses, EndOfRun)


class Outbox:
    """Publishers of the messages of a process.

    :ivar sent: {message type: number sent}, for FinalCounts.
    :ivar reset_number: number of the node's last reset, 0 before the first.
    """

    def __init__(self, node: GuardedNode, message_types: Iterable[type], reset_number: int = 0) -> None:
        """Make the publishers."""
        self._node, self._system = node, node.diagnostics.system
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
            paths = ChainWriter(self._node, Path, SCAN_POSES, topics.CHAIN_HISTORY)
            return lambda scan_poses: paths.publish(conversions.path_message(scan_poses, self._system.name))
        if kind is EndOfRun:
            finals = ChainWriter(self._node, String, FINISHED, topics.CHAIN_HISTORY)
            return lambda totals: finals.publish(self._document(self._final_counts(totals)))
        if kind is EarlyEstimate:
            early = self._node.create_publisher(String, DOCUMENTS[kind], topics.STREAM)
            return lambda estimate: early.publish(self._document(estimate))
        profile = topics.ESTIMATE_HISTORY if kind is LocalEstimate else topics.CHAIN_HISTORY
        documents = ChainWriter(self._node, String, DOCUMENTS[kind], profile)
        return lambda message: documents.publish(self._document(message))

    def _document(self, message: object) -> String:
        return String(data=encode(message, self.reset_number, self._system.name))

    def _keyframe_writer(self) -> Writer:
        scans = ChainWriter(self._node, LaserScan, KEYFRAME_SCANS, topics.CHAIN_HISTORY)
        headers = ChainWriter(self._node, String, KEYFRAMES, topics.CHAIN_HISTORY)

        def write(keyframe: Keyframe) -> None:
            frame = conversions.keyframe_frame(keyframe.sequence, self.reset_number, self._system.name)
            scans.publish(conversions.scan_message(keyframe.scan, frame))
            headers.publish(self._document(KeyframeHeader.from_keyframe(keyframe)))

        return write

    def _final_counts(self, totals: EndOfRun) -> FinalCounts:
        keyframes, scan_poses = (self.sent[kind.__name__] for kind in _COUNTED)
        return FinalCounts(totals, keyframes, scan_poses)
