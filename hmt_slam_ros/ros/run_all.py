"""Run the five processes from one program: ``ros2 run hmt_slam_ros all``.

The program loads the libraries once and forks a process for each node, which shares that memory until it changes it.
Each node stays an OS process: its kernels and Python code run beside those of the others, and it may be killed alone.
rclpy is loaded after the fork, since its tracing starts threads.
"""

from __future__ import annotations

import gc
import os
import re
import signal
import socket
import sys
import traceback
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from hmt_slam_ros.kernel_loading import KernelLoading
from hmt_slam_ros.process_memory import release_code
from hmt_slam_ros.process_table import process_names, process_row, resolve, resolve_class
from hmt_slam_ros.ros.child_processes import FAULT, PARENT_VARIABLE, RestartLimit

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_MODULES = (
    *("asyncio", "inspect", "multiprocessing", "yaml"),
    *("diagnostic_msgs.msg", "geometry_msgs.msg", "lifecycle_msgs.srv", "nav_msgs.msg", "nav_msgs.srv"),
    *("rcl_interfaces.srv", "rosgraph_msgs.msg", "sensor_msgs.msg", "std_msgs.msg", "std_srvs.srv"),
    "visualization_msgs.msg",
)
"""Modules that rclpy and the nodes import, and that start no thread."""
_MAX_HOST = 80
"""Characters of the computer in the name of a system, which may have 100."""
_MAX_NAME = 15
"""Characters of the name of an OS process."""


def run_all() -> int:
    """Run all processes until SIGINT or SIGTERM, or until one ends with a fault; the arguments are those of each node.

    A node that a signal kills is forked again. The parameter ``system`` is by default a name that no other program has.

    :returns: exit status.
    """
    # One that the arguments give comes later, and so counts.
    sys.argv[1:1] = ["--ros-args", "-p", f"system:={_system_name()}", "--"]
    _load_libraries()
    return _ForkedNodes().wait()


def _system_name() -> str:
    """Name of the system of this program, which no other program has."""
    host = re.sub(r"[^\w.:+-]", "_", socket.gethostname(), flags=re.ASCII)
    return f"{host[:_MAX_HOST]}-{os.getpid()}"


def _load_libraries() -> None:
    """Load what the nodes need and the kernels that are cached; the garbage collector of each node leaves it alone."""
    for name in process_names():
        row = process_row(name)
        resolve(row.factory)
        resolve_class(row.state)
        KernelLoading(name).load_cached()
    for module in _MODULES:
        import_module(module)
    assert len(list(Path("/proc/self/task").iterdir())) == 1, "threads do not survive a fork"
    gc.collect()
    gc.freeze()
    release_code()  # of the compiler, which cached kernels need once


class _ForkedNodes:
    """The nodes as forked processes."""

    def __init__(self) -> None:
        self._pids: dict[int, str] = {}
        self._limit = RestartLimit()
        self._stopped = False
        self._status = 0
        for number in _SIGNALS:
            signal.signal(number, self._on_signal)
        for name in process_names():
            self._fork(name)

    def wait(self) -> int:
        """Wait for the end of all nodes; returns the exit status."""
        while self._pids:
            pid, wait_status = os.waitpid(-1, 0)
            self._on_end(self._pids.pop(pid), os.waitstatus_to_exitcode(wait_status))
        return self._status

    def _on_end(self, name: str, status: int) -> None:
        """Fork a killed node again; end all others after one that ended with a fault."""
        if self._stopped or status == 0:
            return
        if status < 0 and self._limit.admits_restart(name):
            _say(f"the node {name} was killed by signal {-status}: it is started again")
            self._fork(name)
        else:
            _say(f"the node {name} ended with status {status}, and all others with it")
            self._status = status if status > 0 else FAULT
            self._stop(signal.SIGINT)

    def _on_signal(self, number: int, _frame: object) -> None:
        self._stop(number)

    def _stop(self, number: int) -> None:
        """Pass a signal on to all nodes."""
        self._stopped = True
        for pid in self._pids:
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    def _fork(self, name: str) -> None:
        parent = os.getpid()
        # No signal comes between the fork and the entry of the pid.
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        if not self._stopped:
            pid = os.fork()
            if not pid:
                _become(name, parent)
            self._pids[pid] = name
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)


def _say(sentence: str) -> None:
    print(f"hmt_slam_all: {sentence}", file=sys.stderr, flush=True)


def _become(name: str, parent: int) -> None:
    """Run a node in this process, and end it; signals are blocked before."""
    os.environ[PARENT_VARIABLE] = str(parent)
    sys.argv[0] = f"hmt_slam_{name}"
    Path("/proc/self/comm").write_text(sys.argv[0][:_MAX_NAME], encoding="ascii")
    status = FAULT
    for number in _SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        from hmt_slam_ros.ros.execution import run  # noqa: PLC0415  it loads rclpy

        node_class = resolve_class(process_row(name).node_class)
        status = run(lambda: node_class(name), node_class.spin)
    except KeyboardInterrupt:
        status = 0
    except Exception:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
