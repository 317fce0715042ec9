"""A rosbag2 of everything that is published, as `ros2 bag record --all` makes it; PyPI does not have that."""

import time
from collections import Counter
from importlib import import_module

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import StoragePlugin, Writer

from hmt_slam_ros.logs.ros_types import typestore

LOOK = 0.2  # s


class Recording:
    """Subscribes to every topic as soon as it has a publisher, and keeps the bytes that come.

    :ivar counts: messages of each topic, {topic: count}; that they can be read by others is seen to as they come.
    :ivar offered: {topic: (type, profiles of the publishers)}.
    """

    def __init__(self, listener, folder):
        self.folder, self.counts, self.offered = folder, Counter(), {}
        self._node, self._subscriptions = listener.node, {}
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._timer = self._node.create_timer(LOOK, self._look)

    def _look(self):
        for topic, (kind, *others) in self._node.get_topic_names_and_types():
            offers = [end.qos_profile for end in self._node.get_publishers_info_by_topic(topic)]
            if topic not in self._subscriptions and offers:
                assert not others, topic
                self.offered[topic] = kind, offers
                self._subscriptions[topic] = self._subscribe(topic, kind, offers)

    def _subscribe(self, topic, kind, offers):
        connection = self._writer.add_connection(topic, kind, typestore=typestore())

        def keep(content):
            typestore().deserialize_cdr(content, kind)
            self._writer.write(connection, time.time_ns(), content)
            self.counts[topic] += 1

        package, _, name = kind.split("/")
        its_type = getattr(import_module(f"{package}.msg"), name)
        return self._node.create_subscription(its_type, topic, keep, what_all_offer(offers), raw=True)

    def close(self):
        """Record no more."""
        self._node.destroy_timer(self._timer)
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._writer.close()


def what_all_offer(offers):
    """The profile that rosbag2 requests."""
    reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
