"""Which of two systems on the same topics was started first, and so goes on."""

from __future__ import annotations

import re
from typing import NamedTuple

from hmt_slam_ros.messages.system_name import SystemName

_STAMP = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{1,9}\+00:00", re.ASCII)
_MEMORY = 5.0
"""Time after its last announcement for which a node counts as running, s; announcements come once a second."""
_MAX_KNOWN = 64
"""Most nodes, and most systems, of which the starts are known."""


class Announcement(NamedTuple):
    """What a node says of itself once a second.

    :ivar node: its name with the namespace.
    :ivar system: name of its system, empty without.
    :ivar started: its start, UTC in ISO 8601.
    :ivar system_started: the earliest start of a node of its system that it knows, in the same form.
    """

    node: str
    system: str
    started: str
    system_started: str

    @property
    def is_valid(self) -> bool:
        """Whether both stamps can be compared."""
        return all(_STAMP.fullmatch(stamp) is not None for stamp in (self.started, self.system_started))


class Precedence:
    """Order of a node's system and of others: the one of which a node was started first precedes, then by names.

    Where both have the same name, or none, the starts of the two nodes of one name count.
    """

    def __init__(self, node: str, system: SystemName, started: str) -> None:
        """:param node: name of the node with its namespace.

        :param system: of the node; it may be known later.
        :param started: start of the node, UTC in ISO 8601.
        """
        self._node, self._system, self._started = node, system, started
        self._starts: dict[str, str] = {}
        self._heard: dict[Announcement, float] = {}

    @property
    def system_started(self) -> str:
        """The earliest start of a node of this system that is known."""
        return min(self._started, self._starts.get(self._system.name, self._started))

    def note(self, announcement: Announcement, now: float) -> bool:
        """Take note of what a node says; return whether it is of another system on the same topics.

        :param now: time of a monotonic clock, s.
        """
        if not announcement.is_valid or self._is_own(announcement):
            return False
        system = announcement.system
        if system and (system in self._starts or len(self._starts) < _MAX_KNOWN):
            self._starts[system] = min(announcement.system_started, self._starts.get(system, announcement.started))
        if not self._is_of_other(announcement):
            return False
        self._heard = {one: at for one, at in self._heard.items() if now - at < _MEMORY}
        if len(self._heard) < _MAX_KNOWN:
            self._heard[announcement] = now
        return True

    def preceding(self, now: float) -> Announcement | None:
        """The last announcement of a node that still runs and whose system precedes this one; None without.

        :param now: time of a monotonic clock, s.
        """
        found = (one for one, at in self._heard.items() if now - at < _MEMORY and self._precedes(one))
        return min(found, key=self._rank, default=None)

    def _is_own(self, announcement: Announcement) -> bool:
        return (announcement.node, announcement.started) == (self._node, self._started)

    def _is_of_other(self, announcement: Announcement) -> bool:
        own, other = self._system.name, announcement.system
        return announcement.node == self._node or bool(own and other and own != other)

    def _rank(self, announcement: Announcement) -> tuple[str, str]:
        system = announcement.system
        return min(announcement.system_started, self._starts.get(system, announcement.started)), system

    def _precedes(self, announcement: Announcement) -> bool:
        if announcement.system == self._system.name:
            return announcement.started < self._started
        return self._rank(announcement) < (self.system_started, self._system.name)
