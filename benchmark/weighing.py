"""Hypotheses weighed by the filter's evidence, Eq. (14), by contradictions, or by both: which is better calibrated."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmark.calibration import (
    Forecast,
    forecast_of_hypotheses,
    reliability_of_all,
    reliability_of_top,
)
from benchmark.logs import ROOT, open_logs
from benchmark.report import Columns, Report, mean, table_of
from benchmark.runs import Case, Run
from benchmark.scoring import FINAL, score
from benchmark.settings import Settings, chosen_families, chosen_seeds
from benchmark.simulated.records import Record, code_hash
from benchmark.simulated.weighed import Weighing
from benchmark.simulated.worlds import FAMILIES, World
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.submap.pose_modes import normalize_weights

WORLDS = ("twins", "nested", "ring", "straight", "busy")
"""Identical wings, nested loops, a ring with identical sides, a corridor, and an office with people."""

RECORDED = ("aces", "intel", "csail")

SEEDS, RECORDED_SEEDS = 6, 2

IN_USE = "contradictions"

WEIGHINGS = {
    IN_USE: Weighing(1.0, 0.0, 1.0),
    "filter": Weighing(0.0, 1.0, 1.0),
    "filter alone": Weighing(0.0, 1.0, 0.0),
    "both": Weighing(1.0, 1.0, 1.0),
    "filter, tempered": Weighing(0.0, 0.03, 1.0),
    "filter alone, tempered": Weighing(0.0, 0.1, 0.0),
}
"""The weights that are compared; the factors of the last two are chosen on training seeds."""

FACTORS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Factors on the filter's evidence that are replayed."""

AMOUNTS = (0.1, 0.3, 1.0, 3.0, 6.0, 12.0)
"""Lower ends of ranges of evidence, nats."""

_DRAWS = 1000
_DPI = 110

CAPTION = (
    "Evidence for the most probable true hypothesis against the most probable false one. Left: of the filter, by the "
    "shares of beams on known surfaces. Right: how often evidence of so many nats is for the truth."
)

POLICY = (
    "Questions, Brier score, log score and expected calibration error are as of `python -m benchmark calibration`. "
    "*contradictions* is the package. *filter* has, in place of the contradictions with the submap, the log of the "
    "weighted mean of the particles' evidence of each scan, relative to unknown space; *filter alone* also leaves out "
    "the contradictions with older scans of the same ground; *both* has all. *Tempered* is the filter's evidence times "
    f"{WEIGHINGS['filter, tempered'].filter:g}, alone times {WEIGHINGS['filter alone, tempered'].filter:g}. Each is a "
    "run of its own, so that the questions differ. Intervals hold 95 % of the differences over resampled runs, the "
    "same for both. Accepted closures are those that became definite. The truth of a recorded log is the trajectory of "
    "the package with seed 0, whose errors at true relations are in a table; its walls part no places."
)

REPLAY_POLICY = (
    "Replayed: at every keyframe event of the package's runs with a true and a false live hypothesis, the probability "
    "of the true ones, had the evidence since the last acceptance been weighed otherwise. Which hypotheses live is as "
    "the package decided."
)


@dataclass(frozen=True)
class WeighedCase:
    """A log to be mapped with a weighing.

    :ivar name: of the log.
    :ivar log: name of a simulated log, or path of a recorded one.
    :ivar seed: of the run.
    :ivar reference: trajectory that is the truth of a recorded log.
    """

    name: str
    log: str
    seed: int
    reference: Path | None = None


