"""The content of the live page, shared by the thread that receives messages and those that serve browsers."""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import KeyframeHeader
from hmt_slam_ros.messages.messages import Hypotheses
from hmt_slam_ros.sensors.plausibility import MAX_STAMP
from hmt_slam_ros.untrusted_input import shorten
from hmt_slam_ros.view.run_ring import RunRing
from hmt_slam_ros.view.wall_points import WallPoints

_MAX_BARS = 12
"""Hypotheses of an event that the page shows. It adds the others, the least probable, to the unexamined probability."""

HISTORY_LENGTH = 1000
"""Keyframe events that the page shows: about ten minutes of a moving robot."""

_RECONNECT_TIME = 10.0
"""Time within which a browser may reconnect by itself, s."""


class KeyframeHistory:
    """Joins keyframes, which have the time, with the hypotheses that answer them: the two have separate topics."""

    def __init__(self, board: Board, on_new_run: Callable[[], None] = lambda: None) -> None:
        """:param on_new_run: called where a known event has another stamp."""
        self._board, self._on_new_run = board, on_new_run
        self._headers: dict[int, KeyframeHeader] = {}
        self._answers: dict[int, Hypotheses] = {}
        self._published_stamps: dict[int, int] = {}

    def add(self, message: KeyframeHeader | Hypotheses) -> None:
        """Store a message until its counterpart arrives.

        :raises HmtSlamError: where a number in it is none that the page can show.
        """
        _check_event(message)
        pending: dict[int, Any] = self._headers if isinstance(message, KeyframeHeader) else self._answers
        pending[message.sequence] = message
        while len(pending) > HISTORY_LENGTH:
            del pending[min(pending)]

    def publish_complete(self) -> None:
        """Append the events whose two messages are there to the history of the board.

        Events that a restarted node repeats are skipped. A known event with another stamp begins a new run.
        """
        for sequence in sorted(self._headers.keys() & self._answers.keys()):
            header, answer = self._headers.pop(sequence), self._answers.pop(sequence)
            if self._published_stamps.get(sequence) == header.scan.stamp:
                continue
            if self._published_stamps and sequence <= max(self._published_stamps):
                self._published_stamps = {}
                self._board.clear_history()
                self._on_new_run()
            self._published_stamps[sequence] = header.scan.stamp
            while len(self._published_stamps) > HISTORY_LENGTH:
                del self._published_stamps[min(self._published_stamps)]
            self._board.append_event(_event_entry(header, answer))


def _check_event(message: KeyframeHeader | Hypotheses) -> None:
    if isinstance(message, KeyframeHeader):
        numbers = {"stamp": message.scan.stamp, "path_length": message.path_length}
    else:
        numbers = {f"probability of {shorten(h.id)}": h.probability for h in message.hypotheses}
    for name, value in {"sequence": message.sequence, **numbers}.items():
        # An integer of any size compares with a float; it may not become one.
        if not 0 <= value <= MAX_STAMP:
            raise HmtSlamError(
                f"{name} = {shorten(value)} is none of a keyframe event: run the same version everywhere"
            )


def _event_entry(header: KeyframeHeader, answer: Hypotheses) -> dict[str, Any]:
    """Time, s, path length, m, and (hypothesis, area, probability, lost) of each, the most probable first."""
    hypotheses = sorted(answer.hypotheses, key=lambda hypothesis: (-hypothesis.probability, hypothesis.id))[:_MAX_BARS]
    return {
        "event": header.sequence,
        "time": round(header.scan.stamp / 1e9, 3),
        "path_length": round(header.path_length, 2),
        "hypotheses": [[h.id, h.area, round(h.probability, 5), h.lost] for h in hypotheses],
        "live": len(answer.hypotheses),
    }


def _check_json(content: object, section: str) -> None:
    try:
        json.dumps(content, allow_nan=False)
    except ValueError as fault:
        raise HmtSlamError(
            f"{section} of the page is no JSON ({fault}): it is not shown, look who publishes it"
        ) from fault


