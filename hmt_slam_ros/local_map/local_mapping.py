"""What all filters of a process share: the pool of patches, the models of the laser, how a scan enters a map."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.local_map import matching
from hmt_slam_ros.local_map.insertion import InverseModel
from hmt_slam_ros.local_map.match_error import MatchNoise
from hmt_slam_ros.local_map.patch_pool import Beams, PatchPool
from hmt_slam_ros.local_map.patches import FAR, PATCH
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.sensing.surfels import surfels

_ODDS_PER_NAT = 20.0


class LocalMapping:
    """What all filters of a process share: the pool of patches, the beam model, the settings."""

    def __init__(self, configuration: Configuration) -> None:
        self.configuration = configuration
        local_map, match = configuration.local_map, configuration.matching
        patch = PATCH * local_map.cell
        self.pool = PatchPool(2 * math.ceil(local_map.extent / patch), local_map.cell, local_map.field_radius)
        self.model = matching.beam_model(
            local_map.field_radius, match.sigma_hit, match.unknown_range, match.random_returns
        )
        self.alignment = matching.Alignment(
            match.sigma_match, match.robust_scale, configuration.filter.covariance_inflation, match.iterations
        )
        self.noise = MatchNoise(match.beam_noise, match.block_noise, match.map_age)
        self._inverse_model = InverseModel(
            round(local_map.log_odds_hit * _ODDS_PER_NAT),
            round(-local_map.log_odds_miss * _ODDS_PER_NAT),
            round(local_map.log_odds_limit * _ODDS_PER_NAT),
        )
        self.near = int(match.matched_distance / local_map.field_radius * FAR)

    def matching_points(self, scan: Scan) -> Float64:
        """The surfels that are matched: within the map's range, evenly thinned; shape (n, 4), base frame."""
        beams = self.mapped_beams(scan)
        count = len(beams.points)
        stride = -(-count // self.configuration.matching.max_points)
        return surfels(beams.points, beams.origins[:count], max(1, stride))

    def mapped_beams(self, scan: Scan) -> Beams:
        """The part of a scan within the map's range."""
        limit = self.configuration.local_map.max_range
        points, origins = scan.points, scan.origins
        beams = points - origins
        distance = np.hypot(beams[:, 0], beams[:, 1])
        near = distance <= limit
        if near.all():
            return Beams(points, np.zeros((0, 2)), origins)
        beyond = origins[~near] + beams[~near] * (limit / distance[~near, None])
        return Beams(points[near], beyond, np.concatenate((origins[near], origins[~near])))

    def insert(self, tables: Int32, poses: Float64, scan: Scan) -> None:
        """Enter a scan into maps (m, T, T), into each at its own ``map_T_base`` (m, 3)."""
        self.pool.insert(tables, poses, self.mapped_beams(scan), self._inverse_model)