def _record(folder: Path, weighing: Weighing, case: WeighedCase) -> Record:
    """The record of a run, which is kept in a folder.

    :raises HmtSlamError: where the run failed.
    """
    weights = ",".join(f"{weight:g}" for weight in weighing)
    path = folder / f"{weights}-{case.name}-{case.seed}.json"
    if not path.is_file() or _read(path)["code"] != code_hash():
        words = [weights, case.log, str(case.seed), str(path), *([str(case.reference)] if case.reference else [])]
        command = [sys.executable, "-m", "benchmark.simulated.weighed", *words]
        result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if result.returncode:
            raise HmtSlamError(f"the run {path.stem} failed: {result.stderr.strip() or 'nothing'}")
        print(f"{path.stem}: {_read(path)['cpu_s']:.1f} CPU s", file=sys.stderr, flush=True)
    return _read(path)


def _read(path: Path) -> Record:
    record: Record = json.loads(path.read_text(encoding="utf-8"))
    return record


Figures = Callable[[Sequence[Forecast]], float]

FIGURES: dict[str, Figures] = {
    "Brier": lambda some: mean([forecast.brier for forecast in some]),
    "log score [nat]": lambda some: mean([forecast.surprise for forecast in some]),
    "error of the most probable": lambda some: reliability_of_top(some).error,
    "error, all": lambda some: reliability_of_all(some).error,
}
"""What is measured of forecasts; less is better."""

_LEAST = 1e-300  # probability of a live hypothesis, for its logarithm


def measure_weighing(settings: Settings) -> Report:
    """Map worlds and recorded logs with every weighing; training worlds with the one in use alone."""
    chosen = chosen_families(settings, (*WORLDS, *RECORDED), (*FAMILIES, *RECORDED))
    seeds = chosen_seeds(settings, SEEDS)
    report = Report("weighing", "Weights of hypotheses by the filter's evidence", seeds=seeds)
    if worlds := [World(family, seed) for family in chosen if family in FAMILIES for seed in seeds]:
        cases = [WeighedCase(world.family, world.log, world.seed) for world in worlds]
        records = _map(settings, cases)
        _add(report, "Simulated worlds", cases, records)
        report.pictures["filter_evidence.png"] = CAPTION
        plot_evidence(settings.out / "filter_evidence.png", records[IN_USE])
    if logs := [name for name in chosen if name in RECORDED and not settings.training]:
        with open_logs(logs) as opened:
            references = settings.runner.runs([Case(log, 0) for log in opened])
            cases = [
                WeighedCase(run.case.log.name, str(run.case.log.path), seed, run.folder / FINAL)
                for run in references
                for seed in settings.seeds_or(RECORDED_SEEDS)
            ]
            _add(report, "Recorded logs", cases, _map(settings, cases))
            report.body.append(reference_table(references))
    report.body += [POLICY, REPLAY_POLICY]
    return report


def _add(report: Report, title: str, cases: Sequence[WeighedCase], records: Mapping[str, Sequence[Record]]) -> None:
    """Add the tables of some cases."""
    by_name = {
        f"{name}, {weighing}": [record for record, case in zip(own, cases, strict=True) if case.name == name]
        for name in dict.fromkeys(case.name for case in cases)
        for weighing, own in records.items()
    }
    report.body += [f"## {title}", outcome_table(records), name_table(by_name), replay_table(records[IN_USE])]
    report.data[title] = {name: [_forecasts(record) for record in own] for name, own in by_name.items()}


def reference_table(runs: Sequence[Run]) -> str:
    """A table of the errors at true relations of the runs that are the truth of recorded logs."""
    scores = {run.case.log.name: score(run.folder, run.case.log) for run in runs}
    columns: Columns[str] = [
        ("truth of", lambda name: name),
        ("translation [m]", lambda name: f"{scores[name].overall.translation.mean:.3f}"),
        ("over 60 s [m]", lambda name: f"{scores[name].over_60_s.translation.mean:.3f}"),
        ("its max", lambda name: f"{scores[name].over_60_s.translation.max:.2f}"),
    ]
    return table_of(columns, scores)


