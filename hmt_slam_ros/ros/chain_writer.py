"""Writer of a chain topic: a bounded history, of which a reader that is there loses nothing."""

from __future__ import annotations

from typing import Any

from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile

RCLError = rclpy_implementation.RCLError

_NO_TIME, _POLL = Duration(), Duration(seconds=0.1)


class ChainWriter:
    """Publisher whose history keeps the last messages for late readers.

    DDS overwrites the oldest message of a full history, even if a reader has not acknowledged it. Therefore the writer
    counts the messages since all were acknowledged, and waits before the history is full of others.
    """

    def __init__(self, node: Node, kind: type[Any], topic: str, profile: QoSProfile) -> None:
        """Make the publisher.

        :param kind: type of its ROS messages.
        :param profile: keeps the last messages, and is reliable.
        """
        self._context = node.context
        self._publisher = node.create_publisher(kind, topic, profile)
        self._depth, self._unacknowledged = profile.depth, 0

    def publish(self, message: Any) -> None:  # noqa: ANN401  any ROS message
        """Publish; where a reader lags by the whole history, wait until it has caught up or is gone.

        :raises ExternalShutdownException: where the node is to shut down meanwhile.
        """
        while not self._has_room():
            _check_running(self._context)
        publish_reliably(self._publisher, message, self._context)
        self._unacknowledged += 1

    def _has_room(self) -> bool:
        """Whether the history can lose its oldest message; where it cannot, some time is waited for readers."""
        is_full = self._unacknowledged == self._depth
        is_half_full = 2 * self._unacknowledged >= self._depth
        if is_half_full and self._publisher.wait_for_all_acked(_POLL if is_full else _NO_TIME):
            self._unacknowledged = 0
        return self._unacknowledged < self._depth


def publish_reliably(publisher: Any, message: Any, context: Context) -> None:  # noqa: ANN401  any ROS message
    """Publish; where a reader of a topic that keeps all lags by a whole history, wait for it.

    :param context: of the node.
    :raises ExternalShutdownException: where the node is to shut down meanwhile.
    """
    while True:
        try:
            publisher.publish(message)
        except RCLError:
            # DDS itself waits 0.1 s for room.
            _check_running(context)
        else:
            return


def _check_running(context: Context) -> None:
    """Check that a node is not to shut down.

    :raises ExternalShutdownException: where it is.
    """
    if not context.ok():
        raise ExternalShutdownException from None
