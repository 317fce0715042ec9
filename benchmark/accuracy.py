"""Accuracy of the offline run: errors at true relations, or closing of walls where there is no truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmark.logs import LOGS, WITH_RELATIONS, MeasuredLog, open_logs
from benchmark.report import Columns, Report, Requirement, table_of
from benchmark.runs import Case, Run
from benchmark.scoring import (
    FINAL,
    ONLINE,
    POLICY,
    WALLS_POLICY,
    SeedMeans,
    Walls,
    judge_walls,
    over_seeds,
    score,
    score_pairs,
    score_trajectory,
)
from benchmark.settings import Settings
from hmt_slam_ros.evaluation import PairErrors, RelationErrors, StampedPoses, read_tum
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.output_folder import EARLIER_LOGS

SEEDS = 5

LONG_FACTOR, WORST_FACTOR = 1.5, 1.25
"""Largest ratios to the mean error: of relations over more than 60 s, and of the worst seed."""

_CLOSED = (
    "Whether a map closes is measured by walls that are seen twice, not by the number of loop closures: areas within "
    "one local map need no closure. A missed loop results in torn stretches. If the second pass is far off, it results "
    "in fewer stretches over known ground than with other seeds."
)

WORSE = 1.2
"""Largest ratio of the mean error to that of the log mapped in one session."""

# The scan at the middle is in the first half alone, s.
_NEXT = 1e-3

SESSIONS_POLICY = (
    "The log is cut in the middle of its time. The first half is mapped; the second one extends that map "
    "(`hmt_slam map --from`) like a log of another day: the initial pose is unknown, and the odometry is reset. The "
    "relations are those of the whole log, including those between poses of both halves. They are matched as for "
    "accuracy; means over the seeds."
)

_DPI = 110
_BINS = 12
_LEAST = 20  # errors of a bin that is drawn
_SHORTEST = 0.1  # s; shorter spans are drawn there


@dataclass(frozen=True)
class Bound:
    """Largest mean errors over the seeds: m and degrees."""

    translation: float
    rotation: float


BOUNDS = {
    "aces": Bound(0.043, 0.9),
    "intel": Bound(0.022, 0.8),
    "csail": Bound(0.0319, 0.9),
    "hospital": Bound(0.10, 0.9),
}


def measure_accuracy(settings: Settings) -> Report:
    """Map every log with every seed; score logs with relations by these, and the others by double walls."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("accuracy", "Accuracy of the offline run", seeds=seeds)
    with open_logs(settings.logs_or(LOGS)) as logs:
        cases = [Case(log, seed, changes=settings.changes) for log in logs for seed in seeds]
        runs = settings.runner.runs(cases)
        by_log = {log: [run for run in runs if run.case.log == log] for log in logs}
        _score(report, settings, {log: own for log, own in by_log.items() if log.relations is not None})
        _score_walls(report, {log: own for log, own in by_log.items() if log.relations is None})
    return report


def _score(report: Report, settings: Settings, by_log: dict[MeasuredLog, list[Run]]) -> None:
    if not by_log:
        return
    scores = {
        log.name: {file: [score(run.folder, log, file) for run in runs] for file in (FINAL, ONLINE)}
        for log, runs in by_log.items()
    }
    means = {
        name: {file: over_seeds(scores_of_seeds) for file, scores_of_seeds in of_log.items()}
        for name, of_log in scores.items()
    }
    for name, of_log in means.items():
        report.requirements += accuracy_requirements(name, of_log[FINAL])
    report.body += [accuracy_table(means), POLICY]
    report.data["relations"] = {
        name: {
            file: {
                "seeds": [asdict(score_of_seed) for score_of_seed in scores_of_seeds],
                "mean": asdict(means[name][file]),
            }
            for file, scores_of_seeds in of_log.items()
        }
        for name, of_log in scores.items()
    }
    report.pictures["errors.png"] = "Mean error of every seed; the line is the bound of the mean over the seeds."
    plot_errors_by_seed(settings.out / "errors.png", scores, {name: b.translation for name, b in BOUNDS.items()})
    report.pictures["spans.png"] = "Error against the time that a relation spans, all seeds: median and 95 %."
    pairs = {log.name: [score_pairs(run.folder, log) for run in runs] for log, runs in by_log.items()}
    plot_errors_by_span(settings.out / "spans.png", pairs)


