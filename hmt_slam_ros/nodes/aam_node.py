"""Area abstraction as a node."""

from __future__ import annotations

import sys

from hmt_slam_ros.nodes.process_node import ProcessNode
from hmt_slam_ros.nodes.running import run
from hmt_slam_ros.processes.messages import AreaEvents


def make() -> ProcessNode:
    """The node ``aam``."""
    from hmt_slam_ros.processes.aam import Aam  # noqa: PLC0415  takes time, in which a signal has to be heard

    return ProcessNode("aam", Aam, (AreaEvents,))


def main() -> None:
    """Run the node."""
    sys.exit(run(make))


if __name__ == "__main__":
    main()
