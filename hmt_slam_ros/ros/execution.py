"""How a node begins and ends: status 0 when told to stop, one sentence and status 2 for a fault, never a traceback.

Fast DDS 2.14 may never come back from the destruction of a participant while others leave: the call
``DomainParticipant::set_listener`` polls a mutex without end, and the thread that it waits for never gets it. rclpy
calls it with the interpreter locked, so that no Python thread can help; a timer of the operating system can.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import rclpy
from rclpy.exceptions import NotInitializedException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from hmt_slam_ros.errors import HmtSlamError

_SIGEV_THREAD = 2
_CLOCK_MONOTONIC = 1
# From the disappearance of another node's name until all its topics are gone as well.
_AFTERMATH = 0.1  # s
_SHUTDOWN_POLL = 0.01  # s


class _SignalEvent(ctypes.Structure):
    """``struct sigevent`` of Linux with SIGEV_THREAD."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("number", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("padding", ctypes.c_byte * 32),
    )


class _TimerSpecification(ctypes.Structure):
    """``struct itimerspec``."""

    _fields_ = (
        ("interval_seconds", ctypes.c_long),
        ("interval_nanoseconds", ctypes.c_long),
        ("seconds", ctypes.c_long),
        ("nanoseconds", ctypes.c_long),
    )


def force_exit_after(seconds: float, status: int) -> None:
    """Let the system end this process if it is still there then; on systems other than Linux, do nothing.

    :param seconds: from now, above 0.
    :param status: exit status of the process in that case.
    """
    if not sys.platform.startswith("linux"):
        return
    library = ctypes.CDLL(None, use_errno=True)
    end = ctypes.cast(library._exit, ctypes.c_void_p)
    event = _SignalEvent(value=status, notify=_SIGEV_THREAD, function=end)
    timer = ctypes.c_void_p()
    if library.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
        raise OSError(ctypes.get_errno(), "timer_create")
    whole = int(seconds)
    due = _TimerSpecification(seconds=whole, nanoseconds=int(1e9 * (seconds - whole)))
    if library.timer_settime(timer, 0, ctypes.byref(due), None):
        raise OSError(ctypes.get_errno(), "timer_settime")


def wait_until_alone(node: Node, seconds: float) -> None:
    """Wait until nobody else is there, so that the node can be destroyed safely.

    :param seconds: at most, for those that were killed and did not say goodbye.
    """
    deadline = time.monotonic() + seconds
    while len(node.get_node_names()) > 1 and time.monotonic() < deadline:
        time.sleep(_SHUTDOWN_POLL)
    time.sleep(_AFTERMATH)


# The least of those of real time: any other program that asks for it comes before.
_PRIORITY = 1


def set_realtime_priority() -> bool:
    """Let all threads of this process run before ordinary ones whenever they have something to do (SCHED_RR).

    :returns: whether the system permits that, as it does to root and to those with an ``rtprio`` limit.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(_PRIORITY))
    except PermissionError:
        return False
    return True


# Names the process that started this one, which ends when that one does.
PARENT_VARIABLE = "HMT_SLAM_PARENT"

FAULT = 2
_PR_SET_PDEATHSIG = 1
# How long what is being done may take to end, such as the compilation of a kernel, before it is broken off.
_GRACE_PERIOD = 8.0  # s
# How long taking leave of the other nodes may take.
_SHUTDOWN_TIMEOUT = 2.0  # s
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
    stop = _SignalListener()
    nodes: list[NodeType] = []
    try:
        status = _run_node(make, spin, stop, nodes)
        force_exit_after(_SHUTDOWN_TIMEOUT, status)
    finally:
        _ignore_signals()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return status


def spin_until(node: Node, is_done: Callable[[], bool] | None = None) -> None:
    """Spin a node until SIGINT or SIGTERM, or until it is at its end.

    By an executor of its own: ``rclpy.spin`` shares one, and fails where the signal comes before it has it.

    :param is_done: whether it is at its end, asked 20 times a second.
    """
    if not rclpy.ok():
        return
    executor = SingleThreadedExecutor()
    try:
        executor.add_node(node)
        while rclpy.ok() and not (is_done and is_done()):
            executor.spin_once(timeout_sec=_POLL if is_done else None)
    finally:
        executor.shutdown()


def _run_node(
    make: Callable[[], NodeType], spin: Callable[[NodeType], None], stop: _SignalListener, nodes: list[NodeType]
) -> int:
    """Make a node, which is also put into ``nodes``, and spin it; return the exit status."""
    try:
        _exit_with_parent()
        rclpy.init()
        try:
            if not stop.received:
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
        force_exit_after(_SHUTDOWN_TIMEOUT, FAULT)
        print(f"{sys.argv[0].rsplit('/', 1)[-1]}: {error}", file=sys.stderr, flush=True)
        return FAULT
    return 0


class _SignalListener:
    """Takes note of SIGINT and SIGTERM; rclpy's own handler shuts the context down, and spinning ends.

    Nothing is raised: an exception would come up at any line, also inside of a compiler, which cannot bear it. A thread
    waits for the signal, since Python's handlers run between two lines of the main thread only: a signal that another
    thread gets, or that comes right before a long call of C, would be taken note of after that call.
    """

    def __init__(self) -> None:
        self.received = False
        self._wakeup_fd, told = os.pipe()
        os.set_blocking(told, False)
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        threading.Thread(target=self._exit_after_signal, daemon=True).start()

    def _on_signal(self, _number: int, _frame: object) -> None:
        self.received = True

    def _exit_after_signal(self) -> None:
        os.read(self._wakeup_fd, 1)
        force_exit_after(_GRACE_PERIOD, 0)


def _ignore_signals() -> None:
    """A second Ctrl-C does not disturb the clean-up."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _exit_with_parent() -> None:
    """Where another program started this node as its helper, see to it that the node does not outlive it."""
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        raise KeyboardInterrupt