def accuracy_requirements(name: str, means: SeedMeans) -> list[Requirement]:
    """Requirements on the final trajectory of a log.

    :param name: of the log; the errors themselves are bounded only for logs in ``BOUNDS``.
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
    """A table with one line for every log and kind of trajectory."""
    columns: Columns[tuple[str, str, SeedMeans]] = [
        ("log", lambda row: row[0]),
        ("trajectory", lambda row: "final" if row[1] == FINAL else "online"),
        *((heading, lambda row, cell=cell: cell(row[2])) for heading, cell in _ERROR_COLUMNS),
        ("matched", lambda row: f"{100.0 * row[2].matched:.1f} %"),
        ("extrapolated", lambda row: str(row[2].extrapolated)),
        ("missed", lambda row: str(row[2].missed)),
    ]
    return table_of(columns, [(name, file, mean) for name, files in means.items() for file, mean in files.items()])


def _score_walls(report: Report, by_log: dict[MeasuredLog, list[Run]]) -> None:
    if not by_log:
        return
    walls = {
        log.name: [judge_walls(log.scans, read_tum(run.folder / FINAL).poses) for run in runs]
        for log, runs in by_log.items()
    }
    areas, closures = (
        {log.name: [int(run.report[name]) for run in runs] for log, runs in by_log.items()}
        for name in ("areas", "loop_closures")
    )
    for name, seeds in walls.items():
        report.requirements += [
            Requirement(f"{name}: torn stretches, worst seed", max(len(seed.torn_stretches) for seed in seeds), 0),
            Requirement(f"{name}: seeds in which nothing is seen twice", [len(s.stretches) for s in seeds].count(0), 0),
        ]
    report.body += [_walls_table(walls, areas, closures), WALLS_POLICY, _CLOSED]
    report.data["walls"] = {
        name: [{"agreement": w.agreement, "stretches": [asdict(s) for s in w.stretches]} for w in own]
        for name, own in walls.items()
    }


def _walls_table(walls: dict[str, list[Walls]], areas: dict[str, list[int]], closures: dict[str, list[int]]) -> str:
    columns: Columns[tuple[str, list[Walls]]] = [
        ("log without truth", lambda row: row[0]),
        ("areas", lambda row: _format_range(areas[row[0]])),
        ("loop closures", lambda row: _format_range(closures[row[0]])),
        ("stretches over known ground", lambda row: _format_range([len(seed.stretches) for seed in row[1]])),
        ("torn", lambda row: _format_range([len(seed.torn_stretches) for seed in row[1]])),
        (
            "where",
            lambda row: (
                ", ".join(sorted({f"{s.begin:.0f} m" for seed in row[1] for s in seed.torn_stretches})) or "nowhere"
            ),
        ),
        ("agreement", lambda row: f"{np.mean([seed.agreement for seed in row[1]]):.3f}"),
    ]
    return table_of(columns, walls.items())


def _format_range(counts: Sequence[int]) -> str:
    return str(min(counts)) if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def measure_sessions(settings: Settings) -> Report:
    """Map every log in one session and in two, with every seed."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("sessions", "A log in two sessions", seeds=seeds)
    rows: list[tuple[str, str, SeedMeans]] = []
    with open_logs(settings.logs_or(WITH_RELATIONS)) as logs:
        for log in logs:
            cases = [Case(log, seed, "", settings.changes) for seed in seeds]
            scores = {
                "in one session": [score(run.folder, log) for run in settings.runner.runs(cases)],
                "in two sessions": [errors_of_all(run.folder, log) for run in _second_halves(cases, settings)],
            }
            means = {name: over_seeds(errors_of_seeds) for name, errors_of_seeds in scores.items()}
            whole, halves = means.values()
            ratio = halves.translation / whole.translation
            report.requirements.append(Requirement(f"{log.name}: error in two sessions / in one", ratio, WORSE))
            rows += [(log.name, name, mean) for name, mean in means.items()]
            report.data[log.name] = {name: [asdict(errors) for errors in own] for name, own in scores.items()}
    columns: Columns[tuple[str, str, SeedMeans]] = [
        ("log", lambda row: row[0]),
        ("mapped", lambda row: row[1]),
        *(
            (heading, lambda row, cell=cell: cell(row[2]))
            for heading, cell in _ERROR_COLUMNS
            if "relations" not in heading
        ),
        ("matched", lambda row: f"{100.0 * row[2].matched:.1f} %"),
    ]
    report.body += [table_of(columns, rows), SESSIONS_POLICY]
    return report


