"""How a node begins and ends: status 0 when told to stop, one sentence and status 2 for a fault, never a traceback."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from typing import TypeVar

import rclpy
from rclpy.exceptions import NotInitializedException
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from hmt_slam_ros.errors import HmtSlamError

# Names the process that started this one, which ends when that one does.
PARENT_VARIABLE = "HMT_SLAM_PARENT"

FAULT = 2
_PR_SET_PDEATHSIG = 1
_CONTEXT_LOST = (NotInitializedException, rclpy_implementation.InvalidHandle, rclpy_implementation.RCLError)

NodeType = TypeVar("NodeType", bound=Node)


def run(make: Callable[[], NodeType], spin: Callable[[NodeType], None] = rclpy.spin) -> int:
    """Make a node, spin it until SIGINT or SIGTERM, and take it down.

    :param make: makes the node, and imports what takes time.
    :param spin: returns when the node has nothing more to do.
    :returns: exit status.
    """
    # From here to rclpy's own handlers, and while a node is made, a signal ends the program just as well.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    try:
        _end_with_parent()
        rclpy.init()
        try:
            _live(make, spin)
        except _CONTEXT_LOST:
            # rclpy's own handler takes the context away at any moment, also from under a node that is being made.
            if rclpy.ok():
                raise
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except HmtSlamError as error:
        print(f"{sys.argv[0].rsplit('/', 1)[-1]}: {error}", file=sys.stderr, flush=True)
        return FAULT
    finally:
        _ignore_signals()
        rclpy.try_shutdown()
    return 0


def _live(make: Callable[[], NodeType], spin: Callable[[NodeType], None]) -> None:
    node = make()
    try:
        if rclpy.ok():
            spin(node)
    finally:
        _ignore_signals()
        node.destroy_node()


def _stop(_number: int, _frame: object) -> None:
    raise KeyboardInterrupt


def _ignore_signals() -> None:
    """A second Ctrl-C does not disturb the clean-up."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _end_with_parent() -> None:
    """Where another program started this node as its helper, see to it that the node does not outlive it."""
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        raise KeyboardInterrupt
