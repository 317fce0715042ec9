"""Cost of a run: CPU time, memory, a scan in each process, and the start of the programs."""

from __future__ import annotations

import importlib.util
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmark.logs import ROOT, WITH_RELATIONS, open_logs
from benchmark.report import Report, Requirement, table
from benchmark.runs import Case, Run, Runner
from benchmark.settings import Settings
from hmt_slam_ros.results.plots import plot_cost

SEEDS = 3
CPU_BOUNDS = {"aces": 15.0, "intel": 25.0}
"""Largest CPU time of the whole process, kernels compiled before, s."""

MEMORY_BOUNDS = {"intel": 350e6}
"""Largest resident memory, bytes."""

START_BOUND = 1.0
"""Largest time until a node answers, kernels compiled before, s."""

_REPEATS = 5

Measured = TypeVar("Measured")

POLICY = (
    "One run at a time, each an OS process, after one run of every log that compiles missing kernels and does not "
    "count. CPU time is user and system time of the process and its children, from start to exit, including reading "
    "the log and writing the folder; memory is the largest resident set. A scan's cost is wall time; its mean, its 95 "
    "% quantile and its maximum are over all scans of a log. The mean of the first two and the maximum of the third "
    "are over the seeds. Runs in two OS processes follow those in one. Start times are medians of five; on a busy "
    "machine DDS may miss the first announcement of a node, which adds 3 s of wall time."
)


