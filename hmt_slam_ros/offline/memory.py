"""How much memory the parts of a run take."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hmt_slam_ros.sensing import Scan


def code_bytes() -> dict[str, int]:
    """Resident memory of this OS process, bytes, that is mapped from ``libraries``, and what compiled ``kernels`` take.

    :returns: nothing where the system does not tell.
    """
    try:
        lines = Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines()
    except OSError:
        return {}
    parts = {"libraries": 0, "kernels": 0}
    part = None
    for line in lines:
        words = line.split()
        if not words[0].endswith(":"):
            # begin-end permissions offset device inode path
            executable, file = "x" in words[1], words[4] != "0"
            part = "libraries" if file else "kernels" if executable and len(words) == 5 else None
        elif words[0] == "Rss:" and part is not None:
            parts[part] += 1024 * int(words[1])
    return parts


def scan_bytes(scans: Iterable[Scan]) -> int:
    """What scans take, with the points that were worked out of them, bytes."""
    return sum(value.nbytes for scan in scans for value in vars(scan).values() if isinstance(value, np.ndarray))
