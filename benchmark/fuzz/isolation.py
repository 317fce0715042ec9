"""A command in a process of its own, with limits of time and memory, and a verdict on its answer."""

from __future__ import annotations

import contextlib
import math
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from hmt_slam_ros.cli.main import FAULT, main

MEMORY = 1 << 30
"""Bytes of address space that a command may take beyond those of the process that forks it."""

TIMEOUT = 10.0
"""Seconds of computing that a command may take, on a machine that others use too."""

_WAITING = 6.0
"""Times as long it may take by the clock, so that one that waits for ever ends as well."""

_LONGEST_SENTENCE = 1000
"""Characters of an answer, at most."""


class Verdict(Enum):
    """How a command answered."""

    ACCEPTED = "accepted"
    REFUSED = "refused in one sentence"
    TRACEBACK = "traceback"
    MEMORY = "out of memory"
    HANG = "hang"
    CRASH = "killed by a signal"
    UNCLEAR = "no single sentence"

    @property
    def is_fault(self) -> bool:
        """Whether it is none that a user should meet."""
        return self not in (Verdict.ACCEPTED, Verdict.REFUSED)


@dataclass(frozen=True)
class CommandAnswer:
    """What a command came to.

    :ivar verdict: how it answered.
    :ivar text: what it printed on stderr.
    :ivar seconds: it took.
    """

    verdict: Verdict
    text: str
    seconds: float

    @property
    def place(self) -> str:
        """Where a traceback ended, file and line, or the verdict."""
        lines = [line.strip() for line in self.text.splitlines() if line.strip().startswith("File ")]
        return lines[-1] if lines else self.verdict.value


def run_command(arguments: Sequence[str], timeout: float = TIMEOUT) -> CommandAnswer:
    """Run ``hmt_slam`` with some arguments in a fork of this process."""
    return run_isolated(lambda: main(arguments), timeout)


def run_isolated(command: Callable[[], int], timeout: float = TIMEOUT) -> CommandAnswer:
    """Run a function in a fork of this process.

    :param command: returns an exit status, as ``hmt_slam`` does.
    """
    with tempfile.TemporaryFile() as output:
        begin = time.monotonic()
        child = os.fork()
        if child == 0:
            _run_child(command, output.fileno(), timeout)
        status = _wait(child, begin + _WAITING * timeout)
        output.seek(0)
        text = output.read().decode("utf-8", "replace")
        return CommandAnswer(judge(status, text), text, time.monotonic() - begin)


def _run_child(command: Callable[[], int], descriptor: int, timeout: float) -> None:
    """Run the command and end the process; nothing of the parent is flushed or cleaned up."""
    status = 1
    try:
        os.dup2(descriptor, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        limit = _address_space() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(timeout), math.ceil(timeout) + 1))
        status = command()
    except SystemExit as leave:
        status = leave.code if isinstance(leave.code, int) else 1
    except BaseException:
        status = 1
        with contextlib.suppress(BaseException):
            traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(status)


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def _wait(child: int, until: float) -> int | None:
    """The child's status, None where it was killed since it took too long."""
    pause = 0.001
    while time.monotonic() < until:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return status
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def judge(status: int | None, text: str) -> Verdict:
    """The verdict on an exit status as of `os.wait`, None after a timeout, and on what was printed."""
    if status is None or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        return Verdict.HANG
    if "MemoryError" in text or "there is no memory left" in text:
        return Verdict.MEMORY
    if "Traceback (most recent call last)" in text:
        return Verdict.TRACEBACK
    if os.WIFSIGNALED(status):
        return Verdict.CRASH
    code = os.WEXITSTATUS(status)
    if code == FAULT:
        lines = [line for line in text.splitlines() if line.strip()]
        return Verdict.REFUSED if lines and len(lines[-1]) < _LONGEST_SENTENCE else Verdict.UNCLEAR
    return Verdict.ACCEPTED if code in (0, 1) else Verdict.UNCLEAR
