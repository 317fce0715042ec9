"""What happened to the nodes, with times: warnings, faults, silences and new starts leave a trace."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from hmt_slam_ros.view.health import NODE_TIMEOUT, NodeHealth

_MOST = 100
"""Incidents that are kept, the newest."""

_STARTED = "started at"
"""Name of the value by which a node says when it started."""

Kind = Literal["good", "attention", "fault"]
_KINDS: dict[int, Kind] = {0: "good", 1: "attention"}
"""{level of diagnostic_msgs/DiagnosticStatus: level on the page}; others are faults."""


@dataclass(frozen=True)
class Incident:
    """Something that happened to a node.

    :ivar time: seconds since the epoch.
    :ivar node: name of the node.
    :ivar level: on the page.
    :ivar text: what happened.
    """

    time: float
    node: str
    level: Kind
    text: str


@dataclass
class _Known:
    """What is known of a node.

    :ivar message: its last warning or error, empty without.
    :ivar is_silent: whether no diagnostics come.
    :ivar started: time of its start in ISO 8601.
    """

    message: str = ""
    is_silent: bool = False
    started: str = ""


class IncidentLog:
    """Finds incidents in the diagnostics of the nodes.

    :ivar incidents: the newest, in the order of time.
    """

    def __init__(self) -> None:
        self.incidents: deque[Incident] = deque(maxlen=_MOST)
        self._known: dict[str, _Known] = {}

    def update(self, nodes: Mapping[str, NodeHealth], now: float, time: float) -> list[Incident]:
        """The incidents since the last update.

        :param nodes: {node: its last diagnostics}.
        :param now: time on the clock of ``nodes``, s.
        :param time: seconds since the epoch.
        """
        new = []
        for name, node in sorted(nodes.items()):
            known = self._known.setdefault(name, _Known(started=node.values.get(_STARTED, "")))
            new += [Incident(round(time, 1), name, level, text) for level, text in _changes(known, node, now)]
        self.incidents += new
        return new

    def rows(self) -> list[dict[str, Any]]:
        """The incidents as JSON, the newest first."""
        return [asdict(incident) for incident in reversed(self.incidents)]


def _changes(known: _Known, node: NodeHealth, now: float) -> list[tuple[Kind, str]]:
    """What changed since the last update, which is noted."""
    changes: list[tuple[Kind, str]] = []
    is_silent, started = now - node.heard_at > NODE_TIMEOUT, node.values.get(_STARTED, "")
    if is_silent and not known.is_silent:
        changes.append(("fault", "is silent"))
    if started > known.started:
        changes.append(("attention", "was started again"))
        known.message = ""
    elif known.is_silent and not is_silent:
        changes.append(("good", "is there again"))
    message = node.message if node.level else ""
    if message and message != known.message:
        changes.append((_KINDS.get(node.level, "fault"), message))
    known.message, known.is_silent, known.started = message, is_silent, max(started, known.started)
    return changes
