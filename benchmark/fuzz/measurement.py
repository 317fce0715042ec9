"""``python -m benchmark fuzz``: mutated and hostile files against the commands that read them.

``--logs`` chooses the kinds: ``readers``, ``yaml`` and ``maps`` are mutated, ``hostile`` are those of an attacker, and
``guided`` is coverage-guided, for as many minutes as ``--minutes`` says. Each mutated run is drawn by the seed and its
number alone, so that a fault is found again by both. A command has 10 s and 1 GB, and must accept what it is given or
refuse it in one sentence with exit status 2.
"""

from __future__ import annotations

import contextlib
import gc
import io
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmark.fuzz.cases import FuzzCase, map_cases, reader_cases, yaml_cases
from benchmark.fuzz.crafted import GROUPS, crafted_cases, run_subprocess
from benchmark.fuzz.guided import fuzz_guided
from benchmark.fuzz.isolation import CommandAnswer, Verdict, run_isolated
from benchmark.fuzz.node_loading import run_arguments
from benchmark.fuzz.seeds import write_map_seeds, write_seeds
from benchmark.fuzz.targets import TARGETS
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from hmt_slam_ros.errors import HmtSlamError

KINDS: dict[str, tuple[Callable[[Path], Iterable[FuzzCase]], int]] = {
    "readers": (reader_cases, 1400),
    "yaml": (yaml_cases, 100),
    "maps": (map_cases, 1300),
}
"""{kind: its cases below a folder of seeds, and the number of runs for each seed}."""


_HOSTILE, _GUIDED = "hostile", "guided"
"""Kinds without mutations of their own."""


class FuzzRun(NamedTuple):
    """A mutated run.

    :ivar kind: of `KINDS`.
    :ivar case: name of the case.
    :ivar seed: of the random numbers.
    :ivar number: of the run, from 0.
    :ivar arguments: of the command, without the folder of the run.
    :ivar answer: what the command came to.
    """

    kind: str
    case: str
    seed: int
    number: int
    arguments: str
    answer: CommandAnswer


def measure_fuzz(settings: Settings) -> Report:
    """Run all kinds, each with all seeds, and count the verdicts."""
    seeds = settings.seeds or (0,)
    report = Report("fuzz", "Mutated files against the commands that read them", seeds=seeds)
    chosen = settings.logs_or((*KINDS, _HOSTILE))
    known = (*KINDS, _HOSTILE, _GUIDED)
    unknown = sorted(set(chosen) - set(known))
    if unknown:
        raise HmtSlamError(f"--logs {unknown[0]} is nothing that is fuzzed: choose of {', '.join(known)}")
    folder = settings.out / "seeds"
    with _silence():
        write_seeds(folder)
        if "maps" in chosen:
            write_map_seeds(folder)
    if _GUIDED in chosen:
        _add_guided(report, settings)
    if _HOSTILE in chosen:
        _add_hostile(report, folder)
    for kind in (kind for kind in chosen if kind in KINDS):
        runs = [run for seed in seeds for run in mutated_runs(kind, folder, KINDS[kind][1], seed)]
        faults = [run for run in runs if run.answer.verdict.is_fault]
        report.requirements.append(Requirement(f"faults in {len(runs)} runs of {kind}", len(faults), 0))
        report.body += [f"## {kind}", _table_of_verdicts(runs), _list_of_faults(faults)]
        report.data[kind] = [_entry(run) for run in faults]
    return report


def _add_guided(report: Report, settings: Settings) -> None:
    """Fuzz each target for an equal part of the time."""
    seconds = 60.0 * settings.minutes / len(TARGETS)
    runs = [fuzz_guided(target, seconds, settings.out / _GUIDED, report.seeds[0]) for target in TARGETS]
    faults = [run for run in runs if run.fault]
    executions = sum(run.executions for run in runs)
    report.requirements.append(Requirement(f"faults in {executions} guided runs", len(faults), 0))
    rows = [[run.target, str(run.executions), str(run.file or "")] for run in runs]
    report.body += ["## guided", table(["target", "runs", "file of a fault"], rows)]
    report.data[_GUIDED] = [{"target": run.target, "said": run.fault, "file": str(run.file)} for run in faults]


