"""Run a node by its name: ``python -m hmt_slam_ros.ros.run_node slam``."""

from __future__ import annotations

import sys
from pathlib import Path

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.process_table import node_names, node_row, resolve_class
from hmt_slam_ros.ros.execution import FAULT, run

_PREFIX = "hmt_slam_"  # of console scripts


def run_node(name: str) -> None:
    """Run the node ``name`` of the process table, and exit.

    :raises HmtSlamError: where there is no such node.
    """
    if name not in node_names():
        raise HmtSlamError(f"there is no node {name!r}: give one of {', '.join(node_names())}")
    node_class = resolve_class(node_row(name).node_class)
    sys.exit(run(lambda: node_class(name), node_class.spin))


def main() -> None:
    """Run the node that the first argument names, or the name of the program."""
    program = Path(sys.argv[0]).name.removeprefix(_PREFIX)
    name = sys.argv[1] if sys.argv[1:] and program not in node_names() else program
    try:
        run_node(name)
    except HmtSlamError as fault:
        print(fault, file=sys.stderr)
        sys.exit(FAULT)


if __name__ == "__main__":
    main()
