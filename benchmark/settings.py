"""Settings of a measurement, and the worlds, seeds and records that they select."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmark.runs import PARAMETERS, Runner
from benchmark.simulated.records import Record, Records
from benchmark.simulated.worlds import FAMILIES, World, seeds
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.errors import HmtSlamError

SEEDS = 40
"""Worlds of every family: 320 runs in all."""


@dataclass(frozen=True)
class Settings:
    """Settings of a measurement.

    :ivar logs: names of logs or families of simulated worlds; empty for the measurement's own choice.
    :ivar seeds: of the runs; empty for the measurement's own choice.
    :ivar changes: parameters that differ from the file, as ``name=value``.
    :ivar out: folder of the report.
    :ivar write_expected: whether the figures to compare with are written.
    :ivar runner: runs each case once for all measurements.
    :ivar records: the same for simulated worlds.
    :ivar training: whether simulated worlds have training seeds instead of validation seeds.
    :ivar minutes: how long the nodes run in soak.
    :ivar first_seed: of the measurement's own choice; 0 for the usual one.
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
    first_seed: int = 0

    @property
    def configuration(self) -> Configuration:
        """The configuration of the parameter file, with the changes."""
        return load_configuration(PARAMETERS, list(self.changes))

    def logs_or(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The selected logs, by default ``names``."""
        return self.logs or names

    def seeds_or(self, count: int) -> tuple[int, ...]:
        """The selected seeds, by default the first ``count``."""
        return self.seeds or tuple(range(self.first_seed, self.first_seed + count))


def chosen_seeds(settings: Settings, count: int = SEEDS) -> tuple[int, ...]:
    """Training or validation seeds of simulated worlds, by default ``count`` of them."""
    return seeds(len(settings.seeds_or(count)), settings.first_seed, training=settings.training)


def chosen_families(settings: Settings, families: tuple[str, ...], known: tuple[str, ...] = ()) -> tuple[str, ...]:
    """The selected families, by default ``families``.

    :param known: all families that may be selected, by default ``families``.
    :raises HmtSlamError: for an unknown name.
    """
    chosen, known = settings.logs_or(families), known or families
    for name in chosen:
        if name not in known:
            raise HmtSlamError(f"there is no family {name!r}: choose from {', '.join(known)}")
    return tuple(chosen)


def make_records(
    settings: Settings, families: tuple[str, ...] = FAMILIES, count: int = SEEDS, others: tuple[str, ...] = ()
) -> list[Record]:
    """The records of some families, in the order of families and seeds.

    :param count: number of seeds, if none are selected.
    :param others: further worlds, which are mapped only if they are selected by name.

    :raises HmtSlamError: for an unknown name or a failed run.
    """
    chosen = chosen_families(settings, families, (*FAMILIES, *others))
    mapped, numbers = (family for family in (*families, *others) if family in chosen), chosen_seeds(settings, count)
    worlds = [World(family, seed) for family in mapped for seed in numbers]
    return settings.records.make(worlds, settings.changes)


def group_by_family(records: list[Record]) -> dict[str, list[Record]]:
    """The records of each family."""
    return {family: own for family in FAMILIES if (own := [record for record in records if record["family"] == family])}
