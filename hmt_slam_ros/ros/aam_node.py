"""Area abstraction as a node."""

from __future__ import annotations

import sys

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.messages import AreaEvents
from hmt_slam_ros.messages.routing import Checkpointable
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.initial_state import InitialState
from hmt_slam_ros.ros.map_services import spin
from hmt_slam_ros.ros.process_node import ProcessNode


def make_node() -> ProcessNode:
    """The node ``aam``."""
    return ProcessNode("aam", _make_process, (AreaEvents,))


def _make_process(configuration: Configuration, beginning: InitialState) -> Checkpointable:
    # It takes time, in which a signal has to be heard.
    from hmt_slam_ros import composition  # noqa: PLC0415
    from hmt_slam_ros.area_abstraction.partition import AamState  # noqa: PLC0415

    return composition.area_abstraction(configuration, beginning.read_part("aam", AamState))


def main() -> None:
    """Run the node."""
    sys.exit(run(make_node, spin))


if __name__ == "__main__":
    main()
