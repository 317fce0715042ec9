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

from hmt_slam_ros.messages.documents import KeyframeHead
from hmt_slam_ros.messages.messages import Hypotheses

_SECOND = 1e9
# Of an event; what is left out has the smallest probabilities, and is shown with what was not examined.
_MOST_BARS = 12


class History:
    """Joins keyframes, which know the time, with the answers to them; the two come on topics of their own."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._heads: dict[int, KeyframeHead] = {}
        self._answers: dict[int, Hypotheses] = {}
        self._told: dict[int, int] = {}

    def hear(self, message: KeyframeHead | Hypotheses) -> None:
        """Take in one of the two."""
        kept: dict[int, Any] = self._heads if isinstance(message, KeyframeHead) else self._answers
        kept[message.sequence] = message
        while len(kept) > HISTORY:
            del kept[min(kept)]

    def tell(self) -> None:
        """Put what is complete on the board.

        What a node that was started again repeats is passed over; an event that was there before, but at another time,
        begins a new run.
        """
        for sequence in sorted(self._heads.keys() & self._answers.keys()):
            head, answer = self._heads.pop(sequence), self._answers.pop(sequence)
            if self._told.get(sequence) == head.scan.stamp:
                continue
            if self._told and sequence <= max(self._told):
                self._told = {}
                self._board.forget_history()
            self._told[sequence] = head.scan.stamp
            while len(self._told) > HISTORY:
                del self._told[min(self._told)]
            self._board.append(_event(head, answer))


def _event(head: KeyframeHead, answer: Hypotheses) -> dict[str, Any]:
    """Time (s), way (m), and (hypothesis, area, probability, whether it is lost), the most probable first."""
    leaves = sorted(answer.leaves, key=lambda leaf: (-leaf.probability, leaf.hypothesis))[:_MOST_BARS]
    return {
        "event": head.sequence,
        "time": round(head.scan.stamp / _SECOND, 3),
        "way": round(head.travelled, 2),
        "leaves": [[leaf.hypothesis, leaf.area, round(leaf.probability, 5), leaf.lost] for leaf in leaves],
        "live": len(answer.leaves),
    }


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
