"""Local maps of lines beside grids: the same simulated drives mapped with each, and compared with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from benchmark.logs import MeasuredLog
from benchmark.report import Report, Requirement, table
from benchmark.runs import Case, Run
from benchmark.scoring import FINAL, SeedMeans, over_seeds
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from benchmark.simulated.worlds import SETTINGS, World
from hmt_slam_ros.evaluation import RelationErrors, evaluate_relations, read_tum, true_relations, truth_of
from hmt_slam_ros.open_log import open_log

SEEDS = 4
"""Of the worlds of every family."""

FAMILIES = ("office", "busy", "hall")
KINDS = ("grid", "lines", "by_class")
FILTER = "stages/filter.tum"

_WORSE = 1.25  # times the error with grids

POLICY = (
    "Relations of every metre of a drive: to the next, to the tenth, and to where the robot was before, more than 60 s "
    "earlier. Filter alone: what metric SLAM found, no loop closed; final: after the scans of keyframes were refined "
    "and all scans placed among them, which is the same for all. CPU time is that of the whole command."
)


def measure_localmaps(settings: Settings) -> Report:
    """Map worlds with local maps of both kinds, and by class."""
    chosen = chosen_families(settings, FAMILIES, tuple(SETTINGS))
    seeds = chosen_seeds(settings, SEEDS)
    cases = {
        key: [_case(World(key[0], seed), key[1], settings.changes) for seed in seeds] for key in product(chosen, KINDS)
    }
    settings.runner.runs([case for own in cases.values() for case in own])
    runs = {key: settings.runner.runs(own) for key, own in cases.items()}
    means = {
        file: {key: over_seeds([_errors(run, file) for run in own]) for key, own in runs.items()}
        for file in (FILTER, FINAL)
    }
    report = Report("localmaps", "Local maps of lines beside grids", seeds=seeds)
    report.requirements = [
        Requirement(f"{name}, error {said} over that by grids, worst family", _worst(means[file], kind, chosen), _WORSE)
        for file, name in ((FILTER, "filter alone"), (FINAL, "final"))
        for kind, said in (("lines", "by lines"), ("by_class", "by class"))
    ]
    report.body += [_table(runs, means), POLICY]
    report.data["errors"] = {
        file: {", ".join(key): vars(mean) for key, mean in own.items()} for file, own in means.items()
    }
    return report


def _case(world: World, kind: str, changes: tuple[str, ...]) -> Case:
    return Case(MeasuredLog(world.name, Path(world.log)), world.seed, changes=(*changes, f"local_map.kind={kind}"))


def _errors(run: Run, file: str) -> RelationErrors:
    return evaluate_relations(read_tum(run.folder / file), true_relations(truth_of(open_log(run.case.log.path))))


def _worst(means: dict[tuple[str, str], SeedMeans], kind: str, families: Sequence[str]) -> float:
    return max(means[name, kind].translation / means[name, "grid"].translation for name in families)


def _table(runs: dict[tuple[str, str], list[Run]], means: dict[str, dict[tuple[str, str], SeedMeans]]) -> str:
    head = ["worlds", "local maps", "filter alone [m]", "worst seed", "[deg]", "final [m]", "worst seed", "[deg]"]
    head += ["areas", "loop closures", "CPU time [s]"]
    rows = []
    for key, own in runs.items():
        figures = [
            figure
            for file in (FILTER, FINAL)
            for mean in [means[file][key]]
            for figure in (f"{mean.translation:.4f}", f"{mean.worst:.4f}", f"{mean.rotation:.3f}")
        ]
        counts = [f"{np.mean([run.report[name] for run in own]):.1f}" for name in ("areas", "loop_closures")]
        rows.append([*key, *figures, *counts, f"{np.mean([run.cpu_seconds for run in own]):.1f}"])
    return table(head, rows)
