"""The cells of a grid that a beam crosses, in order (Amanatides and Woo 1987).

Maps of patches and occupancy images follow a beam from the laser to its end. Others follow beams differently:

- simulated rays (:mod:`hmt_slam_ros.simulation.laser`) begin where they enter the grid, and have no end;
- virtual scans and known walls (:mod:`hmt_slam_ros.grids.virtual_scan`,
  :mod:`hmt_slam_ros.registration.consistency`) step by the distance to the nearest surface;
- log-ratio grids and lines of sight (:mod:`hmt_slam_ros.registration.likelihood_grid`,
  :mod:`hmt_slam_ros.hybrid_map.surroundings`) sample a line at even steps, which may miss corners of cells.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.compilation import njit


class GridWalk(NamedTuple):
    """The current cell of a beam. Lengths are shares of the beam.

    :ivar column: of the cell, with ``row``.
    :ivar next_x: length up to the next border between columns; ``next_y``, between rows.
    :ivar step_x: from one column to the next, -1, 0 or 1; ``step_y``, of rows.
    :ivar delta_x: length between two borders of columns; ``delta_y``, of rows.
    """

    column: int
    row: int
    next_x: float
    next_y: float
    step_x: int
    step_y: int
    delta_x: float
    delta_y: float


@njit(cache=True)
def begin_walk(from_x: float, from_y: float, to_x: float, to_y: float) -> tuple[GridWalk, int]:
    """The cell in which a beam starts, and the number of steps to the cell of its end; coordinates in cells."""
    column, row = int(np.floor(from_x)), int(np.floor(from_y))
    step_x, delta_x, next_x = _axis_steps(from_x, to_x)
    step_y, delta_y, next_y = _axis_steps(from_y, to_y)
    steps = abs(int(np.floor(to_x)) - column) + abs(int(np.floor(to_y)) - row)
    return GridWalk(column, row, next_x, next_y, step_x, step_y, delta_x, delta_y), steps


@njit(cache=True)
def _axis_steps(start: float, end: float) -> tuple[int, float, float]:
    """Along one axis: the step in cells, the length per cell, and the length up to the first border."""
    if end == start:
        return 0, np.inf, np.inf
    delta = 1.0 / abs(end - start)
    if end > start:
        return 1, delta, (np.floor(start) + 1.0 - start) * delta
    return -1, delta, (start - np.floor(start)) * delta


@njit(cache=True)
def next_cell(walk: GridWalk) -> GridWalk:
    """The next cell of the beam."""
    column, row, next_x, next_y, step_x, step_y, delta_x, delta_y = walk
    if next_x < next_y:
        return GridWalk(column + step_x, row, next_x + delta_x, next_y, step_x, step_y, delta_x, delta_y)
    return GridWalk(column, row + step_y, next_x, next_y + delta_y, step_x, step_y, delta_x, delta_y)
