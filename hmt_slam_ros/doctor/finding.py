"""What a check says: one sentence, with the value and the remedy, and how serious it is."""

from __future__ import annotations

from typing import Literal, NamedTuple

Severity = Literal["wrong", "doubtful", "fine"]

SEVERITIES: tuple[Severity, ...] = ("wrong", "doubtful", "fine")
"""The most serious first."""


class Finding(NamedTuple):
    """One thing that was looked at.

    :ivar severity: ``wrong`` spoils a map, ``doubtful`` may, ``fine`` is as it should be or could not be judged.
    :ivar subject: what it is about, in two or three words that stay the same from log to log.
    :ivar text: the sentence.
    """

    severity: Severity
    subject: str
    text: str


def grade(value: float, doubtful: float, wrong: float) -> Severity:
    """How serious a value is that should be small."""
    return "wrong" if value >= wrong else "doubtful" if value >= doubtful else "fine"


def times_text(count: int) -> str:
    """How often."""
    return "once" if count == 1 else f"{count} times"
