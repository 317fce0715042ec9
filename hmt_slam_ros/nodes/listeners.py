"""The other processes as slam sees them through DDS: which of them still have a map that slam gave up."""

from __future__ import annotations

import time

from rclpy.node import Node

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes.topics import SAVE

# Until DDS tells that a subscription is gone.
_PATIENCE = 2.0  # s
_POLL = 0.02  # s


class Listeners:
    """Those that are asked for their part of a map; a node that is configured anew is another one."""

    def __init__(self, node: Node) -> None:
        """Nothing was given up yet."""
        self._node = node
        self._bereft: set[bytes] = set()

    def remember(self) -> None:
        """All that there are now have a map that is given up."""
        self._bereft = set(self._names())

    def check(self) -> None:
        """See whether a map can begin.

        :raises HmtSlamError: where others have what was given up.
        """
        deadline = time.monotonic() + _PATIENCE
        while left := self._bereft & self._names().keys():
            if time.monotonic() > deadline:
                names = sorted(self._names()[one] for one in left)
                raise HmtSlamError(
                    f"{', '.join(names)} still have the map that slam gave up: clean these up too, then configure slam"
                )
            time.sleep(_POLL)

    def _names(self) -> dict[bytes, str]:
        """{identity of a subscription: name of its node}."""
        there = self._node.get_subscriptions_info_by_topic(self._node.resolve_topic_name(SAVE))
        return {bytes(one.endpoint_gid): one.node_name for one in there}
