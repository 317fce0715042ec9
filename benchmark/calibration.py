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

from benchmark.report import Columns, Report, Requirement, mean, table, table_of
from benchmark.settings import Settings, chosen_seeds, group_by_family, make_records
from benchmark.simulated.closures import NEW, NOT_EXAMINED
from benchmark.simulated.records import Record
from benchmark.tail import POLICY as TAIL_POLICY
from benchmark.tail import tail_requirement, tail_table

RUNS = 300
"""Smallest number of runs."""

LIMIT = 0.05
"""Largest expected calibration error."""

BINS = 10
"""Bins of equal width."""

LEAST = 1e-6
"""Smallest probability that counts for a true answer: ``tsbi.drop_probability``."""

_DRAWS = 1000

CONSISTENCY_RUNS = 100
"""Smallest number of runs."""

ALLOWED = (2.4, 3.6)
"""Bounds of the mean NEES."""

COVERED, ALMOST_ALL = 7.815, 16.266
"""Chi-square with 3 degrees of freedom at 95 % and at 99.9 %."""

WITHIN = 0.99
"""Smallest share of the errors within the ellipsoid of 99.9 %."""

_Samples = Callable[[Record], list[float]]

KINDS: dict[str, _Samples] = {
    "arcs": lambda record: [arc["nees"] for arc in record["arcs"]],
    "arcs that closed no loop": lambda record: [arc["nees"] for arc in record["arcs"] if not arc["closure"]],
    "arcs that closed a loop": lambda record: [arc["nees"] for arc in record["arcs"] if arc["closure"]],
    "poses of areas": lambda record: [area["nees"] for area in record["area_poses"]],
    "RTL's pose in the map": lambda record: [pose["map"]["nees"] for pose in record["poses"]],
    "RTL's pose in its area": lambda record: [pose["local"]["nees"] for pose in record["poses"]],
}

_REQUIRED = ("arcs that closed a loop", "poses of areas", "RTL's pose in its area")
_DPI = 110

POLICY = (
    "A question is a keyframe event at which TSBI compared keyframes with known areas and one of them fitted. Its "
    "answers are the live hypotheses after the event: their keyframes lie in new ground, or in a known area, at a "
    "pose. All true answers count as one, false ones as one for each known area; unexamined answers are false. "
    "Expected calibration error: mean distance between probability and frequency over ten bins of equal width, "
    "weighted by the number of answers in them; of the most probable answer of each question, and of all answers. "
    "Brier score: sum of squared errors over the answers. Log score: -log of the probability of the true answer, at "
    f"least {LEAST:g}. The base rate is the frequency of new ground; its remaining probability is uniform over the "
    "examined areas. The arcs alone are the transition model without any scan. Intervals hold 95 % of the values over "
    "resampled runs. After a false closure was accepted, later questions are scored in the map with that closure."
)

CONSISTENCY_POLICY = (
    "NEES: squared Mahalanobis distance of the truth from a belief over a pose, under its covariance; 3 on average "
    "for a correct covariance, less for one that is too large. An area's true frame follows from the keyframe nearest "
    "to its origin. Arcs and the poses of areas in the map are those at the end of the run; RTL's pose, in the map and "
    "in the frame of the robot's area, is taken every two seconds. Averages are over the means of the runs, because "
    "errors within a run are dependent; the mean of 100 independent errors would be between 2.54 and 3.50 in 95 % of "
    "the cases. Coverage: share of all errors within the ellipsoids of 95 % and 99.9 %."
)


def measure_calibration(settings: Settings) -> Report:
    """Map the worlds and compare the probabilities with the truth."""
    records = make_records(settings)
    report = Report("calibration", "Calibration of the probabilities", seeds=chosen_seeds(settings))
    events = [event for record in records for event in record["events"]]
    by_run = [[forecast_of_hypotheses(event) for event in record["events"]] for record in records]
    live = [forecast for run in by_run for forecast in run]
    base = new_rate(events)
    forecasts = {
        "live hypotheses": live,
        "arcs alone": [forecast_of_arcs(event) for event in events],
        "base rate": [forecast_of_base_rate(event, base) for event in events],
    }
    top = {"most probable answer": [forecast.top for forecast in live]}
    report.requirements += [
        *_requirements(len(records), forecasts),
        *(tail_requirement(name, pairs) for name, pairs in top.items()),
    ]
    bounds = interval(by_run, lambda some: reliability_of_top(some).error)
    by_family = {
        family: [forecast_of_hypotheses(event) for record in own for event in record["events"]]
        for family, own in group_by_family(records).items()
    }
    counts = {family: len(own) for family, own in group_by_family(records).items()}
    report.body += [
        table_of([("forecast", lambda row: row[0]), *_COLUMNS], forecasts.items()),
        f"The 95 % interval of the first line's error of the most probable answer is {bounds[0]:.3f} to "
        f"{bounds[1]:.3f}. New ground is a true answer of {100.0 * base:.0f} % of the questions.",
        table_of(
            [("family", lambda row: row[0]), ("runs", lambda row: str(counts[row[0]])), *_COLUMNS], by_family.items()
        ),
        tail_table(top),
        POLICY,
        TAIL_POLICY,
    ]
    report.data["forecasts"] = {name: [[f.right, *f.wrong] for f in own] for name, own in forecasts.items()}
    report.pictures["reliability.png"] = "Frequency against probability, with 95 % intervals; below, answers in a bin."
    curves = {"most probable answer": reliability_of_top(live), "all answers": reliability_of_all(live)}
    plot_reliability(settings.out / "reliability.png", curves)
    return report


