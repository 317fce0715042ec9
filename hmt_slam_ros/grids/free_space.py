"""What the beams of a scan meet and what they pass: a wall that is known is not seen through.

Who walks by, what was put there and a door that was closed end a beam early. Only what was taken away lets it pass, or
that it was not sent from there: where people walk, this tells best whether the robot is where it should be.

Maps of lines (:mod:`hmt_slam_ros.landmarks.line_filter`) find the walls differently and count them alike. Three other
checks ask something else:

- whether the end of a beam, not its way, is in free space (``count_agreement`` of ``scan_to_map`` and of area grids);
- by how much that speaks against a match, as a sum of log-ratios (``branch_and_bound``);
- what one scan says of a place without any map (:mod:`hmt_slam_ros.sensors.polar_scan`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.se2_kernels import transform
from hmt_slam_ros.grids.patches import FAR, PATCH, GridView, field_at

# A beam passes a wall if nothing is known within this distance of it before and behind, m: others run along the wall.
_CLEARANCE = 0.2
BEHIND = 0.4
"""A beam that passes a wall ends at least so far behind it, m."""

SAMPLE_SPACING = 0.2
"""Of surfaces, one sample every so many m counts."""

MAX_SAMPLE_GAP = 0.6
"""A wall was passed where samples of it are so near to each other, m: a single one may be the jamb of a door."""

# Part of a cell by which a beam is followed near surfaces.
_STEP = 0.7


class WallSamples(NamedTuple):
    """Samples of walls, taken in the order of the beams.

    :ivar total: how many count.
    :ivar x: where the last of all is, with ``y``, m or cells.
    """

    total: int
    x: float
    y: float


NO_SAMPLES = WallSamples(0, -np.inf, -np.inf)


@njit(cache=True)
def add_wall_hit(samples: WallSamples, x: float, y: float, spacing: float) -> WallSamples:
    """With the end of one more beam on a wall, if it is not too near to the last sample."""
    if np.hypot(x - samples.x, y - samples.y) < spacing:
        return samples
    return WallSamples(samples.total + 1, x, y)


@njit(cache=True)
def add_wall_passed(samples: WallSamples, x: float, y: float, spacing: float, gap: float) -> WallSamples:
    """With the place where one more beam passes a wall: one that is too far from the last sample does not count."""
    between = np.hypot(x - samples.x, y - samples.y)
    if between < spacing:
        return samples
    return WallSamples(samples.total + (between <= gap), x, y)


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
    apart, together = SAMPLE_SPACING / view.cell, MAX_SAMPLE_GAP / view.cell
    met, passed = NO_SAMPLES, NO_SAMPLES
    for i in range(points.shape[0]):
        to_u, to_v = transform(u, v, cos, sin, points[i, 0], points[i, 1])
        if field_at(view, int(to_u), int(to_v)) < near:
            met = add_wall_hit(met, to_u, to_v, apart)
        share = _first_wall_passed(view, from_u, from_v, to_u, to_v)
        if share >= 0.0:
            wall_u, wall_v = from_u + share * (to_u - from_u), from_v + share * (to_v - from_v)
            passed = add_wall_passed(passed, wall_u, wall_v, apart, together)
    return met.total, passed.total


@njit(cache=True)
def _first_wall_passed(view: GridView, from_u: float, from_v: float, to_u: float, to_v: float) -> float:
    """Share of a beam, in cells, up to the first wall that it passes; -1 where it passes none."""
    length = max(np.hypot(to_u - from_u, to_v - from_v), 1e-9)
    du, dv = (to_u - from_u) / length, (to_v - from_v) / length
    clear, behind, quantum = _CLEARANCE / view.cell, BEHIND / view.cell, view.radius / (FAR * view.cell)
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
