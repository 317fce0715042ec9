"""The order of a sensor's messages: what comes late or twice is left out, and time that goes back is told from it."""

from __future__ import annotations

from typing import Generic, TypeVar

Message = TypeVar("Message")

BACK = 1_000_000_000
"""A bag that begins again, or a clock that is set, goes back by more than messages of one source are late, ns."""


class StampOrder(Generic[Message]):
    """Lets messages through in the order of their stamps.

    :ivar newest: stamp of the last one that was let through, ns, None where the next one may be of any time.
    :ivar refused: how many came late or twice.
    :ivar last_refused: stamp of the last such one, ns, None before the first.
    """

    def __init__(self, newest: int | None = None) -> None:
        """:param newest: stamp of the last one before, ns, None where there was none."""
        self.newest, self.refused = newest, 0
        self.last_refused: int | None = None
        self._doubtful: tuple[int, Message] | None = None

    def forget(self) -> None:
        """What comes next may be of any time."""
        self.newest = self._doubtful = None

    def arrive(self, stamp: int, message: Message) -> list[Message]:
        """What is let through now: mostly the message.

        Where one is stamped long before the newest, either it came very late or time went back; it waits for the next
        one, which tells.
        """
        newest, doubtful = self.newest, self._doubtful
        due = [message]
        if newest is not None and stamp <= newest:
            if stamp > newest - BACK:
                self._refuse(stamp)
                return []
            due = []
            if doubtful is not None and stamp > doubtful[0]:
                due, doubtful = [doubtful[1], message], None
        if doubtful is not None:
            self._refuse(doubtful[0])
        self._doubtful = None if due else (stamp, message)
        self.newest = stamp if due else newest
        return due

    def _refuse(self, stamp: int) -> None:
        self.refused, self.last_refused = self.refused + 1, stamp
