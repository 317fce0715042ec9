"""Runs tests in forks of a process that has imported the libraries: that takes longer than most tests.

A program of its own, so that nothing of the package is imported before a fork. Requests and answers are lines of JSON.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import signal
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

_LIBRARIES = (
    "pytest",
    "hypothesis",
    "hypothesis.extra.numpy",
    "numba",
    "numba.extending",
    "scipy.special",
    "scipy.stats",
)

_MEMORY = 6 << 30
"""Address space of the tests, bytes: a mutant may ask for any size of array."""

_TAIL = 2000
"""Characters of the output that are kept."""


def main() -> None:
    """Answer requests until there are no more."""
    for name in _LIBRARIES:
        import_module(name)
    gc.freeze()  # what a fork does not touch, it need not copy
    sys.path.insert(0, str(Path.cwd()))
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps(run_tests(request["arguments"], request["timeout"])), flush=True)


def run_tests(arguments: list[str], timeout: float) -> dict[str, Any]:
    """What pytest came to: exit status, None where it took too long, seconds, and the end of its output."""
    with tempfile.TemporaryFile() as output:
        begin = time.monotonic()
        child = os.fork()
        if child == 0:
            _run_child(arguments, output.fileno())
        status = _wait(child, begin + timeout)
        output.seek(0)
        text = output.read().decode("utf-8", "replace")
    return {"status": status, "seconds": time.monotonic() - begin, "output": text[-_TAIL:]}


def _run_child(arguments: list[str], descriptor: int) -> None:
    status = 1
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        status = int(import_module("pytest").main(arguments))
        sys.stdout.flush()
    finally:
        os._exit(status)


def _wait(child: int, until: float) -> int | None:
    """The child's exit status, below 0 for a signal; None where it was killed since it took too long."""
    while time.monotonic() < until:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


if __name__ == "__main__":
    main()
