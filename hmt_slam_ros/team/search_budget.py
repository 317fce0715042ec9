"""The work that a robot's search in the maps of others may do: a share of a core, whatever their size and its speed."""

from __future__ import annotations

from hmt_slam_ros.logs.stamps import NANOSECONDS

_WORK_PER_SECOND = 50_000_000
"""Work in a second of the robot's time: about 75 ms, and up to twice that where all looks alike."""

_MAX_WORK = 160_000_000
"""Most work that adds up while nothing is searched, about 240 ms: that of an event."""


class SearchBudget:
    """Work that is left: it grows with time, and a step that takes more than is left is paid by the next events.

    The time is that of the keyframes' stamps, so that both runtimes stop at the same step.
    """

    def __init__(self, work: int = 0) -> None:
        """:param work: that is left at the start."""
        self._left = work
        self._stamp: int | None = None

    @property
    def is_left(self) -> bool:
        """Whether a further step may begin."""
        return self._left > 0

    def spend(self, work: int) -> None:
        """Count the work of a step."""
        self._left -= work

    def add_time(self, seconds: float) -> None:
        """Add the work of a time."""
        self._left = min(self._left + round(_WORK_PER_SECOND * seconds), _MAX_WORK)

    def note_stamp(self, stamp: int) -> None:
        """Add the work of the time since the last stamp, ns; one that jumps back adds none."""
        if self._stamp is not None:
            self.add_time(max(0, stamp - self._stamp) / NANOSECONDS)
        self._stamp = stamp
