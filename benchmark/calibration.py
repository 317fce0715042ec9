"""Calibration of the probabilities of topological paths and of the covariances, on simulated worlds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.special import gammainc

from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings, chosen_seeds, group_by_family, make_records
from benchmark.simulated.closures import NEW, NOT_EXAMINED
from benchmark.simulated.records import Record

RUNS = 300
"""Runs that are asked for at least."""

LIMIT = 0.05
"""Largest expected calibration error."""

BINS = 10
"""Bins of equal width."""

LEAST = 1e-6
"""Probability that a true answer is taken to have at least: ``tsbi.drop_probability``."""

_DRAWS = 1000

CONSISTENCY_RUNS = 100
"""Runs that are asked for at least."""

ALLOWED = (2.0, 4.5)
"""Between which the mean NEES has to be."""

COVERED = 7.815
"""Chi-square with 3 degrees of freedom at 95 %."""

_Samples = Callable[[Record], list[float]]

KINDS: dict[str, _Samples] = {
    "arcs": lambda record: [arc["nees"] for arc in record["arcs"]],
    "arcs that closed no loop": lambda record: [arc["nees"] for arc in record["arcs"] if not arc["closure"]],
    "arcs that closed a loop": lambda record: [arc["nees"] for arc in record["arcs"] if arc["closure"]],
    "poses of areas": lambda record: [area["nees"] for area in record["area_poses"]],
    "RTL's pose in the map": lambda record: [pose["map"]["nees"] for pose in record["poses"]],
    "RTL's pose in its area": lambda record: [pose["local"]["nees"] for pose in record["poses"]],
}

_REQUIRED = ("arcs", "poses of areas", "RTL's pose in the map")
_DPI = 110

POLICY = (
    "A question is a keyframe event at which TSBI compared keyframes with known areas and one of them fitted. Its "
    "answers are the live hypotheses after the event: their keyframes lie in new ground, or in a known area, at a "
    "pose. All true answers count as one, false ones as one for each known area; what was not examined is false. "
    "Expected calibration error: mean distance between probability and frequency over ten bins of equal width, "
    "weighted by what is in them; of the most probable answer of each question, and of all answers. Brier score: sum "
    "of squared errors over the answers. Log score: -log of the probability of the true answer, which is taken to be "
    f"{LEAST:g} at least. The base rate knows how often new ground is true, and spreads the rest evenly over the "
    "areas that were examined; the arcs alone are the transition model without a look at any scan. Intervals hold 95 "
    "% of the values over resampled runs. After a false closure was accepted, later questions are judged in the map as "
    "it is."
)

CONSISTENCY_POLICY = (
    "NEES: squared Mahalanobis distance of the truth from a belief over a pose, under its covariance; 3 on average "
    "where the covariance is right, smaller where it is too large. An area's true frame follows from the keyframe that "
    "is nearest to its origin. Arcs and the poses of areas in the map are those at the end of the run; RTL's pose, in "
    "the map and in the frame of the robot's area, is taken every two seconds. What is averaged is the mean of each "
    "run, for within a run errors depend on each other; "
    "the mean of 100 independent errors would be between 2.54 and 3.50 in 95 % of the cases. Coverage: share of all "
    "errors within the 95 % ellipsoid."
)


def measure_calibration(settings: Settings) -> Report:
    """Map the worlds and compare the probabilities with the truth."""
    records = make_records(settings)
    report = Report("calibration", "Calibration of the probabilities", seeds=chosen_seeds(settings))
    events = [event for record in records for event in record["events"]]
    by_run = [[forecast_of_hypotheses(event) for event in record["events"]] for record in records]
    ours = [forecast for own in by_run for forecast in own]
    base = new_rate(events)
    forecasts = {
        "live hypotheses": ours,
        "arcs alone": [forecast_of_arcs(event) for event in events],
        "base rate": [forecast_of_base_rate(event, base) for event in events],
    }
    report.requirements += _requirements(len(records), forecasts)
    bounds = interval(by_run, lambda some: reliability_of_top(some).error)
    report.body += [
        _scores_table(forecasts),
        f"The 95 % interval of the first line's error of the most probable answer is {bounds[0]:.3f} to "
        f"{bounds[1]:.3f}. New ground is a true answer of {100.0 * base:.0f} % of the questions.",
        _family_table(records),
        POLICY,
    ]
    report.data["forecasts"] = {
        name: [[forecast.right, *forecast.wrong] for forecast in own] for name, own in forecasts.items()
    }
    report.pictures["reliability.png"] = "Frequency against probability, with 95 % intervals; below, answers in a bin."
    plot_reliability(
        settings.out / "reliability.png",
        {"most probable answer": reliability_of_top(ours), "all answers": reliability_of_all(ours)},
    )
    return report


def _requirements(runs: int, forecasts: dict[str, list[Forecast]]) -> list[Requirement]:
    ours = forecasts["live hypotheses"]
    score = float(np.mean([forecast.brier for forecast in ours])) if ours else math.nan
    return [
        Requirement("runs", runs, math.inf, least=RUNS),
        Requirement("expected calibration error, most probable answer", reliability_of_top(ours).error, LIMIT),
        Requirement("expected calibration error, all answers", reliability_of_all(ours).error, LIMIT),
        *(
            Requirement(f"Brier score / that of the {name}", _ratio(score, float(np.mean([f.brier for f in own]))), 1.0)
            for name, own in forecasts.items()
            if own is not ours and own
        ),
    ]


def _ratio(score: float, other: float) -> float:
    """Of two scores; 1 where nobody ever erred."""
    return score / other if other else (1.0 if score == 0.0 else math.inf)


def _scores_table(forecasts: dict[str, list[Forecast]]) -> str:
    head = ["forecast", "questions", "Brier", "log score [nat]", "most probable is true", "its error", "error, all"]
    return table(head, [[name, *_forecast_cells(own)] for name, own in forecasts.items()])


def _family_table(records: list[Record]) -> str:
    head = ["family", "runs", "questions", "Brier", "log score [nat]", "most probable is true", "its error"]
    head.append("error, all")
    rows = [
        [
            family,
            str(len(own)),
            *_forecast_cells([forecast_of_hypotheses(event) for record in own for event in record["events"]]),
        ]
        for family, own in group_by_family(records).items()
    ]
    return table(head, rows)


def _forecast_cells(own: Sequence[Forecast]) -> list[str]:
    if not own:
        return ["0", *["-"] * 5]
    return [
        str(len(own)),
        f"{np.mean([forecast.brier for forecast in own]):.4f}",
        f"{np.mean([forecast.surprise for forecast in own]):.3f}",
        f"{100.0 * np.mean([forecast.top[1] for forecast in own]):.1f} %",
        f"{reliability_of_top(own).error:.3f}",
        f"{reliability_of_all(own).error:.3f}",
    ]


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
    def all_answers(self) -> list[tuple[float, bool]]:
        """The same of all answers, without false ones of which nothing is said."""
        return [(self.right, True), *((p, False) for p in self.wrong if p >= LEAST)]


def make_forecast(answers: Sequence[tuple[int, float, bool]]) -> Forecast:
    """From (known area, probability, whether it is right) of some answers."""
    right = sum(p for _, p, true in answers if true)
    wrong: dict[int, float] = {}
    for area, p, true in answers:
        if not true:
            wrong[area] = wrong.get(area, 0.0) + p
    rest = max(0.0, 1.0 - right - sum(wrong.values()))
    return Forecast(min(1.0, right), (*wrong.values(), rest))


def forecast_of_hypotheses(event: Record) -> Forecast:
    """What the live hypotheses say."""
    return make_forecast([(a["area"], a["probability"], a["right"]) for a in event["answers"]])


def forecast_of_arcs(event: Record) -> Forecast:
    """What the arcs alone say."""
    return make_forecast([(a["area"], a["probability"], a["right"]) for a in event["arcs_alone"]])


def forecast_of_base_rate(event: Record, new: float) -> Forecast:
    """What one says who knows how often new ground is true.

    :param new: that frequency.
    """
    found: list[tuple[int, float, bool]] = []
    # The answers of one hypothesis follow each other: new ground, then the known areas.
    arcs = event["arcs_alone"]
    starts = [k for k, answer in enumerate(arcs) if answer["area"] in {NEW, NOT_EXAMINED}]
    for begin, end in zip(starts, [*starts[1:], len(arcs)], strict=True):
        own = arcs[begin:end]
        weight, known = sum(answer["probability"] for answer in own), len(own) - 1
        for answer in own:
            share = new if answer["area"] == NEW else (1.0 - new) / max(1, known)
            found.append((answer["area"], weight * (share if known else 1.0), answer["right"]))
    return make_forecast(found)


def new_rate(events: Sequence[Record]) -> float:
    """Share of the questions of which new ground is a true answer."""
    true = [any(a["right"] for a in event["arcs_alone"] if a["area"] == NEW) for event in events]
    return float(np.mean(true)) if true else math.nan


@dataclass(frozen=True, eq=False)
class Reliability:
    """Frequency against probability.

    :ivar counts: shape (BINS,), answers in each bin.
    :ivar predicted: shape (BINS,), mean probability there, NaN in an empty one.
    :ivar observed: shape (BINS,), share of them that is true.
    """

    counts: NDArray[np.int64]
    predicted: NDArray[np.float64]
    observed: NDArray[np.float64]

    @property
    def error(self) -> float:
        """Expected calibration error."""
        filled = self.counts > 0
        gaps = np.abs(self.predicted[filled] - self.observed[filled])
        return float(np.average(gaps, weights=self.counts[filled])) if filled.any() else math.nan


def reliability(pairs: Sequence[tuple[float, bool]]) -> Reliability:
    """Of (probability, whether it came true)."""
    predicted, observed = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    bins = np.minimum((predicted * BINS).astype(np.int64), BINS - 1)
    counts = np.bincount(bins, minlength=BINS)
    with np.errstate(invalid="ignore"):
        return Reliability(
            counts,
            np.bincount(bins, weights=predicted, minlength=BINS) / counts,
            np.bincount(bins, weights=observed, minlength=BINS) / counts,
        )


def reliability_of_top(forecasts: Sequence[Forecast]) -> Reliability:
    """Of the most probable answers."""
    return reliability([forecast.top for forecast in forecasts])


def reliability_of_all(forecasts: Sequence[Forecast]) -> Reliability:
    """Of all answers."""
    return reliability([pair for forecast in forecasts for pair in forecast.all_answers])


def interval(
    by_run: Sequence[Sequence[Forecast]], figure: Callable[[Sequence[Forecast]], float]
) -> tuple[float, float]:
    """Between which values a figure is in 95 % of the draws of as many runs, with replacement."""
    draw = np.random.default_rng(0)
    runs = [own for own in by_run if own]
    values = []
    for _ in range(_DRAWS if runs else 0):
        chosen = draw.integers(len(runs), size=len(runs))
        values.append(figure([forecast for k in chosen for forecast in runs[k]]))
    low, high = np.percentile(values, [2.5, 97.5]) if values else (math.nan, math.nan)
    return float(low), float(high)


def measure_consistency(settings: Settings) -> Report:
    """Map the worlds and compare covariances with errors."""
    records = make_records(settings)
    report = Report("consistency", "Consistency of the covariances", seeds=chosen_seeds(settings))
    low, high = ALLOWED
    report.requirements.append(Requirement("runs", len(records), math.inf, least=CONSISTENCY_RUNS))
    report.requirements += [
        Requirement(f"NEES of {kind}, mean over runs", mean_nees(records, KINDS[kind]), high, least=low)
        for kind in _REQUIRED
    ]
    report.body += [_nees_table(records), _nees_by_family(records), CONSISTENCY_POLICY]
    report.data["nees"] = {
        kind: {record["world"]: samples(record) for record in records} for kind, samples in KINDS.items()
    }
    report.pictures["nees.png"] = "Share of errors below a NEES; the line is chi-square with 3 degrees of freedom."
    pooled = {kind: [forecast for record in records for forecast in KINDS[kind](record)] for kind in _REQUIRED}
    plot_nees(settings.out / "nees.png", pooled)
    return report


def run_means(records: Sequence[Record], samples: _Samples) -> list[float]:
    """The mean NEES of every run that has any."""
    return [float(np.mean(own)) for record in records if (own := samples(record))]


def mean_nees(records: Sequence[Record], samples: _Samples) -> float:
    """Mean over runs of the mean within each."""
    means = run_means(records, samples)
    return float(np.mean(means)) if means else math.nan


def coverage(records: Sequence[Record], samples: _Samples) -> float:
    """Share of all errors within the 95 % ellipsoid."""
    pooled = [forecast <= COVERED for record in records for forecast in samples(record)]
    return float(np.mean(pooled)) if pooled else math.nan


def _nees_table(records: list[Record]) -> str:
    head = ["of", "runs", "errors", "NEES, mean over runs", "median run", "worst run", "within 95 %"]
    rows = []
    for kind, samples in KINDS.items():
        if means := run_means(records, samples):
            count = sum(len(samples(record)) for record in records)
            figures = [f"{value:.2f}" for value in (np.mean(means), np.median(means), max(means))]
            rows.append([kind, str(len(means)), str(count), *figures, f"{100.0 * coverage(records, samples):.1f} %"])
    return table(head, rows)


def _nees_by_family(records: list[Record]) -> str:
    head = ["family", *(word for kind in _REQUIRED for word in (f"NEES of {kind}", "within 95 %"))]
    rows = []
    for family, own in group_by_family(records).items():
        pairs = [(mean_nees(own, KINDS[kind]), coverage(own, KINDS[kind])) for kind in _REQUIRED]
        rows.append([family, *(cell for mean, share in pairs for cell in (f"{mean:.2f}", f"{100.0 * share:.1f} %"))])
    return table(head, rows)


def plot_reliability(path: Path, curves: Mapping[str, Reliability]) -> None:
    """Frequency against probability with Wilson's 95 % intervals, and how many answers are in each bin.

    :param curves: {of what: its reliability}.
    """
    figure = Figure(figsize=(5.0 * len(curves), 6.0), layout="constrained")
    grid = figure.subplots(2, len(curves), squeeze=False, height_ratios=(3.0, 1.0))
    for column, (name, curve) in enumerate(curves.items()):
        upper, lower = grid[0][column], grid[1][column]
        filled = curve.counts > 0
        predicted, observed, counts = curve.predicted[filled], curve.observed[filled], curve.counts[filled]
        low, high = wilson_interval(observed, counts)
        upper.plot([0.0, 1.0], [0.0, 1.0], color="black", linewidth=0.8)
        bars = np.maximum(0.0, np.stack((observed - low, high - observed)))
        upper.errorbar(predicted, observed, bars, fmt="o-", capsize=3)
        upper.set_title(f"{name}: expected error {curve.error:.3f}")
        upper.set_ylabel("share that is true")
        lower.bar(predicted, counts, width=0.04)
        lower.set_yscale("log")
        lower.set_xlim(upper.get_xlim())
        lower.set_xlabel("probability")
        lower.set_ylabel("answers")
    figure.savefig(path, dpi=_DPI)


def wilson_interval(
    shares: NDArray[np.float64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The 95 % intervals of some shares of so many."""
    z2 = 1.96**2
    middle = (shares + z2 / (2.0 * counts)) / (1.0 + z2 / counts)
    half = np.sqrt(z2 * (shares * (1.0 - shares) / counts + z2 / (4.0 * counts**2))) / (1.0 + z2 / counts)
    return middle - half, middle + half


def plot_nees(path: Path, samples: Mapping[str, Sequence[float]]) -> None:
    """Cumulative distributions of normalised errors.

    :param samples: {of what: NEES}.
    """
    figure = Figure(figsize=(6.0, 4.5), layout="constrained")
    axes = figure.subplots()
    errors = np.geomspace(0.01, 100.0, 200)
    for name, own in samples.items():
        axes.plot(np.sort(own), (np.arange(len(own)) + 1.0) / max(1, len(own)), label=name)
    axes.plot(errors, gammainc(1.5, 0.5 * errors), color="black", linewidth=0.8, label="as it should be")
    axes.set_xscale("log")
    axes.set_xlim(0.01, 100.0)
    axes.set_xlabel("NEES")
    axes.set_ylabel("share of errors below")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)
