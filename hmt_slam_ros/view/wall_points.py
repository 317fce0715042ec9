"""Surfaces that keyframes saw, for maps that are drawn on the page: of other hypotheses, and of the past."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

MAX_POINTS = 60
"""Points of a keyframe."""

_MAX_KEYFRAMES = 5000
"""Keyframes whose points are kept, the newest."""

_MAX_ANSWER = 500
"""Keyframes of an answer."""


class WallPoints:
    """A few surface points of each keyframe, in the frame of the robot. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._points: OrderedDict[int, tuple[int, list[int]]] = OrderedDict()
        self._count = 0

    def add(self, keyframe: int, points: NDArray[np.float64]) -> None:
        """Keep the points of a keyframe.

        :param points: shape (n, 2), m, base frame.
        """
        flat = np.round(100.0 * thin(points)).astype(int).ravel().tolist()
        with self._lock:
            self._count += 1
            self._points.pop(keyframe, None)
            self._points[keyframe] = self._count, flat
            while len(self._points) > _MAX_KEYFRAMES:
                self._points.popitem(last=False)

    def answer(self, after: int) -> bytes:
        """JSON with keyframes that came after some: [keyframe, [x, y, x, y, ...] in cm], the oldest first.

        ``next`` is the number for the next request; ``more`` whether there are more by now.

        :param after: ``next`` of the last answer, 0 for all.
        """
        with self._lock:
            rows = [(number, k, flat) for k, (number, flat) in self._points.items() if number > after]
        sent = rows[:_MAX_ANSWER]
        content = {
            "next": sent[-1][0] if sent else after,
            "more": len(rows) > len(sent),
            "keyframes": [[keyframe, flat] for _, keyframe, flat in sent],
        }
        return json.dumps(content, separators=(",", ":")).encode()


def thin(points: NDArray[np.float64], most: int = MAX_POINTS) -> NDArray[np.float64]:
    """At most so many of some points, evenly chosen.

    :param points: shape (n, 2).
    """
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(int)]
