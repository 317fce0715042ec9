"""From what comes in on the topics to messages, in the order in which a process has to hear them.

DDS keeps the order within a topic, not across topics: Keyframe(k+1) may overtake ClosureDecision(k). Every process gets
Keyframe(k), AreaEvents(k), Hypotheses(k), ClosureDecision(k), Keyframe(k+1), ... as far as it listens to them, so that
a run of the nodes takes the same decisions as the lock-step run, and a node that starts late catches up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import FinalCounts, KeyframeHeader, decode, decode_with_reset
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


class ChainOrder:
    """Holds messages back until their turn; notices repetitions and gaps.

    :ivar repeated_count: messages that came a second time and were put aside.
    :ivar fault: one sentence about the first gap, None where nothing is missing.
    """

    def __init__(self, message_types: Iterable[type], first_event: int = 0) -> None:
        """Take the message types that the process listens to; those outside the chain are ignored.

        :param first_event: keyframe event with which the chain begins.
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
        """Messages held back."""
        return sum(len(queue) for queue in self._waiting.values())

    @property
    def events(self) -> int | None:
        """Keyframe events that were delivered to the end, None amid one."""
        events, begun = divmod(self._delivered_count, len(self._kinds))
        return None if begun else events

    def push(self, message: ChainMessage) -> list[ChainMessage]:
        """Take in a message; return those whose turn has come, in their order."""
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


MessageCallback = Callable[[Message], None]

_HELD = "kept until it is active"


