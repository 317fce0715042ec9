"""The paper's Table II: time and memory against the same program with a single area, at equal accuracy."""

from __future__ import annotations

import hashlib
import lzma
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmark import charted_run
from benchmark.charted_run import AREAS, METRIC
from benchmark.logs import BUNDLED, MeasuredLog, dataset_folder, open_logs
from benchmark.odometry import LONG_LIMIT
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS, CachedRunner, Case, Run, Runner
from benchmark.scoring import FINAL
from benchmark.settings import Settings
from benchmark.simulated.records import code_hash
from benchmark.simulated.worlds import CAMPUS, CAMPUS_WORLD
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import (
    RelationErrors,
    Relations,
    StampedPoses,
    evaluate_relations,
    read_true_poses,
    read_tum,
    true_relations,
)
from hmt_slam_ros.simulation import open_simulated

COMPARED = ("edmonton", CAMPUS, "aces", "intel")

PARTICLES = (12, 100)
"""Numbers of particles of the metric filter, which are tried in this order until it is as accurate."""

FACTOR, SLACK = 1.25, 0.01
"""Largest ratio and largest difference (m) of errors that are as good as each other."""

MEMORY, TIME = 3.0, 4.0
"""Smallest ratios of memory and time of the metric filter on the campus."""

SEEDS = 1

POLICY = (
    "HMT-SLAM is the program as it is. The metric RBPF is the same program with a single area: its local map contains "
    "the whole log, and area abstraction never cuts. So the topological processes have nothing to do, and loops are "
    f"closed by particles alone. It runs with {', '.join(map(str, PARTICLES))} particles, until its final trajectory "
    f"is as accurate over relations of more than 60 s: up to {FACTOR:g} times the error, or {SLACK:g} m more, and no "
    f"error above {LONG_LIMIT:g} m, beyond which a map is not right. If none is, its figures with the most particles "
    "are lower bounds. One run at a time, each an OS process, with compiled kernels. CPU time is user and system time "
    "of the process without reading or simulating the log; peak memory is the largest resident set, which includes the "
    "memory before the first scan. Both runs end with the same refinement of the trajectory, which is listed, and part "
    f"of both figures. The campus is {CAMPUS_WORLD}, scored by the truth; ACES and Intel by their relations; Edmonton, "
    "which has no truth, by the distance of its relations from those of GMapping, which is a metric RBPF as well."
)

EXTENTS = {"edmonton": 100.0, CAMPUS: 200.0, "aces": 80.0, "intel": 60.0}
"""Half of the side of a map that contains the whole log, m."""

_GMAPPING = "edmonton.gmapping.txt.xz"
_DPI = 80


@dataclass(frozen=True)
class Entry:
    """One method on one log, means over the seeds.

    :ivar particles: of every hypothesis.
    :ivar cpu: s; ``refinement``, the part of it that comes after the log.
    :ivar peak: largest resident memory, MB; ``start``, before the first scan; ``maps``, of the particles' maps.
    :ivar error: m, over all relations; ``long_error``, over more than 60 s; ``worst``, the largest of these.
    """

    method: str
    particles: int
    areas: float
    closures: float
    cpu: float
    refinement: float
    peak: float
    start: float
    maps: float
    error: float
    long_error: float
    worst: float

    def as_accurate_as(self, other: Entry) -> bool:
        """Whether the long error is as good, and the map right."""
        return self.worst <= LONG_LIMIT and self.long_error <= max(FACTOR * other.long_error, other.long_error + SLACK)


@dataclass(frozen=True)
class Comparison:
    """The entries of a log.

    :ivar ours: the program as it is.
    :ivar metric: the program with a single area, with increasing numbers of particles.
    :ivar runs: {method: its run with the first seed}.
    :ivar reference_name: name of the reference of the errors.
    """

    ours: Entry
    metric: tuple[Entry, ...]
    runs: dict[str, Run]
    reference_name: str

    @property
    def is_equal(self) -> bool:
        """Whether the last metric filter is as accurate."""
        return self.metric[-1].as_accurate_as(self.ours)

    @property
    def memory_ratio(self) -> float:
        """Ratio of the memory of the last metric filter."""
        return self.metric[-1].peak / self.ours.peak

    @property
    def time_ratio(self) -> float:
        """Ratio of the CPU time of the last metric filter."""
        return self.metric[-1].cpu / self.ours.cpu