@dataclass
class ClientState:
    """What was sent to one browser.

    :ivar section_versions: {section: its version when it was sent}.
    :ivar next_event: number of the next event to send.
    :ivar generation: generation of the history to which that event belongs.
    """

    section_versions: dict[str, int] = field(default_factory=dict)
    next_event: int = 0
    generation: int = -1


class Board:
    """Sections that are replaced, a history of events that grows, and the picture of the map. Thread-safe.

    :ivar past: snapshots of the map.
    :ivar walls: surfaces that keyframes saw.
    """

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._sections: dict[str, tuple[int, Any]] = {}
        self._version = 0
        self._history: deque[Any] = deque(maxlen=HISTORY_LENGTH)
        self._event_count, self._generation = 0, 0
        self._watchers, self._last_watched = 0, -_RECONNECT_TIME
        self._map_images: dict[str, tuple[bytes, str]] = {}
        self.past, self.walls = RunRing(), WallPoints()

    def put(self, section: str, content: Any) -> None:  # noqa: ANN401  any JSON value
        """Replace a section, unless it is equal.

        :raises HmtSlamError: where a number in it is not finite, which JSON does not have.
        """
        _check_json(content, section)
        with self._condition:
            known = self._sections.get(section)
            if known is None or known[1] != content:
                self._version += 1
                self._sections[section] = (self._version, content)
                self._condition.notify_all()

    def append_event(self, event: Any) -> None:  # noqa: ANN401  any JSON value
        """Append an event to the history.

        :raises HmtSlamError: as :meth:`put`.
        """
        _check_json(event, "history")
        with self._condition:
            self._history.append(event)
            self._event_count += 1
            self._condition.notify_all()

    def clear_history(self) -> None:
        """Clear the history and begin a new generation."""
        with self._condition:
            self._history.clear()
            self._generation += 1
            self._condition.notify_all()

    def put_map_image(self, picture: bytes, robot: str = "") -> str:
        """Replace the picture of the map, a PNG, and return its HTTP entity tag.

        :param robot: name of another robot whose map it is; empty for that of the page.
        """
        with self._condition:
            tag = hashlib.sha256(picture).hexdigest()[:16]
            self._map_images[robot] = picture, tag
            return tag

    def map_image(self, robot: str = "") -> tuple[bytes, str]:
        """The picture of a robot's map, empty where there is none, and its tag."""
        with self._condition:
            return self._map_images.get(robot, (b"", ""))

    def wait_for_changes(self, client: ClientState, timeout: float = 0.0) -> dict[str, Any]:
        """The sections and events that a browser does not have, {} where there are none; updates the client's state.

        :param timeout: longest wait for a change, s.
        """
        with self._condition:
            self._condition.wait_for(lambda: self._has_changes(client), timeout)
            changes = {
                name: content for name, (n, content) in self._sections.items() if n != client.section_versions.get(name)
            }
            client.section_versions = {name: number for name, (number, _) in self._sections.items()}
            if self._has_changes(client):
                anew = client.generation != self._generation
                missed = len(self._history) if anew else min(self._event_count - client.next_event, len(self._history))
                changes["history"] = {"anew": anew, "events": list(self._history)[len(self._history) - missed :]}
                client.generation, client.next_event = self._generation, self._event_count
            return changes

    def _has_changes(self, client: ClientState) -> bool:
        return (
            client.generation != self._generation
            or client.next_event != self._event_count
            or any(number != client.section_versions.get(name) for name, (number, _) in self._sections.items())
        )

    @contextmanager
    def count_watcher(self) -> Iterator[None]:
        """A context in which a browser is connected."""
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
        """Whether a browser is connected, or was within the time in which it may reconnect."""
        with self._condition:
            return self._watchers > 0 or time.monotonic() - self._last_watched < _RECONNECT_TIME
