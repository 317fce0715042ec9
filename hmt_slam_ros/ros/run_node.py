"""Run a node by its name; a process that needs no node of its own runs in a plain process node."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.process_table import node_names, node_row
from hmt_slam_ros.ros.execution import FAULT, run

_PREFIX = "hmt_slam_"  # of console scripts


def run_node(name: str) -> None:
    """Run the node ``name`` of the process table, and exit.

    :raises HmtSlamError: where there is no such node.
    """
    if name not in node_names():
        raise HmtSlamError(f"there is no node {name!r}: give one of {', '.join(node_names())}")
    module = node_row(name).node_module
    if module:
        import_module(module).main()
    else:
        _run_plain_node(name)


def _run_plain_node(name: str) -> None:
    from hmt_slam_ros.ros.map_services import spin  # noqa: PLC0415  other nodes do not need it
    from hmt_slam_ros.ros.process_node import ProcessNode  # noqa: PLC0415

    sys.exit(run(lambda: ProcessNode(name), spin))


def main() -> None:
    """Run the node that the first argument names, else the name of the program."""
    program = Path(sys.argv[0]).name.removeprefix(_PREFIX)
    name = sys.argv[1] if sys.argv[1:] and program not in node_names() else program
    try:
        run_node(name)
    except HmtSlamError as fault:
        print(fault, file=sys.stderr)
        sys.exit(FAULT)


if __name__ == "__main__":
    main()
