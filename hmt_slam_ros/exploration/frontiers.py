"""Navigation grid around the robot: free cells, shortest paths, and frontiers (Yamauchi 1997).

A single search of scipy serves all paths of a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.occupancy_map import OCCUPIED, UNKNOWN, occupancy_image
from hmt_slam_ros.sensors import Scan

_CELL = 0.1
"""Side of a cell, m."""

KEYFRAME_RANGE = 4.0
"""Range of a keyframe's beams in the grid, m: farther on, doors are at grazing angles, and beams leave gaps."""

_MIN_FRONTIER_CELLS = 3
"""Cells of a frontier, at least."""

_FRONTIER_CLEARANCE = 0.1
"""Distance of a frontier from surfaces beyond the robot's clearance, m."""

_MIN_ROOM_SIZE = 0.5
"""Free ground of an unvisited room, at least, m^2."""

_MAX_DETOUR = 0.5
"""Largest distance between a position and the reachable cell that replaces it, m."""

_INFLATION_COST, _INFLATION_DISTANCE = 2.0, 0.4
"""Additional cost of a cell at a surface, in cells, and the distance beyond the clearance at which it is 0, m."""

_NEIGHBORS = np.ones((3, 3), dtype=np.bool_)


class GridPath(NamedTuple):
    """A shortest path from keyframes to a position.

    :ivar keyframe_row: row of the nearest keyframe.
    :ivar points: shape (n, 2), from that keyframe to the position, m, in the frame of the grid.
    """

    keyframe_row: int
    points: Float64


