"""The work of a keyframe event, which bounds its time.

It is counted, not timed, so that both runtimes stop at the same step. A step that has begun is finished: the map of a
region or of an area's place, a match with it, a place where keyframes do not lie, or the walls of a candidate.
"""

from __future__ import annotations

_MAX_WORK = 20_000_000
"""Work after which an event begins no further step of a search: samples looked up, about 30 ms."""

_MAX_COMPARISON_WORK = 10_000_000
"""Work after which an event begins no further step of a comparison. A comparison can wait; a lost robot drives on."""

CELL_WORK = 50
"""Work of a cell of a map that is made: in the time of so many samples."""


class EventWork:
    """The work of an event, which its hypotheses share.

    :ivar done: number of samples looked up, or of what takes as long.
    """

    def __init__(self) -> None:
        self.done = 0

    def begin_event(self) -> None:
        """Begin an event."""
        self.done = 0

    def add(self, work: int) -> None:
        """Count the work of a step."""
        self.done += work

    @property
    def is_exhausted(self) -> bool:
        """Whether the work of the event is done, after which no further step begins."""
        return self.done >= _MAX_WORK

    @property
    def admits_comparison(self) -> bool:
        """Whether a further step of a comparison may begin."""
        return self.done < _MAX_COMPARISON_WORK
