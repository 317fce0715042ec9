"""The runs behind Table II: which logs are compared, mapped in which way, and what their trajectories are judged by."""

from __future__ import annotations

import hashlib
import json
import lzma
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmark import charted_run
from benchmark.charted_run import METRIC
from benchmark.logs import MeasuredLog, datasets, opened
from benchmark.runs import PARAMETERS, Case, Run, Runner
from benchmark.scoring import FINAL
from benchmark.simulated.records import code
from benchmark.simulated.worlds import CAMPUS, CAMPUS_WORLD
from hmt_slam_ros.evaluation import (
    RelationErrors,
    Relations,
    StampedPoses,
    evaluate_relations,
    read_tum,
    true_relations,
    truth_of,
)
from hmt_slam_ros.simulation import open_simulated

EXTENTS = {"edmonton": 100.0, CAMPUS: 200.0, "aces": 80.0}
"""Half side of the one map of a log, m, that holds all of it."""

_GMAPPING = "edmonton.gmapping.txt.xz"


@dataclass(frozen=True)
class Charted(Case):
    """A run whose cost is told as it goes on.

    :ivar way: "areas" or "metric", see :mod:`benchmark.charted_run`.
    """

    way: str = ""

    @property
    def name(self) -> str:
        """Of the output folder."""
        return f"{self.way}-{super().name}"

    def command(self, folder: Path) -> list[str]:
        """The command line that maps the log into a folder."""
        options = ["--out", str(folder), "--seed", str(self.seed), "--config", str(PARAMETERS)]
        changes = [word for change in self.changes for word in ("--set", change)]
        return [sys.executable, "-m", "benchmark.charted_run", self.way, str(self.log.path), *options, *changes]


def metric_case(log: MeasuredLog, seed: int, changes: tuple[str, ...], particles: int) -> Charted:
    """One area for everything, with so many particles."""
    own = (f"local_map.extent={EXTENTS[log.name]:g}", f"filter.particles={particles}")
    return Charted(log, seed, changes=(*changes, *own), way=METRIC)


class KeptRunner(Runner):
    """Runs that stay in their folder, and are made anew only for another program or other parameters."""

    def _run(self, case: Case) -> Run:
        folder = self.folder.absolute() / case.name
        kept = folder / "usage.json"
        if kept.is_file():
            usage: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
            if usage.pop("code") == _code():
                return Run(case, folder, **usage)
        shutil.rmtree(folder, ignore_errors=True)
        run = super()._run(case)
        if not run.fault:
            usage = {"cpu_seconds": run.cpu_seconds, "wall_seconds": run.wall_seconds, "peak_rss": run.peak_rss}
            kept.write_text(json.dumps(usage | {"code": _code()}), encoding="utf-8")
        return run


def _code() -> str:
    """What the runs of this code are known by."""
    return code() + hashlib.sha256(Path(charted_run.__file__).read_bytes()).hexdigest()[:8]


@contextmanager
def compared(names: Sequence[str]) -> Iterator[list[MeasuredLog]]:
    """The logs of some names, the campus among them.

    :raises HmtSlamError: for a name that is none, or a file that is not there.
    """
    with opened([name for name in names if name != CAMPUS]) as logs:
        by_name = {log.name: log for log in logs} | {CAMPUS: MeasuredLog(CAMPUS, Path(CAMPUS_WORLD))}
        yield [by_name[name] for name in names]


def reference(log: MeasuredLog, run: Run) -> tuple[Relations, str]:
    """Relations by which the trajectories of a log are judged, and where they are from.

    :param run: of the program as it is, by which the others are judged where nothing else is known.
    """
    if log.name == CAMPUS:
        return true_relations(truth_of(open_simulated(CAMPUS_WORLD))), "truth"
    if log.relations is not None:
        return log.relations, "relations"
    file = datasets() / _GMAPPING
    if log.name in file.name and file.is_file():
        with lzma.open(file, "rt", encoding="utf-8") as lines:
            rows = np.loadtxt(lines)
        stamps = np.round(1e9 * rows[:, 0]).astype(np.int64)
        return true_relations(StampedPoses(stamps, rows[:, 1:4])), "GMapping"
    return true_relations(read_tum(run.folder / FINAL)), "the other run"


def judged(run: Run, relations: Relations) -> RelationErrors:
    """Errors of a run's trajectory."""
    log = run.case.log
    odometry = None if log.name == CAMPUS else log.odometry
    return evaluate_relations(read_tum(run.folder / FINAL), relations, odometry)
