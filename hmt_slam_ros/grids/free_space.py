"""What the beams of a scan meet and what they pass: a wall that is known is not seen through.

Who walks by, what was put there and a door that was closed end a beam early. Only what was taken away lets it pass, or
that it was not sent from there: where people walk, this tells best whether the robot is where it should be.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.se2_kernels import transform
from hmt_slam_ros.grids.patches import FAR, PATCH, GridView, field_at

# A beam passes a wall if nothing is known within this distance of it before and behind, m: others run along the wall.
_CLEARANCE = 0.2
# It ends at least so far behind the wall, m.
_BEHIND = 0.4
# Of surfaces, one sample every so many m counts.
_SAMPLE_SPACING = 0.2
# A wall was passed where samples of it are so near to each other, m: a single one may be the jamb of a door.
_MAX_SAMPLE_GAP = 0.6
# Part of a cell by which a beam is followed near surfaces.
_STEP = 0.7


@njit(cache=True)
def count_hits_and_violations(
    points: Float64, laser: Float64, pose: Float64, view: GridView, near: int
) -> tuple[int, int]:
    """How many samples of known surfaces the beams of a scan end on, and of how many they pass.

    :param points: ends of the beams in their order, shape (n, 2 or more), m, base frame.
    :param laser: where the beams begin, shape (2,), likewise.
    :param pose: ``map_T_base``, shape (3,).
    :param near: quantised distance to a surface below which a beam ends on it.
    """
    cos, sin = np.cos(pose[2]) / view.cell, np.sin(pose[2]) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = pose[0] / view.cell + half, pose[1] / view.cell + half
    from_u, from_v = transform(u, v, cos, sin, laser[0], laser[1])
    apart, together = _SAMPLE_SPACING / view.cell, _MAX_SAMPLE_GAP / view.cell
    met, met_u, met_v = 0, -np.inf, -np.inf
    passed, passed_u, passed_v = 0, -np.inf, -np.inf
    for i in range(points.shape[0]):
        to_u, to_v = transform(u, v, cos, sin, points[i, 0], points[i, 1])
        if field_at(view, int(to_u), int(to_v)) < near and np.hypot(to_u - met_u, to_v - met_v) >= apart:
            met, met_u, met_v = met + 1, to_u, to_v
        share = _first_wall_passed(view, from_u, from_v, to_u, to_v)
        if share < 0.0:
            continue
        wall_u, wall_v = from_u + share * (to_u - from_u), from_v + share * (to_v - from_v)
        between = np.hypot(wall_u - passed_u, wall_v - passed_v)
        if between >= apart:
            passed, passed_u, passed_v = passed + (between <= together), wall_u, wall_v
    return met, passed


@njit(cache=True)
def _first_wall_passed(view: GridView, from_u: float, from_v: float, to_u: float, to_v: float) -> float:
    """Share of a beam, in cells, up to the first wall that it passes; -1 where it passes none."""
    length = max(np.hypot(to_u - from_u, to_v - from_v), 1e-9)
    du, dv = (to_u - from_u) / length, (to_v - from_v) / length
    clear, behind, quantum = _CLEARANCE / view.cell, _BEHIND / view.cell, view.radius / (FAR * view.cell)
    before, wall, at = -np.inf, np.inf, 0.0
    while at < length:
        distance = quantum * field_at(view, int(from_u + at * du), int(from_v + at * dv))
        if distance >= clear:
            if wall < at:
                return wall / length
            before = at
        elif wall == np.inf and distance < 0.5 and at - before <= 2.0 * clear and at <= length - behind:
            wall = at
        elif at - wall > 2.0 * clear:
            before, wall = -np.inf, np.inf
        at += max(_STEP, distance - clear)
    return -1.0
