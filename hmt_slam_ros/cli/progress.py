"""How far a run is, on stderr: a moving line for a person, a line now and then for a file."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import TextIO

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
        self._moving = self._stream.isatty()
        self._begin = self._last = clock()
        self._shown = False

    def __call__(self, done: int) -> None:
        """Show the state where the last one was shown some time ago, and at the end."""
        now = self._clock()
        due = now - self._last >= (_TTY_PERIOD if self._moving else _FILE_PERIOD)
        if not due and not (self._moving and done >= self._scans):
            return
        self._last, self._shown = now, True
        line = self.line(done, now - self._begin)
        self._stream.write(f"\r{line}\x1b[K" if self._moving else f"{line}\n")
        self._stream.flush()

    def line(self, done: int, elapsed: float) -> str:
        """The state in words."""
        share = min(done / self._scans, 1.0)
        filled = int(_BAR * share)
        bar = f"[{'#' * filled}{'.' * (_BAR - filled)}] " if self._moving else ""
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
        if self._moving and self._shown:
            self._stream.write("\n")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
