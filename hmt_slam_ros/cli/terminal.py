"""Progress and summary of a command on the terminal, and its end on a signal.

A signal handler must not raise inside numba. Numba calls Python from LLVM, which has no exceptions: the exception would
be lost, and with it the kernel that is being loaded.
"""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, TextIO

from hmt_slam_ros.logs.records import Log, describe_left_out

if TYPE_CHECKING:
    from hmt_slam_ros.results.recorder import Recording

_TTY_PERIOD, _FILE_PERIOD = 0.1, 10.0
"""Least time between two lines of progress, on a terminal and in a file, s."""

_BAR = 24
"""Width of the progress bar, characters."""


def report_left_out(log: Log, command: str) -> None:
    """Say on stderr how many measurements of a log are left out, where there are any."""
    sentence = describe_left_out(log)
    if sentence is not None:
        print(f"hmt_slam {command}: {sentence}", file=sys.stderr)


class MovingLine:
    """A line that is written over on a terminal; a file has one every ten seconds. As a context it ends the line."""

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        """:param stream: stream to write to.

        :param clock: returns seconds since any start.
        """
        self._stream, self._clock = stream, clock
        self.is_terminal = stream.isatty()
        self._last, self._was_shown = clock(), False

    def show(self, text: str, *, is_last: bool = False) -> None:
        """Write the line where the period since the last one is over.

        :param is_last: whether a terminal shows it in any case.
        """
        now = self._clock()
        due = now - self._last >= (_TTY_PERIOD if self.is_terminal else _FILE_PERIOD)
        if not due and not (self.is_terminal and is_last):
            return
        self._last, self._was_shown = now, True
        self._stream.write(f"\r{text}\x1b[K" if self.is_terminal else f"{text}\n")
        self._stream.flush()

    def __enter__(self) -> MovingLine:
        """Nothing is prepared."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the line."""
        if self.is_terminal and self._was_shown:
            self._stream.write("\n")


class Progress:
    """Shows the progress of a run. Call it with the number of scans done; as a context it ends the moving line."""

    def __init__(
        self,
        scans: int,
        log_seconds: float,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """:param scans: number of scans of the log.
        :param log_seconds: duration of the log, s.
        :param stream: stream to write to, stderr where None.
        :param clock: returns seconds since any start.
        """
        self._scans, self._log_seconds = max(scans, 1), log_seconds
        self._line, self._clock = MovingLine(stream or sys.stderr, clock), clock
        self._first: tuple[int, float] | None = None

    def __call__(self, done: int) -> None:
        """Write a line where the period since the last one is over, and at the end."""
        now = self._clock()
        if self._first is None and done:
            self._first = done, now
        self._line.show(self._text(done, now), is_last=done >= self._scans)

    def _text(self, done: int, now: float) -> str:
        """Bar, count, speed and remaining time; both from the first scan on, before which kernels may be compiled."""
        share = min(done / self._scans, 1.0)
        filled = int(_BAR * share)
        bar = f"[{'#' * filled}{'.' * (_BAR - filled)}] " if self._line.is_terminal else ""
        return f"{bar}{done}/{self._scans} scans, {self._pace(done, now)}"

    def _pace(self, done: int, now: float) -> str:
        """Speed relative to real time, and the time that is left."""
        first, begin = self._first or (done, now)
        scans, seconds = done - first, max(now - begin, 1e-9)
        if scans <= 0:
            return "starting"
        speed = f"{scans / self._scans * self._log_seconds / seconds:.1f} x real time"
        if done >= self._scans:
            return f"{speed}, the final map is being made"
        return f"{speed}, {_duration((self._scans - done) * seconds / scans)} left"

    def __enter__(self) -> Progress:
        """Nothing is prepared."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the moving line."""
        self._line.__exit__(kind, fault, trace)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _count_logs(count: int) -> str:
    return "one log" if count == 1 else f"{count} logs"


TERMINATED = 143
"""Exit status after SIGTERM."""

_LLVM, _NUMBA = frozenset({"llvmlite"}), frozenset({"llvmlite", "numba"})
"""Packages between LLVM and the program: no exception may pass calls of LLVM, nor numba while it loads a kernel."""

_MAX_DEFERRAL = 2.0
"""Longest time that loading a kernel takes, s. What takes longer compiles one, and may be interrupted outside LLVM."""

_RETRY_DELAY = 0.02
"""Delay until a deferred signal is tried again, s."""


class _DeferringHandler:
    """A signal handler that raises outside of numba, and inside of it tries again later."""

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
    """Raise ``KeyboardInterrupt`` on SIGINT and ``SystemExit`` on SIGTERM, but not while a kernel is loaded.

    A SIGINT that the parent process ignores stays ignored.
    """
    handler = _DeferringHandler()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        if number != signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def _is_inside(frame: FrameType | None, packages: Collection[str]) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in packages:
            return True
        frame = frame.f_back
    return False


def summary(directory: Path, recording: Recording, log_seconds: float, wall_seconds: float) -> str:
    """The notices of the processes, a line each, and one line with counts and speed.

    :param log_seconds: duration of the log, s.
    :param wall_seconds: duration of the run, s.
    """
    arcs = [arc for _, _, arc in recording.hybrid_map.all_arcs()]
    own, earlier = recording.own_totals, recording.first_scans[-1]
    before = f" beside {earlier} of {_count_logs(len(recording.first_scans) - 1)} before" if earlier else ""
    outcome = (
        f"{directory}: {own.processed} of {own.received} scans{before}, {own.dropped} dropped; "
        f"areas: {len(recording.area_poses)}, arcs: {len(arcs)}, "
        f"of them loop closures: {sum(arc.closure for arc in arcs)}; "
        f"{wall_seconds:.1f} s, {log_seconds / max(wall_seconds, 1e-9):.1f} x real time"
    )
    return "\n".join([*(f"{notice.process}: {notice.text}" for notice in recording.notices), outcome])
