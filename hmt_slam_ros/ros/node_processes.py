"""Nodes as child processes, in a DDS domain that no other nodes use."""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.process_memory import ResourceUsage, resource_usage
from hmt_slam_ros.process_table import node_command
from hmt_slam_ros.ros.child_processes import MAX_RESTARTS, PARENT_VARIABLE, RestartLimit

_DOMAINS = range(1, 102)
"""Ids of domains that may be used: 0 is the default, and ports above 101 overlap Linux's outgoing connections."""
_PORT_BASE, _DOMAIN_GAIN, _UNICAST_OFFSET, _PARTICIPANT_GAIN = 7400, 250, 10, 2
"""Ports of a domain in the RTPS standard: 7400 + 250 * domain + 10 + 2 * participant."""
_PARTICIPANTS = 4
"""Participants of a domain whose ports are checked."""
_STOP_TIMEOUT = 5.0
"""Time from SIGINT to SIGKILL, s."""
_TAIL = 3
"""Lines of a node's output in a message."""


@contextmanager
def own_domain() -> Iterator[int]:
    """Reserve and yield the id of a domain that no process on this computer uses.

    :raises HmtSlamError: where all are in use.
    """
    for domain in _DOMAINS:
        with _lock(domain) as locked:
            if locked and _is_silent(domain):
                yield domain
                return
    raise HmtSlamError(f"all ROS domains from {_DOMAINS[0]} to {_DOMAINS[-1]} are in use: end some ROS nodes")


@contextmanager
def _lock(domain: int) -> Iterator[bool]:
    """Whether the domain could be reserved; the system releases it when the process ends."""
    path = Path(tempfile.gettempdir()) / f"hmt_slam_domain_{domain}.lock"
    try:
        file = path.open("a")
    except OSError:  # another user's
        yield False
        return
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield True


def _is_silent(domain: int) -> bool:
    """Whether the ports of the first participants of the domain are free."""
    first = _PORT_BASE + _DOMAIN_GAIN * domain + _UNICAST_OFFSET
    return all(_is_free(first + _PARTICIPANT_GAIN * number) for number in range(_PARTICIPANTS))


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True


class NodeProcesses:
    """Nodes as child processes; as a context manager it ends all of them.

    :ivar processes: {node: process}.
    """

    def __init__(self, folder: Path, restartable: Collection[str], notify: Callable[[str], None]) -> None:
        """Prepare; :meth:`start` starts a node.

        :param folder: for the logs of the nodes.
        :param restartable: nodes that are restarted where a signal kills them.
        :param notify: called with one sentence about a restart.
        """
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._folder, self._restartable, self._notify = folder, restartable, notify
        self._start_arguments: dict[str, tuple[Sequence[str], Mapping[str, str]]] = {}
        self._limit = RestartLimit()

    def start(self, name: str, arguments: Sequence[str], environment: Mapping[str, str]) -> None:
        """Start the node ``name`` with arguments for ROS."""
        self._start_arguments[name] = arguments, environment
        command = [sys.executable, *node_command(name), "--ros-args", *arguments]
        with self._open_log(name, "ab") as stderr:
            self.processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stderr,
                stderr=stderr,
                # Ctrl-C in the terminal then reaches this process alone, which ends the nodes.
                start_new_session=True,
                env={**environment, PARENT_VARIABLE: str(os.getpid())},
            )

    def _open_log(self, name: str, mode: str) -> IO[bytes]:
        return (self._folder / f"{name}.log").open(mode)

    def restart_killed(self) -> None:
        """Restart the nodes that were killed.

        :raises HmtSlamError: for a node that ended by itself, or was killed too often, with its last output.
        """
        for name, process in list(self.processes.items()):
            if (status := process.poll()) is None:
                continue
            if status >= 0 or name not in self._restartable:
                raise HmtSlamError(f"the node {name} ended with status {status}, it said: {self.log_tail(name)}")
            self._restart(name, -status)

    def _restart(self, name: str, number: int) -> None:
        if not self._limit.admits_restart(name):
            raise HmtSlamError(
                f"the node {name} was killed by signal {number} for the {MAX_RESTARTS + 1}th time within a minute and "
                f"is not started again, it said: {self.log_tail(name)}"
            )
        self._notify(f"the node {name} was killed by signal {number}: it is started again and goes on where it was")
        self.start(name, *self._start_arguments[name])

    def log_tail(self, name: str) -> str:
        """The last lines of a node's output, joined to one."""
        with self._open_log(name, "rb") as stderr:
            lines = stderr.read().decode(errors="replace").strip().splitlines()
        return " | ".join(line.strip() for line in lines[-_TAIL:]) or "nothing"

    def usage(self) -> dict[str, ResourceUsage]:
        """{node: resources so far}."""
        return {name: resource_usage(process.pid) for name, process in self.processes.items()}

    def stop(self) -> None:
        """End all nodes by SIGINT, and those that do not react by SIGKILL."""
        alive = [process for process in self.processes.values() if process.poll() is None]
        for process in alive:
            process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + _STOP_TIMEOUT
        for process in alive:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def __enter__(self) -> NodeProcesses:
        """The node processes."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all nodes."""
        self.stop()
