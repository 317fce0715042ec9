"""The records that a measurement on simulated worlds is an analysis of."""

from __future__ import annotations

from benchmark.settings import Settings
from benchmark.simulated.records import Record
from benchmark.simulated.worlds import FAMILIES, World, seeds
from hmt_slam_ros.errors import HmtSlamError

SEEDS = 40
"""Worlds of every family: 320 runs in all."""


def chosen_seeds(settings: Settings, count: int = SEEDS) -> tuple[int, ...]:
    """Those for training or for validation, as many as are asked for, else ``count``."""
    return seeds(len(settings.seeds_or(count)), training=settings.training)


def records_of(settings: Settings, families: tuple[str, ...] = FAMILIES, count: int = SEEDS) -> list[Record]:
    """The records of some families, those of one family one after the other.

    :param count: of the seeds where none are asked for.

    :raises HmtSlamError: for a name that is no family, or a run that failed.
    """
    chosen = settings.logs_or(families)
    for name in chosen:
        if name not in FAMILIES:
            raise HmtSlamError(f"there is no family {name!r}: choose from {', '.join(FAMILIES)}")
    worlds = [World(family, seed) for family in families if family in chosen for seed in chosen_seeds(settings, count)]
    return settings.records.of(worlds, settings.changes)


def by_family(records: list[Record]) -> dict[str, list[Record]]:
    """The records of each family."""
    return {family: own for family in FAMILIES if (own := [record for record in records if record["family"] == family])}
