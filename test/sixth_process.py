"""A process beyond the five of the package, for programs of their own that have it in the process table from the start.

It counts closure decisions, and can be brought to a fault.
"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from hmt_slam_ros import process_table
from hmt_slam_ros.process_table import ProcessRow

NAME = "counter"
POISON, FATAL = 13.0, 666.0
"""Ambiguities on which the process raises an error: always, and such that it cannot be rebuilt."""
_UNBUILDABLE = "UNBUILDABLE"
"""Environment variable with the path of a file: where it exists, the process cannot be made."""


@dataclass(frozen=True)
class CounterState:
    """Number of closure decisions so far."""

    decisions: int = 0


class Counter:
    """A process that counts closure decisions, reports them, and changes before it fails."""

    def __init__(self, _configuration, state=None):
        if Path(os.environ[_UNBUILDABLE]).exists():
            raise MemoryError("no room")
        self.state = state or CounterState()

    def handle(self, message):
        from hmt_slam_ros.messages.messages import Notice  # noqa: PLC0415  when the row is in the table

        self.state = CounterState(self.state.decisions + 1)
        ambiguity = message.ambiguity[0, 0]
        if ambiguity == FATAL:
            Path(os.environ[_UNBUILDABLE]).touch()
        if ambiguity in (POISON, FATAL):
            raise ZeroDivisionError("a fault of the program")
        return [Notice(NAME, f"decisions: {self.state.decisions}")]


ROW = ProcessRow(
    name=NAME,
    title="counts closure decisions",
    consumes=("ClosureDecision",),
    factory=f"{__name__}:Counter",
    state=f"{__name__}:CounterState",
)


def add_row():
    process_table.PROCESSES = (*process_table.PROCESSES, ROW)


def add_to_programs(folder, monkeypatch):
    """Have all Python programs that are started from here on add the row at their start.

    :param folder: an existing one, for a file that Python reads at its start, and for the process's own.
    """
    (folder / "sitecustomize.py").write_text(f"import {__name__}\n{__name__}.add_row()\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(Path(__file__).parent), *sys.path]))
    monkeypatch.setenv(_UNBUILDABLE, str(folder / "unbuildable"))
