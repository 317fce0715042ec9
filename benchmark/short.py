"""Accuracy check for CI: fails where accuracy became worse by more than the noise between seeds.

``benchmark/expected.toml`` holds, for every figure, mean and deviation over some seeds, normally ten, of the code that
it was written with. The mean over the few seeds of the short form may exceed the expected mean by

    max(4 s sqrt(1 / n + 1 / m), 2 % of the mean),    s: deviation, n: seeds of the short form, m: expected seeds

that is by four standard errors of the difference of two such means: with ten seeds, one false alarm in about 600
figures (Student, 9 degrees of freedom). The 2 % are for figures that hardly depend on the seed. A change for the
better, or for the worse on purpose, is recorded with ``python -m benchmark short --write-expected``.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmark.logs import BUNDLED, MeasuredLog, open_logs, reason_missing
from benchmark.report import Report, Requirement, describe_commit, table
from benchmark.runs import Case, Run, Runner
from benchmark.scoring import FINAL, ONLINE, judge_walls, sample_deviation
from benchmark.settings import Settings
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import evaluate_relations, read_tum

EXPECTED = Path(__file__).with_name("expected.toml")
EXPECTED_SEEDS = 10
STANDARD_ERRORS = 4.0
SMALLEST_MARGIN = 0.02


@dataclass(frozen=True)
class Part:
    """The part of a log that is run.

    :ivar log: its name.
    :ivar duration: seconds of it, 0 for all.
    :ivar seeds: number of runs.
    """

    log: str
    duration: float
    seeds: int


# The loops of ACES close only at its end; the first minutes of Intel have hundreds of relations over more than 60 s.
PARTS = (Part(BUNDLED, 0.0, 2), Part("aces", 0.0, 2), Part("intel", 700.0, 4))


@dataclass(frozen=True)
class Expected:
    """Mean and sample deviation of a figure over a number of seeds."""

    mean: float
    std: float
    seeds: int

    def bound(self, seeds: int) -> float:
        """Largest mean over a number of seeds that is within the noise."""
        error = self.std * math.sqrt(1.0 / seeds + 1.0 / self.seeds)
        return self.mean + max(STANDARD_ERRORS * error, SMALLEST_MARGIN * self.mean)


Figures = dict[str, list[float]]
"""{name of a figure, of which less is better: its value for each seed}."""


def measure_short(settings: Settings) -> Report:
    """Run the parts whose logs are there, and compare the figures with expected ones, or record them."""
    report = Report("short", "Has accuracy become worse?", seeds=tuple(range(max(part.seeds for part in PARTS))))
    figures = _measure_parts(settings, report)
    if settings.write_expected:
        write_expected(EXPECTED, figures)
    expected = read_expected(EXPECTED)
    for part in PARTS:
        if part.log in figures:
            first = {name: values[: part.seeds] for name, values in figures[part.log].items()}
            report.requirements += regressions(part.log, first, expected.get(part.log, {}))
    report.data["figures"] = figures
    return report


def _measure_parts(settings: Settings, report: Report) -> dict[str, Figures]:
    reasons = {part.log: reason_missing(part.log) for part in PARTS}
    if settings.write_expected and any(reasons.values()):
        raise HmtSlamError(f"not all expected figures can be measured: {next(filter(None, reasons.values()))}")
    report.body += [f"Skipped {log}: {reason}." for log, reason in reasons.items() if reason]
    parts = [part for part in PARTS if not reasons[part.log]]
    with tempfile.TemporaryDirectory(prefix="hmt_slam_benchmark_") as folder, open_logs([p.log for p in parts]) as logs:
        runner = Runner(Path(folder), settings.runner.jobs)
        cases = {
            log: [
                Case(log, seed, changes=settings.changes, duration=part.duration)
                for seed in (settings.seeds_or(EXPECTED_SEEDS) if settings.write_expected else range(part.seeds))
            ]
            for part, log in zip(parts, logs, strict=True)
        }
        # All cases are run together, so that no core waits for the last run of a log.
        runner.runs([case for own in cases.values() for case in own])
        report.body.append(_cost_table(runs := {log: runner.runs(own) for log, own in cases.items()}))
        return {log.name: figures_of(log, own) for log, own in runs.items()}


def _cost_table(runs: Mapping[MeasuredLog, Sequence[Run]]) -> str:
    rows = [[log.name, str(len(own)), f"{sum(run.cpu_seconds for run in own):.1f}"] for log, own in runs.items()]
    return table(["log", "runs", "CPU time [s]"], rows)


def figures_of(log: MeasuredLog, runs: Sequence[Run]) -> Figures:
    """The figures of a log's runs."""
    own = [_relation_figures(log, run) if log.relations is not None else _wall_figures(log, run) for run in runs]
    return {name: [figures[name] for figures in own] for name in own[0]}


