"""Memory of OS processes, by Linux; 0 where it is unknown."""

from __future__ import annotations

from pathlib import Path


def peak_rss(process: int | str = "self") -> int:
    """Largest resident memory of an OS process, bytes."""
    return _memory(process, "status", "VmHWM")


def current_rss(process: int | str = "self") -> int:
    """Current resident memory of an OS process, bytes."""
    return _memory(process, "status", "VmRSS")


def proportional_set_size(process: int | str = "self") -> int:
    """Current resident memory of an OS process, of which what n processes share counts 1/n, bytes."""
    return _memory(process, "smaps_rollup", "Pss:")


def _memory(process: int | str, file: str, key: str) -> int:
    try:
        lines = Path(f"/proc/{process}/{file}").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(key)), 0)
