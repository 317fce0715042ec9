"""The hostile files against the commands that read them, by ``hmt_slam`` as a user calls it."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmark.fuzz.cases import SHORT
from benchmark.fuzz.hostile_bags import FOLDERS, MCAP, SQLITE, Hostile
from benchmark.fuzz.hostile_files import CARMEN, PLACES, RAWLOG, RESULTS, SETTINGS
from benchmark.fuzz.isolation import CommandAnswer, judge, run_command

_LOG = (
    ("doctor", "{log}"),
    ("convert", "{log}", "{folder}/converted"),
    ("map", "{log}", "--out", "{folder}/mapped", *SHORT),
)
_RESULT = (
    ("plot", "{log}"),
    ("export", "{log}"),
    ("evaluate", "{log}", "--relations", "{seeds}/map/relations"),
)
_PLACE = (
    *_LOG,
    *_RESULT,
    ("evaluate", "{seeds}/map/out", "--relations", "{log}"),
    ("parameters", "--config", "{log}"),
    ("simulate", "{log}", "--out", "{folder}/simulated"),
    ("map", "{seeds}/map/bag", "--from", "{log}", "--out", "{folder}/mapped"),
)

GROUPS: dict[str, tuple[dict[str, Hostile], tuple[tuple[str, ...], ...]]] = {
    "mcap": (MCAP, _LOG),
    "sqlite": (SQLITE, _LOG),
    "bag folder": (FOLDERS, _LOG),
    "carmen": (CARMEN, _LOG),
    "rawlog": (RAWLOG, _LOG),
    "results": (RESULTS, _RESULT),
    "places": (PLACES, _PLACE),
    "parameters": (
        {name: one for name, one in SETTINGS.items() if name.startswith("parameters")},
        (("parameters", "--config", "{log}"),),
    ),
    "worlds": (
        {name: one for name, one in SETTINGS.items() if "world" in name},
        (("simulate", "{log}", "--out", "{folder}/simulated", "--duration", "2"),),
    ),
}
"""{group: its hostile files, and the commands that read them}; each file meets one of them."""


@dataclass(frozen=True)
class CraftedCase:
    """A hostile file and a command that reads it.

    :ivar group: of `GROUPS`.
    :ivar name: of the file.
    :ivar write: writes it.
    :ivar command: arguments of ``hmt_slam``.
    """

    group: str
    name: str
    write: Hostile
    command: tuple[str, ...]

    def run(self, folder: Path, seeds: Path, run: Callable[[list[str]], CommandAnswer] = run_command) -> CommandAnswer:
        """Write the file into an empty folder, and run the command on it."""
        log = self.write(folder, seeds)
        return run([word.format(log=log, folder=folder, seeds=seeds) for word in self.command])


def crafted_cases(*, all_commands: bool = False) -> Iterator[CraftedCase]:
    """Each hostile file with one command, or with all that read it."""
    for group, (files, commands) in GROUPS.items():
        for number, (name, write) in enumerate(files.items()):
            chosen = commands if all_commands or group == "places" else (commands[number % len(commands)],)
            for command in chosen:
                yield CraftedCase(group, name, write, command)


def run_subprocess(arguments: list[str], timeout: float = 30.0, memory: int = 3 << 30) -> CommandAnswer:
    """Run ``hmt_slam`` as a new process, whose address space has room for the libraries and a gigabyte."""
    begin = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "hmt_slam_ros.cli.main", *arguments],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (memory, memory)),  # noqa: PLW1509  no threads here
    )  # fmt: skip
    status: int | None
    try:
        _, output = process.communicate(timeout=timeout)
        status = process.returncode << 8 if process.returncode >= 0 else -process.returncode
    except subprocess.TimeoutExpired:
        process.kill()
        _, output = process.communicate()
        status = None
    text = output.decode("utf-8", "replace")
    return CommandAnswer(judge(status, text), text, time.monotonic() - begin)
