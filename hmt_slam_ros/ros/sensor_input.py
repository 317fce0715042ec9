"""Subscriptions to a robot's sensors: their order in time, and what they do that they should not."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_from_time
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.sensors import Odometry, Scan

MessageType = TypeVar("MessageType")

MIN_BACKWARD_JUMP = 1_000_000_000
"""A bag that begins again, or a clock that is set, goes back by more than messages of one source are late, ns."""


class StampOrder(Generic[MessageType]):
    """Lets messages through in the order of their stamps.

    :ivar newest_stamp: stamp of the last one that was let through, ns, None where the next one may be of any time.
    :ivar rejected_count: how many came late or twice.
    :ivar last_rejected_stamp: stamp of the last such one, ns, None before the first.
    """

    def __init__(self, newest_stamp: int | None = None) -> None:
        """:param newest_stamp: stamp of the last one before, ns, None where there was none."""
        self.newest_stamp, self.rejected_count = newest_stamp, 0
        self.last_rejected_stamp: int | None = None
        self._pending: tuple[int, MessageType] | None = None

    def reset(self) -> None:
        """What comes next may be of any time."""
        self.newest_stamp = self._pending = None

    def push(self, stamp: int, message: MessageType) -> list[MessageType]:
        """What is let through now: mostly the message.

        Where one is stamped long before the newest, either it came very late or time went back; it waits for the next
        one, which tells.
        """
        newest, doubtful = self.newest_stamp, self._pending
        due = [message]
        if newest is not None and stamp <= newest:
            if stamp > newest - MIN_BACKWARD_JUMP:
                self._reject(stamp)
                return []
            due = []
            if doubtful is not None and stamp > doubtful[0]:
                due, doubtful = [doubtful[1], message], None
        if doubtful is not None:
            self._reject(doubtful[0])
        self._pending = None if due else (stamp, message)
        self.newest_stamp = stamp if due else newest
        return due

    def _reject(self, stamp: int) -> None:
        self.rejected_count, self.last_rejected_stamp = self.rejected_count + 1, stamp


# Within this time a robot node has sent again what was missed.
_RESEND_TIME = 10.0  # s


class SensorSubscription:
    """Begins reliable, and changes over to best effort when a publisher offers nothing better.

    Messages that come late or twice are left out; /diagnostics counts them.

    :ivar is_best_effort: whether it listens to a publisher that may lose messages.
    """

    def __init__(
        self,
        node: Node,
        diagnostics: NodeDiagnostics,
        kind: type,
        topic: str,
        on_message: Callable[[Any], None],
        resume_stamp: int | None = None,
    ) -> None:
        """Listen to nothing yet.

        :param diagnostics: through which it tells.
        :param resume_stamp: stamp of the last message that was heard before, ns, where what was missed since is wanted,
            from a publisher that kept it.
        """
        self.is_best_effort = False
        self._node, self._kind, self._topic, self._deliver = node, kind, topic, on_message
        self._last_stamp = self._resume_stamp = resume_stamp
        self._started_at = time.monotonic()
        self._diagnostics, self._order = diagnostics, StampOrder[Any](resume_stamp)
        self._subscription: Any = None

    def start(self) -> None:
        """Listen; what was missed since :meth:`stop` comes first, where the publisher kept it."""
        self._resume_stamp, self._started_at = self._last_stamp, time.monotonic()
        wanted = topics.SENSOR if self._resume_stamp is None else topics.LATCHED_SENSOR
        self._subscription = self._subscribe(topics.LIVE_SENSOR if self.is_best_effort else wanted)

    def stop(self) -> None:
        """Listen no more."""
        self._node.destroy_subscription(self._subscription)

    def _subscribe(self, profile: QoSProfile) -> Any:  # noqa: ANN401  rclpy's subscription
        self._profile = profile
        events = SubscriptionEventCallbacks(incompatible_qos=self._relax_qos)
        return self._node.create_subscription(
            self._kind, self._topic, self._on_message, profile, event_callbacks=events
        )

    def _on_message(self, message: Any) -> None:  # noqa: ANN401  a ROS message with a header
        stamp = stamp_from_time(message.header.stamp)
        if self._resume_stamp is not None:
            if stamp <= self._resume_stamp and time.monotonic() - self._started_at < _RESEND_TIME:
                return
            if self._profile is not topics.LATCHED_SENSOR:
                self._node.get_logger().warning(
                    f"what came on {self._topic} between the stamps {self._resume_stamp} and {stamp} ns, "
                    f"{(stamp - self._resume_stamp) / 1e9:.1f} s, is lost: the node did not listen"
                )
            self._resume_stamp = None
        newest, refused = self._order.newest_stamp, self._order.rejected_count
        for due in self._order.push(stamp, message):
            self._last_stamp = stamp
            self._deliver(due)
        if self._order.rejected_count > refused:
            self._report_rejected(newest)

    def reset_order(self) -> None:
        """What comes next may be of any time."""
        self._order.reset()

    def _report_rejected(self, newest: int | None) -> None:
        order = self._order
        self._diagnostics.values[f"refused on {self._topic}"] = order.rejected_count
        if order.rejected_count == 1:
            self._diagnostics.warn(
                f"on {self._topic} the message of stamp {order.last_rejected_stamp} ns came late or twice, after that "
                f"of {newest} ns, and is left out, as all such: look for a second publisher, or a link that reorders"
            )

    def _relax_qos(self, _event: object) -> None:
        if self.is_best_effort:
            return
        self._node.destroy_subscription(self._subscription)
        if self._profile is topics.LATCHED_SENSOR:
            self._subscription = self._subscribe(topics.SENSOR)
            return
        self.is_best_effort = True
        self._node.get_logger().info(f"{self._topic} comes from a live driver (best effort): messages may be lost")
        self._subscription = self._subscribe(topics.LIVE_SENSOR)


# A laser that sends nothing for so long, while odometry comes, is silent: much longer than any sweep takes.
_SILENCE_TIMEOUT = 3.0  # s
# Who looks once a second was kept from it where the last time is this long ago.
_BUSY = 2.0  # s
# One clock where at least one of so many scans is that close to the newest reading: scans may wait longer than readings
# on their way, but not all of them.
_MAX_CLOCK_OFFSET = 5_000_000_000  # ns
_SCANS = 50


class SensorMonitor:
    """Follows the stamps of what comes from the sensors, and tells."""

    def __init__(self, diagnostics: NodeDiagnostics) -> None:
        """:param diagnostics: through which it tells."""
        self._diagnostics = diagnostics
        self._newest_stamps: dict[type, int] = {}
        self._last_scan_at = self._checked_at = time.monotonic()
        self._reading_count = 0
        self._is_silent = False
        self._clock_offset, self._compared_scans = math.inf, 0

    def reset(self) -> None:
        """What comes next may be of any time."""
        self._newest_stamps.clear()
        self._clock_offset, self._compared_scans = math.inf, 0

    def detect_backward_jump(self, measurement: Scan | Odometry) -> bool:
        """Take in a measurement; whether time went back with it, which is told."""
        kind, stamp = type(measurement), measurement.stamp
        newest = self._newest_stamps.get(kind, stamp)
        self._newest_stamps[kind] = max(stamp, newest)
        if kind is Scan:
            self._compare_clocks(stamp)
        if stamp > newest - MIN_BACKWARD_JUMP:
            return False
        self.reset()
        self._newest_stamps[kind] = stamp
        self._diagnostics.warn(
            f"time went back by {(newest - stamp) / 1e9:.1f} s, to {stamp} ns: the robot is taken for carried, and may "
            "be anywhere in the map; if this is another drive through a place that is new, call slam/reset"
        )
        return True

    def _compare_clocks(self, stamp: int) -> None:
        reading = self._newest_stamps.get(Odometry)
        if reading is None:
            return
        self._clock_offset = min(self._clock_offset, stamp - reading, key=abs)
        self._compared_scans += 1
        if self._compared_scans == _SCANS:
            if abs(self._clock_offset) > _MAX_CLOCK_OFFSET:
                self._diagnostics.warn(
                    f"scans are stamped {abs(self._clock_offset) / 1e9:.1f} s "
                    f"{'after' if self._clock_offset > 0 else 'before'} the odometry that comes with them: let both "
                    "computers have one clock (NTP, PTP), or correct the stamps; until then odometry does not help"
                )
            self._clock_offset, self._compared_scans = math.inf, 0

    def start(self) -> None:
        """Scans are listened to from now on."""
        self._last_scan_at = time.monotonic()

    def note_scan(self) -> None:
        """A scan has come."""
        now = time.monotonic()
        if self._is_silent:
            self._is_silent = False
            self._diagnostics.note(f"scans come again, after {now - self._last_scan_at:.1f} s")
        self._last_scan_at = now

    def check_silence(self, reading_count: int) -> None:
        """Once a second: tell of a laser that is silent.

        A node that was busy for long itself, as by compiling, has not heard yet what came meanwhile.

        :param reading_count: odometry readings that came so far.
        """
        now = time.monotonic()
        moving, self._reading_count = reading_count > self._reading_count, reading_count
        if now - self._checked_at > _BUSY and not self._is_silent:
            self._last_scan_at = now
        self._checked_at = now
        if moving and not self._is_silent and now - self._last_scan_at > _SILENCE_TIMEOUT:
            self._is_silent = True
            self._diagnostics.warn(
                f"no scan came for {_SILENCE_TIMEOUT:g} s, while odometry does: look at the laser, and at the name and "
                "the type of the topic scan; meanwhile the pose goes on by odometry"
            )
