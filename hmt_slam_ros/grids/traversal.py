"""Which cells of a grid a beam crosses, one after the other (Amanatides and Woo 1987).

Maps of patches and images of whole maps take a beam from its laser to its end. Others follow beams differently:

- simulated rays (:mod:`hmt_slam_ros.simulation.laser`) step alike, but begin where they enter the grid and have no
  end;
- virtual scans and known walls (:mod:`hmt_slam_ros.grids.virtual_scan`,
  :mod:`hmt_slam_ros.registration.consistency`) jump by the distance to the nearest surface, as they ask for surfaces
  and not for cells;
- log-ratio grids and lines of sight between keyframes (:mod:`hmt_slam_ros.registration.likelihood_grid`,
  :mod:`hmt_slam_ros.hybrid_map.surroundings`) sample a line at even steps, which may miss cells at their corners.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit


class GridWalk(NamedTuple):
    """Where a beam is on its way through a grid.

    :ivar column: of the cell, with ``row``.
    :ivar next_x: how far along the beam the next border between columns is; ``next_y``, between rows.
    :ivar step_x: from one column to the next, -1, 0 or 1; ``step_y``, of rows.
    :ivar delta_x: how far along the beam from one border between columns to the next; ``delta_y``, between rows.
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
    """A beam at its start, and how many steps there are to the cell of its end; in cells, along it in shares of it."""
    column, row = int(np.floor(from_x)), int(np.floor(from_y))
    step_x, delta_x, next_x = _axis_steps(from_x, to_x)
    step_y, delta_y, next_y = _axis_steps(from_y, to_y)
    steps = abs(int(np.floor(to_x)) - column) + abs(int(np.floor(to_y)) - row)
    return GridWalk(column, row, next_x, next_y, step_x, step_y, delta_x, delta_y), steps


@njit(cache=True)
def _axis_steps(start: float, end: float) -> tuple[int, float, float]:
    """Along one axis: the cell step, the beam's length per cell, and its length up to the first boundary."""
    if end == start:
        return 0, np.inf, np.inf
    delta = 1.0 / abs(end - start)
    if end > start:
        return 1, delta, (np.floor(start) + 1.0 - start) * delta
    return -1, delta, (start - np.floor(start)) * delta


@njit(cache=True)
def next_cell(walk: GridWalk) -> GridWalk:
    """The beam in the cell that it enters next."""
    column, row, next_x, next_y, step_x, step_y, delta_x, delta_y = walk
    if next_x < next_y:
        return GridWalk(column + step_x, row, next_x + delta_x, next_y, step_x, step_y, delta_x, delta_y)
    return GridWalk(column, row + step_y, next_x, next_y + delta_y, step_x, step_y, delta_x, delta_y)
