"""The scan that a laser with a full circle of beams would take in a local map.

A beam is followed by steps of the distance field (sphere tracing, Hart 1996) to the first surface, and there to the
minimum of the field. The minimum is in the middle of the occupied cells, so grazed walls have no bias to the near side.
A beam that enters unknown space ends there without a return.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.grids.patches import FAR, PATCH, GridView, field_at_four, odds_at
from hmt_slam_ros.sensors import Scan

_HIT_DISTANCE = 0.65
"""Distance from the middle of an occupied cell below which a beam meets a surface, cells."""

_MAX_STEP, _MIN_STEP, _FINE_STEP = 2.0, 0.5, 0.1
"""Longest and shortest step of a beam, and the step in search of the least distance, cells."""

_BEHIND = 2.0
"""Search range for the least distance behind the first hit, cells."""

_STRETCH, _GRAZING = 4.0, 0.05
"""Length before a hit over which the incidence is measured, cells, and the smallest cosine of the incidence."""

_MAX_HOLE = 0.3
"""Unknown space in a row that a beam still crosses, m: beams of real scans leave such holes."""


class VirtualScan(NamedTuple):
    """A full circle of beams cast in a map.

    :ivar scan: in the frame of the base at the pose from which it was cast; its first beam points backwards. NaN where
        the map shows no surface.
    :ivar free_range: shape (n,), length of each beam in known space, m: up to the surface where there is one.
    :ivar incidence_cosine: shape (n,), cosine of the angle between each beam and the normal of the surface that it
        meets, at least 0.05. The error of a range is the error of the map across the surface, divided by this.
    """

    scan: Scan
    free_range: Float64
    incidence_cosine: Float64


def cast_virtual_scan(view: GridView, pose: Float64, beams: int, reach: float, stamp: int = 0) -> VirtualScan:
    """The virtual scan of a map.

    :param pose: ``map_T_base``, shape (3,), m and rad.
    :param beams: number of beams, evenly over the circle, 3 at least.
    :param reach: largest range, m.
    :param stamp: of the scan, ns.
    """
    step = 2.0 * math.pi / beams
    ranges, free, cosines = np.empty(beams), np.empty(beams), np.empty(beams)
    _cast_beams(view, pose, step, reach, ranges, free, cosines)
    scan = Scan(stamp, ranges.astype(np.float32), -math.pi, step, 0.0, float(np.float32(reach)) + view.cell)
    return VirtualScan(scan, free, cosines)


@njit(cache=True)
def _cast_beams(
    view: GridView, pose: Float64, step: float, reach: float, ranges: Float64, free: Float64, cosines: Float64
) -> None:
    """Write the range of each beam, (n,), m, NaN without a surface, its free range, and the cosine of its incidence."""
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = pose[0] / view.cell + half, pose[1] / view.cell + half
    for k in range(len(ranges)):
        angle = pose[2] - math.pi + k * step
        du, dv = math.cos(angle), math.sin(angle)
        hit, known = _cast_beam(view, u, v, du, dv, reach / view.cell)
        ranges[k], free[k], cosines[k] = hit * view.cell, known * view.cell, 1.0
        if not math.isnan(hit):
            stretch = max(_MIN_STEP, min(hit, _STRETCH))
            back = hit - stretch
            cosines[k] = min(1.0, max(_GRAZING, _distance(view, u + back * du, v + back * dv) / stretch))


@njit(cache=True)
def _cast_beam(view: GridView, u: float, v: float, du: float, dv: float, reach: float) -> tuple[float, float]:
    """The range at which a beam meets a surface, NaN for none, and its free range, both in cells."""
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
    """The first minimum of the distance behind the range ``at``, cells."""
    least, best, end = math.inf, at, at + _BEHIND
    while at < end:
        distance = _distance(view, u + at * du, v + at * dv)
        if distance > least + _FINE_STEP:
            break
        if distance < least:
            least, best = distance, at
        at += _FINE_STEP
    return best
