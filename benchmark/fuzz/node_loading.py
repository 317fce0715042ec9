"""What the nodes do with a saved map, in one process and without ROS's network."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from hmt_slam_ros.cli.main import FAULT, main
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.messages import PoseReset, TrackingReset
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS
from hmt_slam_ros.process_table import COORDINATOR, PROCESSES
from hmt_slam_ros.results.log_reading import map_folder
from hmt_slam_ros.saved_map.folder import CONFIGURATION
from hmt_slam_ros.untrusted_input import one_sentence

LOAD_IN_NODES = "nodes"
"""Word that stands for `load_in_nodes` where others are subcommands of ``hmt_slam``."""


def run_arguments(arguments: Sequence[str]) -> int:
    """Run a subcommand of ``hmt_slam``, or load a map as nodes do."""
    if arguments[0] != LOAD_IN_NODES:
        return main(arguments)
    try:
        load_in_nodes(Path(arguments[1]))
    except HmtSlamError as fault:
        print(one_sentence(fault), file=sys.stderr)
        return FAULT
    return 0


def load_in_nodes(folder: Path) -> None:
    """Start all processes, the drawing of the map, the explorer and the pilot with a map.

    :raises HmtSlamError: where a node refuses the map.
    """
    from hmt_slam_ros.exploration.explorer import Explorer  # noqa: PLC0415  only here
    from hmt_slam_ros.exploration.pilot import PilotProcess  # noqa: PLC0415  only here
    from hmt_slam_ros.messages.replica import Replica  # noqa: PLC0415  only here
    from hmt_slam_ros.ros.initial_state import InitialState, locate_in_map  # noqa: PLC0415  rclpy is only for nodes
    from hmt_slam_ros.ros.map_view import MapRenderer, MapRendererState  # noqa: PLC0415  likewise

    node: Any = SimpleNamespace(
        configuration=load_configuration(map_folder(folder) / CONFIGURATION),
        get_logger=lambda: SimpleNamespace(warning=lambda _: None),
    )
    state = InitialState(node, str(folder), lost=True)
    processes = {
        row.name: row.make(node.configuration, state.read_part(row.name, row.state_class)) for row in PROCESSES
    }
    for name, process in processes.items():
        if TrackingReset in SUBSCRIPTIONS[name]:
            process.handle(TrackingReset(state.events, 0))
    document = state.map
    assert document is not None
    poses = {entry.area: entry for entry in document.area_poses}
    renderer = MapRenderer(node.configuration, "map", MapRendererState.from_document(document))
    renderer.occupancy_grid()
    renderer.graph_markers()
    renderer.path()
    renderer.topology(processes["tlca"].robot_poses)
    Explorer(node.configuration, Replica.from_state(document.replica))
    with contextlib.suppress(HmtSlamError):  # a small map has no places
        PilotProcess(node.configuration, document.replica)
    anywhere = PoseGaussian(np.zeros(3), np.diag([1e4, 1e4, 1.0]))
    initial_pose = locate_in_map(processes[COORDINATOR], poses, anywhere, node.configuration.tsbi.place_radius)
    processes[COORDINATOR].handle(PoseReset(initial_pose))
