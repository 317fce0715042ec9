"""Scan matching against a map of patches: likelihood, correlative search, Gauss-Newton on the distance field.

Poses are ``map_T_base`` (x, y, theta); points are (n, 2) in m in the base frame, surfels (n, 4) points with normals
(``sensing/surfels.py``), which serve wherever points do. The likelihood of a beam is taken
relative to unknown space, so that 0 means "nothing known here", and maps of different extent compare.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.local_map.patches import FAR, PATCH, MapView, field_at, odds_at


class BeamModel(NamedTuple):
    """Log-likelihood ratio of an end point, tabulated over the quantised distance to the nearest surface.

    :ivar in_unknown: shape (256,), nats, where the cell of the end point was never seen.
    :ivar in_known: shape (256,), nats, where it was: far from surfaces the map contradicts the beam.
    """

    in_unknown: Float64
    in_known: Float64


class Prior(NamedTuple):
    """A Gaussian over poses, in map coordinates (x, y, theta).

    :ivar mean: shape (3,).
    :ivar information: shape (3, 3), inverse of the covariance.
    """

    mean: Float64
    information: Float64


class Alignment(NamedTuple):
    """How Gauss-Newton weighs the beams.

    :ivar sigma: deviation of an end point from its surface, m.
    :ivar robust: scale of the Cauchy weight, m.
    :ivar inflation: of how many beams only one tells something of its own; the prior outweighs the others.
    :ivar iterations: steps at most.
    """

    sigma: float
    robust: float
    inflation: float
    iterations: int


def beam_model(radius: float, sigma: float, unknown_range: float, random: float) -> BeamModel:
    """The table of log p(z | map) / p(z | unknown).

    :param radius: truncation of the distance field, m.
    :param sigma: standard deviation of a return around a surface, sigma_hit, m.
    :param unknown_range: scale over which a return is uniform in unknown space, m.
    :param random: share of returns that no surface explains, z_rand, in (0, 1).
    """
    distance = np.arange(256) / FAR * radius
    hit = (1.0 - random) * unknown_range * np.exp(-0.5 * (distance / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    return BeamModel(np.log(hit + 1.0), np.log(hit + random))


@njit(cache=True)
def log_ratio(points: Float64, x: float, y: float, theta: float, view: MapView, model: BeamModel) -> float:
    """Sum over the points of the log-likelihood ratio at the pose (x, y, theta), nats."""
    cos, sin = np.cos(theta) / view.cell, np.sin(theta) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = x / view.cell + half, y / view.cell + half
    total = 0.0
    for i in range(points.shape[0]):
        column = int(u + cos * points[i, 0] - sin * points[i, 1])
        row = int(v + sin * points[i, 0] + cos * points[i, 1])
        distance = field_at(view, column, row)
        if odds_at(view, column, row) == 0:
            total += model.in_unknown[distance]
        else:
            total += model.in_known[distance]
    return total


@njit(cache=True)
def matched_fraction(points: Float64, pose: Float64, view: MapView, near: int) -> float:
    """Share of the points whose quantised distance to a surface is below ``near``."""
    cos, sin = np.cos(pose[2]) / view.cell, np.sin(pose[2]) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    count = 0
    for i in range(points.shape[0]):
        column = int(pose[0] / view.cell + half + cos * points[i, 0] - sin * points[i, 1])
        row = int(pose[1] / view.cell + half + sin * points[i, 0] + cos * points[i, 1])
        if field_at(view, column, row) < near:
            count += 1
    return count / max(1, points.shape[0])


@njit(cache=True)
def log_prior(pose: Float64, prior: Prior) -> float:
    """-1/2 of the squared Mahalanobis distance, without the normaliser."""
    difference = pose - prior.mean
    difference[2] = (difference[2] + np.pi) % (2.0 * np.pi) - np.pi
    return -0.5 * np.dot(difference, prior.information @ difference)


@njit(cache=True)
def evidence(
    points: Float64, mode: Float64, hessian: Float64, prior: Prior, view: MapView, model: BeamModel, temper: float
) -> float:
    """Log of the Laplace integral of prior times tempered likelihood around a mode, relative to unknown space, nats.

    :param hessian: (3, 3) information of the points at the mode.
    """
    ratio = log_ratio(points, mode[0], mode[1], mode[2], view, model)
    occam = np.linalg.det(prior.information) / np.linalg.det(prior.information + temper * hessian)
    return log_prior(mode, prior) + temper * ratio + 0.5 * np.log(occam)


class Lattice(NamedTuple):
    """The poses that a search tries: around a centre, along the axes of the map and in heading.

    :ivar stride: from one pose to the next, cells.
    :ivar turn: from one heading to the next, rad.
    :ivar counts: (3,), int64, steps to each side in x, y and heading.
    """

    stride: int
    turn: float
    counts: Int64


@njit(cache=True)
def correlative_search(
    points: Float64, prior: Prior, lattice: Lattice, view: MapView, model: BeamModel, temper: float, most: int
) -> Float64:
    """The highest peaks of tempered likelihood ratio times prior on a lattice around the prior's mean (Olson 2009).

    :param most: how many peaks at most.
    :returns: (k, 3) poses, the best first; no two are neighbours or neighbours' neighbours on the lattice.
    """
    counts = lattice.counts
    sizes = (2 * counts[0] + 1, 2 * counts[1] + 1, 2 * counts[2] + 1)
    scores = np.empty(sizes)
    pose = np.empty(3)
    for k in range(sizes[2]):
        pose[2] = prior.mean[2] + (k - counts[2]) * lattice.turn
        columns, rows = _cells_at(points, prior.mean[0], prior.mean[1], pose[2], view)
        for i in range(sizes[0]):
            right = (i - counts[0]) * lattice.stride
            pose[0] = prior.mean[0] + right * view.cell
            for j in range(sizes[1]):
                up = (j - counts[1]) * lattice.stride
                pose[1] = prior.mean[1] + up * view.cell
                ratio = _log_ratio_of_cells(columns, rows, right, up, view, model)
                scores[i, j, k] = log_prior(pose, prior) + temper * ratio
    return _peaks(scores, prior.mean, lattice, view.cell, most)


@njit(cache=True)
def _cells_at(points: Float64, x: float, y: float, theta: float, view: MapView) -> tuple[Int64, Int64]:
    """Columns and rows of the points at the pose (x, y, theta), each (n,)."""
    cos, sin = np.cos(theta) / view.cell, np.sin(theta) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    columns, rows = np.empty(points.shape[0], dtype=np.int64), np.empty(points.shape[0], dtype=np.int64)
    for n in range(points.shape[0]):
        columns[n] = int(x / view.cell + half + cos * points[n, 0] - sin * points[n, 1])
        rows[n] = int(y / view.cell + half + sin * points[n, 0] + cos * points[n, 1])
    return columns, rows


@njit(cache=True)
def _log_ratio_of_cells(
    columns: Int64, rows: Int64, right: int, up: int, view: MapView, model: BeamModel
) -> float:
    """Sum of the log-likelihood ratios of end points in these cells, all shifted, nats."""
    total = 0.0
    for n in range(columns.size):
        distance = field_at(view, columns[n] + right, rows[n] + up)
        if odds_at(view, columns[n] + right, rows[n] + up) == 0:
            total += model.in_unknown[distance]
        else:
            total += model.in_known[distance]
    return total


@njit(cache=True)
def _peaks(scores: Float64, centre: Float64, lattice: Lattice, cell: float, most: int) -> Float64:
    """The poses (k, 3) of the highest scores, each at least three steps from those before it; empties ``scores``."""
    found = np.empty((most, 3))
    counts = lattice.counts
    step = np.array([lattice.stride * cell, lattice.stride * cell, lattice.turn])
    for n in range(most):
        best = np.argmax(scores)
        i, rest = divmod(best, scores.shape[1] * scores.shape[2])
        j, k = divmod(rest, scores.shape[2])
        if scores[i, j, k] == -np.inf:
            return found[:n]
        found[n] = centre + step * (np.array([i, j, k]) - counts)
        scores[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3, max(0, k - 2) : k + 3] = -np.inf
    return found


@njit(cache=True)
def _smooth_distance(view: MapView, u: float, v: float) -> tuple[float, float, float]:
    """Bilinear distance and its gradient per cell at the continuous cell coordinates (u, v), in quanta."""
    column, row = int(np.floor(u)), int(np.floor(v))
    fu, fv = u - column, v - row
    d00 = float(field_at(view, column, row))
    d10 = float(field_at(view, column + 1, row))
    d01 = float(field_at(view, column, row + 1))
    d11 = float(field_at(view, column + 1, row + 1))
    low, high = d00 + fu * (d10 - d00), d01 + fu * (d11 - d01)
    gradient_u = (1.0 - fv) * (d10 - d00) + fv * (d11 - d01)
    return low + fv * (high - low), gradient_u, high - low


@njit(cache=True)
def linearise(
    points: Float64, pose: Float64, view: MapView, settings: Alignment
) -> tuple[Float64, Float64, float]:
    """Normal equations of the surfels (n, 4) at a pose: J' W J (3, 3) and J' W r (3,); and r' W r.

    Distance and gradient of a point on a surface count by what they have in the direction of its normal.
    """
    hessian, gradient, square, row = np.zeros((3, 3)), np.zeros(3), 0.0, np.empty(3)
    half = 0.5 * view.table.shape[0] * PATCH - 0.5
    quantum = view.radius / FAR
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    for n in range(points.shape[0]):
        rx = cos * points[n, 0] - sin * points[n, 1]
        ry = sin * points[n, 0] + cos * points[n, 1]
        distance, gu, gv = _smooth_distance(
            view, (pose[0] + rx) / view.cell + half, (pose[1] + ry) / view.cell + half
        )
        if distance >= FAR - 1:
            continue
        distance *= quantum
        row[0], row[1] = gu * quantum / view.cell, gv * quantum / view.cell
        weight = 1.0 / ((1.0 + (distance / settings.robust) ** 2) * settings.sigma**2)
        if points[n, 2] != 0.0 or points[n, 3] != 0.0:
            normal_x, normal_y = cos * points[n, 2] - sin * points[n, 3], sin * points[n, 2] + cos * points[n, 3]
            across = row[0] * normal_x + row[1] * normal_y
            row[0], row[1] = across * normal_x, across * normal_y
            distance *= abs(across)
        row[2] = row[1] * rx - row[0] * ry
        square += weight * distance * distance
        for i in range(3):
            gradient[i] += weight * distance * row[i]
            for j in range(3):
                hessian[i, j] += weight * row[i] * row[j]
    return hessian, gradient, square


@njit(cache=True)
def align(
    points: Float64, start: Float64, prior: Prior, view: MapView, settings: Alignment
) -> tuple[Float64, Float64]:
    """Gauss-Newton on the distance field with a Gaussian prior.

    Minimises sum rho(d(T p)^2) / (inflation sigma^2) + (T - prior)' information (T - prior), rho being Cauchy's.

    :param points: surfels (n, 4).
    :param start: (3,) pose to start from.
    :returns: the mode (3,), and the information (3, 3) of the points alone, map coordinates.
    """
    if points.shape[1] != 4:
        raise ValueError("points are aligned with their normals: give surfels (n, 4)")
    pose = start.copy()
    hessian = np.zeros((3, 3))
    held = settings.inflation * prior.information
    for _ in range(settings.iterations):
        hessian, gradient, _ = linearise(points, pose, view, settings)
        difference = pose - prior.mean
        difference[2] = (difference[2] + np.pi) % (2.0 * np.pi) - np.pi
        step = np.linalg.solve(hessian + held, gradient + held @ difference)
        pose -= step
        if abs(step[0]) + abs(step[1]) < 1e-4 and abs(step[2]) < 1e-4:
            break
    return pose, hessian
