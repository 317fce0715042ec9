"""Forecasts of topological paths, from records of simulated runs, and how right they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.simulated.closures import NEW, NOT_ASKED
from benchmark.simulated.records import Record

BINS = 10
"""Bins of equal width."""

LEAST = 1e-6
"""Probability that a true answer is taken to have at least: ``tsbi.drop_probability``."""

_DRAWS = 1000


class Forecast(NamedTuple):
    """What somebody says of one question.

    :ivar right: probability of the true answer.
    :ivar wrong: of every false one, and of what was not examined.
    """

    right: float
    wrong: tuple[float, ...]

    @property
    def brier(self) -> float:
        """Sum of squared errors."""
        return (1.0 - self.right) ** 2 + sum(p * p for p in self.wrong)

    @property
    def surprise(self) -> float:
        """-log of the probability of the true answer, nats."""
        return -math.log(max(self.right, LEAST))

    @property
    def top(self) -> tuple[float, bool]:
        """Probability of the most probable answer, and whether that is true."""
        return max(self.right, *self.wrong), self.right >= max(self.wrong)

    @property
    def each(self) -> list[tuple[float, bool]]:
        """The same of all answers, without false ones of which nothing is said."""
        return [(self.right, True), *((p, False) for p in self.wrong if p >= LEAST)]


def forecast(answers: Sequence[tuple[int, float, bool]]) -> Forecast:
    """From (known area, probability, whether it is right) of some answers."""
    right = sum(p for _, p, true in answers if true)
    wrong: dict[int, float] = {}
    for area, p, true in answers:
        if not true:
            wrong[area] = wrong.get(area, 0.0) + p
    rest = max(0.0, 1.0 - right - sum(wrong.values()))
    return Forecast(min(1.0, right), (*wrong.values(), rest))


def of_hypotheses(event: Record) -> Forecast:
    """What the live hypotheses say."""
    return forecast([(a["area"], a["probability"], a["right"]) for a in event["answers"]])


def of_arcs(event: Record) -> Forecast:
    """What the arcs alone say."""
    return forecast([(a["area"], a["probability"], a["right"]) for a in event["arcs_alone"]])


def of_base_rate(event: Record, new: float) -> Forecast:
    """What one says who knows how often new ground is true.

    :param new: that frequency.
    """
    found: list[tuple[int, float, bool]] = []
    # The answers of one hypothesis follow each other: new ground, then the known areas.
    arcs = event["arcs_alone"]
    starts = [k for k, answer in enumerate(arcs) if answer["area"] in {NEW, NOT_ASKED}]
    for begin, end in zip(starts, [*starts[1:], len(arcs)], strict=True):
        own = arcs[begin:end]
        weight, known = sum(answer["probability"] for answer in own), len(own) - 1
        for answer in own:
            share = new if answer["area"] == NEW else (1.0 - new) / max(1, known)
            found.append((answer["area"], weight * (share if known else 1.0), answer["right"]))
    return forecast(found)


def new_rate(events: Sequence[Record]) -> float:
    """Share of the questions of which new ground is a true answer."""
    true = [any(a["right"] for a in event["arcs_alone"] if a["area"] == NEW) for event in events]
    return float(np.mean(true)) if true else math.nan


@dataclass(frozen=True, eq=False)
class Reliability:
    """Frequency against probability.

    :ivar counts: shape (BINS,), answers in each bin.
    :ivar said: shape (BINS,), mean probability there, NaN in an empty one.
    :ivar came: shape (BINS,), share of them that is true.
    """

    counts: NDArray[np.int64]
    said: NDArray[np.float64]
    came: NDArray[np.float64]

    @property
    def error(self) -> float:
        """Expected calibration error."""
        filled = self.counts > 0
        gaps = np.abs(self.said[filled] - self.came[filled])
        return float(np.average(gaps, weights=self.counts[filled])) if filled.any() else math.nan


def reliability(pairs: Sequence[tuple[float, bool]]) -> Reliability:
    """Of (probability, whether it came true)."""
    said, came = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    bins = np.minimum((said * BINS).astype(np.int64), BINS - 1)
    counts = np.bincount(bins, minlength=BINS)
    with np.errstate(invalid="ignore"):
        return Reliability(
            counts,
            np.bincount(bins, weights=said, minlength=BINS) / counts,
            np.bincount(bins, weights=came, minlength=BINS) / counts,
        )


def of_top(forecasts: Sequence[Forecast]) -> Reliability:
    """Of the most probable answers."""
    return reliability([each.top for each in forecasts])


def of_each(forecasts: Sequence[Forecast]) -> Reliability:
    """Of all answers."""
    return reliability([pair for each in forecasts for pair in each.each])


def interval(
    by_run: Sequence[Sequence[Forecast]], figure: Callable[[Sequence[Forecast]], float]
) -> tuple[float, float]:
    """Between which values a figure is in 95 % of the draws of as many runs, with replacement."""
    draw = np.random.default_rng(0)
    runs = [own for own in by_run if own]
    values = []
    for _ in range(_DRAWS if runs else 0):
        chosen = draw.integers(len(runs), size=len(runs))
        values.append(figure([each for k in chosen for each in runs[k]]))
    low, high = np.percentile(values, [2.5, 97.5]) if values else (math.nan, math.nan)
    return float(low), float(high)
