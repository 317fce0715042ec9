"""A log mapped in two sessions: the second half extends the map of the first. Is that as accurate as in one go?"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from benchmark.logs import WITH_RELATIONS, MeasuredLog, opened
from benchmark.report import Report, Requirement, table
from benchmark.runs import Case, Run
from benchmark.scoring import FINAL, SeedMeans, over_seeds, score, scored
from benchmark.settings import Settings
from hmt_slam_ros.evaluation import RelationErrors, StampedPoses, read_tum
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.output_folder import EARLIER

SEEDS = 5
WORSE = 1.2
"""How much larger the mean error may be than that of the log mapped in one go."""

# The scan at the middle is in the first half alone, s.
_NEXT = 1e-3

POLICY = (
    "The log is cut in the middle of its time. The first half is mapped; the second one extends that map "
    "(`hmt_slam map --from`) as a log of another day would: the robot may be anywhere in it, and its odometry begins "
    "anew. The relations are those of the whole log, also between poses of the first half and of the second, which the "
    "output folder has in one frame. Matched as for accuracy; means over the seeds."
)


def measure_sessions(settings: Settings) -> Report:
    """Map every log in one go and in two sessions, with every seed."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("sessions", "A log in two sessions", seeds=seeds)
    rows: list[list[str]] = []
    with opened(settings.logs_or(WITH_RELATIONS)) as logs:
        for log in logs:
            scores = {
                "in one go": [score(run.folder, log) for run in settings.runner.runs(_cases(log, settings))],
                "in two sessions": [errors_of_all(run.folder, log) for run in _halves(log, settings)],
            }
            means = {name: over_seeds(own) for name, own in scores.items()}
            whole, halves = means.values()
            worse = halves.translation / whole.translation
            report.requirements.append(Requirement(f"{log.name}: error in two sessions / in one go", worse, WORSE))
            rows += [_row(log.name, name, mean) for name, mean in means.items()]
            report.data[log.name] = {name: [asdict(one) for one in own] for name, own in scores.items()}
    head = ["log", "mapped", "translation [m]", "between seeds", "worst seed", "over 60 s [m]", "its max"]
    report.body += [table([*head, "rotation [deg]", "matched"], rows), POLICY]
    return report


def _cases(log: MeasuredLog, settings: Settings) -> list[Case]:
    return [Case(log, seed, "", settings.changes) for seed in settings.seeds_or(SEEDS)]


def _halves(log: MeasuredLog, settings: Settings) -> list[Run]:
    """The runs of the second half of a log, each on the map of the first."""
    middle = round(0.5 * open_log(log.path).duration, 3)
    first = settings.runner.runs([replace(case, duration=middle) for case in _cases(log, settings)])
    second = [replace(run.case, duration=0.0, start=middle + _NEXT, source=run.folder) for run in first]
    return settings.runner.runs(second)


def errors_of_all(folder: Path, log: MeasuredLog) -> RelationErrors:
    """Errors of the trajectories of all sessions in the final map of an output folder."""
    parts = [read_tum(path) for path in (*sorted((folder / EARLIER).glob("*.tum")), folder / FINAL)]
    stamps, poses = (np.concatenate(columns) for columns in zip(*((p.stamps, p.poses) for p in parts), strict=True))
    return scored(StampedPoses(stamps, poses), log)


def _row(name: str, mapped: str, mean: SeedMeans) -> list[str]:
    return [
        name,
        mapped,
        f"**{mean.translation:.4f}**",
        f"± {mean.translation_std:.4f}",
        f"{mean.worst:.4f}",
        f"{mean.long:.4f}",
        f"{mean.long_max:.2f}",
        f"{mean.rotation:.3f}",
        f"{100.0 * mean.matched:.1f} %",
    ]
