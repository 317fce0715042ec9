"""How a node begins and ends: status 0 when told to stop, one sentence and status 2 for a fault, never a traceback."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import TypeVar

import rclpy
from rclpy.exceptions import NotInitializedException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes.departure import end_within

# Names the process that started this one, which ends when that one does.
PARENT_VARIABLE = "HMT_SLAM_PARENT"

FAULT = 2
_PR_SET_PDEATHSIG = 1
# How long what is being done may take to end, such as the compilation of a kernel, before it is broken off.
_GRACE = 8.0  # s
# How long taking leave of the other nodes may take.
_DEPARTURE = 2.0  # s
# Between two looks whether a node is at its end for another reason than a signal.
_POLL = 0.05  # s
# What calls of rclpy raise whose context is gone; the last two where they find None in its place.
_CONTEXT_LOST = (
    NotInitializedException,
    rclpy_implementation.InvalidHandle,
    rclpy_implementation.RCLError,
    AttributeError,
    TypeError,
)

NodeType = TypeVar("NodeType", bound=Node)


def run(make: Callable[[], NodeType], spin: Callable[[NodeType], None]) -> int:
    """Make a node, spin it until SIGINT or SIGTERM, and take it down.

    :param make: makes the node, and imports what takes time.
    :param spin: returns when the node has nothing more to do.
    :returns: exit status.
    """
    stop = _Stop()
    nodes: list[NodeType] = []
    try:
        status = _live(make, spin, stop, nodes)
        end_within(_DEPARTURE, status)
    finally:
        _ignore_signals()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return status


def spin_until(node: Node, over: Callable[[], bool] | None = None) -> None:
    """Spin a node until SIGINT or SIGTERM, or until it is at its end.

    By an executor of its own: ``rclpy.spin`` shares one, and fails where the signal comes before it has it.

    :param over: whether it is at its end, asked 20 times a second.
    """
    if not rclpy.ok():
        return
    executor = SingleThreadedExecutor()
    try:
        executor.add_node(node)
        while rclpy.ok() and not (over and over()):
            executor.spin_once(timeout_sec=_POLL if over else None)
    finally:
        executor.shutdown()


def _live(make: Callable[[], NodeType], spin: Callable[[NodeType], None], stop: _Stop, nodes: list[NodeType]) -> int:
    """Make a node, which is also put into ``nodes``, and spin it; return the exit status."""
    try:
        _end_with_parent()
        rclpy.init()
        try:
            if not stop.told:
                nodes.append(make())
                if rclpy.ok():
                    spin(nodes[0])
        except _CONTEXT_LOST:
            # rclpy's own handler takes the context away at any moment, also from under a node that is being made.
            if rclpy.ok():
                raise
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except HmtSlamError as error:
        # With the error goes what is there of a node that could not be made, and with it its participant.
        end_within(_DEPARTURE, FAULT)
        print(f"{sys.argv[0].rsplit('/', 1)[-1]}: {error}", file=sys.stderr, flush=True)
        return FAULT
    return 0


class _Stop:
    """Takes note of SIGINT and SIGTERM; rclpy's own handler shuts the context down, and spinning ends.

    Nothing is raised: an exception would come up at any line, also inside of a compiler, which cannot bear it. A thread
    waits for the signal, since Python's handlers run between two lines of the main thread only: a signal that another
    thread gets, or that comes right before a long call of C, would be taken note of after that call.
    """

    def __init__(self) -> None:
        self.told = False
        self._come, told = os.pipe()
        os.set_blocking(told, False)
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._take_note)
        threading.Thread(target=self._end_in_time, daemon=True).start()

    def _take_note(self, _number: int, _frame: object) -> None:
        self.told = True

    def _end_in_time(self) -> None:
        os.read(self._come, 1)
        end_within(_GRACE, 0)


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
