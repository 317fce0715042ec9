"""Hallway or room: classification of the free space around the robot, or of an area.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.1: thin and long spaces are hallways, others are rooms. A chord is
the free distance ahead and back along an axis. The width of a space is its shortest chord. Its length is a high
quantile of the chords, as a few of them pass through doors. The log-odds of a hallway are linear in the logarithms of
both. For an area they are averaged over its keyframes, with hysteresis.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.grids.virtual_scan import cast_virtual_scan
from hmt_slam_ros.landmarks.rays import Rays, rays_from_virtual_scan
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_mapping import LocalMapping

_SECTORS = 72
"""Sectors of the circle, an even number. The median beam of each counts, so that no single one decides."""

_MIN_CHORDS = 18
"""Known chords of a space, at least."""

_MAX_DISTANCE = 10.0
"""Largest free distance of a sector, m, so that lengths do not depend on the laser's reach."""

_LENGTH_QUANTILE = 0.925
"""Quantile of the chords that is the length of a space."""

_BEAMS, _REACH = 360, 10.0
"""Beams of the virtual scans, and their reach, m."""

UNKNOWN_DISTANCES = np.full(_SECTORS, np.nan)
"""Free distances of the sectors before the first scan, m, shape (72,)."""


class FreeSpace(NamedTuple):
    """Width and length of the free space around a position.

    :ivar width: shortest chord, m.
    :ivar length: a high quantile of the chords, m.
    """

    width: float
    length: float


class AreaClass(NamedTuple):
    """Class of an area.

    :ivar probability: of a hallway.
    :ivar is_hallway: the class after hysteresis.
    """

    probability: float
    is_hallway: bool


def measure_free_space(rays: Rays) -> FreeSpace | None:
    """The free space around one scan; None where less than half of its axes are known.

    :param rays: of a real or virtual scan all around.
    """
    return space_from_distances(distances_around(rays))


def distances_around(rays: Rays) -> Float64:
    """Free distance of each sector of the circle, from -pi on, m, shape (72,); nan without a beam."""
    bearings = np.arctan2(rays.directions[:, 1], rays.directions[:, 0])
    sectors = sector_indices(bearings)
    order = np.lexsort((rays.free_range, sectors))
    bounds = np.searchsorted(sectors[order], np.arange(_SECTORS + 1))
    known = np.flatnonzero(np.diff(bounds))
    # Both middle beams of each sector, which are the same one for an odd number.
    total = bounds[known] + bounds[known + 1]
    middle = rays.free_range[order[np.stack(((total - 1) // 2, total // 2))]]
    distances = np.full(_SECTORS, np.nan)
    distances[known] = np.minimum(_MAX_DISTANCE, middle.mean(axis=0))
    return distances


def sector_indices(bearings: Float64) -> Int64:
    """The sectors of bearings of any shape, rad."""
    return np.floor((bearings + math.pi) / (2.0 * math.pi) * _SECTORS).astype(np.int64) % _SECTORS


def space_from_distances(distances: Float64) -> FreeSpace | None:
    """The free space of sector distances as of `distances_around`; None where too few chords are known."""
    half = _SECTORS // 2
    chords = distances[:half] + distances[half:]
    chords = chords[np.isfinite(chords)]
    if chords.size < _MIN_CHORDS:
        return None
    return FreeSpace(float(chords.min()), float(np.quantile(chords, _LENGTH_QUANTILE)))


def hallway_log_odds(space: FreeSpace, features: FeatureParameters) -> float:
    """Log-odds of a space being a hallway, nats."""
    width, ratio = math.log(max(space.width, 1e-3)), math.log(max(space.length / max(space.width, 1e-3), 1e-3))
    return features.hallway_bias + features.hallway_width * width + features.hallway_ratio * ratio


def min_hallway_length(width: float, features: FeatureParameters) -> float:
    """Length from which on a space of a width is a hallway, m; inf where no length makes one."""
    if features.hallway_ratio <= 0.0:
        return math.inf
    logarithm = math.log(max(width, 1e-3))
    return math.exp(logarithm - (features.hallway_bias + features.hallway_width * logarithm) / features.hallway_ratio)


def classify_area(spaces: Iterable[FreeSpace], features: FeatureParameters) -> AreaClass:
    """The class of an area by the spaces around its keyframes, in the order of time.

    :raises ValueError: for no space.
    """
    total, count, is_hallway, probability = 0.0, 0, None, 0.5
    for space in spaces:
        total, count = total + hallway_log_odds(space, features), count + 1
        probability = 1.0 / (1.0 + math.exp(-max(-50.0, min(50.0, total / count))))
        is_hallway = decide_hallway(is_hallway, probability, features)
    if is_hallway is None:
        raise ValueError("an area has no keyframe with enough known free space around it to classify it")
    return AreaClass(probability, is_hallway)


def decide_hallway(was_hallway: bool | None, probability: float, features: FeatureParameters) -> bool:
    """Whether the class is hallway, with hysteresis.

    :param was_hallway: the class before; None for the first one.
    :param probability: of a hallway now.
    """
    bound = 0.5 if was_hallway is None else 1.0 - features.hallway_sure if was_hallway else features.hallway_sure
    return probability >= bound


class AreaClassifier:
    """Classifies areas by virtual scans in the grid of their keyframes."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping, self._features = mapping, mapping.configuration.features

    def classify(self, scans: Iterable[Scan], poses: Float64) -> AreaClass | None:
        """The class of an area; None where too little is known around its keyframes.

        :param scans: of its keyframes, in the order of time.
        :param poses: shape (n, 3), their ``area_T_base``, m and rad.
        """
        table = self._mapping.pool.empty_table()
        for scan, pose in zip(scans, poses, strict=True):
            self._mapping.insert_scan(table[None], np.ascontiguousarray(pose[None]), scan)
        view = self._mapping.pool.view(table)
        scans_around = (cast_virtual_scan(view, pose, _BEAMS, _REACH) for pose in poses)
        measured = (measure_free_space(rays_from_virtual_scan(each, self._features)) for each in scans_around)
        spaces = [space for space in measured if space is not None]
        self._mapping.pool.release(table)
        return classify_area(spaces, self._features) if spaces else None
