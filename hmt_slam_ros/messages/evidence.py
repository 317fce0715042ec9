"""The message with what spoke for and against the live hypotheses when they branched."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

BranchKind = Literal["closure", "known_area", "new_area", "unchanged", "lost", "withdrawal"]
"""What a hypothesis assumes that others do not.

"closure": an arc joins ``area`` to the known area ``other``. "known_area": the robot is in the known area ``area``.
"new_area": it is in ``area``, which begins there. "unchanged": it is still in ``area``, and no arc is new. "lost": it
is in ``area``, whose place in the map is unknown. "withdrawal": the closure between ``area`` and ``other`` was wrong.
"""


@dataclass(frozen=True, eq=False, slots=True)
class BranchStep:
    """A step by which a live hypothesis departed from others.

    :ivar event: the keyframe event.
    :ivar kind: what the hypothesis assumes since then.
    :ivar area: the area that the kind names.
    :ivar other: the other area of a closure, else None.
    :ivar probability: of the hypothesis right after the event.
    :ivar prior: probability of the place by odometry, arcs and marks, before its surfaces were compared; None where
        there was no comparison.
    :ivar matched: length of the surfaces that match the known area, m; None likewise.
    :ivar contradicting: length of those that lie in its free space, and were seen through, m; None likewise.
    """

    event: int
    kind: BranchKind
    area: int
    other: int | None
    probability: float
    prior: float | None = None
    matched: float | None = None
    contradicting: float | None = None


@dataclass(frozen=True, eq=False, slots=True)
class HypothesisEvidence:
    """A live hypothesis with its steps.

    :ivar hypothesis: id of the hypothesis.
    :ivar steps: since the last accepted hypothesis, the oldest first; of many the newest.
    """

    hypothesis: int
    steps: tuple[BranchStep, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """tsbi -> view, other programs: why there are several hypotheses; one when that changes.

    :ivar sequence: the keyframe event of the change.
    :ivar hypotheses: every live hypothesis that has steps, ordered by id; empty where one is definite.
    """

    sequence: int
    hypotheses: tuple[HypothesisEvidence, ...] = ()
