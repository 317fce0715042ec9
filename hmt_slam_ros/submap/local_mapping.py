"""The parts that all filters of a process share: the pool of patches, and models of the laser."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.grids.patch_pool import InverseSensorModel, MappedBeams, PatchPool
from hmt_slam_ros.grids.patches import FAR, PATCH
from hmt_slam_ros.registration import scan_to_map
from hmt_slam_ros.registration.match_covariance import MatchNoise
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.scan import extract_surfels

_ODDS_PER_NAT = 20.0
"""Quanta of the odds in a nat."""

_MIN_SURFEL_SHARE = 0.05
"""Smallest share of the beams that end on surfaces in a keyframe (docs/decisions/0064-scans-that-show-nothing.md)."""

T = TypeVar("T")


class LocalMapping:
    """The pool of patches, the models of the laser and the settings that all filters of a process share."""

    def __init__(self, configuration: Configuration) -> None:
        self.configuration = configuration
        local_map, match = configuration.local_map, configuration.matching
        patch = PATCH * local_map.cell
        self.pool = PatchPool(2 * math.ceil(local_map.extent / patch), local_map.cell, local_map.field_radius)
        self.beam_model = scan_to_map.make_beam_model(
            local_map.field_radius, match.sigma_hit, match.unknown_range, match.random_returns
        )
        self.alignment = scan_to_map.AlignmentSettings(
            match.sigma_match, match.robust_scale, configuration.filter.covariance_inflation, match.iterations
        )
        self.match_noise = MatchNoise(match.beam_noise, match.block_noise, match.map_age)
        self._inverse_sensor_model = InverseSensorModel(
            round(local_map.log_odds_hit * _ODDS_PER_NAT),
            round(-local_map.log_odds_miss * _ODDS_PER_NAT),
            round(local_map.log_odds_limit * _ODDS_PER_NAT),
        )
        self.hit_distance = int(match.matched_distance / local_map.field_radius * FAR)

    def matching_surfels(self, scan: Scan) -> Float64:
        """Surfels for matching: within the map's range, evenly thinned; shape (n, 4), base frame."""
        beams = self.mapped_beams(scan)
        count = len(beams.hits)
        stride = -(-count // self.configuration.matching.max_points)
        return extract_surfels(beams.hits, beams.origins[:count], max(1, stride))

    def mapped_beams(self, scan: Scan) -> MappedBeams:
        """The beams of a scan within the map's range."""
        return MappedBeams(*_split_at_range(scan.points, scan.origins, self.configuration.local_map.max_range))

    def insert_scan(self, tables: Int32, poses: Float64, scan: Scan) -> None:
        """Insert a scan into maps (m, T, T), each at its own ``map_T_base`` (m, 3)."""
        self.pool.insert(tables, poses, self.mapped_beams(scan), self._inverse_sensor_model)


@njit(cache=True)
def _split_at_range(points: Float64, origins: Float64, limit: float) -> tuple[Float64, Float64, Float64]:
    """Points (n, 2) within a limit of their origins (n, 2), the others cut off at the limit, and their origins."""
    distance = np.hypot(points[:, 0] - origins[:, 0], points[:, 1] - origins[:, 1])
    near = (distance <= limit).sum()
    within, beyond, ordered = np.empty((near, 2)), np.empty((len(points) - near, 2)), np.empty((len(points), 2))
    i = j = 0
    for n in range(len(points)):
        if distance[n] <= limit:
            within[i, 0], within[i, 1] = points[n, 0], points[n, 1]
            ordered[i, 0], ordered[i, 1] = origins[n, 0], origins[n, 1]
            i += 1
        else:
            share, x, y = limit / distance[n], origins[n, 0], origins[n, 1]
            beyond[j, 0], beyond[j, 1] = x + (points[n, 0] - x) * share, y + (points[n, 1] - y) * share
            ordered[near + j, 0], ordered[near + j, 1] = x, y
            j += 1
    return within, beyond, ordered


class PreparedScan:
    """A scan with values derived from it, computed once for all filters and only on demand.

    :ivar scan: the scan.
    """

    def __init__(self, mapping: LocalMapping, scan: Scan) -> None:
        self.scan = scan
        self._mapping = mapping
        self._derived: dict[Callable[[Scan, Configuration], Any], Any] = {}

    @cached_property
    def surfels(self) -> Float64:
        """Surfels for matching with a grid, shape (n, 4), base frame."""
        return self._mapping.matching_surfels(self.scan)

    @property
    def is_blind(self) -> bool:
        """Whether the scan shows too few surfaces to be a keyframe."""
        beams = min(self.scan.ranges.size, self._mapping.configuration.matching.max_points)
        return len(self.surfels) < _MIN_SURFEL_SHARE * beams

    def derive(self, make: Callable[[Scan, Configuration], T]) -> T:
        """The value that a function derives from the scan."""
        if make not in self._derived:
            self._derived[make] = make(self.scan, self._mapping.configuration)
        value: T = self._derived[make]
        return value

    @property
    def laser_position(self) -> Float64:
        """Position of the laser, shape (2,), base frame."""
        return self.scan.laser_pose[:2]