def measure_table(settings: Settings) -> Report:
    """Map every log with both programs."""
    names, seeds = settings.logs_or(COMPARED), settings.seeds_or(SEEDS)
    if strange := [name for name in names if name not in EXTENTS]:
        raise HmtSlamError(f"there is no {strange[0]!r} to compare on: choose from {', '.join(EXTENTS)}")
    report = Report("table", "Time and memory against a global metric RBPF", seeds=seeds)
    runner = CachedRunner(settings.records.folder / "table", jobs=1, fingerprint=_fingerprint())
    with open_compared_logs(names) as logs:
        _compile_kernels()
        found = {log.name: _compare_log(log, seeds, settings.changes, runner) for log in logs}
    if CAMPUS in found:
        report.requirements += requirements(found[CAMPUS])
    processes = {name: own.runs["HMT-SLAM"].report["ms_per_scan"] for name, own in found.items()}
    report.body += [comparison_table(found), _ratio_table(found), _process_table(processes), POLICY]
    report.data["runs"] = {
        name: {"ours": vars(own.ours), "metric": [vars(entry) for entry in own.metric]} for name, own in found.items()
    }
    report.pictures["table_growth.png"] = "Memory of the process above what it had before the first scan, over the log."
    reports = {name: {method: run.report for method, run in own.runs.items()} for name, own in found.items()}
    plot_growth(settings.out / "table_growth.png", reports)
    report.pictures["table_processes.png"] = "Time of every process for a scan, mean over the log."
    plot_processes(settings.out / "table_processes.png", processes)
    report.illustrations = ("table_growth.png", "table_processes.png")
    return report


def _compile_kernels() -> None:
    """Compile missing kernels in a run that does not count."""
    with tempfile.TemporaryDirectory(prefix="hmt_slam_benchmark_") as folder, open_logs([BUNDLED]) as (log,):
        Runner(Path(folder), jobs=1).runs([ChartedCase(log, 0, variant=AREAS)])


def _compare_log(log: MeasuredLog, seeds: Sequence[int], changes: tuple[str, ...], runner: Runner) -> Comparison:
    own = runner.runs([ChartedCase(log, seed, changes=changes, variant=AREAS) for seed in seeds])
    relations, reference_name = choose_reference(log, own[0])

    def entry(method: str, particles: int, runs: Sequence[Run]) -> Entry:
        errors = [score_run(run, relations) for run in runs]
        return Entry(
            method,
            particles,
            mean(run.report["areas"] for run in runs),
            mean(run.report["loop_closures"] for run in runs),
            mean(run.cpu_seconds - run.report["log_s"] for run in runs),
            mean(run.report["refinement_s"] for run in runs),
            mean(run.peak_rss for run in runs) / 1e6,
            mean(run.report["memory"][0]["bytes"] for run in runs) / 1e6,
            mean(run.report["particle_map_bytes"] for run in runs) / 1e6,
            mean(error.overall.translation.mean for error in errors),
            mean(error.over_60_s.translation.mean for error in errors),
            max(error.over_60_s.translation.max for error in errors),
        )

    ours = entry("HMT-SLAM", own[0].report["particles"], own)
    kept, metric = {ours.method: own[0]}, list[Entry]()
    for particles in PARTICLES:
        runs = runner.runs([metric_case(log, seed, changes, particles) for seed in seeds])
        metric.append(entry("metric RBPF", particles, runs))
        kept[f"metric RBPF, {particles} particles"] = runs[0]
        if metric[-1].as_accurate_as(ours):
            break
    return Comparison(ours, tuple(metric), kept, reference_name)


def requirements(campus: Comparison) -> list[Requirement]:
    """Requirements on the campus."""
    last = campus.metric[-1]
    accuracy = "as accurate" if campus.is_equal else "not as accurate"
    subject = f"metric RBPF of {last.particles} particles, {accuracy}, against HMT-SLAM on the campus"
    return [
        Requirement("largest error of HMT-SLAM on the campus, over 60 s", campus.ours.worst, LONG_LIMIT, "m"),
        Requirement(f"memory of the {subject}", campus.memory_ratio, float("inf"), "times", least=MEMORY),
        Requirement(f"CPU time of the {subject}", campus.time_ratio, float("inf"), "times", least=TIME),
    ]


def comparison_table(found: dict[str, Comparison]) -> str:
    """A table with a line for every method on every log."""
    head = ["log", "method", "particles", "areas", "loop closures", "CPU time [s]", "of it refinement"]
    head += ["peak memory [MB]", "of it before the first scan", "maps of the particles [MB]", "error [m]"]
    head += ["over 60 s [m]", "the largest [m]", "by", "as accurate"]
    rows = []
    for name, own in found.items():
        for entry in (own.ours, *own.metric):
            counts = [f"{entry.particles}", f"{entry.areas:g}", f"{entry.closures:g}"]
            costs = [f"{cost:.0f}" for cost in (entry.cpu, entry.refinement, entry.peak, entry.start, entry.maps)]
            same = "yes" if entry.as_accurate_as(own.ours) else "no"
            errors = [f"{error:.3f}" for error in (entry.error, entry.long_error, entry.worst)]
            rows.append(
                [name, entry.method, *counts, *costs, *errors, own.reference_name, "" if entry is own.ours else same]
            )
    return table(head, rows)


def _ratio_table(found: dict[str, Comparison]) -> str:
    head = ["metric RBPF / HMT-SLAM", "particles", "as accurate", "peak memory", "memory above the start"]
    head += ["maps of the particles", "CPU time"]
    rows = []
    for name, own in found.items():
        last, ours = own.metric[-1], own.ours
        grown = (last.peak - last.start) / (ours.peak - ours.start)
        ratios = [f"{ratio:.2f}" for ratio in (own.memory_ratio, grown, last.maps / ours.maps, own.time_ratio)]
        rows.append([name, str(last.particles), "yes" if own.is_equal else "no", *ratios])
    return table(head, rows)


