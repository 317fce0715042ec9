"""A subscription to a sensor that hears the robot node, which loses nothing, and live drivers, which may."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from hmt_slam_ros.nodes import qos


class SensorSubscription:
    """Begins reliable, and changes over to best effort when a publisher offers nothing better.

    :ivar live: whether it listens to a publisher that may lose messages.
    """

    def __init__(self, node: Node, kind: type, topic: str, hear: Callable[[Any], None]) -> None:
        self.live = False
        self._node, self._kind, self._topic, self._hear = node, kind, topic, hear
        self._subscription = self._subscribe(qos.SENSOR)

    def _subscribe(self, profile: QoSProfile) -> Any:  # noqa: ANN401  rclpy's subscription
        events = SubscriptionEventCallbacks(incompatible_qos=self._change_over)
        return self._node.create_subscription(self._kind, self._topic, self._hear, profile, event_callbacks=events)

    def _change_over(self, _event: object) -> None:
        if self.live:
            return
        self.live = True
        self._node.get_logger().info(f"{self._topic} comes from a live driver (best effort): messages may be lost")
        self._node.destroy_subscription(self._subscription)
        self._subscription = self._subscribe(qos.LIVE_SENSOR)
