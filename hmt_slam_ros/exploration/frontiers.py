"""The ground around an area: where a robot can go, and where what is known of it ends (frontiers; Yamauchi, 1997).

One search of scipy's serves all paths of a grid. Roadmaps and policies have few nodes with names: networkx does there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.grids.occupancy_map import OCCUPIED, UNKNOWN, occupancy_image
from hmt_slam_ros.sensors import Scan

_CELL = 0.1  # m
# A beam tells of ground up to here, m: beyond, doors are seen too much askew, and there are gaps between beams.
KEYFRAME_RANGE = 4.0
"""So far a keyframe shows ground, m."""

# Cells of a frontier at least, and how much farther from surfaces than the robot has to keep they are, m.
_LEAST, _FRONTIER_CLEARANCE = 3, 0.1
# A part of the ground is a room of its own from this size on, m^2.
_PART = 0.5
# A place that is too near to a surface is got to by way of the next one that is not, up to so far away, m.
_ASIDE = 0.5
# A cell costs up to so many times more the nearer it is to a surface, up to so many m beyond the radius.
_INFLATION_COST, _INFLATION_DISTANCE = 2.0, 0.4
_AROUND = np.ones((3, 3), dtype=np.bool_)


class GridPath(NamedTuple):
    """The way to a place from the keyframe from which that is shortest.

    :ivar keyframe_row: row of that keyframe.
    :ivar points: shape (n, 2), m, from the keyframe to the place; in the frame of the ground.
    """

    keyframe_row: int
    points: Float64


class NavigationGrid:
    """A grid of what some keyframes show.

    :ivar free: shape (h, w), where the robot's middle may be.
    :ivar unknown: shape (h, w), of which nothing is known.
    :ivar origin: shape (2,), lower left corner, m.
    :ivar clearance: shape (h, w), m, from the middles of cells to surfaces.
    """

    def __init__(self, scans: Sequence[Scan], poses: Float64, min_clearance: float) -> None:
        """Draw the grid.

        :param scans: of n keyframes.
        :param poses: shape (n, 3), theirs in the frame of the ground, m and rad.
        :param min_clearance: that the robot's middle has to keep from surfaces, m.
        """
        image = occupancy_image(scans, poses, _CELL, KEYFRAME_RANGE)
        pixels = image.pixels[::-1]
        self.origin, self._min_clearance = image.origin, min_clearance
        # Single cells between two beams are no frontier.
        known = ndimage.binary_closing(pixels != UNKNOWN, _AROUND)
        self.unknown: Bool = ~known
        self.clearance: Float64 = _CELL * ndimage.distance_transform_edt(pixels != OCCUPIED)
        self.free: Bool = known & (pixels != OCCUPIED) & (self.clearance >= min_clearance)
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
        """Rows and columns (..., 2) of points (..., 2), m; on the grid's border where they are outside."""
        found = np.floor((points - self.origin) / _CELL).astype(np.int64)[..., ::-1]
        return np.clip(found, 0, np.array(self.free.shape) - 1)

    def is_straight_path_free(self, starts: Float64, ends: Float64) -> Bool:
        """Whether the robot can go straight from places (n, 2) to others (n, 2), shape (n,)."""
        longest = float(np.hypot(*(ends - starts).T).max(initial=0.0))
        shares = np.linspace(0.0, 1.0, 2 + int(longest / _CELL))[:, None, None]
        rows, columns = np.moveaxis(self.cells(starts + shares * (ends - starts)), -1, 0)
        return np.asarray(self.free[rows, columns].all(axis=0))

    def paths_to_frontiers(self) -> list[GridPath]:
        """The ways to all frontiers that can be reached from keyframes."""
        wide = self.clearance >= self._min_clearance + _FRONTIER_CLEARANCE
        border = wide & (self._numbers >= 0) & ndimage.binary_dilation(self.unknown, _AROUND)
        groups, count = ndimage.label(border, _AROUND)
        found = []
        for group in range(1, count + 1):
            own = self._numbers[groups == group]
            own = own[np.isfinite(self._cost[own])]
            if own.size >= _LEAST:
                found.append(self._path_to_cell(self._cell_with_most_clearance(own)))
        return found

    def paths_to_unvisited_rooms(self, doors: Float64) -> list[GridPath]:
        """The ways to the parts of the ground behind doors in which no keyframe was taken: to the middle of each.

        :param doors: shape (n, 4), x and y of both jambs of each, m.
        """
        parts, _ = ndimage.label(self.free & ~self._cells_on_lines(doors))
        parts[np.isin(parts, parts[self._keyframe_cells])] = 0
        numbers, sizes = np.unique(parts[parts > 0], return_counts=True)
        found = []
        for part in numbers[sizes * _CELL**2 >= _PART]:
            own = self._numbers[parts == part]
            own = own[np.isfinite(self._cost[own])]
            if own.size:
                found.append(self._path_to_cell(self._cell_with_most_clearance(own)))
        return found

    def _cells_on_lines(self, lines: Float64) -> Bool:
        """The cells that straight lines (n, 4), m, pass."""
        passed = np.zeros_like(self.free)
        longest = float(np.hypot(*(lines[:, 2:] - lines[:, :2]).T).max(initial=0.0))
        shares = np.linspace(0.0, 1.0, 2 + int(2.0 * longest / _CELL))[:, None, None]
        rows, columns = np.moveaxis(self.cells(lines[:, :2] + shares * (lines[:, 2:] - lines[:, :2])), -1, 0)
        passed[rows, columns] = True
        return passed

    def _cell_with_most_clearance(self, cells: Int64) -> int:
        """Of some cells by their numbers the one that is the farthest from surfaces; of equals the first."""
        away = self.clearance[self._passable_cells[cells, 0], self._passable_cells[cells, 1]]
        return int(cells[np.argmax(away)])

    def path_to(self, place: Float64) -> GridPath | None:
        """The way to a place (2,), m, or to the nearest beside it; None where none leads there."""
        away = np.hypot(*(self._cell_centers(self._passable_cells) - place).T)
        away[~np.isfinite(self._cost)] = np.inf
        nearest = int(np.argmin(away))
        return self._path_to_cell(nearest) if away[nearest] <= _ASIDE else None

    def _path_to_cell(self, end: int) -> GridPath:
        """The way to a cell by its number."""
        way = [end]
        while self._predecessors[way[-1]] >= 0:
            way.append(int(self._predecessors[way[-1]]))
        return GridPath(self._owners[int(self._source[end])], self._cell_centers(self._passable_cells[way[::-1]]))

    def _cell_centers(self, cells: Int64) -> Float64:
        """The middles of cells (n, 2), m."""
        return self.origin + _CELL * (cells[:, ::-1] + 0.5)

    def _step_costs(self, passable: Bool) -> coo_array:
        """What steps between cells cost, in cells."""
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
