"""What each choice of the design is worth: the same runs with one parameter changed at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from benchmark.logs import MeasuredLog, opened
from benchmark.report import Report, table
from benchmark.runs import Case, Run
from benchmark.scoring import FINAL, ONLINE, POLICY, SeedMeans, over_seeds, score
from benchmark.settings import Settings
from benchmark.walls import POLICY as WALLS
from benchmark.walls import judge_walls
from hmt_slam_ros.evaluation import read_tum

SEEDS = 1
LOGS = ("aces", "intel", "edmonton", "freiburg-101")
AS_CONFIGURED = "as configured"

CHOICES: dict[str, tuple[str, ...]] = {
    AS_CONFIGURED: (),
    "one area for everything": ("aam.ncut_threshold=0", "tsbi.recheck_keyframes=1000", "local_map.extent=200"),
    "one particle": ("filter.particles=1",),
    "30 particles": ("filter.particles=30",),
    "a keyframe a metre": ("filter.keyframe_distance=1",),
    "cells of 0.1 m": ("local_map.cell=0.1",),
    "beams up to 15 m": ("local_map.max_range=15",),
    "areas with a prior up to 10 m": ("tsbi.prior_limit=10",),
    "no refinement": ("refinement.iterations=0",),
    "one linearisation": ("refinement.iterations=1",),
    "ten linearisations": ("refinement.iterations=10",),
    "6 neighbours": ("refinement.neighbours=6",),
    "30 neighbours": ("refinement.neighbours=30",),
    "neighbours within 8 m": ("refinement.reach=8",),
    "a scan placed by one keyframe": ("refinement.scan_neighbours=1",),
    "a scan placed by 8 keyframes": ("refinement.scan_neighbours=8",),
    "an overlap is 30 % of the points": ("refinement.min_share=0.3",),
    "likelihood to the power of 0.1": ("refinement.temper=0.1",),
    "likelihood to the power of 1": ("refinement.temper=1",),
    "robust beyond 0.1 m": ("refinement.robust_scale=0.1",),
}
"""{what differs: the parameters}."""


@dataclass(frozen=True)
class Outcome:
    """What a choice came to on a log with truth, or on one without.

    :ivar cpu_seconds: mean over the seeds.
    :ivar final: errors of the final trajectory, None without truth; ``online`` likewise.
    :ivar agreement: of the walls, mean over the seeds; NaN with truth.
    :ivar torn: torn stretches a seed; NaN with truth.
    """

    cpu_seconds: float
    final: SeedMeans | None = None
    online: SeedMeans | None = None
    agreement: float = float("nan")
    torn: float = float("nan")


def measure_choices(settings: Settings) -> Report:
    """Run every log with every choice."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("choices", "What each choice of the design is worth", seeds=seeds)
    outcomes: dict[str, dict[str, Outcome]] = {}
    with opened(settings.logs_or(LOGS)) as logs:
        cases = {
            (log.name, name): [Case(log, seed, changes=(*settings.changes, *changes)) for seed in seeds]
            for log in logs
            for name, changes in CHOICES.items()
        }
        settings.runner.runs([case for own in cases.values() for case in own])
        for (log, name), own in cases.items():
            outcomes.setdefault(log, {})[name] = _outcome(own[0].log, settings.runner.runs(own))
    report.body += [_table(log, own) for log, own in outcomes.items()] + [POLICY, WALLS]
    report.data["choices"] = {
        log: {name: {"changes": list(CHOICES[name])} | asdict(outcome) for name, outcome in own.items()}
        for log, own in outcomes.items()
    }
    return report


def _outcome(log: MeasuredLog, runs: Sequence[Run]) -> Outcome:
    cpu = float(np.mean([run.cpu_seconds for run in runs]))
    if log.relations is not None:
        final, online = (over_seeds([score(run.folder, log, file) for run in runs]) for file in (FINAL, ONLINE))
        return Outcome(cpu, final, online)
    walls = [judge_walls(log.scans, read_tum(run.folder / FINAL).poses) for run in runs]
    agreement = float(np.mean([judged.agreement for judged in walls]))
    return Outcome(cpu, agreement=agreement, torn=float(np.mean([len(judged.torn) for judged in walls])))


def _table(log: str, outcomes: dict[str, Outcome]) -> str:
    """One line for every choice."""
    figures = {name: _figures(outcome) for name, outcome in outcomes.items()}
    head = next(iter(figures.values()))
    rows = [
        [name, ", ".join(f"`{change}`" for change in CHOICES[name]), *own.values()] for name, own in figures.items()
    ]
    return table([log, "changed", *head], rows)


def _figures(outcome: Outcome) -> dict[str, str]:
    """{head of a column: cell}."""
    cpu = {"CPU time [s]": f"{outcome.cpu_seconds:.1f}"}
    if outcome.final is None or outcome.online is None:
        return {"agreement of the walls": f"{outcome.agreement:.3f}", "torn": f"{outcome.torn:.1f}"} | cpu
    return {
        "translation [m]": f"{outcome.final.translation:.4f}",
        "over 60 s [m]": f"{outcome.final.long:.4f}",
        "rotation [deg]": f"{outcome.final.rotation:.3f}",
        "online [m]": f"{outcome.online.translation:.4f}",
    } | cpu