def _requirements(runs: int, forecasts: dict[str, list[Forecast]]) -> list[Requirement]:
    live = forecasts["live hypotheses"]
    score = mean([forecast.brier for forecast in live])
    return [
        Requirement("runs", runs, math.inf, least=RUNS),
        Requirement("expected calibration error, most probable answer", reliability_of_top(live).error, LIMIT),
        Requirement("expected calibration error, all answers", reliability_of_all(live).error, LIMIT),
        *(
            Requirement(f"Brier score / that of the {name}", _ratio(score, mean([f.brier for f in own])), 1.0)
            for name, own in forecasts.items()
            if own is not live and own
        ),
    ]


def _ratio(score: float, other: float) -> float:
    """The ratio of two scores; 1 if both are 0."""
    return score / other if other else (1.0 if score == 0.0 else math.inf)


def _column(cell: Callable[[list[Forecast]], str]) -> Callable[[tuple[str, list[Forecast]]], str]:
    """The cell of the forecasts of a line, "-" if there are none."""
    return lambda row: cell(row[1]) if row[1] else "-"


_COLUMNS: Columns[tuple[str, list[Forecast]]] = [
    ("questions", lambda row: str(len(row[1]))),
    ("Brier", _column(lambda own: f"{mean([forecast.brier for forecast in own]):.4f}")),
    ("log score [nat]", _column(lambda own: f"{mean([forecast.surprise for forecast in own]):.3f}")),
    ("most probable is true", _column(lambda own: f"{100.0 * mean([forecast.top[1] for forecast in own]):.1f} %")),
    ("its error", _column(lambda own: f"{reliability_of_top(own).error:.3f}")),
    ("error, all", _column(lambda own: f"{reliability_of_all(own).error:.3f}")),
]


class Forecast(NamedTuple):
    """The probabilities of the answers to one question.

    :ivar right: probability of the true answer.
    :ivar wrong: of every false answer, and of unexamined ones.
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
        """Probability of the most probable answer, and whether it is true."""
        return max(self.right, *self.wrong), self.right >= max(self.wrong)

    @property
    def all_answers(self) -> list[tuple[float, bool]]:
        """The same of all answers, without false ones of negligible probability."""
        return [(self.right, True), *((p, False) for p in self.wrong if p >= LEAST)]


def make_forecast(answers: Sequence[tuple[int, float, bool]]) -> Forecast:
    """The forecast of some answers, each (known area, probability, whether it is right)."""
    right = sum(p for _, p, true in answers if true)
    wrong: dict[int, float] = {}
    for area, p, true in answers:
        if not true:
            wrong[area] = wrong.get(area, 0.0) + p
    rest = max(0.0, 1.0 - right - sum(wrong.values()))
    return Forecast(min(1.0, right), (*wrong.values(), rest))


def forecast_of_hypotheses(event: Record) -> Forecast:
    """The forecast of the live hypotheses."""
    return make_forecast([(a["area"], a["probability"], a["right"]) for a in event["answers"]])


def forecast_of_arcs(event: Record) -> Forecast:
    """The forecast of the arcs alone."""
    return make_forecast([(a["area"], a["probability"], a["right"]) for a in event["arcs_alone"]])


def forecast_of_base_rate(event: Record, new: float) -> Forecast:
    """The forecast of the base rate of new ground.

    :param new: frequency of new ground as a true answer.
    """
    found: list[tuple[int, float, bool]] = []
    # The answers of one hypothesis are consecutive: new ground, then the known areas.
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
    """Share of the questions for which new ground is a true answer; NaN if there are none."""
    return mean([any(a["right"] for a in event["arcs_alone"] if a["area"] == NEW) for event in events])


@dataclass(frozen=True, eq=False)
class Reliability:
    """Frequency by probability.

    :ivar counts: shape (BINS,), answers in each bin.
    :ivar predicted: shape (BINS,), mean probability in each bin, NaN in an empty one.
    :ivar observed: shape (BINS,), share of true answers in each bin.
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
    """The reliability of some answers, each (probability, whether it is true)."""
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
    """The reliability of the most probable answers."""
    return reliability([forecast.top for forecast in forecasts])


def reliability_of_all(forecasts: Sequence[Forecast]) -> Reliability:
    """The reliability of all answers."""
    return reliability([pair for forecast in forecasts for pair in forecast.all_answers])


