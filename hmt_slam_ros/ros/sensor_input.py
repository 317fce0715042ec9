"""Subscriptions of the nodes to sensors: scans and odometry in the order of their stamps."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_from_time
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.guarded_node import GuardedNode

MessageType = TypeVar("MessageType")

MIN_BACKWARD_JUMP = 1_000_000_000
"""Step back in time above which a bag began again or a clock was set, ns; late messages of one source are within it."""

MAX_FORWARD_JUMP = 600_000_000_000
"""Step ahead in time above which a stamp is believed as one that is far behind, ns; a break of a drive is within it."""

_CHECK_PERIOD = 0.5
"""Time between two checks of messages that wait for others to confirm their stamps, s."""
_SILENT_CHECKS = 4
"""Checks in which no message follows the newest one, after which time has jumped; a busy node makes none."""
_MAX_PENDING = 5000
"""Messages that wait for that."""


class StampOrder(Generic[MessageType]):
    """Passes messages in the order of their stamps, and rejects late and repeated ones.

    One that is far from the newest is damaged, very late or of a second source; or time jumped, since a bag began again
    or nothing came for long. It is pending with those that follow it. The next message near the newest rejects them. If
    none comes for some time, all of them pass.

    :ivar newest_stamp: stamp of the last message that passed, ns; None where the next one may have any.
    :ivar rejected_count: number of rejected messages.
    :ivar last_rejected_stamp: stamp of the last rejected message, ns, None before the first.
    """

    def __init__(self, newest_stamp: int | None = None) -> None:
        """:param newest_stamp: stamp of the last message before, ns, None without."""
        self.newest_stamp, self.rejected_count = newest_stamp, 0
        self.last_rejected_stamp: int | None = None
        self._pending: list[tuple[int, MessageType]] = []
        self._silent_checks = 0

    def reset(self) -> None:
        """Accept any stamp of the next message."""
        self.newest_stamp = None

    def push(self, stamp: int, message: MessageType) -> list[MessageType]:
        """The messages that pass now: mostly ``message`` itself."""
        newest, follows_pending = self.newest_stamp, bool(self._pending) and _follows(stamp, self._pending[-1][0])
        if newest is None or _follows(stamp, newest):
            if newest is not None or not follows_pending:
                self._reject_pending()
            self._pending.append((stamp, message))
            return self._pass_pending()
        if newest - MIN_BACKWARD_JUMP < stamp <= newest or len(self._pending) == _MAX_PENDING:
            self._reject(stamp)
            return []
        if not follows_pending:
            self._reject_pending()
        self._pending.append((stamp, message))
        return []

    def check(self) -> list[MessageType]:
        """The messages that pass as time has jumped; to be called every half a second."""
        self._silent_checks += 1
        has_jumped = self._silent_checks >= _SILENT_CHECKS and len(self._pending) > 1
        return self._pass_pending() if self._pending and (has_jumped or self.newest_stamp is None) else []

    def _pass_pending(self) -> list[MessageType]:
        due, self.newest_stamp = [message for _, message in self._pending], self._pending[-1][0]
        self._pending.clear()
        self._silent_checks = 0
        return due

    def _reject_pending(self) -> None:
        for stamp, _ in self._pending:
            self._reject(stamp)
        self._pending.clear()
        self._silent_checks = 0

    def _reject(self, stamp: int) -> None:
        self.rejected_count, self.last_rejected_stamp = self.rejected_count + 1, stamp


def _follows(stamp: int, newest: int) -> bool:
    return newest < stamp <= newest + MAX_FORWARD_JUMP


_RESEND_TIME = 10.0
"""Time after a subscription in which a latched publisher sends old messages again, s."""


class SensorSubscription:
    """Subscription that starts reliable, and changes to best effort for a publisher that offers no more.

    Late and repeated messages are dropped and counted in /diagnostics.

    :ivar is_best_effort: whether messages may be lost.
    """

    def __init__(
        self,
        node: GuardedNode,
        diagnostics: NodeDiagnostics,
        kind: type,
        topic: str,
        convert: Callable[[Any], Any],
        deliver: Callable[[Any], None],
        resume_stamp: int | None = None,
        receive: Callable[[int, Any], None] | None = None,
    ) -> None:
        """Prepare; :meth:`start` subscribes.

        :param convert: called with each message; returns what is delivered, and raises an error for what is refused.
        :param deliver: called in the order of the stamps.
        :param receive: called with the stamp, ns, and each converted message in the order of arrival; passes them to
            :meth:`push`, now or later. By default now.
        :param resume_stamp: stamp of the last message before, ns, where those missed since are wanted from a latched
            publisher.
        """
        self.is_best_effort = False
        self._node, self._kind, self._topic, self._convert, self._deliver = node, kind, topic, convert, deliver
        self._last_stamp = self._resume_stamp = resume_stamp
        self._started_at = time.monotonic()
        self._receive = receive or self.push
        self._diagnostics, self._order = diagnostics, StampOrder[Any](resume_stamp)
        self._subscription: Any = None
        node.create_timer(_CHECK_PERIOD, self._check_pending, clock=diagnostics.steady_clock)

    def start(self) -> None:
        """Subscribe; what was missed since :meth:`stop` comes first, where the publisher is latched."""
        self._resume_stamp, self._started_at = self._last_stamp, time.monotonic()
        reliable = topics.SENSOR if self._resume_stamp is None else topics.LATCHED_SENSOR
        self._subscribe(topics.LIVE_SENSOR if self.is_best_effort else reliable)

    def stop(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)

    def reset_order(self) -> None:
        """Accept any stamp of the next message."""
        self._order.reset()

    def _subscribe(self, profile: QoSProfile) -> None:
        self._profile = profile
        events = SubscriptionEventCallbacks(incompatible_qos=self._relax_qos)
        self._subscription = self._node.create_subscription(
            self._kind, self._topic, self._on_message, profile, event_callbacks=events
        )

    def _on_message(self, message: Any) -> None:  # noqa: ANN401  a ROS message with a header
        stamp = stamp_from_time(message.header.stamp)
        value = self._convert(message)
        if self._resume_stamp is not None:
            if stamp <= self._resume_stamp and time.monotonic() - self._started_at < _RESEND_TIME:
                return
            if self._profile is not topics.LATCHED_SENSOR:
                self._node.get_logger().warning(
                    f"what came on {self._topic} between the stamps {self._resume_stamp} and {stamp} ns, "
                    f"{(stamp - self._resume_stamp) / 1e9:.1f} s, is lost: the node did not listen"
                )
            self._resume_stamp = None
        self._receive(stamp, value)

    def push(self, stamp: int, value: Any) -> None:  # noqa: ANN401  as converted
        """Deliver what is due after a message; reject it where its stamp is not in order."""
        newest, rejected_count = self._order.newest_stamp, self._order.rejected_count
        self._deliver_due(self._order.push(stamp, value))
        if self._order.rejected_count > rejected_count:
            self._report_rejected(newest, self._order.rejected_count - rejected_count)

    def _check_pending(self) -> None:
        """Deliver what waits, where time has jumped."""
        self._deliver_due(self._order.check())

    def _deliver_due(self, due: list[Any]) -> None:
        if due:
            self._last_stamp = self._order.newest_stamp
        for value in due:
            self._deliver(value)

    def _report_rejected(self, newest: int | None, count: int) -> None:
        order = self._order
        self._diagnostics.count_refused(self._topic, count)
        if order.rejected_count == count:
            self._diagnostics.warn(
                f"on {self._topic} the message of stamp {order.last_rejected_stamp} ns came late, twice or far ahead, "
                f"beside that of {newest} ns, and is left out, as all such: look for a second publisher, or a link "
                "that reorders"
            )

    @property
    def _is_offered_reliably(self) -> bool:
        """Whether another publisher offers the whole profile; one that does not is then left aside."""
        wanted = self._profile.durability
        offers = [end.qos_profile for end in self._node.get_publishers_info_by_topic(self._topic)]
        return any(
            offer.reliability == ReliabilityPolicy.RELIABLE
            and (wanted != DurabilityPolicy.TRANSIENT_LOCAL or offer.durability == wanted)
            for offer in offers
        )

    def _relax_qos(self, _event: object) -> None:
        if self.is_best_effort or self._is_offered_reliably:
            return
        self._node.destroy_subscription(self._subscription)
        if self._profile is topics.LATCHED_SENSOR:
            self._subscribe(topics.SENSOR)
            return
        self.is_best_effort = True
        self._node.get_logger().info(f"{self._topic} comes from a live driver (best effort): messages may be lost")
        self._subscribe(topics.LIVE_SENSOR)
