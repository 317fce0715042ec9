"""Rigid motions of the plane as arrays (..., 3) of (x, y, theta), metres and radians.

``a_T_b`` is the pose of frame b in frame a: ``compose(a_T_b, b_T_c)`` is ``a_T_c``. All functions broadcast over
leading dimensions and return theta in [-pi, pi).

A single pose takes a way of its own through plain floats, ten times as fast as through arrays of three.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import ArrayLike, NDArray

from hmt_slam_ros.geometry import se2_kernels

Pose = NDArray[np.float64]

_SMALL_ANGLE = 1e-5


def wrap(angle: ArrayLike) -> NDArray[np.float64]:
    """``angle`` brought into [-pi, pi)."""
    angle = np.asarray(angle, dtype=np.float64)
    if not angle.ndim:
        return np.array(se2_kernels.wrap(angle.item()))
    inside = (angle >= -np.pi) & (angle < np.pi)
    if inside.all():
        return angle.copy()
    # An angle inside the interval keeps its bits: 2 pi is not a double, so the modulus is not exact.
    wrapped = (angle + np.pi) % (2.0 * np.pi) - np.pi
    # Just below -pi the modulus rounds up to 2 pi itself.
    return np.where(inside, angle, np.where(wrapped < np.pi, wrapped, -np.pi))


def compose(a_T_b: ArrayLike, b_T_c: ArrayLike) -> Pose:
    """``a_T_c``: the second motion carried out in the frame that the first leads to."""
    a, b = np.asarray(a_T_b, dtype=np.float64), np.asarray(b_T_c, dtype=np.float64)
    if a.ndim == b.ndim == 1:
        return _compose_one(a.tolist(), b.tolist())
    if a.ndim == 2 and b.ndim == 1:
        return _compose_each(a, b)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    y = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return _stacked(x, y, wrap(a[..., 2] + b[..., 2]))


def _stacked(*parts: NDArray[np.float64]) -> NDArray[np.float64]:
    """``np.stack`` along a new last axis, in a third of its time."""
    stacked = np.empty((*parts[0].shape, len(parts)))
    for k, part in enumerate(parts):
        stacked[..., k] = part
    return stacked


@njit(cache=True)
def _compose_each(a: Pose, b: Pose) -> Pose:
    found = np.empty((a.shape[0], 3))
    for n in range(a.shape[0]):
        cos, sin = np.cos(a[n, 2]), np.sin(a[n, 2])
        found[n, 0], found[n, 1] = se2_kernels.transform(a[n, 0], a[n, 1], cos, sin, b[0], b[1])
        found[n, 2] = se2_kernels.wrap(a[n, 2] + b[2])
    return found


def _compose_one(a: list[float], b: list[float]) -> Pose:
    cos, sin = math.cos(a[2]), math.sin(a[2])
    x = a[0] + cos * b[0] - sin * b[1]
    y = a[1] + sin * b[0] + cos * b[1]
    return np.array((x, y, se2_kernels.wrap(a[2] + b[2])))


def inverse(a_T_b: ArrayLike) -> Pose:
    """``b_T_a``."""
    a = np.asarray(a_T_b, dtype=np.float64)
    if a.ndim == 1:
        return _inverse_one(a.tolist())
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -cos * a[..., 0] - sin * a[..., 1]
    y = sin * a[..., 0] - cos * a[..., 1]
    return _stacked(x, y, wrap(-a[..., 2]))


def _inverse_one(a: list[float]) -> Pose:
    cos, sin = math.cos(a[2]), math.sin(a[2])
    return np.array((-cos * a[0] - sin * a[1], sin * a[0] - cos * a[1], se2_kernels.wrap(-a[2])))


def between(c_T_a: ArrayLike, c_T_b: ArrayLike) -> Pose:
    """``a_T_b``, from the poses of a and b in a common frame."""
    a, b = np.asarray(c_T_a, dtype=np.float64), np.asarray(c_T_b, dtype=np.float64)
    if a.ndim == b.ndim == 1:
        return _between_one(a.tolist(), b.tolist())
    return compose(inverse(a), b)


def _between_one(a: list[float], b: list[float]) -> Pose:
    cos, sin = math.cos(a[2]), math.sin(a[2])
    x, y = b[0] - a[0], b[1] - a[1]
    return np.array((cos * x + sin * y, cos * y - sin * x, se2_kernels.wrap(b[2] - a[2])))


def transform(a_T_b: ArrayLike, points: ArrayLike) -> NDArray[np.float64]:
    """Points (n, 2) of frame b in frame a, for one pose (3,), or one for each point (n, 3)."""
    a, p = np.asarray(a_T_b, dtype=np.float64), np.asarray(points, dtype=np.float64)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * p[..., 0] - sin * p[..., 1]
    y = a[..., 1] + sin * p[..., 0] + cos * p[..., 1]
    return _stacked(x, y)


def exp(xi: ArrayLike) -> Pose:
    """The motion of the twist (..., 3) of (v_x, v_y, omega) over unit time."""
    xi = np.asarray(xi, dtype=np.float64)
    if xi.ndim == 1:
        return _exp_one(*xi.tolist())
    omega = xi[..., 2]
    small = np.abs(omega) < _SMALL_ANGLE
    safe = np.where(small, 1.0, omega)
    a = np.where(small, 1.0 - omega**2 / 6.0, np.sin(safe) / safe)
    # 1 - cos(omega) would cancel; 2 sin^2(omega / 2) does not.
    b = np.where(small, omega / 2.0, 2.0 * np.sin(0.5 * safe) ** 2 / safe)
    x = a * xi[..., 0] - b * xi[..., 1]
    y = b * xi[..., 0] + a * xi[..., 1]
    return _stacked(x, y, wrap(omega))


def _exp_one(x: float, y: float, omega: float) -> Pose:
    return np.array((*exp_shift(x, y, omega), se2_kernels.wrap(omega)))


@register_jitable
def exp_shift(x: float, y: float, omega: float) -> tuple[float, float]:
    """The translation of :func:`exp`, for kernels."""
    if abs(omega) < _SMALL_ANGLE:
        a, b = 1.0 - omega**2 / 6.0, 0.5 * omega
    else:
        a, b = math.sin(omega) / omega, 2.0 * math.sin(0.5 * omega) ** 2 / omega
    return a * x - b * y, b * x + a * y


def log(pose: ArrayLike) -> NDArray[np.float64]:
    """The twist (..., 3) with ``exp(twist) == pose`` and |omega| <= pi."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.ndim == 1:
        return _log_one(*pose.tolist())
    omega = wrap(pose[..., 2])
    small = np.abs(omega) < _SMALL_ANGLE
    safe = np.where(small, 1.0, omega)
    half_cot = np.where(small, 1.0 - omega**2 / 12.0, 0.5 * safe / np.tan(0.5 * safe))
    x = half_cot * pose[..., 0] + 0.5 * omega * pose[..., 1]
    y = -0.5 * omega * pose[..., 0] + half_cot * pose[..., 1]
    return _stacked(x, y, omega)


