"""Run a node by its name, or all processes: ``python -m hmt_slam_ros.ros.run_node slam``."""

from __future__ import annotations

import sys
from pathlib import Path

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.process_table import ALL, node_row, program_names, resolve_class
from hmt_slam_ros.ros.child_processes import FAULT
from hmt_slam_ros.ros.run_all import run_all

_PREFIX = "hmt_slam_"  # of console scripts


def run_node(name: str) -> None:
    """Run the node ``name`` of the process table, or all processes, and exit.

    :raises HmtSlamError: where there is no such node.
    """
    if name not in program_names():
        raise HmtSlamError(f"there is no node {name!r}: give one of {', '.join(program_names())}")
    if name == ALL:
        sys.exit(run_all())
    from hmt_slam_ros.ros.execution import run  # noqa: PLC0415  a program that forks nodes does not load rclpy

    node_class = resolve_class(node_row(name).node_class)
    sys.exit(run(lambda: node_class(name), node_class.spin))


def main() -> None:
    """Run the node that the first argument names, or the name of the program."""
    program = Path(sys.argv[0]).name.removeprefix(_PREFIX)
    name = sys.argv[1] if sys.argv[1:] and program not in program_names() else program
    try:
        run_node(name)
    except HmtSlamError as fault:
        print(fault, file=sys.stderr)
        sys.exit(FAULT)


if __name__ == "__main__":
    main()
