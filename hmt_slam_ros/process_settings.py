"""Settings of the OS process, for commands and nodes. They must be applied before numpy is imported."""

from __future__ import annotations

import ctypes
import os
import signal

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3)."""

_MMAP_THRESHOLD, _TRIM_THRESHOLD = 1 << 18, 1 << 21
"""Least size of an allocation that is mapped on its own, and least free memory at the end of the heap, bytes."""


def apply_process_settings() -> None:
    """Set one thread for BLAS, and fixed thresholds of malloc.

    The matrices are small: several threads of BLAS take longer, and make the last bits of a sum depend on the machine.
    ``OPENBLAS_NUM_THREADS`` in the environment takes precedence.

    malloc maps large arrays one by one and unmaps them when they are freed, but raises the threshold with each freed
    array, up to 32 MB. Smaller arrays then fragment the heap: 11 MB in three passes over Intel with a threshold of
    1 MB, 5 MB with this one. A fixed threshold also fixes the trim threshold, at 128 kB, with which the pages of every
    submap are mapped again. So this one is set too.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MMAP_THRESHOLD)
        mallopt(_M_TRIM_THRESHOLD, _TRIM_THRESHOLD)


def exit_on_signals() -> None:
    """Exit at once with status 0 on SIGINT and SIGTERM, for a node that is still importing."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
