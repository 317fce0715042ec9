"""Runs operations with a fault at every call; this process has the injector in memory, and forks one for each trial."""

from __future__ import annotations

import argparse
import ctypes
import errno
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmark.fuzz.isolation import CommandAnswer, Verdict, run_isolated
from benchmark.write_faults.operations import Operation, complaint, digests, operations
from hmt_slam_ros.cli.main import FAULT
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.untrusted_input import one_sentence

_PROCESS = re.compile(r"(?<=\.partial-)[0-9]+(-\w+)?")
"""Process id, and what makes the name of a scratch folder unique."""


@dataclass(frozen=True)
class Fault:
    """What happens at a call.

    :ivar name: of the fault.
    :ivar kind: as in inject.c: 0 fails, 1 writes half, 2 ends the process before, 3 after it.
    :ivar error: its error number.
    :ivar lasts: whether all later calls that need room fail too.
    :ivar exchange: whether the file system can exchange two names.
    """

    name: str
    kind: int
    error: int = 0
    lasts: bool = False
    exchange: bool = True


FAULTS = (
    Fault("full disk", 0, errno.ENOSPC, lasts=True),
    Fault("faulty disk", 0, errno.EIO),
    Fault("disk that became read-only", 0, errno.EROFS, lasts=True),
    Fault("half a write", 1),
    Fault("killed before", 2),
    Fault("killed after", 3),
    Fault("killed before, no exchange", 2, exchange=False),
    Fault("killed after, no exchange", 3, exchange=False),
    Fault("faulty disk, no exchange", 0, errno.EIO, exchange=False),
)


@dataclass(frozen=True)
class Breach:
    """What went wrong in a trial.

    :ivar operation: its name.
    :ivar fault: its name.
    :ivar call: number of the call, from 1.
    :ivar text: what went wrong.
    """

    operation: str
    fault: str
    call: int
    text: str


def _arm(folder: Path, call: int, fault: Fault) -> None:
    library = ctypes.CDLL(None)
    library.inject_arm(os.fsencode(folder), call, fault.kind, fault.error, int(fault.lasts), int(fault.exchange))


