"""What a command says on the terminal, and how it ends when it is told to.

But not inside of numba. It calls Python back from LLVM, which knows no exceptions: what is raised there is lost, and so
is the kernel that was being loaded, whose address is then taken from nowhere.
"""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from types import FrameType, TracebackType
from typing import TextIO

from hmt_slam_ros.results.recorder import Recording

_TTY_PERIOD, _FILE_PERIOD = 0.1, 10.0  # s
_BAR = 24  # characters


class Progress:
    """Call it with the number of scans done; use it as a context, which ends the moving line."""

    def __init__(
        self,
        scans: int,
        log_seconds: float,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start the clock.

        :param scans: of the whole log.
        :param log_seconds: that the log lasts.
        :param stream: where to write, stderr where None.
        :param clock: seconds, from any start.
        """
        self._scans, self._log_seconds = max(scans, 1), log_seconds
        self._stream = stream or sys.stderr
        self._clock = clock
        self._is_terminal = self._stream.isatty()
        self._begin = self._last = clock()
        self._was_shown = False

    def __call__(self, done: int) -> None:
        """Show the state where the last one was shown some time ago, and at the end."""
        now = self._clock()
        due = now - self._last >= (_TTY_PERIOD if self._is_terminal else _FILE_PERIOD)
        if not due and not (self._is_terminal and done >= self._scans):
            return
        self._last, self._was_shown = now, True
        line = self.line(done, now - self._begin)
        self._stream.write(f"\r{line}\x1b[K" if self._is_terminal else f"{line}\n")
        self._stream.flush()

    def line(self, done: int, elapsed: float) -> str:
        """The state in words."""
        share = min(done / self._scans, 1.0)
        filled = int(_BAR * share)
        bar = f"[{'#' * filled}{'.' * (_BAR - filled)}] " if self._is_terminal else ""
        speed = share * self._log_seconds / max(elapsed, 1e-9)
        left = elapsed * (1.0 - share) / share if share > 0.0 else 0.0
        rest = f"{_duration(left)} left" if share < 1.0 else "the final map is being made"
        return f"{bar}{done}/{self._scans} scans, {speed:.1f} x real time, {rest}"

    def __enter__(self) -> Progress:
        """Nothing to prepare."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the moving line as it is and go to the next."""
        if self._is_terminal and self._was_shown:
            self._stream.write("\n")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


TERMINATED = 143

# Who is between LLVM and the program. Loading a kernel takes no longer than this; what takes longer compiles one, and
# can be broken off but for the calls of LLVM themselves.
_LLVM, _NUMBA = frozenset({"llvmlite"}), frozenset({"llvmlite", "numba"})
_MAX_DEFERRAL = 2.0  # s
_RETRY_DELAY = 0.02  # s


class _DeferringHandler:
    """A handler that raises where the program can bear it, and otherwise tries again a little later."""

    def __init__(self) -> None:
        self._signal = signal.SIGTERM
        self._since = math.inf

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if number != signal.SIGALRM:
            self._signal, self._since = signal.Signals(number), min(self._since, time.monotonic())
        if _is_inside(frame, _NUMBA if time.monotonic() - self._since < _MAX_DEFERRAL else _LLVM):
            signal.setitimer(signal.ITIMER_REAL, _RETRY_DELAY)
        elif self._signal == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            raise SystemExit(TERMINATED)


def install_signal_handlers() -> None:
    """Raise ``KeyboardInterrupt`` on SIGINT and ``SystemExit`` on SIGTERM from now on, once no kernel is being loaded.

    A SIGINT that was to be ignored stays so.
    """
    stop = _DeferringHandler()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        if number != signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)


def _is_inside(frame: FrameType | None, packages: Collection[str]) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in packages:
            return True
        frame = frame.f_back
    return False


def summary(directory: Path, recording: Recording, log_seconds: float, wall_seconds: float) -> str:
    """What the processes had to tell, what came of the run and how long it took.

    :param log_seconds: that the log lasts.
    :param wall_seconds: that the run took.
    """
    arcs = [arc for _, _, arc in recording.hybrid_map.all_arcs()]
    totals = recording.totals
    outcome = (
        f"{directory}: {totals.processed} of {totals.received} scans, {totals.dropped} dropped; "
        f"areas: {len(recording.area_poses)}, arcs: {len(arcs)}, "
        f"of them loop closures: {sum(arc.closure for arc in arcs)}; "
        f"{wall_seconds:.1f} s, {log_seconds / max(wall_seconds, 1e-9):.1f} x real time"
    )
    return "\n".join([*(f"{notice.process}: {notice.text}" for notice in recording.notices), outcome])
