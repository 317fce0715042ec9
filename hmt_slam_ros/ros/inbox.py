"""From what comes in on the topics to messages, in the order in which a process has to hear them.

DDS keeps the order within a topic, not across topics: Keyframe(k+1) may overtake Accepted(k). Every process gets
Keyframe(k), AreaEvents(k), Hypotheses(k), Accepted(k), Keyframe(k+1), ... as far as it listens to them, so that a run
of the nodes takes the same decisions as the lock-step run, and a node that starts late catches up.
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
from hmt_slam_ros.messages.documents import Closing, KeyframeHead, decode, decode_numbered
from hmt_slam_ros.messages.messages import (
    Accepted,
    AreaEvents,
    Arriving,
    Finished,
    Hypotheses,
    Keyframe,
    LocalEstimate,
    Message,
    Trail,
)
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import Figures
from hmt_slam_ros.ros.sensor_input import SensorSubscription
from hmt_slam_ros.ros.topics import DOCUMENTS, FINISHED, KEYFRAME_SCANS, KEYFRAMES, ODOM, TRAIL
from hmt_slam_ros.sensors import Odometry

ChainMessage = Keyframe | AreaEvents | Hypotheses | Accepted

CHAIN: tuple[type, ...] = (Keyframe, AreaEvents, Hypotheses, Accepted)


class ChainOrder:
    """Holds messages back until their turn; notices repetitions and gaps.

    :ivar repeated: messages that came a second time and were put aside.
    :ivar fault: one sentence about the first gap, None where nothing is missing.
    """

    def __init__(self, heard: Iterable[type], first: int = 0) -> None:
        """Take the message types that the process listens to; those outside the chain are ignored.

        :param first: keyframe event with which the chain begins.
        """
        heard = tuple(heard)
        self._kinds = tuple(kind for kind in CHAIN if kind in heard)
        self._waiting: dict[type, deque[ChainMessage]] = {kind: deque() for kind in self._kinds}
        self._arrived = dict.fromkeys(self._kinds, first)
        self._delivered = first * len(self._kinds)
        self.repeated = 0
        self.fault: str | None = None

    @property
    def waiting(self) -> int:
        """Messages held back."""
        return sum(len(queue) for queue in self._waiting.values())

    @property
    def events(self) -> int | None:
        """Keyframe events that were delivered to the end, None amid one."""
        events, begun = divmod(self._delivered, len(self._kinds))
        return None if begun else events

    def arrive(self, message: ChainMessage) -> list[ChainMessage]:
        """Take in a message; return those whose turn has come, in their order."""
        kind, sequence = type(message), message.sequence
        if sequence < self._arrived[kind]:
            self.repeated += 1
            return []
        if sequence > self._arrived[kind] and self.fault is None:
            self.fault = (
                f"{kind.__name__} {self._arrived[kind]} never came, {sequence} did: the node started too late or lost "
                "messages, restart all nodes"
            )
        self._arrived[kind] = sequence + 1
        self._waiting[kind].append(message)
        return list(self._due())

    def _due(self) -> Iterable[ChainMessage]:
        while True:
            sequence, turn = divmod(self._delivered, len(self._kinds))
            queue = self._waiting[self._kinds[turn]]
            if not queue or queue[0].sequence != sequence:
                return
            self._delivered += 1
            yield queue.popleft()


Deliver = Callable[[Message], None]

_KEPT = "kept until it is active"


class Inbox:
    """Subscriptions for the kinds of messages that a node hears.

    :ivar closing: slam's last word with its counts, None before it.
    :ivar waits: whether what comes is kept.
    """

    def __init__(
        self,
        node: Node,
        heard: Iterable[type],
        deliver: Deliver,
        figures: Figures,
        estimates: QoSProfile = topics.CHAIN_FROM_NOW,
        first: int = 0,
        begun: int | None = None,
        after: Mapping[str, int] | None = None,
    ) -> None:
        """Subscribe.

        :param heard: kinds of messages; Scan and EndOfLog are left to the node.
        :param deliver: called for each message in its turn.
        :param estimates: profile for LocalEstimate, of which most nodes have no use for the past.
        :param first: keyframe event with which the chain begins.
        :param begun: number of the request after which the node began anew, 0 before the first; None where it hears
            on, whoever begins anew.
        :param after: {kind of measurement: stamp from which on, ns}, where past ones are wanted too.
        """
        self._after, self._begun = after or {}, begun
        self._ahead: list[tuple[int, Callable[[], None]]] = []
        self._heard = heard = tuple(heard)
        self._node, self._deliver, self._figures = node, deliver, figures
        self._order = ChainOrder(heard, first)
        self._estimates = estimates
        self.waits = False
        self._kept: deque[Message] = deque()
        self._heads: deque[KeyframeHead] = deque()
        self._ranges: deque[tuple[int, Any]] = deque()
        self.closing: Closing | None = None
        self._odometry: SensorSubscription | None = None
        for kind in heard:
            self._subscribe(kind)

    def forget_odometry(self) -> None:
        """What comes next of it may be of any time."""
        if self._odometry is not None:
            self._odometry.forget()

    def wait(self) -> None:
        """Keep what comes from now on."""
        self.waits = True

    def go_on(self) -> None:
        """Deliver what was kept, in the order in which it came, and what comes from now on."""
        self.waits = False
        self._figures.state.pop(_KEPT, None)
        while self._kept:
            self.receive(self._kept.popleft())

    def begin_anew(self, first: int, begun: int) -> None:
        """The chain begins once more, when all of it so far was heard.

        :param first: keyframe event with which it begins.
        :param begun: number of the request after which it does.
        """
        self._order, self._begun = ChainOrder(self._heard, first), begun
        self._kept.clear()
        self._heads.clear()
        self._ranges.clear()

    def catch_up(self) -> None:
        """Hear what others said that had begun anew before."""
        ahead, self._ahead = self._ahead, []
        for begun, hear in ahead:
            self._hear_in_turn(begun, hear)

    def _hear_in_turn(self, begun: int, hear: Callable[[], None]) -> None:
        """Hear what was said since the same request to begin anew; keep what was said after a later one."""
        if self._begun is None or begun == self._begun:
            hear()
        elif begun > self._begun:
            self._ahead.append((begun, hear))

    @property
    def fault(self) -> str | None:
        """One sentence about the first gap in the chain, None where nothing is missing."""
        return self._order.fault

    @property
    def events(self) -> int | None:
        """Keyframe events that were delivered to the end, None amid one."""
        return self._order.events

    def _subscribe(self, kind: type) -> None:
        if kind is Keyframe:
            self._listen(LaserScan, KEYFRAME_SCANS, self._hear_ranges)
            self._listen(String, KEYFRAMES, self._hear_head)
        elif kind is Trail:
            self._listen(Path, TRAIL, lambda message: self.receive(conversions.trail_from(message)))
        elif kind is Finished:
            self._listen(String, FINISHED, self._hear_closing)
        elif kind is Odometry:
            self._odometry = SensorSubscription(
                self._node,
                self._figures,
                OdometryMessage,
                ODOM,
                lambda message: self.receive(conversions.odometry_from(message)),
                self._after.get("Odometry"),
            )
            self._odometry.begin()
        elif kind in DOCUMENTS:
            profile = self._estimates if kind is LocalEstimate else topics.CHAIN
            self._listen(String, DOCUMENTS[kind], lambda message: self._hear_document(message, kind), profile)

    def _listen(self, kind: type, topic: str, hear: Callable[[Any], None], profile: QoSProfile = topics.CHAIN) -> None:
        def callback(message: object) -> None:
            try:
                hear(message)
            except HmtSlamError as error:
                self._figures.fail(f"{topic}: {error}")

        self._node.create_subscription(kind, topic, callback, profile)

    def _hear_document(self, message: String, kind: type[Any]) -> None:
        document, begun = decode_numbered(message.data, kind)
        self._hear_in_turn(begun, lambda: self.receive(document))

    def _hear_head(self, message: String) -> None:
        head, begun = decode_numbered(message.data, KeyframeHead)
        self._hear_in_turn(begun, lambda: self._pair(heads=[head]))

    def _hear_ranges(self, message: LaserScan) -> None:
        sequence, begun = conversions.keyframe_of(message.header.frame_id)
        ranges = (sequence, conversions.ranges_of(message))
        self._hear_in_turn(begun, lambda: self._pair(ranges=[ranges]))

    def _pair(self, heads: Sequence[KeyframeHead] = (), ranges: Sequence[tuple[int, Any]] = ()) -> None:
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
                self.receive(head.with_ranges(beams))

    def _hear_closing(self, message: String) -> None:
        self.closing = decode(message.data, Closing)
        self.receive(self.closing.totals)

    def receive(self, message: Message) -> None:
        """Count a message, and deliver what is due, unless all has to wait."""
        if self.waits:
            self._kept.append(message)
            self._figures.state[_KEPT] = len(self._kept)
            return
        self._figures.received[type(message).__name__] += 1
        if isinstance(message, Arriving):
            self.forget_odometry()
        if not isinstance(message, CHAIN):
            self._deliver(message)
            return
        for due in self._order.arrive(message):  # type: ignore[arg-type]
            self._deliver(due)
        self._figures.state["waiting for their turn"] = self._order.waiting
        self._figures.state["repeated"] = self._order.repeated
        if self._order.fault is not None:
            self._figures.fail(self._order.fault)
