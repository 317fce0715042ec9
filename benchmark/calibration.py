"""Are the probabilities of topological paths as right as they say? On simulated worlds, at every closure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmark.forecasts import (
    LEAST,
    Forecast,
    interval,
    new_rate,
    of_arcs,
    of_base_rate,
    of_each,
    of_hypotheses,
    of_top,
)
from benchmark.plots import plot_reliability
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings, by_family, chosen_seeds, records_of
from benchmark.simulated.records import Record

RUNS = 300
"""Runs that are asked for at least."""

LIMIT = 0.05
"""Largest expected calibration error."""

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


def measure_calibration(settings: Settings) -> Report:
    """Map the worlds and compare the probabilities with the truth."""
    records = records_of(settings)
    report = Report("calibration", "Calibration of the probabilities", seeds=chosen_seeds(settings))
    events = [event for record in records for event in record["events"]]
    by_run = [[of_hypotheses(event) for event in record["events"]] for record in records]
    ours = [each for own in by_run for each in own]
    base = new_rate(events)
    sayings = {
        "live hypotheses": ours,
        "arcs alone": [of_arcs(event) for event in events],
        "base rate": [of_base_rate(event, base) for event in events],
    }
    report.requirements += _requirements(len(records), sayings)
    bounds = interval(by_run, lambda some: of_top(some).error)
    report.body += [
        _scores_table(sayings),
        f"The 95 % interval of the first line's error of the most probable answer is {bounds[0]:.3f} to "
        f"{bounds[1]:.3f}. New ground is a true answer of {100.0 * base:.0f} % of the questions.",
        _family_table(records),
        POLICY,
    ]
    report.data["forecasts"] = {name: [[each.right, *each.wrong] for each in own] for name, own in sayings.items()}
    report.pictures["reliability.png"] = "Frequency against probability, with 95 % intervals; below, answers in a bin."
    plot_reliability(
        settings.out / "reliability.png", {"most probable answer": of_top(ours), "all answers": of_each(ours)}
    )
    return report


def _requirements(runs: int, sayings: dict[str, list[Forecast]]) -> list[Requirement]:
    ours = sayings["live hypotheses"]
    score = float(np.mean([each.brier for each in ours])) if ours else math.nan
    return [
        Requirement("runs", runs, math.inf, least=RUNS),
        Requirement("expected calibration error, most probable answer", of_top(ours).error, LIMIT),
        Requirement("expected calibration error, all answers", of_each(ours).error, LIMIT),
        *(
            Requirement(f"Brier score / that of the {name}", _ratio(score, float(np.mean([f.brier for f in own]))), 1.0)
            for name, own in sayings.items()
            if own is not ours and own
        ),
    ]


def _ratio(score: float, other: float) -> float:
    """Of two scores; 1 where nobody ever erred."""
    return score / other if other else (1.0 if score == 0.0 else math.inf)


def _scores_table(sayings: dict[str, list[Forecast]]) -> str:
    head = ["forecast", "questions", "Brier", "log score [nat]", "most probable is true", "its error", "error, all"]
    return table(head, [[name, *_cells(own)] for name, own in sayings.items()])


def _family_table(records: list[Record]) -> str:
    head = ["family", "runs", "questions", "Brier", "log score [nat]", "most probable is true", "its error"]
    head.append("error, all")
    rows = [
        [family, str(len(own)), *_cells([of_hypotheses(event) for record in own for event in record["events"]])]
        for family, own in by_family(records).items()
    ]
    return table(head, rows)


def _cells(own: Sequence[Forecast]) -> list[str]:
    if not own:
        return ["0", *["-"] * 5]
    return [
        str(len(own)),
        f"{np.mean([each.brier for each in own]):.4f}",
        f"{np.mean([each.surprise for each in own]):.3f}",
        f"{100.0 * np.mean([each.top[1] for each in own]):.1f} %",
        f"{of_top(own).error:.3f}",
        f"{of_each(own).error:.3f}",
    ]
