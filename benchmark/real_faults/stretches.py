"""The stretches of logs into which faults are planted, drawn by number."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.logs import MeasuredLog
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import Relations
from hmt_slam_ros.evaluation.relations import LONG_SPAN
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.open_log import open_log

RECORDED = ("aces", "intel", "csail")
SOURCES = (*RECORDED, "simulated")
"""Recorded logs with true relations, and drives through simulated worlds."""

FINE_BEAMS = ("csail", "simulated")
"""Sources with two beams a degree."""

FULL_TURN = ("full-turn",)
"""Drives with a laser that sees all around."""

_WORLDS = ("office", "straight")
"""Families of simulated worlds, in turn."""

_WORLD_SETTINGS = {"simulated": "size=0.7", "full-turn": "size=0.7,field_of_view=360,beams=720"}

_FIRST_WORLD = 2000
"""Seed of the first world."""

_SECONDS = (300.0, 900.0)
"""Shortest and longest stretch of a recorded log."""

_MIN_LOOPS = 10
"""Least number of relations over more than 60 s in a stretch, in which a missed loop shows."""

_TRIALS = 10_000


@dataclass(frozen=True)
class LogStretch:
    """A stretch of a log.

    :ivar source: one of ``SOURCES`` or ``FULL_TURN``.
    :ivar number: of the stretch, from 0.
    :ivar log: recorded, or a simulated drive without relations.
    :ivar start: seconds of the log that are skipped.
    :ivar duration: seconds that are used, 0 for all.
    """

    source: str
    number: int
    log: MeasuredLog
    start: float = 0.0
    duration: float = 0.0

    @property
    def name(self) -> str:
        """Of its output folders."""
        return f"{self.source}-{self.number}"


def draw_stretch(source: str, number: int, logs: dict[str, MeasuredLog]) -> LogStretch:
    """A stretch of a source.

    :param logs: {name: log} of the recorded ones.
    :raises HmtSlamError: where a log has no stretch with loops.
    """
    if source not in RECORDED:
        family = _WORLDS[number % len(_WORLDS)]
        world = f"sim:{family},seed={_FIRST_WORLD + number},{_WORLD_SETTINGS[source]}"
        return LogStretch(source, number, MeasuredLog(f"{source}-{number}", Path(world)))
    log = logs[source]
    assert log.relations is not None
    random = np.random.Generator(np.random.Philox(key=[number, RECORDED.index(source)]))
    length, first = open_log(log.path).duration, log.scans[0].stamp
    return LogStretch(source, number, log, *_draw_window(length, _long_relations(log.relations, first), random))


def _long_relations(relations: Relations, first: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Both ends (n, 2) of the relations over more than 60 s, s after the first stamp, the earlier one first."""
    ends = np.sort(np.stack((relations.starts, relations.ends), axis=1), axis=1)
    return np.asarray((ends[np.diff(ends, axis=1)[:, 0] > LONG_SPAN] - first) / NANOSECONDS)


def _draw_window(
    length: float, loops: np.ndarray[tuple[int, int], np.dtype[np.float64]], random: np.random.Generator
) -> tuple[float, float]:
    """Start and duration of a stretch with loops, s.

    :param length: of the log, s.
    :param loops: shape (n, 2), both ends of the long relations, s after the beginning.
    :raises HmtSlamError: where none is found.
    """
    for _ in range(_TRIALS):
        duration = min(length, random.uniform(*_SECONDS))
        start = random.uniform(0.0, length - duration) if duration < length else 0.0
        inside = (loops[:, 0] >= start) & (loops[:, 1] <= start + duration)
        if inside.sum() >= _MIN_LOOPS:
            return round(float(start), 1), round(float(duration), 1)
    raise HmtSlamError(f"of {_TRIALS} stretches none has {_MIN_LOOPS} true relations over more than 60 s")
