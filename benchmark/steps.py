"""What each step of the estimate gains: the trajectories of one run after each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmark.logs import LOGS, MeasuredLog, opened
from benchmark.report import Report, table
from benchmark.runs import Case, Run
from benchmark.scoring import FINAL, ONLINE, POLICY, SeedMeans, over_seeds, score
from benchmark.settings import Settings
from benchmark.walls import POLICY as WALLS
from benchmark.walls import Walls, judge_walls
from hmt_slam_ros.evaluation import read_tum

SEEDS = 5
STEPS = {
    "stages/filter.tum": "filter only, no loop closed",
    "stages/arcs.tum": "+ optimisation of the arcs",
    "stages/keyframes.tum": "+ refinement of the keyframes",
    FINAL: "+ placing of every scan among them: final",
    ONLINE: "online, as known at the time",
}
"""{file of an output folder: what it holds}, in the order of the steps."""

Judged = TypeVar("Judged")


def measure_steps(settings: Settings) -> Report:
    """Score every trajectory that an output folder holds; where there is no truth, look at the walls."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("steps", "What each step gains", seeds=seeds)
    with opened(settings.logs_or(LOGS)) as logs:
        cases = {log: [Case(log, seed, changes=settings.changes) for seed in seeds] for log in logs}
        settings.runner.runs([case for own in cases.values() for case in own])
        runs = {log: settings.runner.runs(own) for log, own in cases.items()}
        scored = {log.name: score_steps(log, own) for log, own in runs.items() if log.relations is not None}
        judged = {log.name: _judge_steps(log, own) for log, own in runs.items() if log.relations is None}
    if scored:
        report.body += [steps_table(scored), POLICY]
    if judged:
        report.body += [_walls_table(judged), WALLS]
    report.body += missing_steps({**scored, **judged})
    report.data["steps"] = {name: {file: asdict(mean) for file, mean in own.items()} for name, own in scored.items()}
    report.data["walls"] = {
        name: {file: [asdict(walls) for walls in of_seeds] for file, of_seeds in own.items()}
        for name, own in judged.items()
    }
    return report


def score_steps(log: MeasuredLog, runs: list[Run]) -> dict[str, SeedMeans]:
    """{file: means over the seeds}, of the trajectories that every run has."""
    scores = _of_every_step(runs, lambda folder, file: score(folder, log, file))
    return {file: over_seeds(of_seeds) for file, of_seeds in scores.items()}


def _judge_steps(log: MeasuredLog, runs: list[Run]) -> dict[str, list[Walls]]:
    return _of_every_step(runs, lambda folder, file: judge_walls(log.scans, read_tum(folder / file).poses))


def _of_every_step(runs: list[Run], judge: Callable[[Path, str], Judged]) -> dict[str, list[Judged]]:
    there = [file for file in STEPS if all((run.folder / file).is_file() for run in runs)]
    return {file: [judge(run.folder, file) for run in runs] for file in there}


def missing_steps(steps: Mapping[str, Mapping[str, object]]) -> list[str]:
    """A sentence that names the trajectories that there are not; none where all are there.

    :param steps: {log: {file: anything}}.
    """
    missing = [file for file in STEPS if any(file not in of_log for of_log in steps.values())]
    return [f"The output folders hold no {', '.join(missing)}: these steps are not measured."] if missing else []


def steps_table(means: Mapping[str, Mapping[str, SeedMeans]]) -> str:
    """One line for every log and step."""
    head = ["log", "step", "translation [m]", "between seeds", "worst seed", "over 60 s [m]", "rotation [deg]"]
    rows = [
        [
            name,
            STEPS[file],
            f"{mean.translation:.4f}",
            f"± {mean.translation_std:.4f}",
            f"{mean.worst:.4f}",
            f"{mean.long:.4f}",
            f"{mean.rotation:.3f}",
        ]
        for name, of_log in means.items()
        for file, mean in of_log.items()
    ]
    return table(head, rows)


def _walls_table(judged: Mapping[str, Mapping[str, list[Walls]]]) -> str:
    head = ["log without truth", "step", "agreement of the walls", "torn stretches a seed"]
    rows = [
        [
            name,
            STEPS[file],
            f"{np.mean([walls.agreement for walls in of_seeds]):.3f}",
            f"{np.mean([len(walls.torn) for walls in of_seeds]):.1f}",
        ]
        for name, of_log in judged.items()
        for file, of_seeds in of_log.items()
    ]
    return table(head, rows)
