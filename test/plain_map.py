"""A grid map made of walls by scipy, without a pool: kernels on it can run without compilation."""

import numpy as np
from scipy.ndimage import distance_transform_edt

from hmt_slam_ros.grids.patches import FAR, PATCH, GridView

_EDGE = 16
"""Patches along an edge of a map."""


def plain_view(walls, known, cell=0.05, radius=0.5):
    """The map of walls (n, 4) in a known box (x0, y0, x1, y1), all of whose other cells are free."""
    size = _EDGE * PATCH
    middles = (np.arange(size) + 0.5 - size / 2) * cell
    x, y = np.meshgrid(middles, middles)
    inside = (x > known[0]) & (y > known[1]) & (x < known[2]) & (y < known[3])
    occupied = np.zeros((size, size), bool)
    for x0, y0, x1, y1 in walls:
        share = np.linspace(0.0, 1.0, int(np.hypot(x1 - x0, y1 - y0) / (0.2 * cell)) + 2)
        column, row = (np.floor((a + share * (b - a)) / cell + size / 2) for a, b in ((x0, x1), (y0, y1)))
        within = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < size)
        occupied[row[within].astype(int), column[within].astype(int)] = True
    odds = np.where(occupied, 20, np.where(inside, -10, 0)).astype(np.int8)
    field = np.minimum(FAR, np.round(distance_transform_edt(~occupied) * cell / radius * FAR)).astype(np.uint8)
    table = np.arange(_EDGE * _EDGE, dtype=np.int32).reshape(_EDGE, _EDGE)
    blocks = (
        each.reshape(_EDGE, PATCH, _EDGE, PATCH).swapaxes(1, 2).reshape(-1, PATCH, PATCH).copy()
        for each in (odds, field)
    )
    return GridView(table, *blocks, cell, radius)
