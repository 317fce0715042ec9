"""Synthetic hybrid maps of any number of areas: a lattice of corridors, with an area at each crossing.

All crossings are the same, so that they share a few scans.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.laser import WallIndex, cast_rays, wall_index

SPACING = 8.0
"""From crossing to crossing, m."""

OFFSETS = (-3.2, -1.6, 0.0, 1.6, 3.2)
"""Positions of keyframes along a crossing, m from its center."""

PER_AREA = 2 * len(OFFSETS)
"""Keyframes of an area, half of them along each corridor."""

FIRST_KEYFRAME = 10_000_000
"""First keyframe of area 0; smaller numbers are those of a run in the map."""

BEAMS = 61

ARC = np.diag([0.05, 0.05, math.radians(0.5)]) ** 2
"""Covariance of every arc."""

_FIELD, _RANGE, _NOISE = math.pi, 8.0, 0.01
_VIEW = 3  # crossings around one whose walls a scan there can see


class Lattice(NamedTuple):
    """A lattice of crossings 0, 1, ..., row by row from y = 0 on."""

    columns: int
    rows: int

    @property
    def areas(self) -> int:
        """Number of areas."""
        return self.columns * self.rows

    def hybrid_map(self) -> HybridMap:
        """The definite map: keyframes along both corridors of every crossing, and an arc to each of the next ones."""
        hybrid_map = HybridMap()
        places = [pose_in_crossing(offset, quarter) for quarter in range(2) for offset in OFFSETS]
        for area in range(self.areas):
            first = FIRST_KEYFRAME + PER_AREA * area
            hybrid_map.changed_areas[area] = {first + k: place.copy() for k, place in enumerate(places)}
            if (area + 1) % self.columns:
                hybrid_map.set_arc(area, area + 1, _make_arc(SPACING, 0.0), closure=False)
            if area + self.columns < self.areas:
                hybrid_map.set_arc(area, area + self.columns, _make_arc(0.0, SPACING), closure=False)
        hybrid_map.commit()
        return hybrid_map

    def poses(self) -> tuple[AreaPose, ...]:
        """Poses of the crossings, as of a closure decision."""
        at = (SPACING * np.array([area % self.columns, area // self.columns, 0.0]) for area in range(self.areas))
        return tuple(AreaPose(area, PoseGaussian(mean, ARC.copy())) for area, mean in enumerate(at))


class LatticeScans(dict[int, Scan]):
    """Scans by keyframe; those of the lattice are shared."""

    def __missing__(self, keyframe: int) -> Scan:
        quarter, offset = divmod((keyframe - FIRST_KEYFRAME) % PER_AREA, len(OFFSETS))
        return shared_scan(OFFSETS[offset], quarter)


def _make_arc(x: float, y: float) -> PoseGaussian:
    return PoseGaussian(np.array([x, y, 0.0]), ARC.copy())


def pose_in_crossing(offset: float, quarter: int) -> Float64:
    """``crossing_T_base`` (3,) at an offset along a corridor, with a heading in quarter turns."""
    return np.asarray(se2.compose([0.0, 0.0, 0.5 * math.pi * quarter], [offset, 0.0, 0.0]))


@cache
def shared_scan(offset: float, quarter: int) -> Scan:
    """The scan at one of ``OFFSETS`` along a corridor, which is the same at every crossing."""
    return scan_at(pose_in_crossing(offset, quarter), 0, quarter)


def scan_at(pose: Float64, stamp: int, seed: int, beams: int = BEAMS) -> Scan:
    """The scan at a pose (3,) in an endless lattice with a crossing at the origin."""
    angles = np.linspace(-0.5 * _FIELD, 0.5 * _FIELD, beams)
    at = pose[:2] - SPACING * np.round(pose[:2] / SPACING)
    ranges = cast_rays(_wall_index(), np.tile(at, (beams, 1)), angles + pose[2], np.inf)
    ranges = np.minimum(ranges + _NOISE * np.random.default_rng(seed).standard_normal(beams), _RANGE)
    return Scan(stamp, ranges.astype(np.float32), angles[0], angles[1] - angles[0], 0.05, _RANGE)


@cache
def _wall_index() -> WallIndex:
    """The blocks between corridors of 2 m around a crossing, each with a niche on one side."""
    corners = [(1.0, 1.0), (4.0, 1.0), (4.0, 1.4), (5.0, 1.4), (5.0, 1.0), (7.0, 1.0), (7.0, 7.0), (1.0, 7.0)]
    block = np.array([[*a, *b] for a, b in pairwise([*corners, corners[0]])])
    shifts = [SPACING * np.array([i, j, i, j]) for i in range(-_VIEW, _VIEW) for j in range(-_VIEW, _VIEW)]
    return wall_index(np.concatenate([block + shift for shift in shifts]))


class LatticeStop(NamedTuple):
    """A keyframe on a path along some crossings.

    :ivar pose: ``lattice_T_base``, shape (3,).
    :ivar scan: the shared one.
    :ivar last: whether it is the last one of its crossing.
    """

    pose: Float64
    scan: Scan
    last: bool


def make_stops(crossings: Sequence[tuple[int, int]]) -> Iterator[LatticeStop]:
    """The stops on the path from the center of the first crossing (column, row) through the next ones."""
    for (column, row), (next_column, next_row) in pairwise(crossings):
        quarter = round(math.atan2(next_row - row, next_column - column) / (0.5 * math.pi)) % 4
        for offset in OFFSETS:
            center = np.array([SPACING * next_column, SPACING * next_row, 0.0])
            yield LatticeStop(
                center + pose_in_crossing(offset, quarter), shared_scan(offset, quarter), offset == OFFSETS[-1]
            )
