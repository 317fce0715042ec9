"""Accuracy of the offline run: errors at true relations, and how well maps close where there is no truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from benchmark.logs import LOGS, MeasuredLog, opened
from benchmark.plots import plot_errors_by_seed, plot_errors_by_span
from benchmark.report import Report, Requirement, table
from benchmark.runs import Case, Run
from benchmark.scoring import FINAL, ONLINE, POLICY, SeedMeans, errors, over_seeds, score
from benchmark.settings import Settings
from benchmark.walls import POLICY as WALLS
from benchmark.walls import Walls, judge_walls
from hmt_slam_ros.evaluation import read_tum

SEEDS = 5
LONG_FACTOR, WORST_FACTOR = 1.5, 1.25
"""Largest ratios to the mean error: of relations over more than 60 s, and of the worst seed."""


@dataclass(frozen=True)
class Bound:
    """Largest mean errors over the seeds: m and degrees."""

    translation: float
    rotation: float


_CLOSED = (
    "Whether a map closes shows in what is seen twice, not in the number of loop closures: of areas that the local map "
    "holds together there is no loop to close. A missed loop shows as torn stretches or, where the second pass "
    "is far off, as fewer stretches over known ground than with other seeds."
)

BOUNDS = {"aces": Bound(0.043, 0.9), "intel": Bound(0.022, 0.8)}


def measure_accuracy(settings: Settings) -> Report:
    """Map every log with every seed, score what has relations, and look for double walls in the others."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("accuracy", "Accuracy of the offline run", seeds=seeds)
    with opened(settings.logs_or(LOGS)) as logs:
        cases = [Case(log, seed, changes=settings.changes) for log in logs for seed in seeds]
        runs = settings.runner.runs(cases)
        by_log = {log: [run for run in runs if run.case.log == log] for log in logs}
        _score(report, settings, {log: own for log, own in by_log.items() if log.relations is not None})
        _look_for_double_walls(report, {log: own for log, own in by_log.items() if log.relations is None})
    return report


def _score(report: Report, settings: Settings, by_log: dict[MeasuredLog, list[Run]]) -> None:
    if not by_log:
        return
    scores = {
        log.name: {file: [score(run.folder, log, file) for run in runs] for file in (FINAL, ONLINE)}
        for log, runs in by_log.items()
    }
    means = {name: {file: over_seeds(own) for file, own in of_log.items()} for name, of_log in scores.items()}
    for name, of_log in means.items():
        report.requirements += accuracy_requirements(name, of_log[FINAL])
    report.body += [accuracy_table(means), POLICY]
    report.data["relations"] = {
        name: {file: {"seeds": [asdict(s) for s in own], "mean": asdict(means[name][file])} for file, own in of.items()}
        for name, of in scores.items()
    }
    report.pictures["errors.png"] = "Mean error of every seed; the line is the bound of the mean over the seeds."
    plot_errors_by_seed(settings.out / "errors.png", scores, {name: b.translation for name, b in BOUNDS.items()})
    report.pictures["spans.png"] = "Error against the time that a relation spans, all seeds: median and 95 %."
    pairs = {log.name: [errors(run.folder, log) for run in runs] for log, runs in by_log.items()}
    plot_errors_by_span(settings.out / "spans.png", pairs)


def accuracy_requirements(name: str, means: SeedMeans) -> list[Requirement]:
    """What is asked for of the final trajectory of a log.

    :param name: of the log; only where it has a bound, the errors themselves are asked for.
    """
    bound = BOUNDS.get(name)
    absolute = (
        [
            Requirement(f"{name}: translation, mean over seeds", means.translation, bound.translation, "m"),
            Requirement(f"{name}: rotation, mean over seeds", means.rotation, bound.rotation, "deg"),
        ]
        if bound
        else []
    )
    return [
        *absolute,
        Requirement(f"{name}: relations over 60 s / all relations", means.long / means.translation, LONG_FACTOR),
        Requirement(f"{name}: worst seed / mean over seeds", means.worst / means.translation, WORST_FACTOR),
    ]


def accuracy_table(means: dict[str, dict[str, SeedMeans]]) -> str:
    """One line for every log and kind of trajectory."""
    head = ["log", "trajectory", "translation [m]", "between seeds", "between relations", "worst seed", "over 60 s [m]"]
    head += ["its max", "rotation [deg]", "matched", "carried", "missed"]
    return table(head, [_row(name, file, mean) for name, of in means.items() for file, mean in of.items()])


def _row(name: str, file: str, mean: SeedMeans) -> list[str]:
    return [
        name,
        "final" if file == FINAL else "online",
        f"**{mean.translation:.4f}**",
        f"± {mean.translation_std:.4f}",
        f"± {mean.relations_std:.3f}",
        f"{mean.worst:.4f}",
        f"{mean.long:.4f}",
        f"{mean.long_max:.2f}",
        f"{mean.rotation:.3f}",
        f"{100.0 * mean.matched:.1f} %",
        str(mean.carried),
        str(mean.missed),
    ]


def _look_for_double_walls(report: Report, by_log: dict[MeasuredLog, list[Run]]) -> None:
    if not by_log:
        return
    walls = {
        log.name: [judge_walls(log.scans, read_tum(run.folder / FINAL).poses) for run in runs]
        for log, runs in by_log.items()
    }
    closures = {log.name: [int(run.report["loop_closures"]) for run in runs] for log, runs in by_log.items()}
    areas = {log.name: [int(run.report["areas"]) for run in runs] for log, runs in by_log.items()}
    for name, own in walls.items():
        report.requirements += [
            Requirement(f"{name}: torn stretches, worst seed", max(len(judged.torn) for judged in own), 0),
            Requirement(f"{name}: seeds in which nothing is seen twice", [len(j.stretches) for j in own].count(0), 0),
        ]
    report.body += [_walls_table(walls, areas, closures), WALLS, _CLOSED]
    report.data["walls"] = {
        name: [{"agreement": w.agreement, "stretches": [asdict(s) for s in w.stretches]} for w in own]
        for name, own in walls.items()
    }


def _walls_table(walls: dict[str, list[Walls]], areas: dict[str, list[int]], closures: dict[str, list[int]]) -> str:
    head = ["log without truth", "areas", "loop closures", "stretches over known ground", "torn", "where", "agreement"]
    rows = [
        [
            name,
            _span(areas[name]),
            _span(closures[name]),
            _span([len(judged.stretches) for judged in own]),
            _span([len(judged.torn) for judged in own]),
            ", ".join(sorted({f"{stretch.begin:.0f} m" for judged in own for stretch in judged.torn})) or "nowhere",
            f"{np.mean([judged.agreement for judged in own]):.3f}",
        ]
        for name, own in walls.items()
    ]
    return table(head, rows)


def _span(counts: Sequence[int]) -> str:
    return str(min(counts)) if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
