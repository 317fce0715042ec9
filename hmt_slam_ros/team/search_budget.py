"""The work that a robot's search in the maps of others may do: a share of a core, whatever their size and its speed."""

from __future__ import annotations

from hmt_slam_ros.logs.stamps import NANOSECONDS

_WORK_PER_SECOND = 60_000_000
"""Work in a second of the robot's time: about 90 ms, and up to twice that where all looks alike."""

_MAX_WORK = 60 * _WORK_PER_SECOND
"""Most work that is saved while there is little to search: that of a minute. Much is to be searched where maps meet."""

_EVENT_WORK = 160_000_000
"""Most work of an event, about 240 ms: messages of other robots wait for its end."""


class SearchBudget:
    """Work that is left: it grows with time, and a step that takes more than is left is paid by the next events.

    The time is that of the keyframes' stamps, so that both runtimes stop at the same step.
    """

    def __init__(self, work: int = 0) -> None:
        """:param work: that is left at the start, for one event."""
        self._left = self._left_in_event = work
        self._stamp: int | None = None

    @property
    def is_left(self) -> bool:
        """Whether a further step may begin."""
        return self._left > 0 and self._left_in_event > 0

    def begin_event(self) -> None:
        """Begin an event."""
        self._left_in_event = _EVENT_WORK

    def spend(self, work: int) -> None:
        """Count the work of a step."""
        self._left -= work
        self._left_in_event -= work

    def add_time(self, seconds: float) -> None:
        """Add the work of a time."""
        self._left = min(self._left + round(_WORK_PER_SECOND * seconds), _MAX_WORK)

    def note_stamp(self, stamp: int) -> None:
        """Add the work of the time since the last stamp, ns; one that jumps back adds none."""
        if self._stamp is not None:
            self.add_time(max(0, stamp - self._stamp) / NANOSECONDS)
        self._stamp = stamp
