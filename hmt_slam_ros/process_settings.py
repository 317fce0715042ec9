"""Settings of the whole OS process, for the commands and the nodes; to be made before numpy is loaded."""

from __future__ import annotations

import ctypes
import os
import signal

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # <malloc.h>
_MMAP_THRESHOLD, _TRIM_THRESHOLD = 1 << 18, 1 << 21  # bytes


def apply_process_settings() -> None:
    """One thread for BLAS, and large arrays apart from small objects.

    The matrices here are small, so that several threads of BLAS would spend more time in waiting for each other than in
    computing; and the order in which they add up, and with it the last bits of a result, would depend on the machine.
    ``OPENBLAS_NUM_THREADS`` in the environment goes before.

    glibc's malloc maps large arrays one by one, and unmaps them when they are freed, but raises the bound from which on
    it does so up to 32 MB with every such array. What it takes from the heap instead, later small objects keep from
    going back: a tenth of a run's memory. With a bound of 1 MB the columns of a run's record, which grow through all
    sizes, still left hole after hole in the heap: 11 MB in three passes over Intel, 5 with this one, at no cost that
    shows. A bound that was set stays; but then so does the other one, of 128 kB, from
    which on free memory at the end of the heap is given back at once, so that every map of an area has its pages made
    anew. Two megabytes are kept for the next.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MMAP_THRESHOLD)
        mallopt(_M_TRIM_THRESHOLD, _TRIM_THRESHOLD)


def exit_on_signals() -> None:
    """Let SIGINT and SIGTERM end this process at once and as if all was well: for a node that is still being loaded."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
