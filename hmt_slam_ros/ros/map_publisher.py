"""Publisher of the whole map in some form, which is made after changes, for subscribers, within a share of a core."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

from rclpy.node import Node

from hmt_slam_ros.ros import topics

MAX_SHARE = 0.05
"""Share of a core that each topic takes at most: the larger a map, the longer the time between two messages."""
_NOTHING_PUBLISHED = -1


class Versioned(Protocol):
    """A map that changes."""

    @property
    def version(self) -> int:
        """A number that grows with every change, from 0 of an empty map on."""


MapT = TypeVar("MapT", bound=Versioned)


class MapPublisher(Generic[MapT]):
    """Publishes a map on a latched topic."""

    def __init__(self, node: Node, kind: type, topic: str, make: Callable[[MapT], Any], period: float) -> None:
        """Make the publisher.

        :param kind: ROS type of the topic.
        :param make: returns the message of a map, or its bytes; None where there is none, or that of before holds.
        :param period: least time between two messages, s.
        """
        self._publisher = node.create_publisher(kind, topic, topics.LATCHED)
        self._make, self._period = make, period
        self._published_version, self._next_at = 0, 0.0

    def publish_if_due(self, source: MapT) -> None:
        """Publish the map where it changed, there are subscribers, and it is time."""
        now, is_changed = time.monotonic(), source.version != self._published_version
        if not is_changed or now < self._next_at or not self._publisher.get_subscription_count():
            return
        begin = time.thread_time()
        message = self._make(source)
        if message is not None:
            self._publisher.publish(message)
        self._published_version = source.version
        self._next_at = now + max(self._period, (time.thread_time() - begin) / MAX_SHARE)

    def invalidate(self) -> None:
        """Publish the map next time, also an empty one."""
        self._published_version, self._next_at = _NOTHING_PUBLISHED, 0.0
