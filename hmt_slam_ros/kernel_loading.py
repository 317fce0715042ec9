"""Loading of kernels before they are needed, and their compilation where they are not cached, with the time left.

A kernel that the table lacks is loaded or compiled at its first call.
"""

from __future__ import annotations

import fcntl
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from hmt_slam_ros.compilation import declared_kernels
from hmt_slam_ros.kernel_table import KernelCall, known_calls
from hmt_slam_ros.process_table import node_rows

COMPILING = "compiling kernels"
"""Beginning of the progress, in diagnostics and on a terminal."""
_PRIOR = 1.0
"""Time of compilation, s, as which it counts that this machine is as fast as that of the table."""
_PLUG_INS = ("hmt_slam_ros.landmarks.", "hmt_slam_ros.places.", "hmt_slam_ros.grids.virtual_scan")
"""Modules that processes import only where the configuration, or a subscriber, asks for them."""
_LOCK = "compiling"
"""File in the folder of a module's kernels that is locked by the process that compiles one of them."""


class KernelLoading:
    """Loads the kernels that a node calls, or all.

    Processes that compile at the same time take turns at the kernels of a module, and each finds those of the others
    in the cache. It may run in a thread, while others read the time left.

    :ivar is_stopped: set to end after the current kernel.
    """

    def __init__(self, user: str | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        """:param user: name of a node; None for all calls. Plug-ins count only where the node has imported them.

        :param clock: returns seconds since any start.
        """
        self.is_stopped = False
        self._user, self._clock = user, clock
        self._begin: float | None = None
        self._done = self._pending = 0.0
        self._current, self._current_begin = 0.0, 0.0

    def run(self, on_progress: Callable[[], None] = lambda: None) -> None:
        """Load what is cached, and compile what is not.

        :param on_progress: called before each compilation.
        """
        self._compile(deque(self.load_cached()), on_progress)
        self._begin = None

    def load_cached(self) -> list[KernelCall]:
        """Load what is cached, and the node's libraries; returns the calls of the kernels that are not."""
        for row in node_rows():
            for library in row.libraries if row.name == self._user else ():
                import_module(library)
        missing = []
        for call in self._calls():
            if self.is_stopped:
                break
            if _is_cached(call):
                _load(call, may_wait=True)
            else:
                missing.append(call)
        return missing

    def _calls(self) -> list[KernelCall]:
        if self._user is None:
            return list(known_calls())
        calls = [call for call in known_calls() if self._user in call.users]
        return [call for call in calls if call.module in sys.modules or not call.module.startswith(_PLUG_INS)]

    def _compile(self, missing: deque[KernelCall], on_progress: Callable[[], None]) -> None:
        """Compile kernels; one whose module another process compiles comes later, where there are others."""
        self._begin = self._clock()
        self._pending = sum(call.seconds for call in missing)
        passed_over = 0
        while missing and not self.is_stopped:
            call = missing.popleft()
            self._current, self._current_begin = call.seconds, self._clock()
            on_progress()
            if _load(call, may_wait=passed_over >= len(missing)):
                self._pending, self._done = self._pending - call.seconds, self._done + call.seconds
                self._load_compiled_elsewhere(missing)
                passed_over = 0
            else:
                missing.append(call)
                passed_over += 1

    def _load_compiled_elsewhere(self, missing: deque[KernelCall]) -> None:
        """Load the kernels that other processes have compiled meanwhile; they say nothing about the pace."""
        for call in [call for call in missing if _is_cached(call)]:
            _load(call, may_wait=True)
            missing.remove(call)
            self._pending -= call.seconds

    @property
    def seconds_left(self) -> float | None:
        """Estimated time to the end of the compilation, s; None where nothing is compiled."""
        if self._begin is None or self._pending <= 0.0:
            return None
        pace = (self._current_begin - self._begin + _PRIOR) / (self._done + _PRIOR)
        spent = min(self._clock() - self._current_begin, pace * self._current)
        return max(pace * self._pending - spent, 0.0)

    @property
    def progress(self) -> str:
        """What is compiled and the time left, in words; empty where nothing is."""
        left = self.seconds_left
        return "" if left is None else f"{COMPILING}, {max(round(left), 1)} s left"


def count_loaded() -> dict[str, int]:
    """{name of a kernel: number of argument types for which it is loaded}; those of several modules are added up."""
    counts: dict[str, int] = {}
    for kernel in declared_kernels():
        if kernel.signatures:
            name = kernel.py_func.__name__
            counts[name] = counts.get(name, 0) + len(kernel.signatures)
    return counts


def _is_cached(call: KernelCall) -> bool:
    """Whether a kernel is loaded or cached, as far as numba lets that be seen."""
    with suppress(Exception):
        kernel, types = call.resolve()
        cache = kernel._cache
        is_loaded = types in kernel.overloads
        return is_loaded or cache._index_key(types, kernel.targetctx.codegen()) in cache._cache_file._load_index()
    return False


def _load(call: KernelCall, *, may_wait: bool) -> bool:
    """Load or compile a kernel, and say whether that is done; one that cannot be compiled is left to its first call.

    :param may_wait: whether to wait for another process that compiles kernels of its module.
    """
    with suppress(Exception):  # numba's, of a table that does not match the kernels
        kernel, types = call.resolve()
        with _turn(kernel, may_wait=may_wait) as is_own:
            if is_own:
                kernel.compile(types)
            return is_own
    return True


@contextmanager
def _turn(kernel: Any, *, may_wait: bool) -> Iterator[bool]:  # noqa: ANN401  numba has no types
    """Lock the kernels of a module for this process; the value is whether that succeeded, or needs no lock."""
    folder = kernel.stats.cache_path
    if folder is None:
        yield True
        return
    try:
        file = (Path(folder).parent / _LOCK).open("wb")
    except OSError:
        yield True
        return
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if may_wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        except OSError:
            pass  # a file system without locks
        yield True
