"""The paper's Table II: time and memory against the same program with one area for everything, at equal accuracy."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

from benchmark.charted_run import AREAS
from benchmark.charts import plot_growth, plot_processes
from benchmark.logs import BUNDLED, MeasuredLog, opened
from benchmark.report import Report, Requirement, table
from benchmark.robustness import LONG_LIMIT
from benchmark.runs import Run, Runner
from benchmark.settings import Settings
from benchmark.simulated.worlds import CAMPUS, CAMPUS_WORLD
from benchmark.table_runs import EXTENTS, Charted, KeptRunner, compared, judged, metric_case
from benchmark.table_runs import reference as reference_of
from hmt_slam_ros.errors import HmtSlamError

COMPARED = ("edmonton", CAMPUS, "aces")

PARTICLES = (12, 100)
"""Of the metric filter; more are tried until it is as accurate, but 1000 take more than an hour on the campus."""

FACTOR, SLACK = 1.25, 0.01
"""An error is as good as another up to this factor, and up to so many m more."""

MEMORY, TIME = 3.0, 4.0
"""How many times as much the metric filter takes on the campus, at least."""

SEEDS = 1

POLICY = (
    "HMT-SLAM is the program as it is. The metric RBPF is the same program with one area for everything: its local map "
    "holds the whole log, area abstraction never cuts, so that no topological process has anything to do, and a loop "
    f"is closed by particles alone. It is tried with {', '.join(map(str, PARTICLES))} particles, until its final "
    f"trajectory is as accurate over relations of more than 60 s: up to {FACTOR:g} times the error, or {SLACK:g} m "
    f"more, and no error above {LONG_LIMIT:g} m, beyond which a map is not right. Where none is, its figures with the "
    "most particles are lower bounds of what it would take. One run at a time, each a process of its own, kernels "
    "compiled before. CPU time is user and system time of the process without what reading or simulating the log "
    "took; peak memory is the largest resident set, of which some is there before the first scan. Both runs "
    "end with the same refinement of the trajectory, which is told, and is part of both figures. The campus is "
    f"{CAMPUS_WORLD}, judged by the truth; ACES by its relations; Edmonton, which has no truth, by how far relations "
    "of the trajectory are from GMapping's, which is a metric RBPF as well."
)


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
        """Whether its long error is as good, and its map right."""
        return self.worst <= LONG_LIMIT and self.long_error <= max(FACTOR * other.long_error, other.long_error + SLACK)


@dataclass(frozen=True)
class Comparison:
    """All that was tried on a log.

    :ivar ours: the program as it is.
    :ivar metric: one area for everything, with more and more particles.
    :ivar runs: {method: its run with the first seed}.
    :ivar judge: what the errors are from.
    """

    ours: Entry
    metric: tuple[Entry, ...]
    runs: dict[str, Run]
    judge: str

    @property
    def equal(self) -> bool:
        """Whether the last metric filter is as accurate."""
        return self.metric[-1].as_accurate_as(self.ours)

    @property
    def memory(self) -> float:
        """How many times as much memory the last metric filter takes."""
        return self.metric[-1].peak / self.ours.peak

    @property
    def time(self) -> float:
        """Likewise CPU time."""
        return self.metric[-1].cpu / self.ours.cpu


def measure_table(settings: Settings) -> Report:
    """Map every log both ways."""
    names, seeds = settings.logs_or(COMPARED), settings.seeds_or(SEEDS)
    if strange := [name for name in names if name not in EXTENTS]:
        raise HmtSlamError(f"there is no {strange[0]!r} to compare on: choose from {', '.join(EXTENTS)}")
    report = Report("table", "Time and memory against a global metric RBPF", seeds=seeds)
    runner = KeptRunner(settings.records.folder / "table", jobs=1)
    with compared(names) as logs:
        _compile()
        found = {log.name: _compared(log, seeds, settings.changes, runner) for log in logs}
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


def _compile() -> None:
    """One run that is not counted, for the kernels that are not in the cache."""
    with tempfile.TemporaryDirectory(prefix="hmt_slam_benchmark_") as folder, opened([BUNDLED]) as (log,):
        Runner(Path(folder), jobs=1).runs([Charted(log, 0, way=AREAS)])


def _compared(log: MeasuredLog, seeds: Sequence[int], changes: tuple[str, ...], runner: Runner) -> Comparison:
    own = runner.runs([Charted(log, seed, changes=changes, way=AREAS) for seed in seeds])
    relations, judge = reference_of(log, own[0])

    def entry(method: str, particles: int, runs: Sequence[Run]) -> Entry:
        errors = [judged(run, relations) for run in runs]
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
    return Comparison(ours, tuple(metric), kept, judge)


def requirements(campus: Comparison) -> list[Requirement]:
    """What is asked for on the campus."""
    last = campus.metric[-1]
    how = "as accurate" if campus.equal else "not as accurate"
    of = f"metric RBPF of {last.particles} particles, {how}, against HMT-SLAM on the campus"
    return [
        Requirement("largest error of HMT-SLAM on the campus, over 60 s", campus.ours.worst, LONG_LIMIT, "m"),
        Requirement(f"memory of the {of}", campus.memory, float("inf"), "times", least=MEMORY),
        Requirement(f"CPU time of the {of}", campus.time, float("inf"), "times", least=TIME),
    ]


def comparison_table(found: dict[str, Comparison]) -> str:
    """One line for every method on every log."""
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
            rows.append([name, entry.method, *counts, *costs, *errors, own.judge, "" if entry is own.ours else same])
    return table(head, rows)


def _ratio_table(found: dict[str, Comparison]) -> str:
    head = ["metric RBPF / HMT-SLAM", "particles", "as accurate", "peak memory", "memory above the start"]
    head += ["maps of the particles", "CPU time"]
    rows = []
    for name, own in found.items():
        last, ours = own.metric[-1], own.ours
        grown = (last.peak - last.start) / (ours.peak - ours.start)
        ratios = [f"{ratio:.2f}" for ratio in (own.memory, grown, last.maps / ours.maps, own.time)]
        rows.append([name, str(last.particles), "yes" if own.equal else "no", *ratios])
    return table(head, rows)


def _process_table(processes: dict[str, dict[str, float]]) -> str:
    names = list(next(iter(processes.values())))
    rows = [[log, *(f"{own[name]:.3f}" for name in names)] for log, own in processes.items()]
    return table(["log", *(f"{name} [ms a scan]" for name in names)], rows)
