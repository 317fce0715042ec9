"""Events of a run for the chart of probabilities: closures that were accepted or withdrawn, and incidents."""

from __future__ import annotations

from collections import deque
from typing import Any

from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses

_MAX_EVENTS = 300
"""Events that are kept, the newest."""

_MAX_WAITING = 1000
"""Messages that wait for their counterpart."""

Pair = tuple[int, int]


class RunEvents:
    """Finds closures in the messages of TSBI and TLCA, which have separate topics, and keeps what happened."""

    def __init__(self) -> None:
        self._events: deque[dict[str, Any]] = deque(maxlen=_MAX_EVENTS)
        self._answers: dict[int, Hypotheses] = {}
        self._decisions: dict[int, ClosureDecision] = {}
        self._pending: dict[int, dict[Pair, bool]] = {}
        self._accepted: set[Pair] = set()
        self._last = -1

    def add(self, message: Hypotheses | ClosureDecision) -> None:
        """Store a message until its counterpart arrives, and take in the events that are complete, in their order."""
        waiting: dict[int, Any] = self._answers if isinstance(message, Hypotheses) else self._decisions
        waiting[message.sequence] = message
        while len(waiting) > _MAX_WAITING:
            del waiting[min(waiting)]
        for sequence in sorted(self._answers.keys() & self._decisions.keys()):
            self._take(sequence, self._answers.pop(sequence), self._decisions.pop(sequence))

    def add_incident(self, text: str) -> None:
        """Keep an incident at the newest event."""
        self._events.append({"event": max(0, self._last), "kind": "incident", "text": text})

    def clear(self) -> None:
        """Forget all, since a new run begins."""
        self._events.clear()
        self._pending, self._last = {}, -1
        self._accepted.clear()

    def rows(self) -> list[dict[str, Any]]:
        """(event, kind, text) of each, the oldest first; ``kind`` is accepted, withdrawn or incident."""
        return list(self._events)

    def _take(self, sequence: int, answer: Hypotheses, decision: ClosureDecision) -> None:
        if sequence <= self._last:
            return  # a restarted node repeats its last messages
        self._last = sequence
        before, self._pending = self._pending, {}
        for hypothesis in answer.hypotheses:
            changes = dict(before.get(hypothesis.parent, {}))
            changes |= {_pair(arc.source, arc.target): True for arc in hypothesis.arcs if arc.closure}
            changes |= {_pair(arc.source, arc.target): False for arc in hypothesis.removed_arcs}
            self._pending[hypothesis.id] = changes
        if decision.hypothesis is not None:
            self._decide(sequence, self._pending.get(decision.hypothesis, {}))
            self._pending = {}

    def _decide(self, sequence: int, changes: dict[Pair, bool]) -> None:
        for pair, is_there in changes.items():
            text = f"closure of {pair[0]} with {pair[1]}"
            if is_there and pair not in self._accepted:
                self._events.append({"event": sequence, "kind": "accepted", "text": f"{text} accepted"})
                self._accepted.add(pair)
            elif not is_there and pair in self._accepted:
                self._events.append({"event": sequence, "kind": "withdrawn", "text": f"{text} withdrawn"})
                self._accepted.discard(pair)


def _pair(a: int, b: int) -> Pair:
    return min(a, b), max(a, b)
