"""What the page shows, between the thread that listens to the nodes and those that serve browsers."""

from __future__ import annotations

import hashlib
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

# Some ten minutes of a robot that drives; older probabilities leave the picture.
HISTORY = 1000
# A browser that was here so many seconds ago may come back: it reconnects by itself.
_ABSENCE = 10.0


@dataclass
class Seen:
    """What one browser knows.

    :ivar sections: {section: its number when it was sent}.
    :ivar events: number of the next event to send.
    :ivar generation: of the history that these belong to.
    """

    sections: dict[str, int] = field(default_factory=dict)
    events: int = 0
    generation: int = -1


class Board:
    """Sections that are replaced, a history that grows, and the picture of the map.

    All methods may be called from any thread.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._sections: dict[str, tuple[int, Any]] = {}
        self._number = 0
        self._history: deque[Any] = deque(maxlen=HISTORY)
        self._events, self._generation = 0, 0
        self._watchers, self._last_watched = 0, -_ABSENCE
        self._picture, self._tag = b"", ""

    def put(self, section: str, content: Any) -> None:  # noqa: ANN401  any JSON value
        """Replace a section, where it is not the same."""
        with self._changed:
            known = self._sections.get(section)
            if known is None or known[1] != content:
                self._number += 1
                self._sections[section] = (self._number, content)
                self._changed.notify_all()

    def append(self, event: Any) -> None:  # noqa: ANN401  any JSON value
        """Add to the history."""
        with self._changed:
            self._history.append(event)
            self._events += 1
            self._changed.notify_all()

    def forget_history(self) -> None:
        """Begin the history anew."""
        with self._changed:
            self._history.clear()
            self._generation += 1
            self._changed.notify_all()

    def put_picture(self, picture: bytes) -> str:
        """Replace the map's picture; return the tag by which a browser knows whether it has it."""
        with self._changed:
            self._picture, self._tag = picture, hashlib.sha256(picture).hexdigest()[:16]
            return self._tag

    def picture(self) -> tuple[bytes, str]:
        """The map's picture, empty where there is none, and its tag."""
        with self._changed:
            return self._picture, self._tag

    def news(self, seen: Seen, patience: float = 0.0) -> dict[str, Any]:
        """What a browser does not know yet; it is noted that it does now.

        :param patience: how long news is waited for, s.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._is_news(seen), patience)
            news = {name: content for name, (n, content) in self._sections.items() if n != seen.sections.get(name)}
            seen.sections = {name: number for name, (number, _) in self._sections.items()}
            if self._is_news(seen):
                anew = seen.generation != self._generation
                missed = len(self._history) if anew else min(self._events - seen.events, len(self._history))
                news["history"] = {"anew": anew, "events": list(self._history)[len(self._history) - missed :]}
                seen.generation, seen.events = self._generation, self._events
            return news

    def _is_news(self, seen: Seen) -> bool:
        return (
            seen.generation != self._generation
            or seen.events != self._events
            or any(number != seen.sections.get(name) for name, (number, _) in self._sections.items())
        )

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Within this, somebody looks."""
        with self._changed:
            self._watchers += 1
        try:
            yield
        finally:
            with self._changed:
                self._watchers -= 1
                self._last_watched = time.monotonic()

    @property
    def watched(self) -> bool:
        """Whether somebody looks, or did a moment ago."""
        with self._changed:
            return self._watchers > 0 or time.monotonic() - self._last_watched < _ABSENCE
