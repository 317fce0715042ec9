"""Hallway or room, of single scans and of stretches of a drive, against the floors of simulated buildings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.landmark_scans import LASERS, VIRTUAL, cast_in_map
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.area_classes import FreeSpace, area_class, free_space, log_odds
from hmt_slam_ros.landmarks.beam_labels import rays_of
from hmt_slam_ros.landmarks.virtual_lines import rays_of_map
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario

Array = NDArray[np.float64]

SEEDS = 20
"""Worlds of every family."""

FAMILIES = ("office", "busy")

_PLACES = 60  # of the first round of a drive
_DOORWAY = 0.5  # m, to a room's border, where a place is neither
_LEAST = 3  # scans of a stretch
_RIGHT, _RIGHT_AREAS, _CALIBRATED = 0.9, 0.95, 0.05

POLICY = (
    f"{_PLACES} scans of the first round of a drive, evenly along it; virtual scans as of the landmarks. Within "
    f"{_DOORWAY:g} m of a room's border a place is neither, and is left out. A stretch is what the robot drives "
    f"through of one hallway or room without leaving it, of {_LEAST} scans at least, and stands for an area: the mean "
    "of their log-odds, with hysteresis. Expected calibration error: over ten bins of equal width, hallways and rooms "
    "weighing alike in all."
)


class Place(NamedTuple):
    """A scan.

    :ivar space: the free space in it.
    :ivar hallway: whether it was taken in a hallway; else in a room.
    :ivar stretch: number of the stretch of the drive.
    """

    space: FreeSpace
    hallway: bool
    stretch: int


def measure_hallways(settings: Settings) -> Report:
    """Classify scans and stretches of simulated drives and compare them with the floors."""
    chosen = chosen_families(settings, FAMILIES)
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    drives = {
        (laser, family, seed): list(places_of(World(family, seed), laser, configuration))
        for laser in LASERS
        for family in chosen
        for seed in seeds
    }
    report = Report("hallways", "Hallway or room", seeds=seeds)
    groups: dict[tuple[str, str], list[list[Place]]] = {}
    for (laser, family, _), places in drives.items():
        groups.setdefault((laser, family), []).append(places)
    head = ["scans", "family", "hallways", "right", "rooms", "right", "stretches", "right"]
    rows = [[laser, family, *_shares(own, configuration)] for (laser, family), own in groups.items()]
    for laser in LASERS:
        own = [places for (name, _), group in groups.items() if name == laser for places in group]
        odds = [(log_odds(place.space, configuration.features), place.hallway) for places in own for place in places]
        name = laser.partition(",")[0]
        right = [_stretches_right(places, configuration) for places in own]
        report.requirements += [
            Requirement(f"{name}: hallways right", _mean([o > 0.0 for o, true in odds if true]), 1.0, least=_RIGHT),
            Requirement(f"{name}: rooms right", _mean([o <= 0.0 for o, true in odds if not true]), 1.0, least=_RIGHT),
            Requirement(f"{name}: stretches right", _mean([r for rs in right for r in rs]), 1.0, least=_RIGHT_AREAS),
            Requirement(f"{name}: expected calibration error", _calibration_error(odds), _CALIBRATED),
        ]
    report.body += [table(head, rows), POLICY]
    return report


def places_of(world: World, laser: str, configuration: Configuration) -> Iterator[Place]:
    """Scans of the first round of a drive, with what is true of them."""
    scenario = open_simulated(",".join(filter(None, (world.log, LASERS[laser])))).scenario
    poses = scenario.true_poses(scenario.scan_stamps[: len(scenario.scan_stamps) // scenario.settings.laps])
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))))
    numbers = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], _PLACES)))
    depths = depth_in_rooms(scenario, poses[numbers])
    stretch, before = 0, None
    for number, depth in zip(numbers.tolist(), depths.tolist(), strict=True):
        if abs(depth) < _DOORWAY:
            continue
        stretch += before is not None and before != (depth < 0.0)
        before = depth < 0.0
        space = _space(scenario, number, laser, configuration)
        if space is not None:
            yield Place(space, before, stretch)


def _space(scenario: Scenario, number: int, laser: str, configuration: Configuration) -> FreeSpace | None:
    if laser == VIRTUAL:
        return free_space(rays_of_map(cast_in_map(scenario, number, configuration)[0], configuration.features))
    return free_space(rays_of(scenario.scan(number), configuration.features))


def depth_in_rooms(scenario: Scenario, poses: Array) -> Array:
    """How deep poses (n, 3) are in a room, m, shape (n,); below 0 for those outside of all, by the distance."""
    deepest = np.full(len(poses), -np.inf)
    for room in scenario.building.rooms:
        local = np.abs(se2.transform(se2.inverse(room[:3]), poses[:, :2]))
        deepest = np.maximum(deepest, (0.5 * room[3:] - local).min(axis=1))
    return deepest


def _stretches_right(places: Sequence[Place], configuration: Configuration) -> list[bool]:
    """Whether each stretch of a drive is taken for what it is."""
    right = []
    for stretch in sorted({place.stretch for place in places}):
        own = [place for place in places if place.stretch == stretch]
        if len(own) >= _LEAST:
            taken = area_class([place.space for place in own], configuration.features)
            right.append(taken.hallway == own[0].hallway)
    return right


def _calibration_error(odds: Sequence[tuple[float, bool]]) -> float:
    """Over ten bins; hallways and rooms weigh alike in all."""
    true = np.array([is_true for _, is_true in odds], dtype=np.bool_)
    if true.all() or not true.any():
        return math.nan
    weights = np.where(true, 0.5 / true.sum(), 0.5 / (~true).sum())
    probabilities = 1.0 / (1.0 + np.exp(-np.array([odd for odd, _ in odds])))
    bins = np.minimum(9, (10.0 * probabilities).astype(int))
    return float(np.abs(np.bincount(bins, weights * (probabilities - true))).sum())


def _shares(drives: Sequence[Sequence[Place]], configuration: Configuration) -> list[str]:
    places = [place for own in drives for place in own]
    cells = []
    for hallway in (True, False):
        own = [(log_odds(p.space, configuration.features) > 0.0) == hallway for p in places if p.hallway == hallway]
        cells += [str(len(own)), _percent(own)]
    right = [value for own in drives for value in _stretches_right(own, configuration)]
    return [*cells, str(len(right)), _percent(right)]


def _mean(values: Sequence[bool]) -> float:
    return float(np.mean(values)) if values else math.nan


def _percent(values: Sequence[bool]) -> str:
    return f"{100.0 * _mean(values):.1f} %" if values else "-"
