"""Relocalization with marks: global localization in a saved map by the number of marks, some of them wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import NamedTuple

import numpy as np

from benchmark.awakening import (
    FAR,
    Awakening,
    MappedLog,
    in_map_of_part,
    last_start,
    path_lengths,
    process_records,
    scan_records,
    try_start,
)
from benchmark.outcomes import map_shared
from benchmark.report import Columns, Report, Requirement, table_of
from benchmark.settings import Settings, chosen_families, chosen_seeds
from benchmark.simulated.worlds import FAMILIES, SETTINGS, World
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log

COUNTS = (0, 10, 30)
"""Marks of a world."""

WRONG_SHARE = 0.1
"""Share of the passes of a mark that have the name of another one."""

WORLDS = ("office", "grid", "hall", "twins")
SEEDS, STARTS = 5, 6
"""Worlds of a family, and starts in each."""

_DRAWS = 2080

POLICY = (
    f"As the measurement `awakening`, in the map of the first of two laps: {STARTS} starts in the second lap of each "
    "world, the same for every number of marks. Marks are on the ceiling, evenly along a lap, and seen within 1.5 m, "
    f"with a noise of 3 cm and 1 degree. Of the passes of one {100 * WRONG_SHARE:g} % have the name of another, in map "
    f"and drive alike. The robot is localized rightly if it is so at the end of its path, within {FAR:g} m, and at no "
    "time wrongly."
)


class MarkedStarts(NamedTuple):
    """The starts in the worlds of a family with some marks.

    :ivar spacing: path from one mark to the next, m.
    """

    family: str
    marks: int
    spacing: float
    starts: list[Awakening]


def measure_relocalization(settings: Settings) -> Report:
    """Map a lap of each world with no, few and many marks, and localize the robot in the next one."""
    seeds = chosen_seeds(settings, SEEDS)
    report = Report("relocalization", "Global localization with marks", seeds=seeds)
    rows = []
    for family in chosen_families(settings, WORLDS, tuple(FAMILIES)):
        for marks in COUNTS:
            row = _localize(settings, family, marks, seeds)
            rows.append(row)
            report.data[f"{family}, {marks} marks"] = [asdict(start) for start in row.starts]
    report.body += [table_of(_COLUMNS, rows), POLICY]
    wrong = sum(start.wrong for row in rows if row.marks for start in row.starts)
    report.requirements.append(Requirement("starts with marks that are localized wrongly", wrong, 0))
    return report


def _localize(settings: Settings, family: str, marks: int, seeds: Sequence[int]) -> MarkedStarts:
    starts, spacings = list[Awakening](), list[float]()
    for seed in seeds:
        laps = "" if "laps=" in SETTINGS[family] else "laps=2,"
        world = World(family, seed, f"{laps}marks={marks},wrong_marks={WRONG_SHARE if marks else 0.0}")
        log = map_first_lap(world.log, settings.configuration)
        spacings.append(_lap_length(log) / marks if marks else math.inf)
        draw = np.random.Generator(np.random.Philox(key=[_DRAWS, seed]))
        chosen = [log.starts[int(share * len(log.starts))] for share in draw.uniform(0.0, 1.0, STARTS) if log.starts]
        starts += map_shared(try_start, log, chosen, settings.runner.jobs)
    return MarkedStarts(family, marks, float(np.mean(spacings)), starts)


def map_first_lap(name: str, configuration: Configuration) -> MappedLog:
    """A simulated world of two laps, with the map of the first one."""
    records = list(open_log(name).records())
    scans = scan_records(records)
    middle = len(scans) // 2
    state = process_records(LockStepRun(configuration), records[: scans[middle]]).state
    truth = np.array([records[scan].true_pose for scan in scans])
    world = MappedLog(configuration, records, state, scans, truth, range(middle))
    return in_map_of_part(world, state, range(middle, last_start(len(scans))))


def _lap_length(log: MappedLog) -> float:
    """Length of a lap, m."""
    return list(path_lengths(log.truth))[-1] / 2.0


def _found_paths(row: MarkedStarts) -> list[float]:
    return [start.found for start in row.starts if start.right and not start.wrong]


_COLUMNS: Columns[MarkedStarts] = [
    ("family", lambda row: row.family),
    ("marks", lambda row: str(row.marks)),
    ("m from one to the next", lambda row: "-" if math.isinf(row.spacing) else f"{row.spacing:.0f}"),
    ("starts", lambda row: str(len(row.starts))),
    (f"right within {FAR:g} m", lambda row: str(sum(start.good for start in row.starts))),
    ("m until known, median", lambda row: f"{np.median(_found_paths(row)):.1f}" if _found_paths(row) else "-"),
    ("mean", lambda row: f"{np.mean(_found_paths(row)):.1f}" if _found_paths(row) else "-"),
    ("wrong", lambda row: str(sum(start.wrong for start in row.starts))),
    ("not known", lambda row: str(sum(math.isinf(start.found) for start in row.starts))),
]
