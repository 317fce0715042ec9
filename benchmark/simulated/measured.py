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


def records_of(
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
    return settings.records.of(worlds, settings.changes)


def by_family(records: list[Record]) -> dict[str, list[Record]]:
    """The records of each family."""
    return {family: own for family in FAMILIES if (own := [record for record in records if record["family"] == family])}
