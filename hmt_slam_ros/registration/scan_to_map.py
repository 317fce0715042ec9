"""Scan to map: likelihood, Gauss-Newton on the distance field, and a search where the prior is wide.

Poses are ``map_T_base`` (x, y, theta); points are (n, 2) in m in the base frame, surfels (n, 4) points with normals
(``sensors/scan.py``), which serve wherever points do. The likelihood of a beam is relative to unknown space: 0 means
"nothing known here", and maps of different extent compare.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.gaussian import (
    Symmetric,
    Vector,
    add_scaled,
    determinant,
    dot,
    multiply,
    solve,
    symmetric_from_array,
    symmetric_inverse,
    write_to_array,
)
from hmt_slam_ros.geometry.se2 import rotate, transform_point, wrap_by_modulus
from hmt_slam_ros.grids.patches import FAR, PATCH, GridView, field_at, field_at_four, odds_at

_UNKNOWN_DISTANCE = 0.6
"""Distance from a surface that a point in unknown space has in the misfit, as a share of the robust scale."""

_MARGIN = 3
"""Distance in which cells on every side of a point have to be free, so that the point is in free space, cells."""


class BeamModel(NamedTuple):
    """Log-likelihood ratio of an end point, tabulated over the quantized distance to the nearest surface.

    :ivar in_unknown: shape (256,), nats, in cells never seen.
    :ivar in_known: shape (256,), nats, in all other cells: far from surfaces the map contradicts the beam.
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


class AlignmentSettings(NamedTuple):
    """The weights of beams in Gauss-Newton.

    :ivar sigma: deviation of an end point from its surface, m.
    :ivar robust_scale: scale of the Cauchy weight, m.
    :ivar inflation: number of correlated beams that count as one.
    :ivar iterations: steps at most.
    """

    sigma: float
    robust_scale: float
    inflation: float
    iterations: int


def make_beam_model(radius: float, sigma: float, unknown_range: float, random: float) -> BeamModel:
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
def log_ratio(points: Float64, x: float, y: float, theta: float, view: GridView, model: BeamModel) -> float:
    """Sum over the points of the log-likelihood ratio at the pose (x, y, theta), nats."""
    cos, sin = np.cos(theta) / view.cell, np.sin(theta) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = x / view.cell + half, y / view.cell + half
    total = 0.0
    for i in range(points.shape[0]):
        at_u, at_v = transform_point(u, v, cos, sin, points[i, 0], points[i, 1])
        column, row = int(at_u), int(at_v)
        distance = field_at(view, column, row)
        if odds_at(view, column, row) == 0:
            total += model.in_unknown[distance]
        else:
            total += model.in_known[distance]
    return total


@njit(cache=True)
def matched_fraction(points: Float64, pose: Float64, view: GridView, near: int) -> float:
    """Share of the points whose quantized distance to a surface is below ``near``."""
    cos, sin = np.cos(pose[2]) / view.cell, np.sin(pose[2]) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = pose[0] / view.cell + half, pose[1] / view.cell + half
    count = 0
    for i in range(points.shape[0]):
        at_u, at_v = transform_point(u, v, cos, sin, points[i, 0], points[i, 1])
        if field_at(view, int(at_u), int(at_v)) < near:
            count += 1
    return count / max(1, points.shape[0])


