"""The node ``tsbi`` that takes a second more for each keyframe event: ``python -m benchmark.slow_topology``."""

from __future__ import annotations

import sys
import time

from hmt_slam_ros.messages.messages import Keyframe, Message
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.publishing_nodes import TsbiNode

DELAY = 1.0
"""Time that an event takes more, s."""


class SlowTsbiNode(TsbiNode):
    """The node ``tsbi`` on a slow computer."""

    def deliver(self, message: Message) -> None:
        """As the node, a second later for a keyframe."""
        if isinstance(message, Keyframe):
            time.sleep(DELAY)
        super().deliver(message)


if __name__ == "__main__":
    sys.exit(run(lambda: SlowTsbiNode("tsbi"), SlowTsbiNode.spin))