def _add_hostile(report: Report, seeds: Path) -> None:
    """Give each hostile file to each command that reads it, as a process of its own."""
    answers = []
    for case in crafted_cases(all_commands=True):
        with tempfile.TemporaryDirectory() as folder:
            answers.append((case, case.run(Path(folder), seeds, run_subprocess)))
    faults = [(case, answer) for case, answer in answers if answer.verdict.is_fault]
    report.requirements.append(Requirement(f"faults in {len(answers)} processes with hostile files", len(faults), 0))
    counts = Counter((case.group, answer.verdict) for case, answer in answers)
    head = ["group", *(verdict.value for verdict in Verdict)]
    rows = [[group, *(str(counts[group, verdict]) for verdict in Verdict)] for group in GROUPS]
    report.body += ["## hostile", table(head, rows)]
    report.data[_HOSTILE] = [
        {"group": case.group, "name": case.name, "command": case.command[0], "said": answer.text[-2000:]}
        for case, answer in faults
    ]


def mutated_runs(kind: str, seeds: Path, count: int, seed: int) -> Iterator[FuzzRun]:
    """Runs of all cases of a kind in turn.

    :param seeds: folder of the seeds, as `write_seeds` makes it.
    :param seed: of the random numbers.
    :raises HmtSlamError: where a command refuses a seed that is not mutated.
    """
    cases = list(KINDS[kind][0](seeds))
    warm_up(cases)
    for number in range(count):
        case, rng = cases[number % len(cases)], np.random.default_rng([seed, number])
        with _copy(case.seed) as folder:
            case.mutate(folder, rng)
            arguments = case.arguments(folder, rng)
            answer = run_isolated(partial(run_arguments, arguments))
        yield FuzzRun(kind, case.name, seed, number, " ".join(arguments).replace(str(folder), ""), answer)


def warm_up(cases: Sequence[FuzzCase]) -> None:
    """Run every command on its first seed, and the first of each seed, in this process.

    A fork of it then has all modules and compiled functions.

    :raises HmtSlamError: where a command refuses the seed.
    """
    first_seeds = {command: case.seed for case in reversed(cases) for command in case.commands}
    commands = {(case.seed, case.commands[0]) for case in cases}
    commands |= {(seed, command) for command, seed in first_seeds.items()}
    for seed, command in sorted(commands):
        with _copy(seed) as folder, _silence():
            status = run_arguments([word.replace("{}", str(folder)) for word in command])
        if status not in (0, 1):
            raise HmtSlamError(f"hmt_slam {' '.join(command)} refuses the seed {seed}: mend the seed")
    gc.freeze()  # what a fork does not touch, it need not copy


@contextlib.contextmanager
def _copy(seed: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "run"
        shutil.copytree(seed, folder)
        yield folder


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


def _table_of_verdicts(runs: Sequence[FuzzRun]) -> str:
    counts = Counter((run.case, run.answer.verdict) for run in runs)
    slowest = {run.case: 0.0 for run in runs}
    for run in runs:
        slowest[run.case] = max(slowest[run.case], run.answer.seconds)
    head = ["case", *(verdict.value for verdict in Verdict), "slowest [s]"]
    rows = [[case, *(str(counts[case, verdict]) for verdict in Verdict), f"{slowest[case]:.1f}"] for case in slowest]
    return table(head, rows)


def _list_of_faults(faults: Sequence[FuzzRun]) -> str:
    """One line for each place of a fault, with the first run that ended there."""
    places = Counter(run.answer.place for run in faults)
    first = {run.answer.place: run for run in reversed(faults)}
    return "".join(
        f"\n- {count} times {place}, first in run {first[place].number} of seed {first[place].seed}, "
        f"`hmt_slam {first[place].arguments[:100]}`"
        for place, count in places.most_common()
    )


def _entry(run: FuzzRun) -> dict[str, object]:
    answer = run.answer
    return {
        "case": run.case,
        "seed": run.seed,
        "number": run.number,
        "arguments": run.arguments,
        "verdict": answer.verdict.value,
        "place": answer.place,
        "said": answer.text[-2000:],
    }
