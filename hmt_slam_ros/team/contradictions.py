"""Contradictions between a window and the places of another component where a placement has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.surroundings import (
    AreaPlace,
    GridCache,
    containing_area,
    keyframe_positions,
    min_distance,
    stack_poses,
)
from hmt_slam_ros.registration.area_to_area import MatchSettings, best_pose
from hmt_slam_ros.registration.consistency import MAP_IN_MAP, Agreement
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.team.components import ComponentPair
from hmt_slam_ros.team.placement import PlacementGeometry
from hmt_slam_ros.team.windows import GROUND_RADIUS, Window
from hmt_slam_ros.topological_inference.place_recognition import MIN_LOG_RATIO

_MAX_SIGMA = 2.0
"""Largest deviation of a window that is compared, m: farther away it may be anywhere."""

_MAX_DRIFT = 10.0
"""By how much arcs of the first component may disagree on where a place is, m."""

_MATCH_COVARIANCE = np.diag([0.25, 0.25, np.radians(4.0)]) ** 2
"""Covariance within which a window is matched where its arcs are certain, m and rad, squared."""


_WINDOW_WORK = 2_500_000
"""Work of a window that is compared with a place, about 4 ms."""


class PlaceComparison:
    """Compares windows with what the first component saw, in both directions.

    :ivar work: of all comparisons.
    """

    def __init__(
        self,
        pair: ComponentPair,
        windows: Sequence[Window],
        geometry: PlacementGeometry,
        configuration: Configuration,
        grid_cache: GridCache,
    ) -> None:
        """:param grid_cache: of the scans of both components."""
        self._pair, self._windows, self._geometry = pair, windows, geometry
        self._grid_cache = grid_cache
        self._settings = replace(MatchSettings.from_options(configuration.tsbi), min_log_ratio=MIN_LOG_RATIO)
        self._outlier_rate = pair.clutter.beam_outlier_rate
        self.work = 0
        known = [(geometry.map_pose(area, np.zeros(3))[:2], _extent(pair, area)) for area in pair.known]
        self._centers = np.array([center for center, _ in known])
        self._extents = np.array([extent for _, extent in known])

    def log_ratio(self, window: int, area: int, belief: PoseGaussian, is_matched: bool) -> float | None:
        """Log Bayes factor of the contradictions of a window, nats, at most 0; None where it lies in no place.

        Surfaces of either side in the free space of the other contradict, at the best match within the belief: the arcs
        to the place leave some decimeters open, also of a match with a map around another area. Those of a window that
        was matched count in one direction, since the match has the other one.

        :param area: in which ``belief`` is over ``area_T_reference``.
        """
        if float(np.linalg.eigvalsh(belief.covariance[:2, :2]).max()) > _MAX_SIGMA**2:
            return None
        poses = self._windows[window].poses
        nearest, there = self._nearest_area(area, belief, poses)
        if nearest is None:
            return None
        place = self._grid_cache.place(self._pair.hybrid_map, nearest, (), self._pair.first_keyframe)
        if containing_area(place, se2.compose(there.mean, stack_poses(poses)), GROUND_RADIUS) is None:
            return None
        self.work += _WINDOW_WORK
        query = self._grid_cache.grid(poses)
        pose = self._match(query, place, there)
        against = self._log_ratio(query.compare(place.grid.points, se2.inverse(pose)))
        if not is_matched:
            against += self._log_ratio(place.grid.compare(query.points, pose))
        return min(0.0, against)

    def _nearest_area(
        self, area: int, belief: PoseGaussian, poses: Mapping[int, Float64]
    ) -> tuple[int | None, PoseGaussian]:
        """The area whose keyframes are nearest to a window, None beyond the radius of a place, and the belief in it."""
        positions = se2.compose(belief.mean, stack_poses(poses))[:, :2]
        distances = {
            other: min_distance(
                positions,
                keyframe_positions(self._pair.hybrid_map, other, self._geometry.paths(area)[other].mean),
            )
            for other in self._areas_around(area, belief, positions)
        }
        nearest = min(distances, key=lambda other: (distances[other], other), default=None)
        if nearest is None or distances[nearest] > GROUND_RADIUS:
            return None, belief
        return nearest, self._geometry.paths(nearest)[area].compose(belief)

    def _areas_around(self, area: int, belief: PoseGaussian, positions: Float64) -> list[int]:
        """The areas of the first component that may have a keyframe near some positions in an area, shape (n, 2)."""
        extent = float(np.hypot(*(positions - belief.mean[:2]).T).max())
        center = self._geometry.map_pose(area, belief.mean)[:2]
        distances = np.hypot(*(self._centers - center).T)
        near = distances <= self._extents + extent + GROUND_RADIUS + _MAX_DRIFT
        return [self._pair.known[n] for n in np.flatnonzero(near)]

    def _match(self, query: AreaGrid, place: AreaPlace, belief: PoseGaussian) -> Float64:
        """The best pose of a window within a belief; its mean where nothing fits."""
        prior = PoseGaussian(belief.mean, belief.covariance + _MATCH_COVARIANCE)
        found, _ = best_pose(query, place.grid, prior, self._settings)
        return belief.mean if found is None else found[0]

    def _log_ratio(self, found: Agreement) -> float:
        return MAP_IN_MAP.log_likelihood_ratio(found, self._outlier_rate)


def _extent(pair: ComponentPair, area: int) -> float:
    """Largest distance of a keyframe from the origin of its area, m."""
    return float(np.hypot(*keyframe_positions(pair.hybrid_map, area).T).max())
