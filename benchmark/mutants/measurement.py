"""``python -m benchmark mutants``: small faults of the numerical core, and how many of them the unit tests notice.

Each mutant is one fault in a copy of the repository. The tests near it run first, then all others that could notice it.
A mutant that all of them pass survives. Where `equivalent.toml` has a reason why no result changes, it is not run, and
counts as a survivor in the first figure. With ``--runs DIR`` verdicts are kept, and only survivors are tried again.
``--first-seed K`` draws other mutants. Tests that were written for the survivors of one draw say little of the next.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import Queue
from threading import Lock

from benchmark.mutants.mutations import (
    FOLDERS,
    Mutant,
    core_modules,
    draw_mutants,
    equivalent_reasons,
    planted_mutants,
)
from benchmark.mutants.sandbox import Sandbox
from benchmark.mutants.selection import STAGES, Baseline, Trial, longest, unit_tests
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from hmt_slam_ros.errors import HmtSlamError

COUNT = 300
"""Mutants for each seed, about."""

LEAST_KILLED = 90.0
"""Mutants that tests must notice, of 100; equivalent ones count as unnoticed."""


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant.

    :ivar module: path below the package.
    :ivar line: of the fault.
    :ivar before: the lines that the fault changes.
    :ivar after: the same with the fault.
    :ivar operator: that made the fault.
    :ivar verdict: "killed", "timeout" or "survived".
    :ivar test: the test that failed.
    :ivar seconds: the tests took.
    """

    module: str
    line: int
    before: str
    after: str
    operator: str
    verdict: str
    test: str
    seconds: float

    def reason(self, reasons: dict[tuple[str, str, str], str]) -> str:
        """Why the mutant is equivalent, or nothing."""
        return reasons.get((self.module, self.before, self.after), "") if self.verdict == "survived" else ""


