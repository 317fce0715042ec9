"""How a command ends when it is told to: by an exception, so that half-written output is removed on the way out.

But not inside of numba. It calls Python back from LLVM, which knows no exceptions: what is raised there is lost, and so
is the kernel that was being loaded, whose address is then taken from nowhere.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Collection
from types import FrameType

TERMINATED = 143

# Who is between LLVM and the program. Loading a kernel takes no longer than this; what takes longer compiles one, and
# can be broken off but for the calls of LLVM themselves.
_LLVM, _NUMBA = frozenset({"llvmlite"}), frozenset({"llvmlite", "numba"})
_LONGEST = 2.0  # s
_LATER = 0.02  # s


class _Stop:
    """A handler that raises where the program can bear it, and otherwise tries again a little later."""

    def __init__(self) -> None:
        self._told = signal.SIGTERM
        self._since = math.inf

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if number != signal.SIGALRM:
            self._told, self._since = signal.Signals(number), min(self._since, time.monotonic())
        if _is_inside(frame, _NUMBA if time.monotonic() - self._since < _LONGEST else _LLVM):
            signal.setitimer(signal.ITIMER_REAL, _LATER)
        elif self._told == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            raise SystemExit(TERMINATED)


def heed_signals() -> None:
    """Raise ``KeyboardInterrupt`` on SIGINT and ``SystemExit`` on SIGTERM from now on, once no kernel is being loaded.

    A SIGINT that was to be ignored stays so.
    """
    stop = _Stop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        if number != signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)


def _is_inside(frame: FrameType | None, packages: Collection[str]) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in packages:
            return True
        frame = frame.f_back
    return False
