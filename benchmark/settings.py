"""What is measured, as the command line says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmark.runs import Runner
from benchmark.simulated.records import Records


@dataclass(frozen=True)
class Settings:
    """Settings of a measurement.

    :ivar logs: names of the logs, or families of simulated worlds, empty for those that the measurement is meant for.
    :ivar seeds: of the runs, empty for as many as the measurement is meant for.
    :ivar changes: parameters that differ from the file, as ``name=value``.
    :ivar out: folder of the report.
    :ivar write_expected: whether the short form writes what it is to compare with.
    :ivar runner: runs what is asked for, each case once for all measurements.
    :ivar records: the same for simulated worlds.
    :ivar training: whether those are the worlds of the training seeds.
    :ivar minutes: how long the nodes run in soak.
    """

    logs: tuple[str, ...]
    seeds: tuple[int, ...]
    changes: tuple[str, ...]
    out: Path
    write_expected: bool
    runner: Runner
    records: Records
    training: bool = False
    minutes: float = 60.0

    def logs_or(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The logs asked for, or those of the measurement."""
        return self.logs or names

    def seeds_or(self, count: int) -> tuple[int, ...]:
        """The seeds asked for, or the first ones."""
        return self.seeds or tuple(range(count))