class OutcomeFile:
    """Outcomes of mutants by their keys, kept in a file of JSON lines."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, Lock()
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self._known = {entry["key"]: Outcome(**entry["outcome"]) for entry in map(json.loads, lines)}

    def get(self, mutant: Mutant) -> Outcome | None:
        """The outcome of a mutant that was killed; tests that were added since may kill the others."""
        known = self._known.get(mutant.key)
        return known if known is not None and known.verdict != "survived" else None

    def add(self, mutant: Mutant, outcome: Outcome) -> None:
        """Keep an outcome."""
        with self._lock, self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"key": mutant.key, "outcome": asdict(outcome)}) + "\n")


def measure_mutants(settings: Settings) -> Report:
    """Try planted and drawn mutants, and list those that survive."""
    seeds = settings.seeds_or(1)
    report = Report("mutants", "Faults of the numerical core that the unit tests notice", seeds=seeds)
    modules = _choose_modules(settings)
    drawn = [
        mutant for seed in seeds for mutant in draw_mutants(core_modules(), COUNT, seed) if mutant.module in modules
    ]
    planted = [mutant for mutant in planted_mutants() if mutant.module in modules or not settings.logs]
    folder = settings.records.folder / "mutants"
    outcomes = try_mutants([*planted, *drawn], folder, settings.records.jobs)
    _fill(report, outcomes[: len(planted)], outcomes[len(planted) :])
    return report


def _choose_modules(settings: Settings) -> list[str]:
    chosen = settings.logs_or((*FOLDERS, "places"))
    modules = core_modules()
    for name in chosen:
        if not any(module.startswith(name) for module in modules):
            raise HmtSlamError(f"--logs {name} is nothing that is mutated: choose of {', '.join(FOLDERS)}")
    return [module for module in modules if module.startswith(tuple(chosen))]


def try_mutants(mutants: Sequence[Mutant], folder: Path, jobs: int) -> list[Outcome]:
    """The outcomes of mutants, in their order: in stages, each of which has the survivors of the stage before.

    :param folder: of the copies of the repository and of the outcomes, for later calls.
    :raises HmtSlamError: where a test fails without a mutant.
    """
    outcomes, reasons = [survive(mutant) for mutant in mutants], equivalent_reasons()
    with contextlib.closing(Workshop(folder, jobs)) as workshop:
        for plan in STAGES:
            left = [n for n, each in enumerate(outcomes) if each.verdict == "survived" and not each.reason(reasons)]
            for n, outcome in zip(left, workshop.try_all([mutants[n] for n in left], plan), strict=True):
                outcomes[n] = outcome
    return outcomes


class Workshop:
    """Copies of the repository, and the outcomes of mutants in them."""

    def __init__(self, folder: Path, jobs: int) -> None:
        """:param folder: of the copies and outcomes, which stay for later calls."""
        self._file = OutcomeFile(folder / "outcomes.jsonl")
        self._jobs = jobs
        self._sandboxes: Queue[tuple[Sandbox, Baseline]] = Queue()
        for job in range(jobs):
            sandbox = Sandbox(folder / f"copy-{job}")
            sandbox.refresh()
            baseline = Baseline(sandbox)
            baseline.verify(unit_tests())
            self._sandboxes.put((sandbox, baseline))

    def try_all(self, mutants: Sequence[Mutant], plan: Callable[[Mutant, Baseline], Trial]) -> list[Outcome]:
        """The outcomes of mutants, in their order.

        :param plan: chooses the tests of a mutant.
        :raises HmtSlamError: where a test fails without a mutant.
        """
        with ThreadPoolExecutor(self._jobs) as pool:
            return list(pool.map(lambda mutant: self._file.get(mutant) or self._try(mutant, plan), mutants))

    def close(self) -> None:
        """End the processes that run tests."""
        while not self._sandboxes.empty():
            self._sandboxes.get()[0].close()

    def _try(self, mutant: Mutant, plan: Callable[[Mutant, Baseline], Trial]) -> Outcome:
        sandbox, baseline = self._sandboxes.get()
        try:
            trial = plan(mutant, baseline)
            outcome = try_mutant(mutant, sandbox, trial, longest(trial)) if trial.files else survive(mutant)
        finally:
            self._sandboxes.put((sandbox, baseline))
        self._file.add(mutant, outcome)
        print(f"{outcome.verdict} {mutant.module}:{mutant.line} {outcome.seconds:.0f} s {outcome.test}", flush=True)
        return outcome


def try_mutant(mutant: Mutant, sandbox: Sandbox, trial: Trial, limit: float) -> Outcome:
    """Run tests on a mutant until one fails.

    :param limit: the longest time that they may take, s.
    """
    with sandbox.apply(mutant):
        run = sandbox.run_tests(trial.files, limit, compiled=trial.compiled)
    if run.status == "passed":
        return survive(mutant, run.seconds)
    verdict = "timeout" if run.status == "timeout" else "killed"
    test = run.failed.removeprefix("test/") or run.output.strip().rpartition("\n")[2][:200]
    return replace(survive(mutant, run.seconds), verdict=verdict, test=test)


def survive(mutant: Mutant, seconds: float = 0.0) -> Outcome:
    """The outcome of a mutant that no test has killed."""
    return Outcome(mutant.module, mutant.line, mutant.before, mutant.after, mutant.operator, "survived", "", seconds)


def _fill(report: Report, planted: Sequence[Outcome], drawn: Sequence[Outcome]) -> None:
    reasons = equivalent_reasons()
    survivors = [each for each in drawn if each.verdict == "survived"]
    open_ones = [each for each in survivors if not each.reason(reasons)]
    raw = 100.0 * (1.0 - len(survivors) / max(1, len(drawn)))
    changing = len(drawn) - len(survivors) + len(open_ones)
    report.requirements = [
        Requirement("mutants drawn", len(drawn), float("inf"), least=300),
        Requirement("killed of 100", raw, 100.0, least=LEAST_KILLED),
        Requirement("killed of 100 that change a result", 100.0 * (1.0 - len(open_ones) / max(1, changing)), 100.0),
        Requirement("planted faults that survive", sum(each.verdict == "survived" for each in planted), 0),
    ]
    report.body = [
        _table_of_modules(drawn, reasons),
        "## Planted faults",
        table(
            ["fault", "verdict", "test"],
            [[f"{each.module}: {each.operator}", each.verdict, each.test] for each in planted],
        ),
        "## Survivors",
        _list_survivors(open_ones),
        "## Equivalent mutants",
        _list_survivors(each for each in survivors if each.reason(reasons)),
    ]
    report.data = {"planted": [asdict(each) for each in planted], "drawn": [asdict(each) for each in drawn]}


def _table_of_modules(drawn: Sequence[Outcome], reasons: dict[tuple[str, str, str], str]) -> str:
    names = list(dict.fromkeys(each.module for each in drawn))
    counts = Counter((each.module, "equivalent" if each.reason(reasons) else each.verdict) for each in drawn)
    verdicts = ("killed", "timeout", "equivalent", "survived")
    rows = [[name, *(str(counts[name, verdict]) for verdict in verdicts)] for name in names]
    total = ["all", *(str(sum(counts[name, verdict] for name in names)) for verdict in verdicts)]
    return table(["module", *verdicts], [*rows, total])


def _list_survivors(outcomes: Iterable[Outcome]) -> str:
    reasons = equivalent_reasons()
    return "\n".join(
        f"- {each.module}:{each.line}: `{each.before}` became `{each.after}`. {each.reason(reasons)}".rstrip()
        for each in outcomes
    )