class NavigationGrid:
    """Occupancy grid of some keyframes, with the shortest paths from these.

    :ivar free: shape (h, w), whether the robot's middle may be in a cell.
    :ivar unknown: shape (h, w), whether a cell is unknown.
    :ivar origin: shape (2,), lower left corner, m.
    :ivar clearance: shape (h, w), from the middles of cells to surfaces, m.
    """

    def __init__(self, scans: Sequence[Scan], poses: Float64, min_clearance: float) -> None:
        """Make the grid.

        :param scans: of n keyframes.
        :param poses: shape (n, 3), theirs in the frame of the grid, m and rad.
        :param min_clearance: smallest distance of the robot's middle from surfaces, m.
        """
        image = occupancy_image(scans, poses, _CELL, KEYFRAME_RANGE)
        pixels = image.pixels[::-1]
        self.origin, self._min_clearance = image.origin, min_clearance
        # Single unknown cells between two beams are closed.
        known = ndimage.binary_closing(pixels != UNKNOWN, _NEIGHBORS)
        self.free: Bool = known
        # No laser sees the ground between it and the robot's middle.
        known |= self._cells_on_lines(_lines_to_lasers(scans, poses))
        self.unknown: Bool = ~known
        self.clearance: Float64 = _CELL * ndimage.distance_transform_edt(pixels != OCCUPIED)
        self.free = known & (pixels != OCCUPIED) & (self.clearance >= min_clearance)
        rows, columns = self.cells(poses[:, :2]).T
        passable = self.free.copy()
        passable[rows, columns] = True
        self._numbers = np.full(passable.shape, -1)
        self._keyframe_cells = rows, columns
        self._numbers[passable] = np.arange(passable.sum())
        self._passable_cells = np.argwhere(passable)
        starts, owners = np.unique(self._numbers[rows, columns], return_index=True)
        self._owners = dict(zip(starts.tolist(), owners.tolist(), strict=True))
        self._cost, self._predecessors, self._source = dijkstra(
            self._step_costs(passable), indices=starts, min_only=True, return_predecessors=True
        )

    def cells(self, points: Float64) -> Int64:
        """Rows and columns (..., 2) of points (..., 2), m; those outside are clipped."""
        found = np.floor((points - self.origin) / _CELL).astype(np.int64)[..., ::-1]
        return np.clip(found, 0, np.array(self.free.shape) - 1)

    def is_straight_path_free(self, starts: Float64, ends: Float64) -> Bool:
        """Whether the straight lines between points (n, 2) are free, shape (n,)."""
        longest = float(np.hypot(*(ends - starts).T).max(initial=0.0))
        shares = np.linspace(0.0, 1.0, 2 + int(longest / _CELL))[:, None, None]
        rows, columns = np.moveaxis(self.cells(starts + shares * (ends - starts)), -1, 0)
        return np.asarray(self.free[rows, columns].all(axis=0))

    def paths_to_frontiers(self) -> list[GridPath]:
        """The paths to all frontiers that are reachable from keyframes."""
        wide = self.clearance >= self._min_clearance + _FRONTIER_CLEARANCE
        border = wide & (self._numbers >= 0) & ndimage.binary_dilation(self.unknown, _NEIGHBORS)
        groups, count = ndimage.label(border, _NEIGHBORS)
        reachable = [self._reachable_cells(groups == group) for group in range(1, count + 1)]
        return [self._path_to_widest(cells) for cells in reachable if cells.size >= _MIN_FRONTIER_CELLS]

    def paths_to_unvisited_rooms(self, doors: Float64) -> list[GridPath]:
        """The paths to the middles of parts of the ground behind doors, without a keyframe in them.

        :param doors: shape (n, 4), x and y of both jambs of each, m.
        """
        parts, _ = ndimage.label(self.free & ~self._cells_on_lines(doors))
        parts[np.isin(parts, parts[self._keyframe_cells])] = 0
        numbers, sizes = np.unique(parts[parts > 0], return_counts=True)
        reachable = [self._reachable_cells(parts == part) for part in numbers[sizes * _CELL**2 >= _MIN_ROOM_SIZE]]
        return [self._path_to_widest(cells) for cells in reachable if cells.size]

    def _reachable_cells(self, mask: Bool) -> Int64:
        """Numbers of the cells of a mask (h, w) to which a path leads."""
        numbers = self._numbers[mask]
        return np.asarray(numbers[np.isfinite(self._cost[numbers])])

    def _cells_on_lines(self, lines: Float64) -> Bool:
        """Whether cells are on any of some straight lines (n, 4), m, shape (h, w)."""
        passed = np.zeros_like(self.free)
        longest = float(np.hypot(*(lines[:, 2:] - lines[:, :2]).T).max(initial=0.0))
        shares = np.linspace(0.0, 1.0, 2 + int(2.0 * longest / _CELL))[:, None, None]
        rows, columns = np.moveaxis(self.cells(lines[:, :2] + shares * (lines[:, 2:] - lines[:, :2])), -1, 0)
        passed[rows, columns] = True
        return passed

    def _path_to_widest(self, cells: Int64) -> GridPath:
        """The path to the first of the cells with the largest clearance, by their numbers."""
        clearances = self.clearance[self._passable_cells[cells, 0], self._passable_cells[cells, 1]]
        return self._path_to_cell(int(cells[np.argmax(clearances)]))

    def path_to(self, position: Float64) -> GridPath | None:
        """The path to a position (2,), m, or to the nearest reachable one; None for none near it."""
        distances = np.hypot(*(self._cell_centers(self._passable_cells) - position).T)
        distances[~np.isfinite(self._cost)] = np.inf
        nearest = int(np.argmin(distances))
        return self._path_to_cell(nearest) if distances[nearest] <= _MAX_DETOUR else None

    def _path_to_cell(self, end: int) -> GridPath:
        """The path to a cell by its number."""
        path = [end]
        while self._predecessors[path[-1]] >= 0:
            path.append(int(self._predecessors[path[-1]]))
        return GridPath(self._owners[int(self._source[end])], self._cell_centers(self._passable_cells[path[::-1]]))

    def _cell_centers(self, cells: Int64) -> Float64:
        """The middles of cells (n, 2), m."""
        return self.origin + _CELL * (cells[:, ::-1] + 0.5)

    def _step_costs(self, passable: Bool) -> coo_array:
        """Costs of the steps between cells, in cells."""
        numbers = self._numbers
        price = 1.0 + _INFLATION_COST * np.clip(
            (self._min_clearance + _INFLATION_DISTANCE - self.clearance) / _INFLATION_DISTANCE, 0.0, 1.0
        )
        firsts, seconds, costs = [], [], []
        height, width = passable.shape
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here = (slice(0, height - down), slice(max(0, -right), width - max(0, right)))
            there = (slice(down, height), slice(max(0, right), width - max(0, -right)))
            both = passable[here] & passable[there]
            firsts.append(numbers[here][both])
            seconds.append(numbers[there][both])
            costs.append(np.hypot(down, right) * 0.5 * (price[here][both] + price[there][both]))
        first, second, cost = (np.concatenate(parts) for parts in (firsts, seconds, costs))
        count = int(passable.sum())
        both_ways = (np.concatenate((first, second)), np.concatenate((second, first)))
        return coo_array((np.concatenate((cost, cost)), both_ways), shape=(count, count)).tocsr()


def _lines_to_lasers(scans: Sequence[Scan], poses: Float64) -> Float64:
    """The lines from keyframes to their lasers, (n, 4), x and y of both ends, m; of lasers amid the robot none."""
    mountings = np.array([scan.laser_pose for scan in scans]).reshape(-1, 3)
    is_aside = mountings[:, :2].any(axis=1)
    lasers = se2.compose(poses[is_aside], mountings[is_aside])
    return np.concatenate((poses[is_aside, :2], lasers[:, :2]), axis=1)
