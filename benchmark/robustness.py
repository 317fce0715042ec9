"""Topology under faults of real sensors: stretches of recorded and simulated logs, each with one kind of fault."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.logs import MeasuredLog, open_logs
from benchmark.real_faults.faulty_run import FINDINGS, NONE, VERDICT
from benchmark.real_faults.kinds import BY_NAME, KINDS, Kind
from benchmark.real_faults.stretches import FULL_TURN, RECORDED, SOURCES, LogStretch, draw_stretch
from benchmark.real_faults.verdict import POLICY
from benchmark.report import Columns, Report, Requirement, mean, table_of
from benchmark.runs import CachedRunner, Case, Run
from benchmark.settings import Settings
from benchmark.simulated.records import code_hash
from hmt_slam_ros.errors import HmtSlamError

SEEDS = 18
"""Cases of every kind: 306 in all."""

LEAST_RIGHT, MOST_WRONG = 0.98, 0.01
"""Least share of maps that are right, and largest share of those that are wrong with confidence."""

_NOT_MAPPING = ("cli", "doctor", "exploration", "ros", "view")
"""Packages on which maps do not depend."""

CASES_POLICY = (
    "Each case is a stretch of a log with one kind of fault. Stretches of recorded logs take 300 to 900 s and have ten "
    "true relations over more than 60 s at least; simulated drives are whole. The number of the stretch draws the "
    "stretch, the places of the fault, and the numbers of the run. All kinds have the same stretches, except where a "
    "fault needs a laser with two beams a degree or a view all around. *Alone* is the same stretch without the fault. "
    "Errors are medians over the cases of the mean error of all relations. The doctor names a fault if it has a "
    "finding of that kind that it does not have without the fault."
)


@dataclass(frozen=True)
class FaultCase(Case):
    """A stretch with a fault.

    :ivar task: "map" or "doctor".
    :ivar reference: output folder of the run without the fault, if that is right.
    """

    task: str = "map"
    reference: Path | None = None

    @property
    def name(self) -> str:
        """Of the output folder."""
        return f"{self.task}-{super().name}"

    def command(self, folder: Path) -> list[str]:
        """The command line that maps or examines the stretch into a folder."""
        program = [sys.executable, "-m", "benchmark.real_faults.faulty_run", self.task, self.kind, str(self.log.path)]
        options: dict[str, object] = {"--start": self.start, "--duration": self.duration}
        options |= {"--relations": self.log.relations_file, "--reference": self.reference}
        words = [word for name, value in options.items() if value for word in (name, str(value))]
        changes = [word for change in self.changes for word in ("--set", change)]
        return [*program, "--out", str(folder), "--seed", str(self.seed), *words, *changes]


@dataclass(frozen=True)
class Attempt:
    """A stretch with a fault, and alone.

    :ivar kind: of the fault; None for the stretch alone.
    :ivar stretch: its name.
    :ivar run: of the map; its fault is not empty where it failed.
    :ivar alone: of the same stretch without the fault.
    :ivar is_named: whether the doctor names the fault; None where it need not.
    """

    kind: Kind | None
    stretch: str
    run: Run
    alone: Run
    is_named: bool | None = None

    @cached_property
    def verdict(self) -> dict[str, Any]:
        """The content of verdict.json."""
        return read_verdict(self.run)

    @property
    def outcome(self) -> str:
        """``right``, ``wrong``, ``open`` or ``failed``."""
        return str(self.verdict["outcome"])


def read_verdict(run: Run) -> dict[str, Any]:
    """The content of a run's verdict.json; a failed run has an outcome alone."""
    if run.fault:
        return {"outcome": "failed", "error": None}
    content: dict[str, Any] = json.loads((run.folder / VERDICT).read_text(encoding="utf-8"))
    return content


