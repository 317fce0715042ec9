"""Reliability of probabilities above 0.9: bins of equal count with exact intervals, and the calibration error."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import beta

from benchmark.report import Columns, Requirement, table_of

TAIL = 0.9
"""Probability above which answers count."""

LIMIT = 0.01
"""Largest expected calibration error above it."""

BINS, LEAST = 4, 10
"""Bins at most, and pairs of each at least, if there are several."""

_OUTSIDE = 0.05  # probability that an interval misses the true share

Pair = tuple[float, bool]
"""Probability of an answer, and whether it is true."""

POLICY = (
    f"Above {TAIL:g}: the answers with a larger probability, in the order of their odds, in up to {BINS} bins of equal "
    f"count with {LEAST} at least; equal probabilities share a bin. The interval of the share that is true is that of "
    f"Clopper and Pearson at {100.0 * (1.0 - _OUTSIDE):g} %, and inside says whether it holds the mean probability. "
    "The expected calibration error is the mean distance of the two, weighted by the counts."
)


@dataclass(frozen=True)
class TailBin:
    """Answers of similar probability.

    :ivar least: smallest probability.
    :ivar most: largest probability.
    :ivar count: number of answers.
    :ivar mean: mean probability.
    :ivar right: number of true answers.
    """

    least: float
    most: float
    count: int
    mean: float
    right: int

    @property
    def share(self) -> float:
        """Share of true answers."""
        return self.right / self.count

    @property
    def interval(self) -> tuple[float, float]:
        """Clopper-Pearson interval of that share at 95 %."""
        right, wrong = self.right, self.count - self.right
        low = float(beta.ppf(0.5 * _OUTSIDE, right, wrong + 1)) if right else 0.0
        high = float(beta.ppf(1.0 - 0.5 * _OUTSIDE, right + 1, wrong)) if wrong else 1.0
        return low, high

    @property
    def is_inside(self) -> bool:
        """Whether the mean probability is in the interval."""
        low, high = self.interval
        return low <= self.mean <= high


def tail_bins(pairs: Sequence[Pair]) -> list[TailBin]:
    """The bins of the answers above 0.9, in the order of their probability; none without such answers."""
    kept = sorted((min(p, 1.0), right) for p, right in pairs if p > TAIL)
    if not kept:
        return []
    probabilities, right = np.array(kept, dtype=np.float64).T
    bins = min(BINS, max(1, len(kept) // LEAST))
    first = [n * len(kept) // bins for n in range(bins)]
    begins = np.unique(np.searchsorted(probabilities, probabilities[first], side="left"))
    return [
        TailBin(float(p[0]), float(p[-1]), len(p), float(p.mean()), int(true.sum()))
        for p, true in zip(np.split(probabilities, begins[1:]), np.split(right, begins[1:]), strict=True)
    ]


def tail_error(pairs: Sequence[Pair]) -> float:
    """Expected calibration error of the answers above 0.9; NaN if there are none."""
    bins = tail_bins(pairs)
    if not bins:
        return math.nan
    return float(np.average([abs(b.mean - b.share) for b in bins], weights=[b.count for b in bins]))


def tail_requirement(name: str, pairs: Sequence[Pair]) -> Requirement:
    """The requirement on the expected calibration error above 0.9 of some answers."""
    return Requirement(f"{name}: expected calibration error above {TAIL:g}", tail_error(pairs), LIMIT)


_COLUMNS: Columns[tuple[str, TailBin | None]] = [
    ("above 0.9", lambda row: row[0]),
    ("probability", lambda row: f"{row[1].least:.5f} to {row[1].most:.5f}" if row[1] else "-"),
    ("answers", lambda row: str(row[1].count if row[1] else 0)),
    ("mean probability", lambda row: f"{row[1].mean:.5f}" if row[1] else "-"),
    ("true", lambda row: f"{row[1].share:.4f}" if row[1] else "-"),
    ("95 % interval", lambda row: "{:.4f} to {:.4f}".format(*row[1].interval) if row[1] else "-"),
    ("inside", lambda row: ("yes" if row[1].is_inside else "no") if row[1] else "-"),
]


def tail_table(answers: Mapping[str, Sequence[Pair]]) -> str:
    """A line for every bin of some kinds of answers.

    :param answers: {what is counted: its pairs}.
    """
    rows: list[tuple[str, TailBin | None]] = []
    for name, pairs in answers.items():
        rows += [(name, one) for one in tail_bins(pairs)] or [(name, None)]
    return table_of(_COLUMNS, rows)