def _log_one(x: float, y: float, angle: float) -> NDArray[np.float64]:
    omega = se2_kernels.wrap(angle)
    half = 0.5 * omega
    half_cot = 1.0 - omega**2 / 12.0 if abs(omega) < _SMALL_ANGLE else half / math.tan(half)
    return np.array((half_cot * x + half * y, -half * x + half_cot * y, omega))


def adjoint(pose: ArrayLike) -> NDArray[np.float64]:
    """Ad_T, shape (..., 3, 3), with ``T exp(xi) = exp(Ad_T xi) T``."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.ndim == 1:
        return _adjoint_one(pose.tolist())
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    ad = np.zeros((*pose.shape[:-1], 3, 3))
    ad[..., 0, 0], ad[..., 0, 1], ad[..., 0, 2] = cos, -sin, pose[..., 1]
    ad[..., 1, 0], ad[..., 1, 1], ad[..., 1, 2] = sin, cos, -pose[..., 0]
    ad[..., 2, 2] = 1.0
    return ad


def _adjoint_one(pose: list[float]) -> NDArray[np.float64]:
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array(((cos, -sin, pose[1]), (sin, cos, -pose[0]), (0.0, 0.0, 1.0)))


def right_jacobian_inverse(xi: ArrayLike) -> NDArray[np.float64]:
    """J, shape (..., 3, 3), with ``log(exp(xi) exp(delta)) = xi + J delta`` to first order in delta."""
    xi = np.asarray(xi, dtype=np.float64)
    omega = xi[..., 2]
    ad = np.zeros((*xi.shape[:-1], 3, 3))
    ad[..., 0, 1], ad[..., 0, 2] = -omega, xi[..., 1]
    ad[..., 1, 0], ad[..., 1, 2] = omega, -xi[..., 0]
    small = np.abs(omega) < 1e-2
    safe = np.where(small, 1.0, omega)
    series = 1.0 / 12.0 + omega**2 / 720.0 + omega**4 / 30240.0
    quadratic = np.where(small, series, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    # The Bernoulli series of ad ends after the square, since ad^3 = -omega^2 ad.
    return np.eye(3) + 0.5 * ad + quadratic[..., None, None] * (ad @ ad)


def best_fit(a: ArrayLike, b: ArrayLike) -> Pose:
    """The motion T, shape (3,), by which ``compose(T, a)`` comes nearest to ``b``, both (n, 3) with n >= 1.

    Least squares over the positions, with a radian of heading counted as a metre.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    (ax, ay), (bx, by) = (a[:, :2] - a[:, :2].mean(axis=0)).T, (b[:, :2] - b[:, :2].mean(axis=0)).T
    turned = b[:, 2] - a[:, 2]
    angle = np.arctan2((ax * by - ay * bx + np.sin(turned)).sum(), (ax * bx + ay * by + np.cos(turned)).sum())
    rotated = transform(np.array([0.0, 0.0, angle]), a[:, :2].mean(axis=0))
    return np.array([*(b[:, :2].mean(axis=0) - rotated), float(wrap(angle))])


def interpolate(start: ArrayLike, end: ArrayLike, fraction: ArrayLike) -> Pose:
    """The pose at ``fraction`` of the way from ``start`` to ``end`` along a constant twist."""
    return compose(start, exp(np.asarray(fraction)[..., None] * log(between(start, end))))
