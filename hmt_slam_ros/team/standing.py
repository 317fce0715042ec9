"""When a robot of a team stands: from then on its process gets its own status, and needs no keyframe events."""

from __future__ import annotations

_STANDING_TIME = 3.0
"""Time after the last keyframe event from which a robot stands, s."""

PERIOD = 0.5
"""Least time between two own statuses of a robot that stands, s."""


class StandingTimer:
    """Shows when a robot's process is to get its own status: once when the robot stands, and again while it searches.

    All times are of one clock, s.
    """

    def __init__(self) -> None:
        self._event_at = self._status_at = 0.0

    def note_event(self, now: float) -> None:
        """Note a keyframe event."""
        self._event_at = now

    def note_status(self, now: float) -> None:
        """Note that the process got its own status."""
        self._status_at = now

    def is_due(self, now: float, *, is_searching: bool) -> bool:
        """Whether the own status is to come now."""
        stands = now - self._event_at > _STANDING_TIME and now - self._status_at > PERIOD
        return stands and (is_searching or self._status_at < self._event_at)
