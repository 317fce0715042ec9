"""Jambs: what bounds an opening on either side, the end of its wall or another wall that crosses its line.

People, and furniture in the room behind a door, cross the line of a wall as well. The support of a jamb is the length
of the stretch of wall that ends there; what crosses gives none, however long it is.
"""

from __future__ import annotations

import math

from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.features.line_fit import variance_at
from hmt_slam_ros.features.rays import Rays
from hmt_slam_ros.features.told import ON, STRAY, Told, across

PLACE, VARIANCE, SUPPORT = range(3)
"""Where what is known of a jamb stands in an array: where on the line, m, the variance of that, and support, m."""


@njit(cache=True)
def wall_end(
    line: Float64, covariance: Float64, rays: Rays, told: Told, k: int, step: int, max_gap: float, jamb: Float64
) -> None:
    """Write the jamb where the wall ends on which the beams from ``k`` on lie, away from the gap.

    The first of them may lie on its other side, in the thickness of the wall.

    :param told: what beams say of the line, all of those that say something.
    """
    end = len(told.kinds)
    while 0 <= k + step < end and told.kinds[k + step] == ON and told.behind[k] > across(line, rays, told.beams[k]):
        k += step
    spacing, beam = told.along[k - step] - told.along[k], told.beams[k]
    jamb[PLACE] = told.along[k] + 0.5 * spacing
    # Where the end is between two beams, and how far the line's error moves it along the beam.
    facing = math.cos(line[0]) * rays.directions[beam, 0] + math.sin(line[0]) * rays.directions[beam, 1]
    slant = (1.0 - facing * facing) / (facing * facing)
    uncertain = abs(spacing) + 2.0 * STRAY * rays.deviations[beam]
    jamb[VARIANCE] = uncertain * uncertain / 12.0
    jamb[VARIANCE] += slant * variance_at(covariance[0, 0], covariance[0, 1], covariance[1, 1], told.along[k])
    last = k
    while 0 <= last + step < end and told.kinds[last + step] == ON:
        if abs(told.along[last + step] - told.along[last]) > max_gap:
            break
        last += step
    jamb[SUPPORT] = abs(told.along[last] - told.along[k])


@njit(cache=True)
def crossing_wall(line: Float64, rays: Rays, told: Told, k: int, step: int, max_gap: float, jamb: Float64) -> bool:
    """Write the jamb where another wall crosses the line before beam ``k``; False where none does."""
    before = told.beams[k - step]
    x, y = _end(rays, told.beams[k])
    from_x, from_y = _end(rays, before)
    if not rays.met[before] or math.hypot(x - from_x, y - from_y) > max_gap:
        return False
    cos, sin = math.cos(line[0]), math.sin(line[0])
    share = told.behind[k - step] / (told.behind[k - step] - told.behind[k])
    crossing_x, crossing_y = from_x + share * (x - from_x), from_y + share * (y - from_y)
    jamb[PLACE] = cos * crossing_y - sin * crossing_x
    beam = told.beams[k]
    slanted = cos * rays.directions[beam, 1] - sin * rays.directions[beam, 0]
    jamb[VARIANCE] = (rays.deviations[beam] * slanted) ** 2
    jamb[SUPPORT] = 0.0
    return True


@njit(cache=True)
def _end(rays: Rays, beam: int) -> tuple[float, float]:
    """Where a beam ends."""
    away = rays.free[beam]
    x = rays.origins[beam, 0] + away * rays.directions[beam, 0]
    return x, rays.origins[beam, 1] + away * rays.directions[beam, 1]
