"""The landmarks of areas against the true ones, in a building in which furniture is moved and doors are closed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.landmark_scans import LASERS, POSES
from benchmark.landmark_truth import REACH, World, alike
from benchmark.landmarkmap_truth import TURN, WITHIN, TrueLandmarks, Visit, matching, truth_of
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from benchmark.simulated.worlds import World as Drive
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.configuration.landmarks import Features
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark
from hmt_slam_ros.landmarks.area_landmarks import AreaLandmarks
from hmt_slam_ros.landmarks.landmark_map import LandmarkMap
from hmt_slam_ros.landmarks.landmarks import OPENING
from hmt_slam_ros.submap.local_mapping import LocalMapping

Array = NDArray[np.float64]

SEEDS = 3
"""Worlds of every family."""

FAMILIES = ("office",)

_AREA = 30  # keyframes of an area
_TRUTH = 3  # one of so many is asked what has to be found from there
_SURE = 0.5

# What is asked of either laser.
_FOUND, _FALSE, _NEES, _CALIBRATED, _KEPT, _GONE = 0.8, 0.03, 3.6, 0.05, 0.95, 0.1

POLICY = (
    f"The first round of a drive in an office, {_AREA} keyframes after each other being an area, at true poses with "
    "deviations of 1 cm and 0.2 degrees; then the first round of the next visit, before which all furniture was moved "
    "and all doors off the way were closed, its keyframes being of the area that is nearest. Landmarks are judged "
    "after the first visit, as those of single scans (`landmarks`), by what is true around any of its keyframes. Had "
    "to be found: what had to be in two of every third keyframe's scans of a laser that sees all around. There and "
    "gone: landmarks that were true and believed in after the first visit, the place of which is in sight within "
    f"{REACH:g} m from two of every third keyframe of the second one; kept is one where a landmark is believed in "
    f"after that, from {_SURE:g} on."
)


@dataclass(frozen=True)
class Literal(Existence):
    """Eqs. (4) and (5) as they stand: a mean over all visits."""

    def after_sight(self, confidence: float, features: Features) -> Existence:  # noqa: ARG002
        """Eq. (4)."""
        return replace(self, confidence=self._mean(confidence), seen=self.seen + 1)

    def after_miss(self, features: Features) -> Existence:  # noqa: ARG002
        """Eq. (5)."""
        return replace(self, confidence=self._mean(1.0 - self.confidence), missed=self.missed + 1)

    def _mean(self, said: float) -> float:
        return self.confidence + (said - self.confidence) / (self.seen + self.missed + 1)


_KEPT_ONE = "Bayes for what was missed"

TREATMENTS: dict[str, tuple[Callable[[float], Existence], float | None]] = {
    _KEPT_ONE: (Existence, None),
    "Eqs. (4) and (5), deleted below 0.6": (Literal, 0.6),
}
"""{name: how existence is judged, and below which a landmark is deleted where that is no parameter}."""


class Judged(NamedTuple):
    """A landmark of a map.

    :ivar kind: of it.
    :ivar probability: of its existence.
    :ivar is_true: whether there is one.
    :ivar nees: of its pose, NaN where there is none.
    :ivar error: of its position, m, likewise.
    :ivar again: whether another landmark of the map is of the same true one, and more probable.
    """

    kind: int
    probability: float
    is_true: bool
    nees: float
    error: float
    again: bool


class Area(NamedTuple):
    """What came of an area under one treatment.

    :ivar judged: its landmarks after the first visit.
    :ivar due: true landmarks that had to be found, and how many were.
    :ivar kept: of those found and still there, in sight at the second visit, whether they stayed.
    :ivar gone: of those found and not there any more, whether they stayed.
    """

    judged: list[Judged]
    due: tuple[int, int]
    kept: list[bool]
    gone: list[bool]


def measure_landmarkmaps(settings: Settings) -> Report:
    """Gather the landmarks of areas in simulated buildings, at two visits, and compare them with the true ones."""
    chosen, seeds = chosen_families(settings, FAMILIES), chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    found: dict[tuple[str, str], list[Area]] = {}
    for laser in LASERS:
        for drive in (Drive(family, seed) for family in chosen for seed in seeds):
            for name, area in areas_of(drive, laser, configuration):
                found.setdefault((laser, name), []).append(area)
    report = Report("landmarkmaps", "Landmarks of areas", seeds=seeds)
    for laser in LASERS:
        report.requirements += _requirements(laser, found[laser, _KEPT_ONE])
    head = ["laser", "existence", "landmarks", "of them twice", f"from {_SURE:g}", "of them true", "had to be found"]
    head += ["were", "error, median [cm]", "NEES, mean", "calibration error", "still there", "kept", "gone", "kept"]
    report.body += [table(head, [_row(*names, areas) for names, areas in found.items()]), POLICY]
    return report


def areas_of(drive: Drive, laser: str, configuration: Configuration) -> Iterator[tuple[str, Area]]:
    """The areas of a drive under every treatment."""
    visits = [Visit(drive, laser, visit, configuration) for visit in (0, 1)]
    noise = visits[0].scenario.settings.range_noise
    configuration = replace(configuration, features=replace(configuration.features, range_deviation=noise))
    nearest = np.hypot(*(visits[1].poses[:, None, :2] - visits[0].poses[None, :, :2]).transpose(2, 0, 1)).argmin(axis=1)
    for number in range(len(visits[0].poses) // _AREA):
        first = list(range(number * _AREA, (number + 1) * _AREA))
        then = np.flatnonzero(nearest // _AREA == number).tolist()
        yield from _area(visits, (first, then), configuration, [drive.seed, number])


def _area(
    visits: Sequence[Visit], keyframes: Sequence[list[int]], configuration: Configuration, seed: list[int]
) -> Iterator[tuple[str, Area]]:
    features, draw = configuration.features, np.random.default_rng(seed)
    frame = visits[0].poses[keyframes[0][0]]
    poses = [se2.between(frame, visit.poses[own]) for visit, own in zip(visits, keyframes, strict=True)]
    truths = [truth_of(visit, own, _TRUTH, frame, features) for visit, own in zip(visits, keyframes, strict=True)]
    placed = np.concatenate(poses)
    placed = se2.compose(placed, POSES * draw.standard_normal(placed.shape))
    numbers = [visit.numbers[k] for visit, own in zip(visits, keyframes, strict=True) for k in own]
    scenarios = [visit.scenario for visit, own in zip(visits, keyframes, strict=True) for _ in own]
    scans = (scenario.scan(number) for scenario, number in zip(scenarios, numbers, strict=True))
    maps = {
        name: LandmarkMap(features if least is None else replace(features, landmark_least=least), begin)
        for name, (begin, least) in TREATMENTS.items()
    }
    before: dict[str, list[Landmark]] = {}
    for k, sighting in enumerate(AreaLandmarks(LocalMapping(configuration)).sightings(scans, placed)):
        if k == len(keyframes[0]):
            before = {name: list(found.landmarks) for name, found in maps.items()}
        for found in maps.values():
            sighting.add_to(found)
    worlds = [(visits[1].world(k), visits[1].poses[k]) for k in keyframes[1][::_TRUTH]]
    for name, found in maps.items():
        own = before.get(name, found.landmarks)
        judged = _judged(own, truths[0])
        due = truths[0].due > 1
        met = [_is_one(own, truths[0], k) for k in np.flatnonzero(due).tolist()]
        stay: dict[bool, list[bool]] = {True: [], False: []}
        for landmark in own:
            if landmark.existence.probability >= _SURE and matching(landmark, truths[0]).any():
                point = se2.transform(frame, se2.transform(landmark.pose.mean, _before(landmark))[None])[0]
                if sum(_shows(world, pose, point) for world, pose in worlds) > 1:
                    there = bool(matching(landmark, truths[1]).any())
                    stay[there].append(any(_same(landmark, other) for other in found.landmarks))
        yield name, Area(judged, (int(due.sum()), sum(met)), stay[True], stay[False])


def _before(landmark: Landmark) -> Array:
    """A point on the free side of a landmark, in its frame, m."""
    return np.array([-0.15 if landmark.kind == OPENING else 0.15, 0.0])


def _shows(world: World, pose: Array, point: Array) -> bool:
    """Whether a point is in sight and within reach."""
    local = se2.transform(se2.inverse(pose), point[None])
    return bool(np.hypot(*local[0]) <= REACH and world.sees(local)[0])


def _same(one: Landmark, other: Landmark) -> bool:
    """Whether two landmarks are of the same thing, and the other is believed in."""
    near = alike(one.pose.mean[None], other.pose.mean, WITHIN[one.kind == OPENING], TURN)[0]
    return bool(near and one.kind == other.kind and other.existence.probability >= _SURE)


def _is_one(landmarks: Sequence[Landmark], truth: TrueLandmarks, k: int) -> bool:
    """Whether a true landmark is in a map."""
    return any(matching(one, truth)[k] for one in landmarks if one.existence.probability >= _SURE)


def _judged(landmarks: Sequence[Landmark], truth: TrueLandmarks) -> list[Judged]:
    taken: set[int] = set()
    judged = []
    for landmark in sorted(landmarks, key=lambda one: -one.existence.probability):
        there = matching(landmark, truth)
        probability = landmark.existence.probability
        if not there.any():
            judged.append(Judged(landmark.kind, probability, False, math.nan, math.nan, False))
            continue
        away = np.where(there, np.hypot(*(truth.poses[:, :2] - landmark.pose.mean[:2]).T), np.inf)
        k = int(np.argmin(away))
        error = se2.log(se2.between(landmark.pose.mean, truth.poses[k]))
        nees = float(error @ np.linalg.solve(landmark.pose.covariance, error))
        judged.append(Judged(landmark.kind, probability, True, nees, float(away[k]), k in taken))
        taken.add(k)
    return judged


def _requirements(laser: str, areas: Sequence[Area]) -> list[Requirement]:
    judged = [one for area in areas for one in area.judged]
    sure = [one for one in judged if one.probability >= _SURE]
    name = laser.partition(",")[0]
    return [
        Requirement(f"{name}: found", _found(areas), 1.0, least=_FOUND),
        Requirement(f"{name}: false, of those of {_SURE:g} and more", 1.0 - _mean([o.is_true for o in sure]), _FALSE),
        Requirement(f"{name}: NEES, mean", _mean([o.nees for o in sure if o.is_true]), _NEES),
        Requirement(f"{name}: expected calibration error", _calibration_error(judged), _CALIBRATED),
        Requirement(f"{name}: kept of what is there", _mean([k for a in areas for k in a.kept]), 1.0, least=_KEPT),
        Requirement(f"{name}: kept of what is gone", _mean([k for a in areas for k in a.gone]), _GONE),
    ]


def _found(areas: Sequence[Area]) -> float:
    return sum(area.due[1] for area in areas) / max(1, sum(area.due[0] for area in areas))


def _calibration_error(judged: Sequence[Judged]) -> float:
    """Over ten bins of equal width."""
    bins: dict[int, float] = {}
    for one in judged:
        number = min(9, int(10.0 * one.probability))
        bins[number] = bins.get(number, 0.0) + one.probability - one.is_true
    return sum(map(abs, bins.values())) / max(1, len(judged))


def _row(laser: str, treatment: str, areas: Sequence[Area]) -> list[str]:
    judged = [one for area in areas for one in area.judged]
    sure = [one for one in judged if one.probability >= _SURE]
    true = [one for one in sure if one.is_true]
    kept, gone = [k for area in areas for k in area.kept], [k for area in areas for k in area.gone]
    return [
        laser,
        treatment,
        str(len(judged)),
        _percent([one.again for one in true]),
        str(len(sure)),
        _percent([one.is_true for one in sure]),
        str(sum(area.due[0] for area in areas)),
        f"{100.0 * _found(areas):.1f} %",
        f"{100.0 * float(np.median([one.error for one in true])):.1f}",
        f"{_mean([one.nees for one in true]):.2f}",
        f"{_calibration_error(judged):.3f}",
        str(len(kept)),
        _percent(kept),
        str(len(gone)),
        _percent(gone),
    ]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _percent(values: Sequence[bool]) -> str:
    return f"{100.0 * _mean(values):.1f} %" if values else "-"
