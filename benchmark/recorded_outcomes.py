"""The outcomes of the measurement on recorded logs, kept in a file for each log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmark import accepted_closures, awakening, displacement, kidnapped_drive, recorded_drive, relation_chains
from benchmark.accepted_closures import EventWatch, judge_closure
from benchmark.awakening import Awakening, MappedLog, in_map_of_part, last_start, try_start
from benchmark.displacement import Displacement, displace, draw_splice
from benchmark.logs import MeasuredLog
from benchmark.outcomes import OutcomesFile, fingerprint, map_shared
from benchmark.recorded_drive import MappedDrive, follow, map_drive
from benchmark.relation_chains import RelationChains
from benchmark.settings import Settings
from hmt_slam_ros.evaluation import Relations, StampedPoses, evaluate_relations
from hmt_slam_ros.offline.lock_step import LockStepRun

RUNS = 3
"""Runs whose closures count, at most."""

HALVES = ("first half", "second half")
TENTH = 10
"""Keyframe events between two starts."""

_CODE = (accepted_closures, awakening, displacement, kidnapped_drive, recorded_drive, relation_chains)


@dataclass(frozen=True, eq=False)
class RecordedOutcomes:
    """The outcomes in one log.

    :ivar errors: of the log's trajectory at its relations, {figure: value}.
    :ivar runs: number of runs whose closures count.
    :ivar closures: as of :func:`~benchmark.accepted_closures.judge_closure`, of all runs.
    :ivar starts: {half of the map: starts in the other half}.
    :ivar staying: {half: those whose drive stays on its ground for a while}.
    :ivar displacements: in the order of their numbers.
    """

    errors: dict[str, float]
    runs: int
    closures: Sequence[dict[str, Any]]
    starts: dict[str, list[Awakening]]
    staying: dict[str, list[Awakening]]
    displacements: Sequence[Displacement]

    def closures_by(self, judge: str) -> list[dict[str, Any]]:
        """The closures that were judged by relations, the trajectory or nothing."""
        return [closure for closure in self.closures if closure["by"] == judge]


def complete_outcomes(log: MeasuredLog, settings: Settings, count: int) -> RecordedOutcomes:
    """The outcomes in a log; missing ones are made.

    :param count: of displacements and, at most, of starts in each half and of runs.
    """
    code = fingerprint(settings.changes, *(Path(str(module.__file__)) for module in _CODE), Path(__file__))
    file = RecordedFile(settings.records.folder / f"recorded-{log.name}-{code}.json", count)
    if not file.is_complete:
        file.complete(JudgedLog(map_drive(log.path, settings.configuration), log), settings.records.jobs)
    return file.outcomes


@dataclass(frozen=True, eq=False)
class JudgedLog:
    """A mapped log with what judges its closures."""

    mapped: MappedDrive
    log: MeasuredLog

    @cached_property
    def source_stamps(self) -> np.ndarray[Any, np.dtype[np.int64]]:
        """Of the scans, ns."""
        whole = self.mapped.whole
        return np.array([whole.records[scan].source_stamp for scan in whole.scans], dtype=np.int64)

    @cached_property
    def chains(self) -> RelationChains | None:
        """Of the log's relations."""
        relations = self.log.relations
        return None if relations is None else RelationChains(relations, self.source_stamps, self.mapped.whole.truth)

    @property
    def errors(self) -> dict[str, float]:
        """Of the trajectory at the relations."""
        none = np.zeros(0, np.int64)
        relations = self.log.relations or Relations(none, none, np.zeros((0, 3)))
        trajectory = StampedPoses(self.source_stamps, self.mapped.whole.truth)
        found = evaluate_relations(trajectory, relations, self.log.odometry)
        return {
            "relations": found.overall.count,
            "mean": found.overall.translation.mean,
            "over_60_s": found.over_60_s.translation.mean,
            "over_60_s_max": found.over_60_s.translation.max,
        }

    @cached_property
    def in_halves(self) -> dict[str, MappedLog]:
        """{half of the map: the drive in it, which starts at every tenth keyframe event of the other half}."""
        whole, keyframes = self.mapped.whole, self.mapped.keyframes
        scans = len(whole.scans)
        outside = {
            HALVES[0]: [n for n in keyframes if scans // 2 <= n < last_start(scans)],
            HALVES[1]: [n for n in keyframes if n < scans // 2],
        }
        parts = {
            half: in_map_of_part(whole, state, outside[half], 0.0)
            for half, state in zip(HALVES, self.mapped.halves, strict=True)
        }
        return {half: replace(part, starts=part.starts[::TENTH]) for half, part in parts.items()}

    def staying_starts(self, half: str) -> list[int]:
        """The starts in a half that stay on its ground."""
        part = self.in_halves[half]
        return list(in_map_of_part(self.mapped.whole, part.state, part.starts).starts)


def closures_of_seed(drive: JudgedLog, seed: int) -> list[dict[str, Any]]:
    """The judged closures of a run with some seed."""
    whole = drive.mapped.whole
    watch = EventWatch()
    if seed == whole.configuration.seed:
        watch.accepted = list(drive.mapped.closures)
    else:
        follow(LockStepRun(replace(whole.configuration, seed=seed)), whole.records, watch)
    judged = (judge_closure(c, whole.numbers, drive.chains, whole.truth) for c in watch.accepted)
    return [{"seed": seed} | one for one in judged]


class RecordedFile(OutcomesFile):
    """The file of the outcomes in a log: of each, its kind, a key and a document.

    :ivar count: of displacements and, at most, of starts in each half and of runs.
    """

    def __init__(self, file: Path, count: int) -> None:
        super().__init__(file)
        self.count = count

    def documents(self, kind: str) -> dict[Any, Any]:
        """{key: document} of a kind."""
        return {key: document for one, key, document in self.rows() if one == kind}

    @property
    def runs(self) -> int:
        """Number of runs whose closures count."""
        return min(RUNS, self.count)

    def chosen_starts(self, half: str) -> list[int]:
        """The starts in a half that count, spread over all that there are."""
        starts = self.documents("starts")[half]
        chosen = min(self.count, len(starts))
        return [starts[k * len(starts) // chosen] for k in range(chosen)]

    @property
    def is_complete(self) -> bool:
        """Whether all outcomes are there."""
        return (
            set(HALVES) <= self.documents("starts").keys()
            and set(range(self.runs)) <= self.documents("closures").keys()
            and all(set(self.chosen_starts(half)) <= self.documents(half).keys() for half in HALVES)
            and set(range(self.count)) <= self.documents("displacement").keys()
        )

    def complete(self, drive: JudgedLog, jobs: int) -> None:
        """Make the missing outcomes."""
        if not self.documents("starts"):
            self.add(["errors", 0, drive.errors])
            for half, part in drive.in_halves.items():
                self.add(["starts", half, list(part.starts)])
                self.add(["staying", half, drive.staying_starts(half)])
        for half, part in drive.in_halves.items():
            starts = [start for start in self.chosen_starts(half) if start not in self.documents(half)]
            for start in map_shared(try_start, part, starts, jobs):
                self.add([half, start.start, astuple(start)])
        numbers = [number for number in range(self.count) if number not in self.documents("displacement")]
        for number, document in zip(numbers, map_shared(_displace, drive.mapped, numbers, jobs), strict=True):
            self.add(["displacement", number, document])
        seeds = [seed for seed in range(self.runs) if seed not in self.documents("closures")]
        for seed, closures in zip(seeds, map_shared(closures_of_seed, drive, seeds, jobs), strict=True):
            self.add(["closures", seed, closures])

    @property
    def outcomes(self) -> RecordedOutcomes:
        """The outcomes, once they are complete."""
        closures, displacements = self.documents("closures"), self.documents("displacement")
        starts = {half: [Awakening(*self.documents(half)[n]) for n in self.chosen_starts(half)] for half in HALVES}
        staying = self.documents("staying")
        return RecordedOutcomes(
            self.documents("errors")[0],
            self.runs,
            [closure for seed in range(self.runs) for closure in closures[seed]],
            starts,
            {half: [one for one in own if one.start in staying[half]] for half, own in starts.items()},
            [Displacement.from_document(d) for k in range(self.count) if (d := displacements[k]) is not None],
        )


def _displace(drive: MappedDrive, number: int) -> dict[str, Any] | None:
    """The document of a displacement, None where there is no place for it."""
    splice = draw_splice(drive, number)
    return None if splice is None else displace(drive, splice).document