class Inbox:
    """Subscriptions for the kinds of messages that a node hears.

    :ivar closing: slam's last word with its counts, None before it.
    :ivar is_holding: whether what comes is kept.
    """

    def __init__(
        self,
        node: Node,
        message_types: Iterable[type],
        deliver: MessageCallback,
        diagnostics: NodeDiagnostics,
        estimate_profile: QoSProfile = topics.VOLATILE_CHAIN,
        first_event: int = 0,
        reset_number: int | None = None,
        resume_stamps: Mapping[str, int] | None = None,
    ) -> None:
        """Subscribe.

        :param message_types: kinds of messages; Scan and EndOfLog are left to the node.
        :param deliver: called for each message in its turn.
        :param estimate_profile: profile for LocalEstimate, of which most nodes have no use for the past.
        :param first_event: keyframe event with which the chain begins.
        :param reset_number: number of the request after which the node began anew, 0 before the first; None where it
            hears on, whoever begins anew.
        :param resume_stamps: {kind of measurement: stamp from which on, ns}, where past ones are wanted too.
        """
        self._resume_stamps, self._reset_number = resume_stamps or {}, reset_number
        self._early: list[tuple[int, Callable[[], None]]] = []
        self._message_types = message_types = tuple(message_types)
        self._node, self._deliver, self._diagnostics = node, deliver, diagnostics
        self._order = ChainOrder(message_types, first_event)
        self._estimate_profile = estimate_profile
        self.is_holding = False
        self._held: deque[Message] = deque()
        self._heads: deque[KeyframeHeader] = deque()
        self._ranges: deque[tuple[int, Any]] = deque()
        self.closing: FinalCounts | None = None
        self._odometry: SensorSubscription | None = None
        for kind in message_types:
            self._subscribe_to(kind)

    def reset_odometry_order(self) -> None:
        """What comes next of it may be of any time."""
        if self._odometry is not None:
            self._odometry.reset_order()

    def hold(self) -> None:
        """Keep what comes from now on."""
        self.is_holding = True

    def release(self) -> None:
        """Deliver what was kept, in the order in which it came, and what comes from now on."""
        self.is_holding = False
        self._diagnostics.values.pop(_HELD, None)
        while self._held:
            self.receive(self._held.popleft())

    def reset(self, first_event: int, reset_number: int) -> None:
        """The chain begins once more, when all of it so far was heard.

        :param first_event: keyframe event with which it begins.
        :param reset_number: number of the request after which it does.
        """
        self._order, self._reset_number = ChainOrder(self._message_types, first_event), reset_number
        self._held.clear()
        self._heads.clear()
        self._ranges.clear()

    def deliver_early(self) -> None:
        """Hear what others said that had begun anew before."""
        ahead, self._early = self._early, []
        for begun, hear in ahead:
            self._deliver_after_reset(begun, hear)

    def _deliver_after_reset(self, begun: int, hear: Callable[[], None]) -> None:
        """Hear what was said since the same request to begin anew; keep what was said after a later one."""
        if self._reset_number is None or begun == self._reset_number:
            hear()
        elif begun > self._reset_number:
            self._early.append((begun, hear))

    @property
    def fault(self) -> str | None:
        """One sentence about the first gap in the chain, None where nothing is missing."""
        return self._order.fault

    @property
    def events(self) -> int | None:
        """Keyframe events that were delivered to the end, None amid one."""
        return self._order.events

    def _subscribe_to(self, kind: type) -> None:
        if kind is Keyframe:
            self._add_subscription(LaserScan, KEYFRAME_SCANS, self._on_ranges)
            self._add_subscription(String, KEYFRAMES, self._on_keyframe_header)
        elif kind is ScanPoses:
            self._add_subscription(
                Path, SCAN_POSES, lambda message: self.receive(conversions.scan_poses_from_message(message))
            )
        elif kind is EndOfRun:
            self._add_subscription(String, FINISHED, self._on_final_counts)
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
            self._add_subscription(String, DOCUMENTS[kind], lambda message: self._on_document(message, kind), profile)

    def _add_subscription(
        self, kind: type, topic: str, hear: Callable[[Any], None], profile: QoSProfile = topics.CHAIN
    ) -> None:
        def callback(message: object) -> None:
            try:
                hear(message)
            except HmtSlamError as error:
                self._diagnostics.fail(f"{topic}: {error}")

        self._node.create_subscription(kind, topic, callback, profile)

    def _on_document(self, message: String, kind: type[Any]) -> None:
        document, begun = decode_with_reset(message.data, kind)
        self._deliver_after_reset(begun, lambda: self.receive(document))

    def _on_keyframe_header(self, message: String) -> None:
        head, begun = decode_with_reset(message.data, KeyframeHeader)
        self._deliver_after_reset(begun, lambda: self._join(heads=[head]))

    def _on_ranges(self, message: LaserScan) -> None:
        sequence, begun = conversions.keyframe_from_frame(message.header.frame_id)
        ranges = (sequence, conversions.ranges_from_message(message))
        self._deliver_after_reset(begun, lambda: self._join(ranges=[ranges]))

    def _join(self, heads: Sequence[KeyframeHeader] = (), ranges: Sequence[tuple[int, Any]] = ()) -> None:
        """Join heads and ranges of the same keyframe; one without its other half is a loss, which the order tells."""
        self._heads += heads
        self._ranges += ranges
        while self._heads and self._ranges:
            head, (sequence, beams) = self._heads[0], self._ranges[0]
            if head.sequence <= sequence:
                self._heads.popleft()
            if sequence <= head.sequence:
                self._ranges.popleft()
            if head.sequence == sequence:
                self.receive(head.to_keyframe(beams))

    def _on_final_counts(self, message: String) -> None:
        self.closing = decode(message.data, FinalCounts)
        self.receive(self.closing.totals)

    def receive(self, message: Message) -> None:
        """Count a message, and deliver what is due, unless all has to wait."""
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
        for due in self._order.push(message):  # type: ignore[arg-type]
            self._deliver(due)
        self._diagnostics.values["waiting for their turn"] = self._order.waiting_count
        self._diagnostics.values["repeated"] = self._order.repeated_count
        if self._order.fault is not None:
            self._diagnostics.fail(self._order.fault)