def measure_speed(settings: Settings) -> Report:
    """Run every log alone with every seed, and start every program."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("speed", "The cost of a run", seeds=seeds)
    runner = Runner(settings.out / "runs_for_speed", jobs=1)
    with open_logs(settings.logs_or(WITH_RELATIONS)) as logs:
        with tempfile.TemporaryDirectory(prefix="hmt_slam_benchmark_") as folder:
            Runner(Path(folder), jobs=1).runs([Case(log, 0, changes=settings.changes) for log in logs])
        cases = {log.name: [Case(log, seed, changes=settings.changes) for seed in seeds] for log in logs}
        runs = {name: runner.runs(own) for name, own in cases.items()}
        pairs = {name: runner.runs([replace(case, jobs=2) for case in own]) for name, own in cases.items()}
    _report_runs(report, runs)
    report.body.append(_pair_table(runs, pairs))
    for name, own in runs.items():
        shutil.copy(plot_cost(own[0].folder), settings.out / f"cost-{name}.png")
        report.pictures[f"cost-{name}.png"] = f"Computing time of every process for every scan of {name}."
    _report_starts(report)
    report.body.append(POLICY)
    return report


def _report_runs(report: Report, runs: dict[str, list[Run]]) -> None:
    for name, own in runs.items():
        report.requirements += speed_requirements(name, [run.cpu_seconds for run in own], [run.peak_rss for run in own])
    report.body += [_whole_table(runs), _process_table(runs), *_memory_tables(runs)]
    report.data["runs"] = {
        name: [
            {"seed": run.case.seed, "cpu_s": run.cpu_seconds, "wall_s": run.wall_seconds, "peak_rss": run.peak_rss}
            | {"processes": run.report["processes"], "memory_bytes": run.report.get("memory_bytes")}
            for run in own
        ]
        for name, own in runs.items()
    }


def _pair_table(runs: dict[str, list[Run]], pairs: dict[str, list[Run]]) -> str:
    """Runs in two OS processes, against those in one."""
    head = ["log, two OS processes", "wall time [s]", "ratio to one", "CPU time [s]", "ratio to one"]
    rows = []
    for name, own in pairs.items():
        row = [name]
        for figure in ("wall_seconds", "cpu_seconds"):
            pair, one = (statistics.mean(getattr(run, figure) for run in all_runs) for all_runs in (own, runs[name]))
            row += [f"{pair:.1f}", f"{pair / one:.2f}"]
        rows.append(row)
    return table(head, rows)


def speed_requirements(name: str, cpu_seconds: Sequence[float], peak_rss: Sequence[int]) -> list[Requirement]:
    """Requirements on the runs of a log, none without a bound.

    :param cpu_seconds: of each run.
    :param peak_rss: of each run, bytes.
    """
    requirements = []
    if name in CPU_BOUNDS:
        requirements.append(Requirement(f"{name}: CPU time", statistics.mean(cpu_seconds), CPU_BOUNDS[name], "s"))
    if name in MEMORY_BOUNDS:
        requirements.append(Requirement(f"{name}: peak memory", max(peak_rss) / 1e6, MEMORY_BOUNDS[name] / 1e6, "MB"))
    return requirements


def _whole_table(runs: dict[str, list[Run]]) -> str:
    head = ["log", "scans", "CPU time [s]", "lowest", "highest", "of it refinement", "wall time [s]"]
    head.append("peak memory [MB]")
    rows = []
    for name, own in runs.items():
        cpu = [run.cpu_seconds for run in own]
        figures = [statistics.mean(cpu), min(cpu), max(cpu)]
        figures.append(statistics.mean(run.report["refinement_s"] for run in own))
        figures.append(statistics.mean(run.wall_seconds for run in own))
        memory = max(run.peak_rss for run in own) / 1e6
        scans = own[0].report["scans"]["processed"]
        rows.append([name, str(scans), *(f"{figure:.1f}" for figure in figures), f"{memory:.0f}"])
    return table(head, rows)


def _process_table(runs: dict[str, list[Run]]) -> str:
    head = ["log", "process", "total [s]", "mean [ms a scan]", "95 %", "max"]
    rows = []
    for name, own in runs.items():
        for process in own[0].report["processes"]:
            figures = [run.report["processes"][process] for run in own]
            means = [np.mean([f[key] for f in figures]) for key in ("total_s", "mean_ms_per_scan", "p95_ms_per_scan")]
            largest = max(figure["max_ms_per_scan"] for figure in figures)
            rows.append([name, process, f"{means[0]:.2f}", *(f"{m:.3f}" for m in means[1:]), f"{largest:.1f}"])
    return table(head, rows)


def _memory_tables(runs: dict[str, list[Run]]) -> list[str]:
    parts = {name: own[0].report.get("memory_bytes") for name, own in runs.items()}
    rows = [[name, part, f"{size / 1e6:.1f}"] for name, sizes in parts.items() for part, size in (sizes or {}).items()]
    absent = [name for name, sizes in parts.items() if not sizes]
    tables = [table(["log", "part", "memory [MB]"], rows)] if rows else []
    return tables + ([f"The reports of {', '.join(absent)} have no memory by part."] if absent else [])


def _report_starts(report: Report) -> None:
    rows = [["`hmt_slam --help`", f"{statistics.median(_repeat(_seconds_of_help)):.2f}", ""]]
    if importlib.util.find_spec("rclpy") is None:
        report.body.append("There is no ROS here: the start of the nodes is not measured. Run scripts/test.sh first.")
    else:
        rows += _node_starts(report)
    report.body.append(table(["start", "wall time [s]", "CPU time [s]"], rows))


def _seconds_of_help() -> float:
    begin = time.monotonic()
    subprocess.run([sys.executable, "-m", "hmt_slam_ros.cli.main", "--help"], cwd=ROOT, capture_output=True, check=True)
    return time.monotonic() - begin


def _node_starts(report: Report) -> list[list[str]]:
    from benchmark.running_nodes import NODES, time_until_answer, time_until_first_pose  # noqa: PLC0415  only where there is ROS

    starts = {f"node {name}, until it answers": _repeat(partial(time_until_answer, name)) for name in NODES}
    wall = {name: statistics.median(start.wall for start in measured) for name, measured in starts.items()}
    slowest = max(wall, key=lambda name: wall[name])
    report.requirements.append(Requirement(f"start: {slowest}", wall[slowest], START_BOUND, "s"))
    starts["node slam, until the first pose"] = _repeat(time_until_first_pose)
    report.data["start_s"] = {name: [start._asdict() for start in measured] for name, measured in starts.items()}
    medians = {name: np.median(np.array(measured), axis=0) for name, measured in starts.items()}
    return [[name, f"{wall_seconds:.2f}", f"{cpu:.2f}"] for name, (wall_seconds, cpu) in medians.items()]


def _repeat(measure: Callable[[], Measured]) -> list[Measured]:
    """Some repetitions, after one that does not count."""
    measure()
    return [measure() for _ in range(_REPEATS)]
