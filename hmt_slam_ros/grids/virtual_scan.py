"""The scan that a laser with a full circle of beams would take in a local map, whatever the robot's own laser sees.

What is around the robot is in the map of the area, also what its laser does not see at the moment. A beam is followed
by steps of the distance field (sphere tracing, Hart 1996) to the first surface, and there to where the field is least:
that is in the middle of the occupied cells, not on the near side of the first of them, so that walls that are grazed
are seen where they are. A beam that comes into ground of which nothing is known ends there without a return.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.grids.patches import FAR, PATCH, GridView, field_at_four, odds_at
from hmt_slam_ros.sensors import Scan

# In cells: a beam meets a surface where the middle of an occupied cell is this near to it.
_HIT_DISTANCE = 0.65
# The longest step over ground that has to be known, and the shortest; and the one in search of the least distance.
_MAX_STEP, _MIN_STEP, _FINE_STEP = 2.0, 0.5, 0.1
# Behind the first meeting with a surface the least distance is sought for so far.
_BEHIND = 2.0
# How fast the distance falls on the last stretch of a beam tells how it meets the surface; not below this.
_STRETCH, _GRAZING = 4.0, 0.05
# Beams of a real scan leave holes between them, m; only more in a row is unknown.
_MAX_HOLE = 0.3


class VirtualScan(NamedTuple):
    """A scan all around, and what is not known of it.

    :ivar scan: in the frame of the base at the pose from which it was cast; its first beam looks backwards. NaN where
        the map shows no surface.
    :ivar free_range: shape (n,), how far each beam goes through known space, m: to the surface where there is one.
    :ivar incidence_cosine: shape (n,), cosine of the angle between each beam and the normal of the surface that it
        meets, at least 0.05. What a map errs by is across its surfaces, which makes a range err by as much divided by
        this.
    """

    scan: Scan
    free_range: Float64
    incidence_cosine: Float64


def cast_virtual_scan(view: GridView, pose: Float64, beams: int, reach: float, stamp: int = 0) -> VirtualScan:
    """Cast a scan in a map.

    :param pose: ``map_T_base``, shape (3,), m and rad.
    :param beams: number of beams, evenly over the circle, 3 at least.
    :param reach: how far they are followed, m.
    :param stamp: of the scan, ns.
    """
    step = 2.0 * math.pi / beams
    ranges, free, facing = np.empty(beams), np.empty(beams), np.empty(beams)
    _cast_beams(view, pose, step, reach, ranges, free, facing)
    scan = Scan(stamp, ranges.astype(np.float32), -math.pi, step, 0.0, float(np.float32(reach)) + view.cell)
    return VirtualScan(scan, free, facing)


@njit(cache=True)
def _cast_beams(
    view: GridView, pose: Float64, step: float, reach: float, ranges: Float64, free: Float64, facing: Float64
) -> None:
    """Write of each beam, (n,), its range, NaN without a surface, how far it is free, m, and how it faces a surface."""
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = pose[0] / view.cell + half, pose[1] / view.cell + half
    for k in range(len(ranges)):
        angle = pose[2] - math.pi + k * step
        du, dv = math.cos(angle), math.sin(angle)
        met, known = _cast_beam(view, u, v, du, dv, reach / view.cell)
        ranges[k], free[k], facing[k] = met * view.cell, known * view.cell, 1.0
        if not math.isnan(met):
            stretch = max(_MIN_STEP, min(met, _STRETCH))
            back = met - stretch
            facing[k] = min(1.0, max(_GRAZING, _distance(view, u + back * du, v + back * dv) / stretch))


@njit(cache=True)
def _cast_beam(view: GridView, u: float, v: float, du: float, dv: float, reach: float) -> tuple[float, float]:
    """Where a beam meets a surface, NaN for nowhere, and how far it is free; all in cells."""
    at, known, holes = 0.0, 0.0, _MAX_HOLE / view.cell
    while at < reach:
        column, row = math.floor(u + at * du), math.floor(v + at * dv)
        distance = _distance(view, u + at * du, v + at * dv)
        if distance < _HIT_DISTANCE:
            at = _nearest_minimum(view, u, v, du, dv, at)
            return (at, at) if at < reach else (math.nan, reach)
        if odds_at(view, column, row) != 0:
            known = at
        elif at - known > holes:
            return math.nan, known
        at += min(_MAX_STEP, max(_MIN_STEP, distance - _HIT_DISTANCE))
    return math.nan, (reach if reach - known <= holes else known)


@njit(cache=True)
def _distance(view: GridView, u: float, v: float) -> float:
    """Distance to the middle of the nearest occupied cell, in cells, interpolated between the middles of four."""
    column, row = math.floor(u - 0.5), math.floor(v - 0.5)
    a, b = u - 0.5 - column, v - 0.5 - row
    here, right, above, beyond = field_at_four(view, column, row)
    mean = (1.0 - b) * ((1.0 - a) * here + a * right) + b * ((1.0 - a) * above + a * beyond)
    return mean * view.radius / (FAR * view.cell)


@njit(cache=True)
def _nearest_minimum(view: GridView, u: float, v: float, du: float, dv: float, at: float) -> float:
    """Where behind ``at`` the distance is least, before it grows again."""
    least, best, end = math.inf, at, at + _BEHIND
    while at < end:
        distance = _distance(view, u + at * du, v + at * dv)
        if distance > least + _FINE_STEP:
            break
        if distance < least:
            least, best = distance, at
        at += _FINE_STEP
    return best