def _second_halves(cases: Sequence[Case], settings: Settings) -> list[Run]:
    """The runs of the second half of a log, each on the map of the first."""
    middle = round(0.5 * open_log(cases[0].log.path).duration, 3)
    first = settings.runner.runs([replace(case, duration=middle) for case in cases])
    return settings.runner.runs(
        [replace(run.case, duration=0.0, start=middle + _NEXT, source=run.folder) for run in first]
    )


def errors_of_all(folder: Path, log: MeasuredLog) -> RelationErrors:
    """Errors of the trajectories of all sessions in the final map of an output folder."""
    parts = [read_tum(path) for path in (*sorted((folder / EARLIER_LOGS).glob("*.tum")), folder / FINAL)]
    stamps, poses = (np.concatenate(columns) for columns in zip(*((p.stamps, p.poses) for p in parts), strict=True))
    return score_trajectory(StampedPoses(stamps, poses), log)


def plot_errors_by_seed(
    path: Path, scores: Mapping[str, Mapping[str, Sequence[RelationErrors]]], bounds: Mapping[str, float]
) -> None:
    """Mean translation errors of every seed, one panel for each log.

    :param scores: {log: {file of the trajectory: score of each seed}}.
    :param bounds: {log: largest mean over the seeds, m}.
    """
    figure = Figure(figsize=(5.0 * len(scores), 4.0), layout="constrained")
    for axes, (name, own) in zip(_panels(figure, len(scores)), scores.items(), strict=True):
        final = own[FINAL]
        axes.plot([s.overall.translation.mean for s in final], "o-", color="C0", label="final, all relations")
        axes.plot([s.over_60_s.translation.mean for s in final], "s-", color="C3", label="final, over 60 s")
        axes.plot([s.overall.translation.mean for s in own[ONLINE]], "^:", color="C2", label="online, all relations")
        if name in bounds:
            axes.axhline(bounds[name], color="black", linewidth=0.8)
        axes.set_xticks(range(len(final)))
        axes.set_ylim(bottom=0.0)
        axes.set(title=name, xlabel="number of the seed", ylabel="mean error of translation [m]")
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)


def plot_errors_by_span(path: Path, pairs: Mapping[str, Sequence[PairErrors]]) -> None:
    """Translation error against the time span of the relations, one panel for each log.

    :param pairs: {log: errors of each seed}.
    """
    figure = Figure(figsize=(5.0 * len(pairs), 4.0), layout="constrained")
    for axes, (name, own) in zip(_panels(figure, len(pairs)), pairs.items(), strict=True):
        seconds = np.maximum(np.concatenate([errors.span[errors.is_matched] for errors in own]) * 1e-9, _SHORTEST)
        translation = np.concatenate([errors.translation[errors.is_matched] for errors in own])
        axes.plot(seconds, translation, ".", markersize=1.5, color="0.7", rasterized=True)
        edges = np.geomspace(seconds.min(), seconds.max(), _BINS + 1)
        bins = np.clip(np.searchsorted(edges, seconds, side="right") - 1, 0, _BINS - 1)
        filled = np.flatnonzero(np.bincount(bins) >= _LEAST)
        centers = [np.median(seconds[bins == k]) for k in filled]
        for share, style in ((50, "o-"), (95, "^--")):
            heights = [np.percentile(translation[bins == k], share) for k in filled]
            axes.plot(centers, heights, style, label=f"{share} %")
        axes.axvline(60.0, color="black", linewidth=0.8)
        axes.set(xscale="log", yscale="log")
        axes.set_ylim(bottom=1e-3)
        axes.set(title=name, xlabel="time between the two poses [s]", ylabel="error of translation [m]")
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)


def _panels(figure: Figure, count: int) -> Sequence[Axes]:
    panels: Sequence[Axes] = figure.subplots(1, count, squeeze=False)[0]
    return panels


_ERROR_COLUMNS: Columns[SeedMeans] = [
    ("translation [m]", lambda mean: f"**{mean.translation:.4f}**"),
    ("between seeds", lambda mean: f"± {mean.translation_std:.4f}"),
    ("between relations", lambda mean: f"± {mean.relations_std:.3f}"),
    ("worst seed", lambda mean: f"{mean.worst:.4f}"),
    ("over 60 s [m]", lambda mean: f"{mean.long:.4f}"),
    ("its max", lambda mean: f"{mean.long_max:.2f}"),
    ("rotation [deg]", lambda mean: f"{mean.rotation:.3f}"),
]
