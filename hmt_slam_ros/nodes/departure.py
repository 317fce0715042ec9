"""How to leave a ROS domain without hanging, which the middleware does not grant.

Fast DDS 2.14 may never come back from the destruction of a participant while others leave: the call
``DomainParticipant::set_listener`` polls a mutex without end, and the thread that it waits for never gets it. rclpy
calls it with the interpreter locked, so that no Python thread can help; a timer of the operating system can.
"""

from __future__ import annotations

import ctypes
import sys
import time

from rclpy.node import Node

_SIGEV_THREAD = 2
_CLOCK_MONOTONIC = 1
# From the disappearance of another node's name until all its topics are gone as well.
_AFTERMATH = 0.1  # s
_POLL = 0.01  # s


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


def end_within(seconds: float, status: int) -> None:
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


def await_departures(node: Node, seconds: float) -> None:
    """Wait until nobody else is there, so that the node can be destroyed safely.

    :param seconds: at most, for those that were killed and did not say goodbye.
    """
    deadline = time.monotonic() + seconds
    while len(node.get_node_names()) > 1 and time.monotonic() < deadline:
        time.sleep(_POLL)
    time.sleep(_AFTERMATH)
