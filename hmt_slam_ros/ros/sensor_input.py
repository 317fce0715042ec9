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
from hmt_slam_ros.ros.conversions import stamp_of
from hmt_slam_ros.ros.diagnostics import Figures
from hmt_slam_ros.sensors import Odometry, Scan

Message = TypeVar("Message")

BACK = 1_000_000_000
"""A bag that begins again, or a clock that is set, goes back by more than messages of one source are late, ns."""


class StampOrder(Generic[Message]):
    """Lets messages through in the order of their stamps.

    :ivar newest: stamp of the last one that was let through, ns, None where the next one may be of any time.
    :ivar refused: how many came late or twice.
    :ivar last_refused: stamp of the last such one, ns, None before the first.
    """

    def __init__(self, newest: int | None = None) -> None:
        """:param newest: stamp of the last one before, ns, None where there was none."""
        self.newest, self.refused = newest, 0
        self.last_refused: int | None = None
        self._doubtful: tuple[int, Message] | None = None

    def forget(self) -> None:
        """What comes next may be of any time."""
        self.newest = self._doubtful = None

    def arrive(self, stamp: int, message: Message) -> list[Message]:
        """What is let through now: mostly the message.

        Where one is stamped long before the newest, either it came very late or time went back; it waits for the next
        one, which tells.
        """
        newest, doubtful = self.newest, self._doubtful
        due = [message]
        if newest is not None and stamp <= newest:
            if stamp > newest - BACK:
                self._refuse(stamp)
                return []
            due = []
            if doubtful is not None and stamp > doubtful[0]:
                due, doubtful = [doubtful[1], message], None
        if doubtful is not None:
            self._refuse(doubtful[0])
        self._doubtful = None if due else (stamp, message)
        self.newest = stamp if due else newest
        return due

    def _refuse(self, stamp: int) -> None:
        self.refused, self.last_refused = self.refused + 1, stamp


# Within this time a robot node has sent again what was missed.
_PAST = 10.0  # s


class SensorSubscription:
    """Begins reliable, and changes over to best effort when a publisher offers nothing better.

    Messages that come late or twice are left out; /diagnostics counts them.

    :ivar live: whether it listens to a publisher that may lose messages.
    """

    def __init__(
        self,
        node: Node,
        figures: Figures,
        kind: type,
        topic: str,
        hear: Callable[[Any], None],
        after: int | None = None,
    ) -> None:
        """Listen to nothing yet.

        :param figures: through which it tells.
        :param after: stamp of the last message that was heard before, ns, where what was missed since is wanted, from a
            publisher that kept it.
        """
        self.live = False
        self._node, self._kind, self._topic, self._hear = node, kind, topic, hear
        self._last = self._after = after
        self._begin = time.monotonic()
        self._figures, self._order = figures, StampOrder[Any](after)
        self._subscription: Any = None

    def begin(self) -> None:
        """Listen; what was missed since :meth:`end` comes first, where the publisher kept it."""
        self._after, self._begin = self._last, time.monotonic()
        wanted = topics.SENSOR if self._after is None else topics.KEPT_SENSOR
        self._subscription = self._subscribe(topics.LIVE_SENSOR if self.live else wanted)

    def end(self) -> None:
        """Listen no more."""
        self._node.destroy_subscription(self._subscription)

    def _subscribe(self, profile: QoSProfile) -> Any:  # noqa: ANN401  rclpy's subscription
        self._profile = profile
        events = SubscriptionEventCallbacks(incompatible_qos=self._change_over)
        return self._node.create_subscription(self._kind, self._topic, self._hear_new, profile, event_callbacks=events)

    def _hear_new(self, message: Any) -> None:  # noqa: ANN401  a ROS message with a header
        stamp = stamp_of(message.header.stamp)
        if self._after is not None:
            if stamp <= self._after and time.monotonic() - self._begin < _PAST:
                return
            if self._profile is not topics.KEPT_SENSOR:
                self._node.get_logger().warning(
                    f"what came on {self._topic} between the stamps {self._after} and {stamp} ns, "
                    f"{(stamp - self._after) / 1e9:.1f} s, is lost: the node did not listen"
                )
            self._after = None
        newest, refused = self._order.newest, self._order.refused
        for due in self._order.arrive(stamp, message):
            self._last = stamp
            self._hear(due)
        if self._order.refused > refused:
            self._tell_of_refused(newest)

    def forget(self) -> None:
        """What comes next may be of any time."""
        self._order.forget()

    def _tell_of_refused(self, newest: int | None) -> None:
        order = self._order
        self._figures.state[f"refused on {self._topic}"] = order.refused
        if order.refused == 1:
            self._figures.warn(
                f"on {self._topic} the message of stamp {order.last_refused} ns came late or twice, after that of "
                f"{newest} ns, and is left out, as all such: look for a second publisher, or a link that reorders"
            )

    def _change_over(self, _event: object) -> None:
        if self.live:
            return
        self._node.destroy_subscription(self._subscription)
        if self._profile is topics.KEPT_SENSOR:
            self._subscription = self._subscribe(topics.SENSOR)
            return
        self.live = True
        self._node.get_logger().info(f"{self._topic} comes from a live driver (best effort): messages may be lost")
        self._subscription = self._subscribe(topics.LIVE_SENSOR)


