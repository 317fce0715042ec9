"""The thread of a node that loads or compiles its kernels, while the node answers requests and sends diagnostics."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from contextlib import suppress

from hmt_slam_ros.kernel_loading import KernelLoading, count_loaded

_SHOWN = 5
"""Kernels that are named in /diagnostics."""


class KernelThread:
    """Loads the kernels of a node, and counts those that are loaded later, at their first call."""

    def __init__(self, name: str) -> None:
        """:param name: name of the node in the table of kernels."""
        self._name = name
        self._loading = KernelLoading(name)
        self._thread: threading.Thread | None = None
        self._loaded: Mapping[str, int] | None = None

    def start(self) -> None:
        """Load the kernels; those of plug-ins that are in memory now."""
        self.stop()
        self._loading, self._loaded = KernelLoading(self._name), None
        self._thread = threading.Thread(target=self._run, args=(self._thread, self._loading))
        self._thread.start()

    def _run(self, previous: threading.Thread | None, loading: KernelLoading) -> None:
        if previous is not None:
            previous.join()
        with suppress(AttributeError, OSError):
            # It has the priority of the thread that started it, which may be a real-time one.
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        try:
            loading.run()
        finally:
            if loading is self._loading:
                self._loaded = count_loaded()

    def stop(self) -> None:
        """End the thread after the kernel that it loads."""
        self._loading.is_stopped = True

    @property
    def is_done(self) -> bool:
        """Whether the kernels are loaded."""
        return self._loaded is not None

    @property
    def progress(self) -> str:
        """What is compiled and the time left, in words; empty where nothing is."""
        return "" if self.is_done else self._loading.progress

    def describe(self) -> str:
        """The kernels for /diagnostics: the progress, or their number and the names of those loaded at a call."""
        before = self._loaded
        if before is None:
            return self._loading.progress or ("loading" if self._thread is not None else "")
        late = sorted(name for name, count in count_loaded().items() if count > before.get(name, 0))
        text = f"{sum(before.values())} loaded"
        if not late:
            return text
        names = ", ".join(late[:_SHOWN]) + (", ..." if len(late) > _SHOWN else "")
        return f"{text}, {len(late)} more at a call: {names}"
