"""Start and end of a node: exit status 0 after a signal, one sentence and another status for a fault, no traceback.

Fast DDS 2.14 may hang in the destruction of a participant while others leave: ``DomainParticipant::set_listener``
waits for a mutex that is never released. rclpy calls it with the interpreter locked, so no Python thread can help. A
timer of the operating system can.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import rclpy
from rclpy.exceptions import NotInitializedException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from hmt_slam_ros.errors import EarlierSystemError, HmtSlamError
from hmt_slam_ros.ros.child_processes import EARLIER_SYSTEM, FAULT, PARENT_VARIABLE

_SIGEV_THREAD = 2  # <signal.h>
_CLOCK_MONOTONIC = 1  # <time.h>
_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>
_REALTIME_PRIORITY = 1
"""The lowest real-time priority, so that any other real-time program comes first."""
_GRACE_PERIOD = 8.0
"""Time from a signal to a forced exit, s; a kernel may be compiled meanwhile."""
_SHUTDOWN_TIMEOUT = 2.0
"""Time for the destruction of a node, s."""
_TOPICS_TIMEOUT = 0.1
"""Time from the end of another node until all its topics are gone, s."""
_SHUTDOWN_POLL = 0.01  # s
_POLL = 0.05  # s
# What rclpy raises where the context is gone; the last two where it finds None instead.
_CONTEXT_LOST = (
    NotInitializedException,
    rclpy_implementation.InvalidHandle,
    rclpy_implementation.RCLError,
    AttributeError,
    TypeError,
)

NodeType = TypeVar("NodeType", bound=Node)


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
    """Let the operating system end this process after some time; only on Linux.

    :param seconds: from now, above 0.
    :param status: exit status.
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
    """Wait until all other nodes are gone, so that the node can be destroyed safely.

    :param seconds: most time to wait, since killed nodes stay in the graph for a while.
    """
    deadline = time.monotonic() + seconds
    while len(node.get_node_names()) > 1 and time.monotonic() < deadline:
        time.sleep(_SHUTDOWN_POLL)
    time.sleep(_TOPICS_TIMEOUT)


def set_realtime_priority() -> bool:
    """Give all threads of this process real-time priority (SCHED_RR).

    :returns: whether the system permits it, as to root and to users with an ``rtprio`` limit.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(_REALTIME_PRIORITY))
    except PermissionError:
        return False
    return True


def lower_priority(niceness: int) -> None:
    """Let other programs come first on a busy processor; for this thread and those that it starts.

    :param niceness: 0 to 19; one that is higher already stays.
    """
    os.setpriority(os.PRIO_PROCESS, 0, max(niceness, os.getpriority(os.PRIO_PROCESS, 0)))


def run(make: Callable[[], NodeType], spin: Callable[[NodeType], None]) -> int:
    """Make a node, spin it until SIGINT or SIGTERM, and destroy it.

    :param make: makes the node.
    :param spin: spins the node, and returns at its end.
    :returns: exit status.
    """
    stop = _SignalListener()
    sys.unraisablehook = _report_unraisable
    # Of a node that a signal interrupts while it is made.
    warnings.filterwarnings("ignore", "Failed to fini", RuntimeWarning)
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
    """Spin a node until SIGINT or SIGTERM, or until it is done.

    The executor of ``rclpy.spin`` is shared, and missing where a signal comes early; so the node gets its own.

    :param is_done: called 20 times a second.
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
            # rclpy's signal handler may end the context at any time, also while the node is made.
            if rclpy.ok():
                raise
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except HmtSlamError as error:
        # An unfinished node is destroyed with the exception, and its participant with it.
        status = EARLIER_SYSTEM if isinstance(error, EarlierSystemError) else FAULT
        force_exit_after(_SHUTDOWN_TIMEOUT, status)
        print(f"{sys.argv[0].rsplit('/', 1)[-1]}: {error}", file=sys.stderr, flush=True)
        return status
    return 0


def _report_unraisable(unraisable: sys.UnraisableHookArgs) -> None:
    """Report an exception of an object that is deleted, but not those of rclpy's after a signal."""
    if rclpy.ok() or not isinstance(unraisable.exc_value, _CONTEXT_LOST):
        sys.__unraisablehook__(unraisable)


class _SignalListener:
    """Records SIGINT and SIGTERM, and forces an exit after :data:`_GRACE_PERIOD`; rclpy's handler ends the spinning.

    It raises nothing, since an exception may come up at any line, also inside a compiler. A thread waits for the
    signal: Python runs handlers in the main thread only, and not during a long call of C.

    :ivar received: whether a signal has come.
    """

    def __init__(self) -> None:
        self.received = False
        self._wakeup_fd, write_fd = os.pipe()
        os.set_blocking(write_fd, False)
        signal.set_wakeup_fd(write_fd, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        threading.Thread(target=self._exit_after_signal, daemon=True).start()

    def _on_signal(self, _number: int, _frame: object) -> None:
        self.received = True

    def _exit_after_signal(self) -> None:
        os.read(self._wakeup_fd, 1)
        force_exit_after(_GRACE_PERIOD, 0)


def _ignore_signals() -> None:
    """Ignore further signals, such as a second Ctrl-C during the clean-up."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _exit_with_parent() -> None:
    """End with the parent process, where :data:`PARENT_VARIABLE` names it."""
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        raise KeyboardInterrupt
