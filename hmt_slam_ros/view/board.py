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

from hmt_slam_ros.messages.documents import KeyframeHeader
from hmt_slam_ros.messages.messages import Hypotheses

_SECOND = 1e9
# Of an event; what is left out has the smallest probabilities, and is shown with what was not examined.
_MOST_BARS = 12


class KeyframeHistory:
    """Joins keyframes, which know the time, with the answers to them; the two come on topics of their own."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._heads: dict[int, KeyframeHeader] = {}
        self._answers: dict[int, Hypotheses] = {}
        self._published_stamps: dict[int, int] = {}

    def add(self, message: KeyframeHeader | Hypotheses) -> None:
        """Take in one of the two."""
        kept: dict[int, Any] = self._heads if isinstance(message, KeyframeHeader) else self._answers
        kept[message.sequence] = message
        while len(kept) > HISTORY_LENGTH:
            del kept[min(kept)]

    def publish_complete(self) -> None:
        """Put what is complete on the board.

        What a node that was started again repeats is passed over; an event that was there before, but at another time,
        begins a new run.
        """
        for sequence in sorted(self._heads.keys() & self._answers.keys()):
            head, answer = self._heads.pop(sequence), self._answers.pop(sequence)
            if self._published_stamps.get(sequence) == head.scan.stamp:
                continue
            if self._published_stamps and sequence <= max(self._published_stamps):
                self._published_stamps = {}
                self._board.clear_history()
            self._published_stamps[sequence] = head.scan.stamp
            while len(self._published_stamps) > HISTORY_LENGTH:
                del self._published_stamps[min(self._published_stamps)]
            self._board.append_event(_event_entry(head, answer))


def _event_entry(head: KeyframeHeader, answer: Hypotheses) -> dict[str, Any]:
    """Time (s), way (m), and (hypothesis, area, probability, whether it is lost), the most probable first."""
    leaves = sorted(answer.hypotheses, key=lambda leaf: (-leaf.probability, leaf.id))[:_MOST_BARS]
    return {
        "event": head.sequence,
        "time": round(head.scan.stamp / _SECOND, 3),
        "path_length": round(head.path_length, 2),
        "hypotheses": [[leaf.id, leaf.area, round(leaf.probability, 5), leaf.lost] for leaf in leaves],
        "live": len(answer.hypotheses),
    }


# Some ten minutes of a robot that drives; older probabilities leave the picture.
HISTORY_LENGTH = 1000
# A browser that was here so many seconds ago may come back: it reconnects by itself.
_RECONNECT_TIME = 10.0


@dataclass
class ClientState:
    """What one browser knows.

    :ivar section_versions: {section: its number when it was sent}.
    :ivar next_event: number of the next event to send.
    :ivar generation: of the history that these belong to.
    """

    section_versions: dict[str, int] = field(default_factory=dict)
    next_event: int = 0
    generation: int = -1


class Board:
    """Sections that are replaced, a history that grows, and the picture of the map.

    All methods may be called from any thread.
    """

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._sections: dict[str, tuple[int, Any]] = {}
        self._version = 0
        self._history: deque[Any] = deque(maxlen=HISTORY_LENGTH)
        self._event_count, self._generation = 0, 0
        self._watchers, self._last_watched = 0, -_RECONNECT_TIME
        self._map_image, self._map_tag = b"", ""

    def put(self, section: str, content: Any) -> None:  # noqa: ANN401  any JSON value
        """Replace a section, where it is not the same."""
        with self._condition:
            known = self._sections.get(section)
            if known is None or known[1] != content:
                self._version += 1
                self._sections[section] = (self._version, content)
                self._condition.notify_all()

    def append_event(self, event: Any) -> None:  # noqa: ANN401  any JSON value
        """Add to the history."""
        with self._condition:
            self._history.append(event)
            self._event_count += 1
            self._condition.notify_all()

    def clear_history(self) -> None:
        """Begin the history anew."""
        with self._condition:
            self._history.clear()
            self._generation += 1
            self._condition.notify_all()

    def put_map_image(self, picture: bytes) -> str:
        """Replace the map's picture; return the tag by which a browser knows whether it has it."""
        with self._condition:
            self._map_image, self._map_tag = picture, hashlib.sha256(picture).hexdigest()[:16]
            return self._map_tag

    def map_image(self) -> tuple[bytes, str]:
        """The map's picture, empty where there is none, and its tag."""
        with self._condition:
            return self._map_image, self._map_tag

    def wait_for_changes(self, client: ClientState, timeout: float = 0.0) -> dict[str, Any]:
        """What a browser does not know yet; it is noted that it does now.

        :param timeout: how long news is waited for, s.
        """
        with self._condition:
            self._condition.wait_for(lambda: self._has_changes(client), timeout)
            news = {
                name: content for name, (n, content) in self._sections.items() if n != client.section_versions.get(name)
            }
            client.section_versions = {name: number for name, (number, _) in self._sections.items()}
            if self._has_changes(client):
                anew = client.generation != self._generation
                missed = len(self._history) if anew else min(self._event_count - client.next_event, len(self._history))
                news["history"] = {"anew": anew, "events": list(self._history)[len(self._history) - missed :]}
                client.generation, client.next_event = self._generation, self._event_count
            return news

    def _has_changes(self, client: ClientState) -> bool:
        return (
            client.generation != self._generation
            or client.next_event != self._event_count
            or any(number != client.section_versions.get(name) for name, (number, _) in self._sections.items())
        )

    @contextmanager
    def count_watcher(self) -> Iterator[None]:
        """Within this, somebody looks."""
        with self._condition:
            self._watchers += 1
        try:
            yield
        finally:
            with self._condition:
                self._watchers -= 1
                self._last_watched = time.monotonic()

    @property
    def is_watched(self) -> bool:
        """Whether somebody looks, or did a moment ago."""
        with self._condition:
            return self._watchers > 0 or time.monotonic() - self._last_watched < _RECONNECT_TIME