def interval(
    by_run: Sequence[Sequence[Forecast]], figure: Callable[[Sequence[Forecast]], float]
) -> tuple[float, float]:
    """The 95 % bootstrap interval of a figure over the runs."""
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
    report.requirements += [
        Requirement(f"{kind}, within 99.9 %", coverage(records, KINDS[kind], ALMOST_ALL), 1.0, least=WITHIN)
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
    return [mean(own) for record in records if (own := samples(record))]


def mean_nees(records: Sequence[Record], samples: _Samples) -> float:
    """Mean over runs of the mean within each; NaN if there are none."""
    return mean(run_means(records, samples))


def coverage(records: Sequence[Record], samples: _Samples, bound: float = COVERED) -> float:
    """Share of all errors within an ellipsoid, by default that of 95 %; NaN if there are none."""
    return mean([sample <= bound for record in records for sample in samples(record)])


def _nees_table(records: list[Record]) -> str:
    head = ["of", "runs", "errors", "NEES, mean over runs", "median run", "worst run", "within 95 %", "99.9 %"]
    rows = []
    for kind, samples in KINDS.items():
        if means := run_means(records, samples):
            count = sum(len(samples(record)) for record in records)
            figures = [f"{value:.2f}" for value in (np.mean(means), np.median(means), max(means))]
            shares = [f"{100.0 * coverage(records, samples, bound):.1f} %" for bound in (COVERED, ALMOST_ALL)]
            rows.append([kind, str(len(means)), str(count), *figures, *shares])
    return table(head, rows)


def _nees_by_family(records: list[Record]) -> str:
    head = ["family", *(word for kind in _REQUIRED for word in (f"NEES of {kind}", "99.9 %"))]
    head += ["error of areas [m]", "runs with all areas within 99.9 %"]
    rows = []
    for family, own in group_by_family(records).items():
        pairs = [(mean_nees(own, KINDS[kind]), coverage(own, KINDS[kind], ALMOST_ALL)) for kind in _REQUIRED]
        cells = [cell for value, share in pairs for cell in (f"{value:.2f}", f"{100.0 * share:.1f} %")]
        error = mean([area["translation"] for record in own for area in record["area_poses"]])
        within = [all(area["nees"] <= ALMOST_ALL for area in record["area_poses"]) for record in own]
        rows.append([family, *cells, f"{error:.3f}", f"{sum(within)} of {len(within)}"])
    return table(head, rows)


def plot_reliability(path: Path, curves: Mapping[str, Reliability]) -> None:
    """Draw frequency against probability with Wilson's 95 % intervals, and the number of answers in each bin.

    :param curves: {name: reliability}.
    """
    figure = Figure(figsize=(5.0 * len(curves), 6.0), layout="constrained")
    grid = figure.subplots(2, len(curves), squeeze=False, height_ratios=(3.0, 1.0))
    for column, (name, curve) in enumerate(curves.items()):
        upper, lower = grid[0][column], grid[1][column]
        filled = curve.counts > 0
        predicted, observed, counts = curve.predicted[filled], curve.observed[filled], curve.counts[filled]
        low, high = _wilson_interval(observed, counts)
        upper.plot([0.0, 1.0], [0.0, 1.0], color="black", linewidth=0.8)
        bars = np.maximum(0.0, np.stack((observed - low, high - observed)))
        upper.errorbar(predicted, observed, bars, fmt="o-", capsize=3)
        upper.set(title=f"{name}: expected error {curve.error:.3f}", ylabel="share that is true")
        lower.bar(predicted, counts, width=0.04)
        lower.set_yscale("log")
        lower.set_xlim(upper.get_xlim())
        lower.set(xlabel="probability", ylabel="answers")
    figure.savefig(path, dpi=_DPI)


def _wilson_interval(
    shares: NDArray[np.float64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wilson's 95 % intervals of some shares, by their counts."""
    z2 = 1.96**2
    middle = (shares + z2 / (2.0 * counts)) / (1.0 + z2 / counts)
    half = np.sqrt(z2 * (shares * (1.0 - shares) / counts + z2 / (4.0 * counts**2))) / (1.0 + z2 / counts)
    return middle - half, middle + half


def plot_nees(path: Path, samples: Mapping[str, Sequence[float]]) -> None:
    """Draw the cumulative distributions of normalized errors.

    :param samples: {name: NEES}.
    """
    figure = Figure(figsize=(6.0, 4.5), layout="constrained")
    axes = figure.subplots()
    errors = np.geomspace(0.01, 100.0, 200)
    for name, own in samples.items():
        axes.plot(np.sort(own), (np.arange(len(own)) + 1.0) / max(1, len(own)), label=name)
    axes.plot(
        errors, gammainc(1.5, 0.5 * errors), color="black", linewidth=0.8, label="chi-square, 3 degrees of freedom"
    )
    axes.set(xscale="log", xlim=(0.01, 100.0), xlabel="NEES", ylabel="share of errors below")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)
