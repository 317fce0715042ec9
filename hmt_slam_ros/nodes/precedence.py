"""How the node that has to be in time comes before all that computes for long."""

from __future__ import annotations

import os
import sys
from pathlib import Path

# The least of those of real time: any other program that asks for it comes before.
_PRIORITY = 1


def take_precedence() -> bool:
    """Let all threads of this process run before ordinary ones whenever they have something to do (SCHED_RR).

    :returns: whether the system permits that, as it does to root and to those with an ``rtprio`` limit.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(_PRIORITY))
    except PermissionError:
        return False
    return True
