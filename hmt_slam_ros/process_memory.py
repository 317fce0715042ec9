"""Memory and CPU time of OS processes, by Linux; 0 where it is unknown."""

from __future__ import annotations

import ctypes
import os
import re
from dataclasses import dataclass
from pathlib import Path

_MADV_DONTNEED = 4  # <asm-generic/mman-common.h>
_CODE = re.compile(r"([0-9a-f]+)-([0-9a-f]+) r-xp [0-9a-f]+ \S+ [1-9]\d* .*")
"""The code of a library in /proc/self/maps, which nobody writes to."""


@dataclass(frozen=True)
class ResourceUsage:
    """Resources of an OS process so far.

    :ivar peak_rss: largest resident memory, bytes.
    :ivar pss: proportional set size, bytes.
    :ivar cpu_seconds: user and system time.
    """

    peak_rss: int
    pss: int
    cpu_seconds: float


def resource_usage(process: int | str = "self") -> ResourceUsage:
    """The resources of an OS process so far."""
    return ResourceUsage(peak_rss(process), proportional_set_size(process), cpu_seconds(process))


def cpu_seconds(process: int | str = "self") -> float:
    """User and system time of an OS process, s."""
    try:
        line = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return 0.0
    # Fields 14 and 15 of the line; field 2 is in parentheses and may hold spaces.
    ticks = line.rpartition(")")[2].split()[11:13]
    return sum(map(int, ticks)) / float(os.sysconf("SC_CLK_TCK"))


def peak_rss(process: int | str = "self") -> int:
    """Largest resident memory of an OS process, bytes."""
    return _memory(process, "status", "VmHWM")


def current_rss(process: int | str = "self") -> int:
    """Current resident memory of an OS process, bytes."""
    return _memory(process, "status", "VmRSS")


def proportional_set_size(process: int | str = "self") -> int:
    """Current resident memory of an OS process, of which what n processes share counts 1/n, bytes."""
    return _memory(process, "smaps_rollup", "Pss:")


def release_code() -> None:
    """Give up the memory that the code of libraries takes; what runs again comes from their files."""
    try:
        mappings = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return
    advise = ctypes.CDLL(None).madvise
    for code in filter(None, map(_CODE.fullmatch, mappings)):
        begin, end = int(code[1], 16), int(code[2], 16)
        advise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)


def _memory(process: int | str, file: str, key: str) -> int:
    try:
        lines = Path(f"/proc/{process}/{file}").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(key)), 0)
