"""What each step of the estimate gains: the trajectories of one run after each of them."""

from __future__ import annotations

from dataclasses import asdict

from benchmark.logs import WITH_RELATIONS, MeasuredLog, opened
from benchmark.report import Report, table
from benchmark.runs import Case, Run
from benchmark.scoring import FINAL, ONLINE, POLICY, SeedMeans, over_seeds, score
from benchmark.settings import Settings

SEEDS = 5
STEPS = {
    "stages/filter.tum": "filter only, no loop closed",
    "stages/arcs.tum": "+ optimisation of the arcs",
    "stages/keyframes.tum": "+ refinement of the keyframes",
    FINAL: "+ placing of every scan among them: final",
    ONLINE: "online, as known at the time",
}
"""{file of an output folder: what it holds}, in the order of the steps."""


def measure_steps(settings: Settings) -> Report:
    """Score every trajectory that an output folder holds."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("steps", "What each step gains", seeds=seeds)
    with opened(settings.logs_or(WITH_RELATIONS)) as logs:
        cases = {log: [Case(log, seed, changes=settings.changes) for seed in seeds] for log in logs}
        settings.runner.runs([case for own in cases.values() for case in own])
        means = {log.name: score_steps(log, settings.runner.runs(own)) for log, own in cases.items()}
    report.body += [steps_table(means), *missing_steps(means), POLICY]
    report.data["steps"] = {
        name: {file: asdict(mean) for file, mean in of_log.items()} for name, of_log in means.items()
    }
    return report


def score_steps(log: MeasuredLog, runs: list[Run]) -> dict[str, SeedMeans]:
    """{file: means over the seeds}, of the trajectories that every run has."""
    there = [file for file in STEPS if all((run.folder / file).is_file() for run in runs)]
    return {file: over_seeds([score(run.folder, log, file) for run in runs]) for file in there}


def missing_steps(means: dict[str, dict[str, SeedMeans]]) -> list[str]:
    """A sentence that names the trajectories that there are not; none where all are there."""
    missing = [file for file in STEPS if any(file not in of_log for of_log in means.values())]
    return [f"The output folders hold no {', '.join(missing)}: these steps are not measured."] if missing else []


def steps_table(means: dict[str, dict[str, SeedMeans]]) -> str:
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
