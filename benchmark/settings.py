"""Settings of a measurement, and the worlds, seeds and records that it asks for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmark.runs import Runner
from benchmark.simulated.records import Record, Records
from benchmark.simulated.worlds import FAMILIES, World, seeds
from hmt_slam_ros.errors import HmtSlamError

SEEDS = 40
"""Worlds of every family: 320 runs in all."""


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


def chosen_seeds(settings: Settings, count: int = SEEDS) -> tuple[int, ...]:
    """Those for training or for validation, as many as are asked for, else ``count``."""
    return seeds(len(settings.seeds_or(count)), training=settings.training)


def chosen_families(settings: Settings, families: tuple[str, ...], known: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Those that are asked for, else ``families``.

    :param known: all that may be asked for, if there are more.
    :raises HmtSlamError: for a name that is none of them.
    """
    chosen, known = settings.logs_or(families), known or families
    for name in chosen:
        if name not in known:
            raise HmtSlamError(f"there is no family {name!r}: choose from {', '.join(known)}")
    return tuple(chosen)


def make_records(
    settings: Settings, families: tuple[str, ...] = FAMILIES, count: int = SEEDS, others: tuple[str, ...] = ()
) -> list[Record]:
    """The records of some families, those of one family one after the other.

    :param count: of the seeds where none are asked for.
    :param others: worlds that are no families, and mapped only where they are asked for by their names.

    :raises HmtSlamError: for a name that is no family, or a run that failed.
    """
    chosen = chosen_families(settings, families, (*FAMILIES, *others))
    mapped, numbers = (family for family in (*families, *others) if family in chosen), chosen_seeds(settings, count)
    worlds = [World(family, seed) for family in mapped for seed in numbers]
    return settings.records.make(worlds, settings.changes)


def group_by_family(records: list[Record]) -> dict[str, list[Record]]:
    """The records of each family."""
    return {family: own for family in FAMILIES if (own := [record for record in records if record["family"] == family])}