def _map(settings: Settings, cases: Sequence[WeighedCase]) -> dict[str, list[Record]]:
    """{weighing: the records of the cases}; of training worlds, only those of the weighing in use."""
    folder = settings.records.folder / "weighing"
    folder.mkdir(parents=True, exist_ok=True)
    names = [IN_USE] if settings.training else list(WEIGHINGS)
    with ThreadPoolExecutor(settings.records.jobs) as pool:
        return {name: list(pool.map(partial(_record, folder, WEIGHINGS[name]), cases)) for name in names}


def _forecasts(record: Record) -> list[Forecast]:
    """The forecasts of a run."""
    return [forecast_of_hypotheses(event) for event in record["events"]]


def outcome_table(records: Mapping[str, Sequence[Record]]) -> str:
    """A table of the figures of each weighing, with their differences from the one in use."""
    forecasts = {name: [_forecasts(record) for record in runs] for name, runs in records.items()}
    columns: Columns[str] = [
        ("weighing", lambda name: name),
        ("questions", lambda name: str(sum(map(len, forecasts[name])))),
        *_figure_columns(forecasts, IN_USE),
        ("closures accepted", lambda name: str(sum(len(record["accepted"]) for record in records[name]))),
        ("false", lambda name: str(_count_false(records[name]))),
        ("CPU [s]", lambda name: f"{sum(record['cpu_s'] for record in records[name]):.0f}"),
    ]
    return table_of(columns, records)


def _count_false(records: Sequence[Record]) -> int:
    return sum(not closure["right"] for record in records for closure in record["accepted"])


def _figure_columns(forecasts: Mapping[str, Sequence[Sequence[Forecast]]], base: str) -> Columns[str]:
    """Columns with the figures of forecasts, and of their differences from those of a base.

    :param forecasts: {name: the forecasts of each run}, the same runs for all names.
    """

    def columns_of(heading: str, figure: Figures) -> Columns[str]:
        return [
            (heading, lambda name: f"{figure([one for run in forecasts[name] for one in run]):.3f}"),
            ("difference", lambda name: _difference(forecasts[name], forecasts[base], figure) if name != base else ""),
        ]

    return [column for heading, figure in FIGURES.items() for column in columns_of(heading, figure)]


def _difference(own: Sequence[Sequence[Forecast]], base: Sequence[Sequence[Forecast]], figure: Figures) -> str:
    """The 95 % bootstrap interval of the difference of a figure over the runs."""
    draw = np.random.default_rng(0)
    values = []
    for _ in range(_DRAWS):
        chosen = draw.integers(len(own), size=len(own))
        values.append(figure([f for k in chosen for f in own[k]]) - figure([f for k in chosen for f in base[k]]))
    low, high = np.nanpercentile(values, [2.5, 97.5])
    return f"{low:+.3f} to {high:+.3f}"


def name_table(records: Mapping[str, Sequence[Record]]) -> str:
    """A table of the figures of every family or log under every weighing."""
    forecasts = {name: [one for record in runs for one in _forecasts(record)] for name, runs in records.items()}
    columns: Columns[str] = [
        ("log, weighing", lambda name: name),
        ("questions", lambda name: str(len(forecasts[name]))),
        *((heading, lambda name, own=figure: f"{own(forecasts[name]):.3f}") for heading, figure in FIGURES.items()),
        ("false closures", lambda name: str(_count_false(records[name]))),
    ]
    return table_of(columns, records)


def replay_table(records: Sequence[Record]) -> str:
    """A table of the figures with the weights replayed on the runs of the package."""
    weighings = [Weighing(c, factor, 1.0) for c in (1.0, 0.0) for factor in FACTORS]
    weighings += [Weighing(c, factor, 0.0) for c, factor in ((1.0, 0.0), (0.0, 0.1), (0.0, 1.0))]
    forecasts = {_name(w): [replay(record, w) for record in records] for w in weighings}
    columns: Columns[str] = [
        ("contradictions, filter, known ground", lambda name: name),
        ("events", lambda name: str(sum(map(len, forecasts[name])))),
        *_figure_columns(forecasts, _name(WEIGHINGS[IN_USE])),
    ]
    return table_of(columns, forecasts)


