"""Child processes of a program: the end with their parent, and how often a killed one is started again.

This module does not load rclpy, whose tracing starts threads that would not survive a fork.
"""

from __future__ import annotations

import time
from collections import defaultdict, deque

PARENT_VARIABLE = "HMT_SLAM_PARENT"
"""Environment variable with the pid of the process that started this one, and with which it ends."""
FAULT = 2
"""Exit status for a fault."""
EARLIER_SYSTEM = 3
"""Exit status of a node that gave way to a system that was started earlier."""
MAX_RESTARTS, _RESTART_WINDOW = 3, 60.0
"""Restarts of a node within this many seconds after which it is given up."""


class RestartLimit:
    """Counts the restarts of killed nodes, of which a few within a minute are tried."""

    def __init__(self) -> None:
        self._times: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=MAX_RESTARTS))

    def admits_restart(self, name: str) -> bool:
        """Whether a killed node may be started once more, which counts."""
        now, times = time.monotonic(), self._times[name]
        if len(times) == MAX_RESTARTS and now - times[0] < _RESTART_WINDOW:
            return False
        times.append(now)
        return True