@njit(cache=True)
def count_agreement(points: Float64, pose: Float64, view: GridView, near: int, far: int) -> tuple[int, int]:
    """The number of points on known surfaces, and of those in known free space.

    :param near: quantized distance to a surface below which a point is on it; ``far``: from which it is not.
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    half = 0.5 * view.table.shape[0] * PATCH
    on, free = 0, 0
    for i in range(points.shape[0]):
        x, y = transform_point(pose[0], pose[1], cos, sin, points[i, 0], points[i, 1])
        column, row = int(x / view.cell + half), int(y / view.cell + half)
        distance = field_at(view, column, row)
        on += distance < near
        free += distance >= far and odds_at(view, column, row) < 0 and _is_surrounded_by_free(view, column, row)
    return on, free


@njit(cache=True)
def _is_surrounded_by_free(view: GridView, column: int, row: int) -> bool:
    """Whether it is free on all sides: at the edge of free space there may be a wall that a beam grazed."""
    across = max(odds_at(view, column - _MARGIN, row), odds_at(view, column + _MARGIN, row))
    return bool(max(across, odds_at(view, column, row - _MARGIN), odds_at(view, column, row + _MARGIN)) < 0)


@njit(cache=True)
def log_prior(pose: Float64, prior: Prior) -> float:
    """-1/2 of the squared Mahalanobis distance, without the normalizer."""
    difference = pose_difference(pose[0], pose[1], pose[2], prior.mean)
    return -0.5 * dot(difference, multiply(symmetric_from_array(prior.information), difference))


@njit(cache=True)
def pose_difference(x: float, y: float, theta: float, other: Float64) -> Vector:
    """The pose (x, y, theta) less another (3,), number by number, m and rad."""
    return x - other[0], y - other[1], wrap_by_modulus(theta - other[2])


@njit(cache=True)
def laplace_log_evidence(
    points: Float64, mode: Float64, hessian: Float64, prior: Prior, view: GridView, model: BeamModel, temper: float
) -> float:
    """Log of the Laplace integral of prior times tempered likelihood around a mode, relative to unknown space, nats.

    :param hessian: (3, 3) information of the points at the mode.
    """
    ratio = log_ratio(points, mode[0], mode[1], mode[2], view, model)
    known = symmetric_from_array(prior.information)
    occam = determinant(known) / determinant(add_scaled(known, symmetric_from_array(hessian), temper))
    return log_prior(mode, prior) + temper * ratio + 0.5 * np.log(occam)


@njit(cache=True)
def _smooth_distance(view: GridView, u: float, v: float) -> tuple[float, float, float]:
    """Bilinear distance and its gradient per cell at the continuous cell coordinates (u, v), in quanta."""
    column, row = int(np.floor(u)), int(np.floor(v))
    fu, fv = u - column, v - row
    four = field_at_four(view, column, row)
    d00, d10, d01, d11 = float(four[0]), float(four[1]), float(four[2]), float(four[3])
    low, high = d00 + fu * (d10 - d00), d01 + fu * (d11 - d01)
    gradient_u = (1.0 - fv) * (d10 - d00) + fv * (d11 - d01)
    return low + fv * (high - low), gradient_u, high - low


@njit(cache=True)
def linearize(
    points: Float64, x: float, y: float, theta: float, view: GridView, settings: AlignmentSettings
) -> tuple[Symmetric, Vector, float]:
    """Normal equations of the surfels (n, 4) at the pose (x, y, theta): J' W J and J' W r; and r' W r.

    Of the distance and gradient of a point with a normal, the component along the normal counts.
    """
    half = 0.5 * view.table.shape[0] * PATCH - 0.5
    quantum = view.radius / FAR
    cos, sin = np.cos(theta), np.sin(theta)
    # Sums in variables of their own stay in registers.
    xx = xy = xt = yy = yt = tt = gx = gy = gt = square = 0.0
    for n in range(points.shape[0]):
        rx, ry = rotate(cos, sin, points[n, 0], points[n, 1])
        distance, gu, gv = _smooth_distance(view, (x + rx) / view.cell + half, (y + ry) / view.cell + half)
        if distance >= FAR - 1:
            continue
        distance *= quantum
        jx, jy = gu * quantum / view.cell, gv * quantum / view.cell
        weight = 1.0 / ((1.0 + (distance / settings.robust_scale) ** 2) * settings.sigma**2)
        if points[n, 2] != 0.0 or points[n, 3] != 0.0:
            normal_x, normal_y = rotate(cos, sin, points[n, 2], points[n, 3])
            across = jx * normal_x + jy * normal_y
            jx, jy = across * normal_x, across * normal_y
            distance *= abs(across)
        jt = jy * rx - jx * ry
        wx, wy, wt, error = weight * jx, weight * jy, weight * jt, weight * distance
        xx += wx * jx
        xy += wx * jy
        xt += wx * jt
        yy += wy * jy
        yt += wy * jt
        tt += wt * jt
        gx += error * jx
        gy += error * jy
        gt += error * jt
        square += error * distance
    return Symmetric(xx, xy, xt, yy, yt, tt), (gx, gy, gt), square


@njit(cache=True)
def misfit(points: Float64, pose: Float64, prior: Prior, view: GridView, settings: AlignmentSettings) -> float:
    """The cost that :func:`align` minimizes, at a pose, nats, but with distances in any direction.

    A point in unknown space has ``_UNKNOWN_DISTANCE``: with more, new space ahead would pull the robot back, with less,
    nothing would keep it in the map.

    :param points: (n, 2) or surfels (n, 4).
    """
    half = 0.5 * view.table.shape[0] * PATCH - 0.5
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    quantum, unseen, cost = view.radius / FAR, _UNKNOWN_DISTANCE * settings.robust_scale, 0.0
    for n in range(points.shape[0]):
        x, y = transform_point(pose[0], pose[1], cos, sin, points[n, 0], points[n, 1])
        u, v = x / view.cell + half, y / view.cell + half
        distance, _, _ = _smooth_distance(view, u, v)
        distance *= quantum
        if distance > unseen and odds_at(view, int(u + 0.5), int(v + 0.5)) == 0:
            distance = unseen
        cost += np.log(1.0 + (distance / settings.robust_scale) ** 2)
    return 0.5 * settings.robust_scale**2 / (settings.inflation * settings.sigma**2) * cost - log_prior(pose, prior)


@njit(cache=True)
def align(
    points: Float64, start: Float64, prior: Prior, view: GridView, settings: AlignmentSettings
) -> tuple[Float64, Float64]:
    """Gauss-Newton on the distance field with a Gaussian prior.

    Minimizes sum rho(d(T p)^2) / (inflation sigma^2) + (T - prior)' information (T - prior), rho being Cauchy's.

    :param points: surfels (n, 4).
    :param start: (3,) pose to start from.
    :returns: the mode (3,), and the information (3, 3) of the points alone, map coordinates.
    """
    mode, hessian = np.empty(3), np.empty((3, 3))
    align_into(points, start, prior, view, settings, mode, hessian)
    return mode, hessian


@njit(cache=True)
def align_into(
    points: Float64,
    start: Float64,
    prior: Prior,
    view: GridView,
    settings: AlignmentSettings,
    mode: Float64,
    hessian: Float64,
) -> None:
    """:func:`align` with its results written into ``mode`` and ``hessian``."""
    if points.shape[1] != 4:
        raise ValueError("points are aligned with their normals: pass surfels (n, 4)")
    x, y, theta = start[0], start[1], start[2]
    known, information = symmetric_from_array(prior.information), Symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for _ in range(settings.iterations):
        information, gradient, _ = linearize(points, x, y, theta, view, settings)
        by_prior = multiply(known, pose_difference(x, y, theta, prior.mean))
        total = (
            gradient[0] + settings.inflation * by_prior[0],
            gradient[1] + settings.inflation * by_prior[1],
            gradient[2] + settings.inflation * by_prior[2],
        )
        step = solve(add_scaled(information, known, settings.inflation), total)
        x, y, theta = x - step[0], y - step[1], theta - step[2]
        if abs(step[0]) + abs(step[1]) < 1e-4 and abs(step[2]) < 1e-4:
            break
    mode[0], mode[1], mode[2] = x, y, theta
    write_to_array(information, hessian)


class Proposals(NamedTuple):
    """The optimal proposals of m particles, in map coordinates.

    :ivar modes: shape (m, 3).
    :ivar hessians: information of the points at the modes, shape (m, 3, 3).
    :ivar covariances: shape (m, 3, 3).
    :ivar evidences: log p(z | x_{t-1}, u), shape (m,), nats.
    """

    modes: Float64
    hessians: Float64
    covariances: Float64
    evidences: Float64


@njit(cache=True)
def propose_all(
    points: Float64,
    static_points: Float64,
    starts: Float64,
    priors: Float64,
    information: Float64,
    tables: Int32,
    view: GridView,
    settings: AlignmentSettings,
    model: BeamModel,
    sharpness: float,
    temper: float,
) -> Proposals:
    """The optimal proposal of every particle, p(x_t | x_{t-1}, u, z, map), as a Gaussian around its mode.

    Its covariance is that of Gauss-Newton, in which each beam informs the pose along its normal. The likelihood would
    not do: along a corridor it varies with the cells of the map, not with the pose.

    :param points: surfels (n, 4) for the evidence.
    :param static_points: surfels (k, 4) among them for the match.
    :param starts: (m, 3) poses to start matching from; ``priors``: (m, 3) poses that odometry predicts.
    :param tables: (m, T, T), the particles' maps; ``view`` is any view of the same pool.
    :param sharpness: exponent on the likelihood in the proposal.
    :param temper: exponent on the likelihood in the evidence.
    """
    m = starts.shape[0]
    modes, hessians = np.empty((m, 3)), np.empty((m, 3, 3))
    covariances, evidences = np.empty((m, 3, 3)), np.empty(m)
    known = symmetric_from_array(information)
    for i in range(m):
        own = GridView(tables[i], view.odds, view.field, view.cell, view.radius)
        prior = Prior(priors[i], information)
        align_into(static_points, starts[i], prior, own, settings, modes[i], hessians[i])
        write_to_array(
            symmetric_inverse(add_scaled(known, symmetric_from_array(hessians[i]), sharpness)), covariances[i]
        )
    # In a separate loop: with two arrays of points in one loop, the compiled alignment is half as fast.
    for i in range(m):
        own = GridView(tables[i], view.odds, view.field, view.cell, view.radius)
        prior = Prior(priors[i], information)
        evidences[i] = laplace_log_evidence(points, modes[i], hessians[i], prior, own, model, temper)
    return Proposals(modes, hessians, covariances, evidences)


class Lattice(NamedTuple):
    """The poses of a search: around a center, along the axes of the map and in heading.

    :ivar stride: from one pose to the next, cells.
    :ivar turn: from one heading to the next, rad.
    :ivar counts: (3,), int64, steps to each side in x, y and heading.
    """

    stride: int
    turn: float
    counts: Int64


@njit(cache=True)
def correlative_search(
    points: Float64, prior: Prior, lattice: Lattice, view: GridView, model: BeamModel, temper: float, most: int
) -> Float64:
    """The highest peaks of tempered likelihood ratio times prior on a lattice around the prior's mean (Olson 2009).

    :param most: how many peaks at most.
    :returns: (k, 3) poses, the best first, at least three steps of the lattice apart.
    """
    counts = lattice.counts
    sizes = (2 * counts[0] + 1, 2 * counts[1] + 1, 2 * counts[2] + 1)
    scores, pose = np.empty(sizes), np.empty(3)
    columns, rows = np.empty(points.shape[0], dtype=np.int64), np.empty(points.shape[0], dtype=np.int64)
    for k in range(sizes[2]):
        pose[2] = prior.mean[2] + (k - counts[2]) * lattice.turn
        _find_cells(points, prior.mean[0], prior.mean[1], pose[2], view, columns, rows)
        for i in range(sizes[0]):
            right = (i - counts[0]) * lattice.stride
            pose[0] = prior.mean[0] + right * view.cell
            for j in range(sizes[1]):
                up = (j - counts[1]) * lattice.stride
                pose[1] = prior.mean[1] + up * view.cell
                ratio = _log_ratio_of_cells(columns, rows, right, up, view, model)
                scores[i, j, k] = log_prior(pose, prior) + temper * ratio
    return _extract_peaks(scores, prior.mean, lattice, view.cell, most)


@njit(cache=True)
def _find_cells(points: Float64, x: float, y: float, theta: float, view: GridView, columns: Int64, rows: Int64) -> None:
    """Write the columns and rows, each (n,), of the points at the pose (x, y, theta)."""
    cos, sin = np.cos(theta) / view.cell, np.sin(theta) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = x / view.cell + half, y / view.cell + half
    for n in range(points.shape[0]):
        at_u, at_v = transform_point(u, v, cos, sin, points[n, 0], points[n, 1])
        columns[n], rows[n] = int(at_u), int(at_v)


@njit(cache=True)
def _log_ratio_of_cells(columns: Int64, rows: Int64, right: int, up: int, view: GridView, model: BeamModel) -> float:
    """Sum of the log-likelihood ratios of end points in cells that are all shifted alike, nats."""
    total = 0.0
    for n in range(columns.size):
        distance = field_at(view, columns[n] + right, rows[n] + up)
        if odds_at(view, columns[n] + right, rows[n] + up) == 0:
            total += model.in_unknown[distance]
        else:
            total += model.in_known[distance]
    return total


@njit(cache=True)
def _extract_peaks(scores: Float64, center: Float64, lattice: Lattice, cell: float, most: int) -> Float64:
    """The poses (k, 3) of the highest scores, at least three steps apart; overwrites ``scores``."""
    peaks = np.empty((most, 3))
    counts, apart = lattice.counts, lattice.stride * cell
    for n in range(most):
        best = np.argmax(scores)
        i, rest = divmod(best, scores.shape[1] * scores.shape[2])
        j, k = divmod(rest, scores.shape[2])
        if scores[i, j, k] == -np.inf:
            return peaks[:n]
        peaks[n, 0] = center[0] + apart * (i - counts[0])
        peaks[n, 1] = center[1] + apart * (j - counts[1])
        peaks[n, 2] = center[2] + lattice.turn * (k - counts[2])
        scores[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3, max(0, k - 2) : k + 3] = -np.inf
    return peaks