def _name(weighing: Weighing) -> str:
    return ", ".join(f"{weight:g}" for weight in weighing)


def replay(record: Record, weighing: Weighing) -> list[Forecast]:
    """The probability of the true hypotheses of a run of the package at its events, had it weighed otherwise."""
    forecasts = []
    for step in record["steps"]:
        right = np.array([entry["right"] for entry in step["hypotheses"]])
        if right.any() and not right.all():
            log_weights = np.array([_replayed_log_weight(entry, weighing) for entry in step["hypotheses"]])
            probabilities = normalize_weights(log_weights)
            forecasts.append(Forecast(float(probabilities[right].sum()), tuple(probabilities[~right].tolist())))
    return forecasts


def _replayed_log_weight(entry: Record, weighing: Weighing) -> float:
    before, newest = Weighing(*entry["before"]), Weighing(*entry["newest"])
    counted = WEIGHINGS[IN_USE].weigh(before)
    return math.log(max(entry["probability"], _LEAST)) + weighing.weigh(before.plus(newest)) - counted


class Contrast(NamedTuple):
    """The most probable true hypothesis less the most probable false one, at an event.

    :ivar matched_share: of the newest scan's beams on known surfaces.
    :ivar newest: log evidence of the newest scan, nats.
    :ivar total: since the last acceptance, nats.
    """

    matched_share: float
    newest: Weighing
    total: Weighing


def contrasts(record: Record) -> list[Contrast]:
    """The contrasts of a run."""
    found = []
    for step in record["steps"]:
        right, wrong = (
            max((e for e in step["hypotheses"] if e["right"] == is_right), key=_probability, default=None)
            for is_right in (True, False)
        )
        if right is not None and wrong is not None:
            matched_share = right["matched_share"] - wrong["matched_share"]
            before, newest = (Weighing(*np.subtract(right[part], wrong[part])) for part in ("before", "newest"))
            found.append(Contrast(matched_share, newest, before.plus(newest)))
    return found


def _probability(entry: Record) -> float:
    probability: float = entry["probability"]
    return probability


def reliability_of_evidence(evidences: Sequence[float]) -> list[tuple[float, int, float]]:
    """How often log evidence speaks for the truth, by its amount.

    :param evidences: for the truth, nats.
    :returns: (median amount, number, share for the truth) for each of some ranges of amounts.
    """
    values = np.array(evidences)
    ranges = np.digitize(np.abs(values), AMOUNTS)
    own = (values[ranges == number] for number in range(1, len(AMOUNTS) + 1))
    return [(float(np.median(np.abs(v))), len(v), float(np.mean(v > 0.0))) for v in own if len(v)]


def plot_evidence(path: Path, records: Sequence[Record]) -> None:
    """Draw the filter's evidence by the matched share, and how often evidence speaks for the truth."""
    found = [contrast for record in records for contrast in contrasts(record)]
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.scatter([c.matched_share for c in found], [c.newest.filter for c in found], s=6)
    left.set(xlabel="share of beams on known surfaces, true less false", ylabel="filter's evidence of a scan [nat]")
    totals = {
        "filter": [c.total.filter for c in found],
        "contradictions": [WEIGHINGS[IN_USE].weigh(c.total) for c in found],
    }
    for name, evidences in totals.items():
        amounts, _, shares = zip(*reliability_of_evidence(evidences), strict=True)
        right.plot(amounts, shares, "o-", label=name)
    stated = np.geomspace(0.1, 30.0, 100)
    right.plot(stated, 1.0 / (1.0 + np.exp(-stated)), color="black", linewidth=0.8, label="as stated")
    right.set(xscale="log", xlabel="evidence since the last acceptance [nat]", ylabel="share that is for the truth")
    right.legend()
    figure.savefig(path, dpi=_DPI)