def _process_table(processes: dict[str, dict[str, float]]) -> str:
    names = list(next(iter(processes.values())))
    rows = [[log, *(f"{own[name]:.3f}" for name in names)] for log, own in processes.items()]
    return table(["log", *(f"{name} [ms a scan]" for name in names)], rows)


@dataclass(frozen=True)
class ChartedCase(Case):
    """A run with the cost over time.

    :ivar variant: "areas" or "metric", see :mod:`benchmark.charted_run`.
    """

    variant: str = ""

    @property
    def name(self) -> str:
        """Of the output folder."""
        return f"{self.variant}-{super().name}"

    def command(self, folder: Path) -> list[str]:
        """The command line that maps the log into a folder."""
        options = ["--out", str(folder), "--seed", str(self.seed), "--config", str(PARAMETERS)]
        changes = [word for change in self.changes for word in ("--set", change)]
        return [sys.executable, "-m", "benchmark.charted_run", self.variant, str(self.log.path), *options, *changes]


def metric_case(log: MeasuredLog, seed: int, changes: tuple[str, ...], particles: int) -> ChartedCase:
    """The case with a single area, and a number of particles."""
    own = (f"local_map.extent={EXTENTS[log.name]:g}", f"filter.particles={particles}")
    return ChartedCase(log, seed, changes=(*changes, *own), variant=METRIC)


def _fingerprint() -> str:
    """A hash of the code, which identifies its runs."""
    return code_hash() + hashlib.sha256(Path(charted_run.__file__).read_bytes()).hexdigest()[:8]


@contextmanager
def open_compared_logs(names: Sequence[str]) -> Iterator[list[MeasuredLog]]:
    """The logs of some names, including the campus.

    :raises HmtSlamError: for an unknown name or a missing file.
    """
    with open_logs([name for name in names if name != CAMPUS]) as logs:
        by_name = {log.name: log for log in logs} | {CAMPUS: MeasuredLog(CAMPUS, Path(CAMPUS_WORLD))}
        yield [by_name[name] for name in names]


def choose_reference(log: MeasuredLog, run: Run) -> tuple[Relations, str]:
    """Relations for the trajectories of a log, and the name of their source.

    :param run: of the program as it is, which is the reference if there is no other.
    """
    if log.name == CAMPUS:
        return true_relations(read_true_poses(open_simulated(CAMPUS_WORLD))), "truth"
    if log.relations is not None:
        return log.relations, "relations"
    file = dataset_folder() / _GMAPPING
    if log.name in file.name and file.is_file():
        with lzma.open(file, "rt", encoding="utf-8") as source:
            rows = np.loadtxt(source)
        stamps = np.round(1e9 * rows[:, 0]).astype(np.int64)
        return true_relations(StampedPoses(stamps, rows[:, 1:4])), "GMapping"
    return true_relations(read_tum(run.folder / FINAL)), "the other run"


def score_run(run: Run, relations: Relations) -> RelationErrors:
    """Errors of a run's trajectory."""
    log = run.case.log
    odometry = None if log.name == CAMPUS else log.odometry
    return evaluate_relations(read_tum(run.folder / FINAL), relations, odometry)


def plot_growth(path: Path, logs: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
    """Draw memory above that before the first scan, and time of a scan, over the log, as Fig. 9e of the paper.

    :param logs: {log: {method: report of :mod:`benchmark.charted_run`}}.
    """
    figure = Figure(figsize=(4.5 * len(logs), 6.0), layout="constrained")
    panels = figure.subplots(2, len(logs), squeeze=False)
    for column, (name, methods) in enumerate(logs.items()):
        upper, lower = panels[0][column], panels[1][column]
        for method, report in methods.items():
            memory, cost = report["memory"], report["cost"]
            minutes = [sample["s"] / 60.0 for sample in memory]
            upper.plot(minutes, [(s["bytes"] - memory[0]["bytes"]) / 1e6 for s in memory], label=method)
            lower.plot([sample["s"] / 60.0 for sample in cost], [sample["ms"] for sample in cost], linewidth=0.8)
        upper.set(title=name, ylabel="memory [MB]")
        upper.set_ylim(bottom=0.0)
        upper.legend(fontsize=7)
        lower.set(yscale="log", ylabel="computing time of a scan [ms]", xlabel="time of the log [min]")
    figure.savefig(path, dpi=_DPI)


def plot_processes(path: Path, logs: Mapping[str, Mapping[str, float]]) -> None:
    """Draw the mean time of every process for a scan, as Fig. 9c of the paper.

    :param logs: {log: {process: ms}}.
    """
    figure = Figure(figsize=(6.0, 3.5), layout="constrained")
    axes = figure.subplots()
    processes = list(next(iter(logs.values())))
    width = 0.8 / len(logs)
    for k, (name, own) in enumerate(logs.items()):
        places = np.arange(len(processes)) + (k - 0.5 * (len(logs) - 1)) * width
        axes.bar(places, [own[process] for process in processes], width, label=name)
    axes.set_xticks(range(len(processes)), processes)
    axes.set(yscale="log", ylabel="mean time for a scan [ms]")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)