def _relation_figures(log: MeasuredLog, run: Run) -> dict[str, float]:
    assert log.relations is not None
    # Without odometry, relations beyond the part of the log count as missed.
    final, online = (evaluate_relations(read_tum(run.folder / file), log.relations) for file in (FINAL, ONLINE))
    return {
        "translation_m": final.overall.translation.mean,
        "rotation_deg": final.overall.rotation.mean,
        "translation_over_60_s_m": final.over_60_s.translation.mean,
        "translation_online_m": online.overall.translation.mean,
        "relations_missed": float(final.overall.missed),
    }


def _wall_figures(log: MeasuredLog, run: Run) -> dict[str, float]:
    final, online = (judge_walls(log.scans, read_tum(run.folder / file).poses) for file in (FINAL, ONLINE))
    return {
        "disagreement": 1.0 - final.agreement,
        "disagreement_online": 1.0 - online.agreement,
        "torn_stretches": float(len(final.torn_stretches)),
        "stretches_over_new_ground": float(final.new),
    }


def regressions(log: str, figures: Figures, expected: Mapping[str, Expected]) -> list[Requirement]:
    """Each figure's mean over the seeds, and its bound.

    :raises HmtSlamError: for a figure without an expected value.
    """
    unknown = sorted(figures.keys() ^ expected.keys())
    if unknown:
        raise HmtSlamError(
            f"{EXPECTED.name} and the figures of {log} differ in {unknown[0]}: run 'python -m benchmark short "
            "--write-expected' and check the changes"
        )
    requirements = []
    for name, values in figures.items():
        count = len(values)
        bound = expected[name].bound(count)
        requirements.append(Requirement(f"{log}: {name}, mean of {count}", statistics.fmean(values), bound))
    return requirements


def read_expected(path: Path) -> dict[str, dict[str, Expected]]:
    """{log: {figure: expected values}}.

    :raises HmtSlamError: where there is no such file.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as fault:
        raise HmtSlamError(f"{path} cannot be read: run 'python -m benchmark short --write-expected'") from fault
    seeds = content["seeds"]
    return {
        log: {name: Expected(entry["mean"], entry["std"], seeds) for name, entry in own.items()}
        for log, own in content["figures"].items()
    }


def write_expected(path: Path, figures: Mapping[str, Figures]) -> None:
    """Write means and deviations over the seeds, of which every figure has as many."""
    lines = [
        "# Means and sample deviations over some seeds, from which benchmark/short.py computes bounds.",
        "# Written by `python -m benchmark short --write-expected`; do not edit.",
        f'commit = "{describe_commit()}"',
        f"seeds = {len(next(iter(next(iter(figures.values())).values())))}",
    ]
    for log, own in figures.items():
        lines += ["", f"[figures.{log}]"]
        for name, values in own.items():
            lines.append(f"{name} = {{ mean = {statistics.fmean(values):.6g}, std = {sample_deviation(values):.3g} }}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
