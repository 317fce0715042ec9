"""A finding of a check: its severity, and a sentence with the value and the remedy."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

Severity = Literal["wrong", "doubtful", "fine"]

SEVERITIES: tuple[Severity, ...] = ("wrong", "doubtful", "fine")
"""All severities, the most serious first."""


class Finding(NamedTuple):
    """The result of a check.

    :ivar severity: ``wrong`` spoils a map, ``doubtful`` may spoil it, ``fine`` is correct or could not be judged.
    :ivar subject: subject of the check, two or three words that are the same for all logs.
    :ivar text: a sentence with the value and the remedy.
    """

    severity: Severity
    subject: str
    text: str


def grade(value: float, doubtful: float, wrong: float) -> Severity:
    """The severity of a value that should be small.

    :param doubtful: value from which it is doubtful.
    :param wrong: value from which it is wrong.
    """
    return "wrong" if value >= wrong else "doubtful" if value >= doubtful else "fine"


def times_text(count: int) -> str:
    """A count in words."""
    return "once" if count == 1 else f"{count} times"


def sorted_findings(findings: Iterable[Finding]) -> list[Finding]:
    """The findings, the most serious first."""
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))
