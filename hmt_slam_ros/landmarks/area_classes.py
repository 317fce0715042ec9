"""Hallway or room: how long and how wide the free space around the robot, or of a stored area, is.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.1: thin and long open spaces are hallways, others are rooms. A chord
is how far one sees ahead and back along an axis; a space is as wide as its shortest chord, and as long as all chords
but the longest few: through a door one sees far out of a room, too, but only along the axes that pass the door. The
log-odds of a hallway are linear in the logarithms of both. An area is what its keyframes say on average, one after the
other, and what it is taken for changes only where that is clear (hysteresis).
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

# Sectors of the circle, an even number, in each of which the median beam counts, so that no single beam decides; and
# how many axes have to be known.
_SECTORS, _MIN_CHORDS = 72, 18
UNKNOWN_DISTANCES = np.full(_SECTORS, np.nan)
"""How far one sees in every sector before the first scan."""

# Nobody sees farther along a hallway than this, m; so a length does not depend on the laser's reach.
_MAX_DISTANCE = 10.0
# Share of the axes along which a space is no longer than its length.
_LENGTH_QUANTILE = 0.925


class FreeSpace(NamedTuple):
    """The open space around a place.

    :ivar width: shortest chord, m.
    :ivar length: no more than a few of the chords are longer, m.
    """

    width: float
    length: float


class AreaClass(NamedTuple):
    """What an area is.

    :ivar probability: that it is a hallway.
    :ivar is_hallway: what it is taken for.
    """

    probability: float
    is_hallway: bool


def measure_free_space(rays: Rays) -> FreeSpace | None:
    """The open space that beams from one place show; None where they show less than half of its axes.

    :param rays: of a scan all around, real or virtual.
    """
    return space_from_distances(distances_around(rays))


def distances_around(rays: Rays) -> Float64:
    """How far one sees in every sector of the circle from -pi on, m, shape (72,); nan where no beam tells."""
    bearings = np.arctan2(rays.directions[:, 1], rays.directions[:, 0])
    sectors = sector_indices(bearings)
    order = np.lexsort((rays.free_range, sectors))
    bounds = np.searchsorted(sectors[order], np.arange(_SECTORS + 1))
    told = np.flatnonzero(np.diff(bounds))
    # The two in the middle of each sector, which are one where their number is odd.
    total = bounds[told] + bounds[told + 1]
    middle = rays.free_range[order[np.stack(((total - 1) // 2, total // 2))]]
    away = np.full(_SECTORS, np.nan)
    away[told] = np.minimum(_MAX_DISTANCE, middle.mean(axis=0))
    return away


def sector_indices(bearings: Float64) -> Int64:
    """The sectors that bearings of any shape, rad, lie in."""
    return np.floor((bearings + math.pi) / (2.0 * math.pi) * _SECTORS).astype(np.int64) % _SECTORS


def space_from_distances(away: Float64) -> FreeSpace | None:
    """The open space by how far one sees around, as `distances_around` has it."""
    half = _SECTORS // 2
    chords = away[:half] + away[half:]
    chords = chords[np.isfinite(chords)]
    if chords.size < _MIN_CHORDS:
        return None
    return FreeSpace(float(chords.min()), float(np.quantile(chords, _LENGTH_QUANTILE)))


def hallway_log_odds(space: FreeSpace, features: FeatureParameters) -> float:
    """Log-odds of a space being a hallway, nats."""
    width, ratio = math.log(max(space.width, 1e-3)), math.log(max(space.length / max(space.width, 1e-3), 1e-3))
    return features.hallway_bias + features.hallway_width * width + features.hallway_ratio * ratio


def min_hallway_length(width: float, features: FeatureParameters) -> float:
    """From which length on a space of a width is a hallway rather than a room, m; inf where length tells of none."""
    if features.hallway_ratio <= 0.0:
        return math.inf
    logarithm = math.log(max(width, 1e-3))
    return math.exp(logarithm - (features.hallway_bias + features.hallway_width * logarithm) / features.hallway_ratio)


def classify_area(spaces: Iterable[FreeSpace], features: FeatureParameters) -> AreaClass:
    """What an area is by the spaces around its keyframes, in the order in which they were taken.

    :raises ValueError: where there is none.
    """
    total, count, taken, probability = 0.0, 0, None, 0.5
    for space in spaces:
        total, count = total + hallway_log_odds(space, features), count + 1
        probability = 1.0 / (1.0 + math.exp(-max(-50.0, min(50.0, total / count))))
        taken = decide_hallway(taken, probability, features)
    if taken is None:
        raise ValueError("an area has no keyframe around which enough is known to tell a hallway from a room")
    return AreaClass(probability, taken)


def decide_hallway(was_hallway: bool | None, probability: float, features: FeatureParameters) -> bool:
    """What is taken for a hallway at its present probability and was ``was_hallway`` for one before; None for not
    yet."""
    bound = 0.5 if was_hallway is None else 1.0 - features.hallway_sure if was_hallway else features.hallway_sure
    return probability >= bound


# Beams of the virtual scans, and how far they go, m.
_BEAMS, _REACH = 360, 10.0


class AreaClassifier:
    """Tells areas apart, one after the other; what it needs to do so is made once."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping, self._features = mapping, mapping.configuration.features

    def classify(self, scans: Iterable[Scan], poses: Float64) -> AreaClass | None:
        """What an area is; None where too little is known around its keyframes.

        :param scans: of its keyframes, in the order in which they were taken.
        :param poses: shape (n, 3), their ``area_T_base``, m and rad.
        """
        table = self._mapping.pool.empty_table()
        for scan, pose in zip(scans, poses, strict=True):
            self._mapping.insert_scan(table[None], np.ascontiguousarray(pose[None]), scan)
        view = self._mapping.pool.view(table)
        virtual = (cast_virtual_scan(view, pose, _BEAMS, _REACH) for pose in poses)
        spaces = [
            space for own in virtual if (space := measure_free_space(rays_from_virtual_scan(own, self._features)))
        ]
        self._mapping.pool.release(table)
        return classify_area(spaces, self._features) if spaces else None
