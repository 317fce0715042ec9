"""The nodes of a replay as child processes: started together, watched, measured, and never left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes.figures import peak_rss
from hmt_slam_ros.nodes.running import PARENT_VARIABLE

_PATIENCE = 5.0  # s for a node to end when it is told to
# A node that is killed more often within a minute would be so for ever.
_RESTARTS, _MINUTE = 3, 60.0
_TAIL = 3  # lines of a node's stderr that go into a message


@dataclass(frozen=True)
class Usage:
    """What an OS process used so far.

    :ivar peak_rss: largest resident memory, bytes.
    :ivar cpu_seconds: user and system time.
    """

    peak_rss: int
    cpu_seconds: float


class Children:
    """Node processes; as a context, all of them are gone at its end.

    :ivar processes: {node: process}.
    """

    def __init__(self, folder: Path, restartable: Collection[str], tell: Callable[[str], None]) -> None:
        """Start nothing yet.

        :param folder: for what the nodes write to stderr.
        :param restartable: nodes that are started again where a signal killed them.
        :param tell: called with one sentence where that is done.
        """
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._folder, self._restartable, self._tell = folder, restartable, tell
        self._begun: dict[str, tuple[Sequence[str], Mapping[str, str]]] = {}
        self._restarts: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=_RESTARTS))

    def start(self, name: str, arguments: Sequence[str], environment: Mapping[str, str]) -> None:
        """Start the node ``name`` with arguments for ROS."""
        self._begun[name] = arguments, environment
        command = [sys.executable, "-m", f"hmt_slam_ros.nodes.{name}_node", "--ros-args", *arguments]
        with self._stderr(name, "ab") as stderr:
            self.processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stderr,
                stderr=stderr,
                # A Ctrl-C in the terminal reaches this process alone, which then ends the nodes in good order.
                start_new_session=True,
                env={**environment, PARENT_VARIABLE: str(os.getpid())},
            )

    def _stderr(self, name: str, mode: str) -> IO[bytes]:
        return (self._folder / f"{name}.log").open(mode)

    def check(self) -> None:
        """See whether all are alive; start those again that were killed.

        :raises HmtSlamError: for one that ended by itself or is killed again and again, with what it said last.
        """
        for name, process in list(self.processes.items()):
            if (status := process.poll()) is None:
                continue
            if status >= 0 or name not in self._restartable:
                raise HmtSlamError(f"the node {name} ended with status {status}, it said: {self.last_words(name)}")
            self._restart(name, -status)

    def _restart(self, name: str, number: int) -> None:
        now, before = time.monotonic(), self._restarts[name]
        if len(before) == _RESTARTS and now - before[0] < _MINUTE:
            raise HmtSlamError(
                f"the node {name} was killed by signal {number} for the {_RESTARTS + 1}th time within a minute and is "
                f"not started again, it said: {self.last_words(name)}"
            )
        before.append(now)
        self._tell(f"the node {name} was killed by signal {number}: it is started again and goes on where it was")
        self.start(name, *self._begun[name])

    def last_words(self, name: str) -> str:
        """The last lines that a node wrote, as one."""
        with self._stderr(name, "rb") as stderr:
            lines = stderr.read().decode(errors="replace").strip().splitlines()
        return " | ".join(line.strip() for line in lines[-_TAIL:]) or "nothing"

    def usage(self) -> dict[str, Usage]:
        """What each node used so far."""
        return {
            name: Usage(peak_rss(process.pid), _cpu_seconds(process.pid)) for name, process in self.processes.items()
        }

    def stop(self) -> None:
        """End all: by SIGINT, and by SIGKILL those that do not hear it."""
        alive = [process for process in self.processes.values() if process.poll() is None]
        for process in alive:
            process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + _PATIENCE
        for process in alive:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def __enter__(self) -> Children:
        """Nothing runs yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all, whatever happened."""
        self.stop()


def _cpu_seconds(pid: int) -> float:
    """User and system time of an OS process; 0 where the system does not tell."""
    try:
        line = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return 0.0
    # Fields 14 and 15; the second, in parentheses, may hold spaces.
    ticks = line.rpartition(")")[2].split()[11:13]
    return sum(map(int, ticks)) / float(os.sysconf("SC_CLK_TCK"))
