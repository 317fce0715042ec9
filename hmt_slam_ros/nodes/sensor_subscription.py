"""A subscription to a sensor that hears the robot node, which loses nothing, and live drivers, which may."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from hmt_slam_ros.nodes import qos
from hmt_slam_ros.nodes.conversions import stamp_of
from hmt_slam_ros.nodes.figures import Figures
from hmt_slam_ros.nodes.stamp_order import StampOrder

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
        wanted = qos.SENSOR if self._after is None else qos.KEPT_SENSOR
        self._subscription = self._subscribe(qos.LIVE_SENSOR if self.live else wanted)

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
            if self._profile is not qos.KEPT_SENSOR:
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
        if self._profile is qos.KEPT_SENSOR:
            self._subscription = self._subscribe(qos.SENSOR)
            return
        self.live = True
        self._node.get_logger().info(f"{self._topic} comes from a live driver (best effort): messages may be lost")
        self._subscription = self._subscribe(qos.LIVE_SENSOR)
