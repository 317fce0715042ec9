"""The past of a run for the time slider: snapshots of the map in bounded memory, thinned as the run grows."""

from __future__ import annotations

import json
import threading
import zlib
from dataclasses import dataclass
from typing import Any

_MAX_SNAPSHOTS = 240
"""Snapshots that are kept, spread over the whole run."""

_MAX_BYTES = 16_000_000
"""Bytes of all snapshots, compressed."""

_COMPRESSION = 1
"""Level of zlib: the fastest."""


@dataclass(frozen=True, eq=False)
class _Snapshot:
    event: int
    time: float
    content: bytes


class RunRing:
    """Snapshots after keyframe events. When there are too many, every second one goes. Thread-safe."""

    def __init__(self, max_snapshots: int = _MAX_SNAPSHOTS, max_bytes: int = _MAX_BYTES) -> None:
        self._lock = threading.Lock()
        self._max_snapshots, self._max_bytes = max_snapshots, max_bytes
        self._snapshots: list[_Snapshot] = []
        self._step = 1

    def add(self, event: int, time: float, content: dict[str, Any]) -> None:
        """Keep the content after a keyframe event, unless one of shortly before is kept.

        An event that is not after the last one begins a new run.

        :param time: stamp of the event, s.
        """
        with self._lock:
            if self._snapshots and event <= self._snapshots[-1].event:
                if event == self._snapshots[-1].event:
                    return
                self._snapshots, self._step = [], 1
            if self._snapshots and event < self._snapshots[-1].event + self._step:
                return
            text = json.dumps(content, allow_nan=False, separators=(",", ":"))
            self._snapshots.append(_Snapshot(event, time, zlib.compress(text.encode(), _COMPRESSION)))
            while len(self._snapshots) > self._max_snapshots or self._size() > self._max_bytes:
                self._thin()

    def _size(self) -> int:
        return sum(len(snapshot.content) for snapshot in self._snapshots)

    def _thin(self) -> None:
        """Keep every second snapshot, and from now on of half as many events."""
        if len(self._snapshots) == 1:
            self._snapshots = []
        self._snapshots = self._snapshots[::2]
        self._step *= 2

    def index(self) -> list[list[float]]:
        """(event, time) of every snapshot, the oldest first."""
        with self._lock:
            return [[snapshot.event, round(snapshot.time, 3)] for snapshot in self._snapshots]

    def content(self, event: int) -> bytes:
        """The JSON text of the last snapshot at or before an event, or of the first; empty where there is none."""
        with self._lock:
            before = [snapshot for snapshot in self._snapshots if snapshot.event <= event]
            chosen = before[-1] if before else next(iter(self._snapshots), None)
        return zlib.decompress(chosen.content) if chosen is not None else b""