# A laser that sends nothing for so long, while odometry comes, is silent: much longer than any sweep takes.
_SILENCE = 3.0  # s
# Who looks once a second was kept from it where the last time is this long ago.
_BUSY = 2.0  # s
# One clock where at least one of so many scans is that close to the newest reading: scans may wait longer than readings
# on their way, but not all of them.
_TOGETHER = 5_000_000_000  # ns
_SCANS = 50


class SensorWatch:
    """Follows the stamps of what comes from the sensors, and tells."""

    def __init__(self, figures: Figures) -> None:
        """:param figures: through which it tells."""
        self._figures = figures
        self._newest: dict[type, int] = {}
        self._last_scan = self._looked = time.monotonic()
        self._readings = 0
        self._silent = False
        self._apart, self._scans = math.inf, 0

    def forget(self) -> None:
        """What comes next may be of any time."""
        self._newest.clear()
        self._apart, self._scans = math.inf, 0

    def is_back(self, measurement: Scan | Odometry) -> bool:
        """Take in a measurement; whether time went back with it, which is told."""
        kind, stamp = type(measurement), measurement.stamp
        newest = self._newest.get(kind, stamp)
        self._newest[kind] = max(stamp, newest)
        if kind is Scan:
            self._compare(stamp)
        if stamp > newest - BACK:
            return False
        self.forget()
        self._newest[kind] = stamp
        self._figures.warn(
            f"time went back by {(newest - stamp) / 1e9:.1f} s, to {stamp} ns: the robot is taken for carried, and may "
            "be anywhere in the map; if this is another drive through a place that is new, call slam/reset"
        )
        return True

    def _compare(self, stamp: int) -> None:
        reading = self._newest.get(Odometry)
        if reading is None:
            return
        self._apart = min(self._apart, stamp - reading, key=abs)
        self._scans += 1
        if self._scans == _SCANS:
            if abs(self._apart) > _TOGETHER:
                self._figures.warn(
                    f"scans are stamped {abs(self._apart) / 1e9:.1f} s {'after' if self._apart > 0 else 'before'} the "
                    "odometry that comes with them: let both computers have one clock (NTP, PTP), or correct the "
                    "stamps; until then odometry does not help"
                )
            self._apart, self._scans = math.inf, 0

    def begin(self) -> None:
        """Scans are listened to from now on."""
        self._last_scan = time.monotonic()

    def hear_scan(self) -> None:
        """A scan has come."""
        now = time.monotonic()
        if self._silent:
            self._silent = False
            self._figures.note(f"scans come again, after {now - self._last_scan:.1f} s")
        self._last_scan = now

    def look(self, readings: int) -> None:
        """Once a second: tell of a laser that is silent.

        A node that was busy for long itself, as by compiling, has not heard yet what came meanwhile.

        :param readings: odometry readings that came so far.
        """
        now = time.monotonic()
        moving, self._readings = readings > self._readings, readings
        if now - self._looked > _BUSY and not self._silent:
            self._last_scan = now
        self._looked = now
        if moving and not self._silent and now - self._last_scan > _SILENCE:
            self._silent = True
            self._figures.warn(
                f"no scan came for {_SILENCE:g} s, while odometry does: look at the laser, and at the name and the "
                "type of the topic scan; meanwhile the pose goes on by odometry"
            )