def measure_robustness(settings: Settings) -> Report:
    """Map stretches with every kind of fault."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("robustness", "Topology under faults of real sensors", seeds=seeds)
    kinds, sources = _choose(settings.logs)
    with open_logs([name for name in RECORDED if name in sources]) as recorded:
        logs = {log.name: log for log in recorded}
        pairs = [(kind, stretch) for kind in kinds for stretch in _draw_stretches(kind, sources, seeds, logs)]
        attempts = _attempt(pairs, settings)
    alone = {attempt.stretch: replace(attempt, kind=None, run=attempt.alone, is_named=None) for attempt in attempts}
    report.requirements += requirements(attempts)
    report.body += [outcome_table(kinds, list(alone.values()), attempts), POLICY, CASES_POLICY]
    report.body.append("\n".join(f"- **{kind.name}**: {kind.description}" for kind in kinds))
    report.data["attempts"] = [
        {
            "kind": attempt.kind.name if attempt.kind else NONE,
            "stretch": attempt.stretch,
            "cpu_s": attempt.run.cpu_seconds,
            "fault": attempt.run.fault,
            "named": attempt.is_named,
            **attempt.verdict,
        }
        for attempt in [*alone.values(), *attempts]
    ]
    return report


def _choose(names: Sequence[str]) -> tuple[list[Kind], tuple[str, ...]]:
    """The kinds and the sources that are chosen, by default all.

    :raises HmtSlamError: for an unknown name, or where no kind can be planted into the sources.
    """
    known = (*SOURCES, *FULL_TURN)
    for name in names:
        if name not in (*known, *BY_NAME):
            raise HmtSlamError(f"there is no stretch or fault {name!r}: choose from {', '.join((*known, *BY_NAME))}")
    sources = tuple(source for source in known if source in names) or known
    chosen = [kind for kind in KINDS if kind.name in names] or KINDS
    kinds = [kind for kind in chosen if set(kind.sources) & set(sources)]
    if not kinds:
        raise HmtSlamError(f"no fault of {', '.join(names)} can be planted there: choose other stretches")
    return kinds, sources


def _draw_stretches(
    kind: Kind, sources: Sequence[str], seeds: Sequence[int], logs: dict[str, MeasuredLog]
) -> list[LogStretch]:
    """The stretches for a kind of fault, from its sources in turn."""
    own = [source for source in kind.sources if source in sources]
    return [draw_stretch(own[seed % len(own)], seed // len(own), logs) for seed in seeds]


def _attempt(pairs: Sequence[tuple[Kind, LogStretch]], settings: Settings) -> list[Attempt]:
    """Map and examine the stretches, first all of them alone."""
    folder, jobs = settings.records.folder / "robustness", settings.records.jobs
    mapping = CachedRunner(folder, jobs, code_hash("benchmark/real_faults", _NOT_MAPPING))
    examining = CachedRunner(folder, jobs, code_hash("benchmark/real_faults"))
    bare = [_case(NONE, stretch, settings) for _, stretch in pairs]
    alone = mapping.attempts(bare)
    faulty = [
        replace(case, kind=kind.name, reference=run.folder if read_verdict(run)["outcome"] == "right" else None)
        for (kind, _), case, run in zip(pairs, bare, alone, strict=True)
    ]
    runs = mapping.attempts(faulty)
    named = [kind.subjects for kind, _ in pairs]
    examined = _examine([case for case, subjects in zip(bare, named, strict=True) if subjects], NONE, examining)
    findings = _examine([case for case, subjects in zip(faulty, named, strict=True) if subjects], "", examining)
    answers = iter(zip(examined, findings, strict=True))
    return [
        Attempt(kind, stretch.name, run, base, is_named(kind.subjects, *next(answers)) if kind.subjects else None)
        for (kind, stretch), run, base in zip(pairs, runs, alone, strict=True)
    ]


def _case(kind: str, stretch: LogStretch, settings: Settings) -> FaultCase:
    return FaultCase(stretch.log, stretch.number, kind, settings.changes, stretch.duration, stretch.start)


def _examine(cases: Sequence[FaultCase], kind: str, runner: CachedRunner) -> list[list[dict[str, str]]]:
    """What the doctor finds in the stretches.

    :raises HmtSlamError: where it fails.
    """
    runs = runner.runs([replace(case, task="doctor", reference=None, kind=kind or case.kind) for case in cases])
    return [json.loads((run.folder / FINDINGS).read_text(encoding="utf-8"))["findings"] for run in runs]


def is_named(subjects: Sequence[str], without: Sequence[dict[str, str]], found: Sequence[dict[str, str]]) -> bool:
    """Whether findings name a fault that those without it do not name.

    :param subjects: of the findings that name it.
    """
    before = {one["text"] for one in without}
    return any(one["subject"] in subjects and one["severity"] != "fine" and one["text"] not in before for one in found)


def requirements(attempts: Sequence[Attempt]) -> list[Requirement]:
    """The requirements on all cases."""
    right, wrong = (mean([attempt.outcome == outcome for attempt in attempts]) for outcome in ("right", "wrong"))
    return [
        Requirement("cases with the right topology, share", right, math.inf, least=LEAST_RIGHT),
        Requirement("cases that are wrong with confidence, share", wrong, MOST_WRONG),
    ]


def outcome_table(kinds: Sequence[Kind], alone: Sequence[Attempt], attempts: Sequence[Attempt]) -> str:
    """A table with a line for the stretches alone, for every kind of fault, and for all."""
    groups = [(kind.name, [attempt for attempt in attempts if attempt.kind == kind]) for kind in kinds]
    columns: Columns[tuple[str, Sequence[Attempt]]] = [
        ("fault", lambda row: row[0]),
        ("cases", lambda row: str(len(row[1]))),
        ("right", lambda row: _count(row[1], "right")),
        ("alone right", lambda row: str(sum(read_verdict(one.alone)["outcome"] == "right" for one in row[1]))),
        ("wrong with confidence", lambda row: _count(row[1], "wrong")),
        ("open", lambda row: _count(row[1], "open")),
        ("failed", lambda row: _count(row[1], "failed")),
        ("error [m]", lambda row: _median_error([one.verdict for one in row[1]])),
        ("alone [m]", lambda row: _median_error([read_verdict(one.alone) for one in row[1]])),
        ("named by the doctor", lambda row: _count_named(row[1])),
        ("CPU [s]", lambda row: f"{sum(one.run.cpu_seconds for one in row[1]):.0f}"),
    ]
    return table_of(columns, [("none", alone), *groups, ("**all**", attempts)])


def _count(attempts: Sequence[Attempt], outcome: str) -> str:
    return str(sum(attempt.outcome == outcome for attempt in attempts))


def _median_error(verdicts: Sequence[dict[str, Any]]) -> str:
    errors = [verdict["error"] for verdict in verdicts if verdict["error"] is not None]
    return f"{np.median(errors):.3f}" if errors else "-"


def _count_named(attempts: Sequence[Attempt]) -> str:
    named = [attempt.is_named for attempt in attempts if attempt.is_named is not None]
    return f"{sum(named)} of {len(named)}" if named else "-"
