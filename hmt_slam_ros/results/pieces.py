"""The pieces of a map as they are drawn: one whose place in the map is unknown stands beside it, in its own frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.occupancy_map import OccupancyImage, occupancy_image, read_map
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import map_pieces, shortest_path_beliefs
from hmt_slam_ros.results.hmt_map import SavedMap
from hmt_slam_ros.results.trajectories import Trajectory

_MARGIN = 0.5
"""Space around keyframes at the border, m."""


@dataclass(frozen=True, eq=False)
class MapPiece:
    """A piece of a map, in the map frame or, where its place in that is unknown, in the frame of its first area.

    :ivar image: occupancy grid of its keyframes.
    :ivar area_poses: {area: belief over ``frame_T_area``}.
    :ivar keyframes: {area: positions of its keyframes, shape (n, 2)}.
    :ivar path: shape (n, 2), positions of the scans, NaN for those in other pieces.
    """

    image: OccupancyImage
    area_poses: Mapping[int, PoseGaussian]
    keyframes: Mapping[int, NDArray[np.float64]]
    path: NDArray[np.float64]

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """Lower left and upper right corner of the grid and the keyframes, shape (2, 2), m."""
        positions = np.concatenate(list(self.keyframes.values()))
        low, high = image_corners(self.image)
        low = np.minimum(low, positions.min(axis=0) - _MARGIN)
        return np.stack([low, np.maximum(high, positions.max(axis=0) + _MARGIN)])


def image_corners(image: OccupancyImage) -> NDArray[np.float64]:
    """Lower left and upper right corner of a grid, shape (2, 2), m."""
    height, width = image.pixels.shape
    return np.stack([image.origin, image.origin + np.array([width, height]) * image.resolution])


def split_map(directory: Path, saved: SavedMap, trajectory: Trajectory) -> list[MapPiece]:
    """The pieces of the most probable map of an output folder; the one in the map frame comes first.

    :param trajectory: shape (n, 3), ``map_T_base`` of the scans of the newest log.
    :raises HmtSlamError: where map.pgm, the grid of a map in one piece, is missing or damaged.
    """
    hybrid_map = saved.replica.maps[saved.replica.best_hypothesis]
    main, *others = map_pieces(hybrid_map)
    image = None if others else read_map(directory)
    pieces = [_cut_piece(saved, {area: saved.area_poses[area] for area in main}, trajectory, image)]
    return pieces + [_cut_piece(saved, _beliefs_within(hybrid_map, areas, saved), trajectory, None) for areas in others]


def _beliefs_within(hybrid_map: HybridMap, areas: list[int], saved: SavedMap) -> dict[int, PoseGaussian]:
    """Beliefs over areas in the frame of their first: the poses of the map, with covariances along the arcs."""
    frame, beliefs = saved.area_poses[areas[0]].mean, shortest_path_beliefs(hybrid_map, areas[0])
    return {
        area: PoseGaussian(se2.between(frame, saved.area_poses[area].mean), beliefs[area].covariance) for area in areas
    }


def _cut_piece(
    saved: SavedMap, area_poses: Mapping[int, PoseGaussian], trajectory: Trajectory, image: OccupancyImage | None
) -> MapPiece:
    """The piece with given areas.

    :param area_poses: {area: belief over ``frame_T_area``}.
    :param image: its grid, which is made where it is None.
    """
    hybrid_map = saved.replica.maps[saved.replica.best_hypothesis]
    keyframes = {
        area: {keyframe: se2.compose(belief.mean, pose) for keyframe, pose in hybrid_map.keyframes(area).items()}
        for area, belief in area_poses.items()
    }
    poses = {keyframe: pose for within in keyframes.values() for keyframe, pose in within.items()}
    if image is None:
        scans, settings = [saved.replica.scans[keyframe] for keyframe in poses], saved.configuration.local_map
        image = occupancy_image(scans, np.array(list(poses.values())), settings.cell, settings.max_range)
    first = min(area_poses)
    path = se2.compose(area_poses[first].mean, se2.between(saved.area_poses[first].mean, trajectory))[:, :2]
    scan_areas = saved.relative_trajectory.areas(hybrid_map)[-len(trajectory) :]
    path[~np.isin(scan_areas, list(area_poses))] = np.nan
    positions = {area: np.array(list(within.values())).reshape(-1, 3)[:, :2] for area, within in keyframes.items()}
    return MapPiece(image, area_poses, positions, path)
