"""Scan matching against a map of patches: likelihood, correlative search, Gauss-Newton, likelihood volume.

Poses are ``map_T_base`` (x, y, theta); points are (n, 2) in m in the base frame. The likelihood of a beam is taken
relative to unknown space, so that 0 means "nothing known here", and products over maps of different extent compare.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.local_map.patches import FAR, PATCH, field_at, odds_at


class BeamModel(NamedTuple):
    """Log-likelihood ratio of an end point, tabulated over the quantised distance to the nearest surface.

    :ivar in_unknown: shape (256,), nats, where the cell of the end point was never seen.
    :ivar in_known: shape (256,), nats, where it was: far from surfaces the map contradicts the beam.
    """

    in_unknown: NDArray[np.float64]
    in_known: NDArray[np.float64]


def beam_model(radius: float, sigma: float, unknown_range: float, random: float) -> BeamModel:
    """The table of p(z | map) / p(z | unknown).

    :param radius: truncation of the distance field, m.
    :param sigma: standard deviation of a return around a surface, sigma_hit, m.
    :param unknown_range: scale over which a return is uniform in unknown space, m.
    :param random: share of returns that no surface explains, z_rand, in (0, 1).
    """
    distance = np.arange(256) / FAR * radius
    hit = (1.0 - random) * unknown_range * np.exp(-0.5 * (distance / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    return BeamModel(np.log(hit + 1.0), np.log(hit + random))


@njit(cache=True)
def log_ratio(points, x, y, theta, table, odds, field, cell, in_unknown, in_known):  # type: ignore[no-untyped-def]
    """Sum over the points of the log-likelihood ratio at a pose, nats."""
    cos, sin = np.cos(theta) / cell, np.sin(theta) / cell
    half = 0.5 * table.shape[0] * PATCH
    x, y = x / cell + half, y / cell + half
    total = 0.0
    for i in range(points.shape[0]):
        column = int(x + cos * points[i, 0] - sin * points[i, 1])
        row = int(y + sin * points[i, 0] + cos * points[i, 1])
        distance = field_at(table, field, column, row)
        if odds_at(table, odds, column, row) == 0:
            total += in_unknown[distance]
        else:
            total += in_known[distance]
    return total


@njit(cache=True)
def matched_fraction(points, pose, table, field, cell, near):  # type: ignore[no-untyped-def]
    """Share of the points whose quantised distance to a surface is below ``near``."""
    cos, sin = np.cos(pose[2]) / cell, np.sin(pose[2]) / cell
    half = 0.5 * table.shape[0] * PATCH
    count = 0
    for i in range(points.shape[0]):
        column = int(pose[0] / cell + half + cos * points[i, 0] - sin * points[i, 1])
        row = int(pose[1] / cell + half + sin * points[i, 0] + cos * points[i, 1])
        if field_at(table, field, column, row) < near:
            count += 1
    return count / max(1, points.shape[0])


@njit(cache=True)
def correlative_search(  # type: ignore[no-untyped-def]
    points, centre, information, steps, counts, table, odds, field, cell, in_unknown, in_known, temper
):
    """The best pose on a regular grid of offsets around ``centre``, by tempered likelihood ratio times prior.

    :param information: (3, 3) of the Gaussian prior around ``centre``, map frame.
    :param steps: (3,) spacing of the grid in m, m, rad, along and across the centre's heading.
    :param counts: (3,) int, steps to each side.
    """
    best_score = -np.inf
    best = centre.copy()
    cos, sin = np.cos(centre[2]), np.sin(centre[2])
    offset = np.empty(3)
    for k in range(-counts[2], counts[2] + 1):
        offset[2] = k * steps[2]
        for i in range(-counts[0], counts[0] + 1):
            for j in range(-counts[1], counts[1] + 1):
                along, across = i * steps[0], j * steps[1]
                offset[0] = cos * along - sin * across
                offset[1] = sin * along + cos * across
                prior = -0.5 * offset @ information @ offset
                score = prior + temper * log_ratio(
                    points, centre[0] + offset[0], centre[1] + offset[1], centre[2] + offset[2],
                    table, odds, field, cell, in_unknown, in_known,
                )
                if score > best_score:
                    best_score = score
                    best[:] = centre + offset
    return best, best_score


@njit(cache=True)
def _smooth_distance(table, field, u, v):  # type: ignore[no-untyped-def]
    """Bilinear distance and its gradient per cell at the continuous cell coordinates (u, v), in quanta."""
    column, row = int(np.floor(u)), int(np.floor(v))
    fu, fv = u - column, v - row
    d00 = float(field_at(table, field, column, row))
    d10 = float(field_at(table, field, column + 1, row))
    d01 = float(field_at(table, field, column, row + 1))
    d11 = float(field_at(table, field, column + 1, row + 1))
    low, high = d00 + fu * (d10 - d00), d01 + fu * (d11 - d01)
    gradient_u = (1.0 - fv) * (d10 - d00) + fv * (d11 - d01)
    return low + fv * (high - low), gradient_u, high - low


@njit(cache=True)
def align(  # type: ignore[no-untyped-def]
    points, start, prior, information, table, field, cell, radius, sigma, robust, iterations
):
    """Gauss-Newton on the distance field with a Gaussian prior: the mode and the information of the likelihood.

    Minimises sum rho(d(T p)^2) / sigma^2 + (T - prior)' information (T - prior), rho of Cauchy with scale
    ``robust``.

    :param start: (3,) pose to start from.
    :param prior: (3,) mean of the prior; ``information``: (3, 3), map frame.
    :param radius: truncation of the distance field, m; ``sigma``, ``robust``: m.
    :returns: the pose (3,), and the information (3, 3) of the points alone, map frame.
    """
    pose = start.copy()
    half = 0.5 * table.shape[0] * PATCH
    quantum = radius / FAR
    hessian = np.zeros((3, 3))
    for _ in range(iterations):
        hessian[:] = 0.0
        difference = pose - prior
        difference[2] = (difference[2] + np.pi) % (2.0 * np.pi) - np.pi
        gradient = information @ difference
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        for i in range(points.shape[0]):
            rx = cos * points[i, 0] - sin * points[i, 1]
            ry = sin * points[i, 0] + cos * points[i, 1]
            distance, gu, gv = _smooth_distance(
                table, field, (pose[0] + rx) / cell + half - 0.5, (pose[1] + ry) / cell + half - 0.5
            )
            if distance >= FAR - 1:
                continue
            distance *= quantum
            jx, jy = gu * quantum / cell, gv * quantum / cell
            jt = jy * rx - jx * ry
            weight = 1.0 / (1.0 + (distance / robust) ** 2) / sigma**2
            hessian[0, 0] += weight * jx * jx
            hessian[0, 1] += weight * jx * jy
            hessian[0, 2] += weight * jx * jt
            hessian[1, 1] += weight * jy * jy
            hessian[1, 2] += weight * jy * jt
            hessian[2, 2] += weight * jt * jt
            gradient[0] += weight * distance * jx
            gradient[1] += weight * distance * jy
            gradient[2] += weight * distance * jt
        hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]
        step = np.linalg.solve(hessian + information, gradient)
        pose -= step
        if abs(step[0]) + abs(step[1]) < 1e-4 and abs(step[2]) < 1e-4:
            break
    return pose, hessian
