"""The live page of a recorded run: the node ``view``, with the messages of a bag instead of those of other nodes."""

from __future__ import annotations

import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.bag_files import BagMessage, check_bag, read_messages, read_topics
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.documents import DocumentVersionError
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.view_node import PERIOD, ViewNode

_STEP = round(PERIOD * NANOSECONDS)
"""Bag time between two updates of the page, ns."""
_LONGEST_GAP = 60 * NANOSECONDS
"""Longest time without a message that is played, ns; then every node is silent, and more shows nothing else."""
_OWN_TOPICS = "/hmt/"
"""Part of the names of a run's topics after the namespace."""
_DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


class PageSettings(NamedTuple):
    """How a bag is shown.

    :ivar rate: speed relative to that of the recording, 0 for as fast as possible.
    :ivar port: TCP port of the page.
    """

    rate: float
    port: int


def view_bag(path: Path, namespace: str | None, settings: PageSettings) -> int:
    """Serve the page of a bag until SIGINT or SIGTERM.

    :param path: a bag folder, or a .mcap or .db3 file.
    :param namespace: of the run's nodes; None for the only one in the bag.
    :returns: exit status.
    :raises HmtSlamError: where the bag is damaged, or has no topics of such a run.
    """
    check_bag(path)
    topics = read_topics(path)
    own = choose_namespace(topics, namespace, path)
    # The node has messages of the bag alone: no other node finds it.
    os.environ[_DISCOVERY_RANGE] = "OFF"
    sys.argv = ["hmt_slam view"]
    return run(lambda: BagViewNode(path, topics, own, settings), BagViewNode.spin)


def choose_namespace(topics: Iterable[str], wanted: str | None, path: Path) -> str:
    """The namespace of the run that the page shows.

    :param topics: names of the topics of the bag.
    :param wanted: namespace that the user wants, None for the only one.
    :raises HmtSlamError: where the bag has no such run, or several to choose from.
    """
    found = sorted({topic.partition(_OWN_TOPICS)[0] or "/" for topic in topics if _OWN_TOPICS in topic})
    if not found:
        raise HmtSlamError(
            f"{path} has no topics of the nodes, such as /hmt/hypotheses: record the run with 'ros2 bag record --all'"
        )
    namespace = None if wanted is None else f"/{wanted.strip('/')}"
    if namespace in found:
        return namespace
    if namespace is None and len(found) == 1:
        return found[0]
    missing = f"no run in the namespace {namespace}" if namespace else f"runs in {len(found)} namespaces"
    raise HmtSlamError(f"{path} has {missing}: choose one by --namespace, of {', '.join(found)}")


def _type_name(message_class: type) -> str:
    """Name of a message type in a bag, such as std_msgs/msg/String."""
    return f"{message_class.__module__.partition('.')[0]}/msg/{message_class.__name__}"


class _BagSubscription(NamedTuple):
    """A subscription that the bag answers.

    :ivar topic: full name.
    :ivar take: called with the bytes of each message.
    """

    topic: str
    take: Callable[[bytes], None]


class BagViewNode(ViewNode):
    """The node of the page of a bag: its subscriptions get the messages of the bag, and its time is that of the bag."""

    def __init__(self, path: Path, topics: Mapping[str, str], namespace: str, settings: PageSettings) -> None:
        """Start the server.

        :param topics: {topic: message type} of the bag.
        :raises HmtSlamError: for an invalid port, or one that is taken.
        """
        self._path, self._bag_topics, self._rate = path, topics, settings.rate
        self._bag_subscriptions: defaultdict[str, list[_BagSubscription]] = defaultdict(list)
        self._newest: dict[str, bytes] = {}
        port = Parameter("port", value=settings.port)
        super().__init__("view", namespace=namespace, parameter_overrides=[port])

    def create_subscription(
        self,
        msg_type: type,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: QoSProfile,
        *_options: Any,  # noqa: ANN401  rclpy's
        **_named: Any,  # noqa: ANN401  rclpy's
    ) -> _BagSubscription:
        """As rclpy's, to a topic of the bag; what is latched comes at once."""

        def deserialize(content: bytes) -> None:
            callback(deserialize_message(content, msg_type))

        subscription = _BagSubscription(self.resolve_topic_name(topic), self.guard(topic, deserialize))
        if self._bag_topics.get(subscription.topic) != _type_name(msg_type):
            return subscription
        self._bag_subscriptions[subscription.topic].append(subscription)
        if qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL and subscription.topic in self._newest:
            subscription.take(self._newest[subscription.topic])
        return subscription

    def destroy_subscription(self, subscription: _BagSubscription) -> bool:
        """End a subscription to a topic of the bag; returns whether it got messages."""
        subscriptions = self._bag_subscriptions[subscription.topic]
        if got_messages := subscription in subscriptions:
            subscriptions.remove(subscription)
        return got_messages

    def spin(self) -> None:
        """Play the bag; then serve the page as it is at its end, until the node is to end."""
        begin = time.monotonic()
        now = 0
        for now, messages in batches(read_messages(self._path, self._bag_topics)):
            self._listening_time += PERIOD
            for message in messages:
                self._deliver(message)
            self._update_page_at(now, has_ended=False)
            if not self._wait_until(begin + (self._listening_time / self._rate if self._rate else 0.0)):
                return
        self.get_logger().info(f"{self._path} has ended, and the page stays as it is: end it by Ctrl-C")
        while rclpy.ok():
            self._update_page_at(now, has_ended=True)
            self._wait_until(time.monotonic() + PERIOD)

    def _update_page_at(self, bag_time: int, *, has_ended: bool) -> None:
        """Show what came until a bag time, ns."""
        self.update_page(bag_time / NANOSECONDS)
        recording = {"bag": self._path.name, "time": bag_time // NANOSECONDS, "ended": has_ended}
        self.board.put("recording", recording)

    def _deliver(self, message: BagMessage) -> None:
        self._newest[message.topic] = message.content
        for subscription in tuple(self._bag_subscriptions[message.topic]):
            subscription.take(message.content)

    def _wait_until(self, due: float) -> bool:
        """Wait until a time of the monotonic clock, s; returns whether the node is to go on."""
        while (left := due - time.monotonic()) > 0.0 and rclpy.ok():
            time.sleep(min(left, PERIOD))
        return bool(rclpy.ok())

    def _refuse(self, name: str, fault: Exception, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401  a response
        """As that of a running system; but a bag of another version ends the node.

        :raises HmtSlamError: where the first message of a topic is of another version.
        """
        if isinstance(fault, DocumentVersionError) and self.diagnostics.received[name] == 1:
            raise HmtSlamError(
                f"{self._path} is of another version of hmt_slam_ros, {fault.difference}: look at it with the version "
                "that recorded it"
            ) from fault
        return super()._refuse(name, fault, arguments)


def batches(messages: Iterable[BagMessage]) -> Iterator[tuple[int, list[BagMessage]]]:
    """The messages of each step of bag time with the end of the step, ns.

    A longer time without messages is shortened to 60 s.
    """
    batch: list[BagMessage] = []
    end = None
    for message in messages:
        if end is None:
            end = message.bag_time + _STEP
        while message.bag_time >= end:
            yield end, batch
            batch, end = [], max(end + _STEP, message.bag_time - _LONGEST_GAP)
        batch.append(message)
    if end is not None:
        yield end, batch