def _run(operation: Operation, folder: Path, call: int, fault: Fault, count: Path) -> CommandAnswer:
    """Run an operation in a fork with a fault at a call, 0 for none; the number of calls is written into a file."""

    def act() -> int:
        counter = os.open(count, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        _arm(folder, call, fault)
        try:
            status = operation.act(folder)
        except HmtSlamError as refusal:
            print(one_sentence(refusal), file=sys.stderr)
            status = FAULT
        os.write(counter, b"%d" % ctypes.CDLL(None).inject_count())
        return status

    return run_isolated(act, timeout=60.0)


def try_operation(operation: Operation, faults: tuple[Fault, ...], every: int, work: Path) -> Iterator[Breach | int]:
    """Breaches of an operation, and the number of each call that was tried.

    :param every: tries every such call, the first and the last two.
    """
    start, count = work / "start", work / "count"
    start.mkdir()
    operation.prepare(start)
    old = digests(start)
    judged: dict[tuple[str, ...], str] = {}
    for fault in faults:
        folder = _fresh(start, work)
        answer = _run(operation, folder, 0, fault, count)
        if answer.verdict is not Verdict.ACCEPTED:
            yield Breach(operation.name, fault.name, 0, f"without a fault it says {answer.text[-500:]}")
            return
        new, calls = digests(folder), int(count.read_text())
        for call in range(1, calls + 1):
            if call % every == 0 or call == 1 or call > calls - 2:
                folder = _fresh(start, work)
                answer = _run(operation, folder, call, fault, count)
                yield call
                text = _judge(operation, folder, fault, answer, (old, new))
                found = _state_left_behind(folder)
                if not text and found not in judged:
                    judged[found] = _judge_next(operation, folder, count, new)
                text = text or judged.get(found, "")
                if text:
                    yield Breach(operation.name, fault.name, call, text)


def _fresh(start: Path, work: Path) -> Path:
    folder = work / "run"
    if folder.exists():
        shutil.rmtree(folder)
    shutil.copytree(start, folder)
    return folder


def _judge(
    operation: Operation,
    folder: Path,
    fault: Fault,
    answer: CommandAnswer,
    states: tuple[dict[str, str], dict[str, str]],
) -> str:
    """What is wrong after a trial, empty where nothing is."""
    old, new = states
    was_killed = fault.kind >= 2 and answer.verdict is Verdict.UNCLEAR and not answer.text.strip()
    if answer.verdict.is_fault and not was_killed:
        return f"{answer.verdict.value}: {answer.text[-800:]}"
    if operation.name == "journal":
        return _verification(operation, folder)
    if answer.verdict is Verdict.ACCEPTED:
        old = new
    if (
        answer.verdict is Verdict.REFUSED
        and fault.kind == 0
        and fault.error != errno.EROFS
        and _leftovers(operation, folder)
    ):
        return f"refused, and left {_leftovers(operation, folder)}"
    if not fault.exchange and not (folder / "out").exists() and any(folder.glob(".out.partial-*/old")):
        return ""  # for a moment there is none; the next run puts it back
    return complaint(folder, old, new, is_whole=operation.is_whole) or (_verification(operation, folder) if old else "")


def _verification(operation: Operation, folder: Path) -> str:
    try:
        operation.verify(folder)
    except Exception as fault:
        return f"it cannot be read, {type(fault).__name__}: {fault}"
    return ""


def _leftovers(operation: Operation, folder: Path) -> list[str]:
    own = {name for path in operation.foreign for name in (path, str(Path(path).parent))}
    names = {str(path.relative_to(folder)) for path in folder.rglob("*") if "partial" in path.name}
    return sorted(names - own)


def _state_left_behind(folder: Path) -> tuple[str, ...]:
    """What the next run finds: digests of all files, but of those under way the names alone, without process ids."""
    hidden = (
        f"{_PROCESS.sub('', str(path.relative_to(folder)))} {path.is_dir() or path.stat().st_size > 0}"
        for path in folder.rglob("*")
        if ".partial-" in str(path.relative_to(folder))
    )
    return (*(f"{name} {digest}" for name, digest in digests(folder).items()), *sorted(hidden))


def _judge_next(operation: Operation, folder: Path, count: Path, new: dict[str, str]) -> str:
    """What is wrong after the next run without a fault, empty where nothing is."""
    # A bag is never replaced.
    is_refused = operation.name.startswith("convert") and digests(folder) == new
    answer = _run(operation, folder, 0, FAULTS[0], count)
    if answer.verdict is not (Verdict.REFUSED if is_refused else Verdict.ACCEPTED):
        return f"the next run says {answer.text[-500:]}"
    if _leftovers(operation, folder):
        return f"the next run leaves {_leftovers(operation, folder)}"
    if operation.name == "journal":
        return _verification(operation, folder)
    return complaint(folder, new, new, is_whole=True)


def main(arguments: list[str]) -> int:
    """Try some operations and print the breaches and the number of trials as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", type=Path)
    parser.add_argument("operations", nargs="+")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--faults", type=int, nargs="*", default=range(len(FAULTS)))
    options = parser.parse_args(arguments)
    chosen = tuple(FAULTS[number] for number in options.faults)
    trials, breaches = {}, []
    for name in options.operations:
        operation = operations(options.seeds)[name]
        with tempfile.TemporaryDirectory() as work:
            _warm_up(operation, Path(work) / "warm")
            results = list(try_operation(operation, chosen, options.every, Path(work)))
        trials[name] = sum(isinstance(result, int) for result in results)
        breaches += [asdict(result) for result in results if isinstance(result, Breach)]
    print(json.dumps({"trials": trials, "breaches": breaches}))
    return 0


def _warm_up(operation: Operation, folder: Path) -> None:
    """Run an operation in this process, so that a fork has all modules and compiled functions."""
    folder.mkdir()
    operation.prepare(folder)
    quiet: Callable[[int], int] = os.dup
    kept = quiet(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        operation.act(folder)
    finally:
        os.dup2(kept, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
