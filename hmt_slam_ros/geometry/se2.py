"""Rigid motions of the plane as arrays (..., 3) of (x, y, theta), meters and radians.

``a_T_b`` is the pose of frame b in frame a: ``compose(a_T_b, b_T_c)`` is ``a_T_c``. All functions broadcast over
leading dimensions and return theta in [-pi, pi).

Single poses are computed with plain floats, ten times as fast as with arrays of three.
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import ArrayLike

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.compilation import njit

_SMALL_ANGLE = 1e-5
"""Angle below which series replace quotients by the angle, rad."""

# Kernels on single numbers. A frame is given by its position (x, y) and the cosine and sine of its angle, which are
# computed once for many points. Both may be divided by the edge of a cell: positions and results are then in cells,
# points in meters. Each function is inlined, and the order of its operations is fixed: results are the same, bit for
# bit, at every place. The three ways to wrap an angle differ in the last bits, on which recorded results depend.


@njit(cache=True, inline="always")
def transform_point(x: float, y: float, cos: float, sin: float, px: float, py: float) -> tuple[float, float]:
    """A point (px, py) of a frame at (x, y), in the frame in which that pose is given."""
    return x + cos * px - sin * py, y + sin * px + cos * py


@njit(cache=True, inline="always")
def rotate(cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """A vector of a turned frame, in the frame in which its angle is given."""
    return cos * x - sin * y, sin * x + cos * y


@njit(cache=True, inline="always")
def rotate_back(cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """A vector in a turned frame: the inverse of :func:`rotate`.

    For the normal (cos, sin) of a line it is the distance across the line, and that along it.
    """
    return cos * x + sin * y, cos * y - sin * x


@njit(cache=True, inline="always")
def inverse_position(cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """The position of the inverse of a pose at (x, y)."""
    return -cos * x - sin * y, sin * x - cos * y


@register_jitable
def wrap_angle(angle: float) -> float:
    """The angle in [-pi, pi), rad; an angle inside the interval keeps its bits."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    # Just below -pi the modulus rounds up to 2 pi itself.
    return wrapped if wrapped < math.pi else -math.pi


@njit(cache=True, inline="always")
def wrap_by_modulus(angle: float) -> float:
    """The angle in [-pi, pi], rad, without a branch; every angle is rounded in its last bits."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True, inline="always")
def wrap_by_turns(angle: float) -> float:
    """The angle in [-pi, pi], rad, less whole turns; an angle inside the interval keeps its bits."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


def wrap(angle: ArrayLike) -> Float64:
    """The angles in [-pi, pi), rad, of the shape of ``angle``."""
    angle = np.asarray(angle, dtype=np.float64)
    if not angle.ndim:
        return np.array(wrap_angle(angle.item()))
    inside = (angle >= -np.pi) & (angle < np.pi)
    if inside.all():
        return angle.copy()
    # An angle inside the interval keeps its bits: 2 pi is not a double, so the modulus is not exact.
    wrapped = (angle + np.pi) % (2.0 * np.pi) - np.pi
    return np.where(inside, angle, np.where(wrapped < np.pi, wrapped, -np.pi))


def compose(a_T_b: ArrayLike, b_T_c: ArrayLike) -> Float64:
    """``a_T_c``, from ``a_T_b`` and ``b_T_c``."""
    a, b = np.asarray(a_T_b, dtype=np.float64), np.asarray(b_T_c, dtype=np.float64)
    if a.ndim == b.ndim == 1:
        return _compose_single(a.tolist(), b.tolist())
    if a.ndim == 2 and b.ndim == 1:
        return _compose_each(a, b)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * b[..., 0] - sin * b[..., 1]
    y = a[..., 1] + sin * b[..., 0] + cos * b[..., 1]
    return _stack(x, y, wrap(a[..., 2] + b[..., 2]))


def _stack(*parts: Float64) -> Float64:
    """``np.stack`` along a new last axis, in a third of its time."""
    result = np.empty((*parts[0].shape, len(parts)))
    for k, part in enumerate(parts):
        result[..., k] = part
    return result


@njit(cache=True)
def _compose_each(a: Float64, b: Float64) -> Float64:
    poses = np.empty((a.shape[0], 3))
    for n in range(a.shape[0]):
        cos, sin = np.cos(a[n, 2]), np.sin(a[n, 2])
        poses[n, 0], poses[n, 1] = transform_point(a[n, 0], a[n, 1], cos, sin, b[0], b[1])
        poses[n, 2] = wrap_angle(a[n, 2] + b[2])
    return poses


def _compose_single(a: list[float], b: list[float]) -> Float64:
    cos, sin = math.cos(a[2]), math.sin(a[2])
    x = a[0] + cos * b[0] - sin * b[1]
    y = a[1] + sin * b[0] + cos * b[1]
    return np.array((x, y, wrap_angle(a[2] + b[2])))


def inverse(a_T_b: ArrayLike) -> Float64:
    """``b_T_a``."""
    a = np.asarray(a_T_b, dtype=np.float64)
    if a.ndim == 1:
        return _inverse_single(a.tolist())
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -cos * a[..., 0] - sin * a[..., 1]
    y = sin * a[..., 0] - cos * a[..., 1]
    return _stack(x, y, wrap(-a[..., 2]))


def _inverse_single(a: list[float]) -> Float64:
    cos, sin = math.cos(a[2]), math.sin(a[2])
    return np.array((-cos * a[0] - sin * a[1], sin * a[0] - cos * a[1], wrap_angle(-a[2])))


def between(c_T_a: ArrayLike, c_T_b: ArrayLike) -> Float64:
    """``a_T_b``, from the poses of a and b in a common frame."""
    a, b = np.asarray(c_T_a, dtype=np.float64), np.asarray(c_T_b, dtype=np.float64)
    if a.ndim == b.ndim == 1:
        return _between_single(a.tolist(), b.tolist())
    return compose(inverse(a), b)


def _between_single(a: list[float], b: list[float]) -> Float64:
    cos, sin = math.cos(a[2]), math.sin(a[2])
    x, y = b[0] - a[0], b[1] - a[1]
    return np.array((cos * x + sin * y, cos * y - sin * x, wrap_angle(b[2] - a[2])))


def transform(a_T_b: ArrayLike, points: ArrayLike) -> Float64:
    """Points (n, 2) of frame b in frame a, for one pose (3,), or one for each point (n, 3)."""
    a, p = np.asarray(a_T_b, dtype=np.float64), np.asarray(points, dtype=np.float64)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cos * p[..., 0] - sin * p[..., 1]
    y = a[..., 1] + sin * p[..., 0] + cos * p[..., 1]
    return _stack(x, y)


def exp(xi: ArrayLike) -> Float64:
    """The motion of the twist (..., 3) of (v_x, v_y, omega) over unit time."""
    xi = np.asarray(xi, dtype=np.float64)
    if xi.ndim == 1:
        return _exp_single(*xi.tolist())
    omega = xi[..., 2]
    small = np.abs(omega) < _SMALL_ANGLE
    safe = np.where(small, 1.0, omega)
    a = np.where(small, 1.0 - omega**2 / 6.0, np.sin(safe) / safe)
    # 1 - cos(omega) would cancel; 2 sin^2(omega / 2) does not.
    b = np.where(small, omega / 2.0, 2.0 * np.sin(0.5 * safe) ** 2 / safe)
    x = a * xi[..., 0] - b * xi[..., 1]
    y = b * xi[..., 0] + a * xi[..., 1]
    return _stack(x, y, wrap(omega))


def _exp_single(x: float, y: float, omega: float) -> Float64:
    return np.array((*exp_shift(x, y, omega), wrap_angle(omega)))


@register_jitable
def exp_shift(x: float, y: float, omega: float) -> tuple[float, float]:
    """The translation of :func:`exp`, for kernels."""
    if abs(omega) < _SMALL_ANGLE:
        a, b = 1.0 - omega**2 / 6.0, 0.5 * omega
    else:
        a, b = math.sin(omega) / omega, 2.0 * math.sin(0.5 * omega) ** 2 / omega
    return a * x - b * y, b * x + a * y


def log(pose: ArrayLike) -> Float64:
    """The twist (..., 3) with ``exp(twist) == pose`` and |omega| <= pi."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.ndim == 1:
        return _log_single(*pose.tolist())
    omega = wrap(pose[..., 2])
    small = np.abs(omega) < _SMALL_ANGLE
    safe = np.where(small, 1.0, omega)
    half_cot = np.where(small, 1.0 - omega**2 / 12.0, 0.5 * safe / np.tan(0.5 * safe))
    x = half_cot * pose[..., 0] + 0.5 * omega * pose[..., 1]
    y = -0.5 * omega * pose[..., 0] + half_cot * pose[..., 1]
    return _stack(x, y, omega)


def _log_single(x: float, y: float, angle: float) -> Float64:
    omega = wrap_angle(angle)
    return np.array((*log_shift(x, y, omega), omega))


@register_jitable
def log_shift(x: float, y: float, omega: float) -> tuple[float, float]:
    """The translation of :func:`log`, for kernels; ``omega`` in [-pi, pi), rad."""
    half = 0.5 * omega
    half_cot = 1.0 - omega**2 / 12.0 if abs(omega) < _SMALL_ANGLE else half / math.tan(half)
    return half_cot * x + half * y, -half * x + half_cot * y


def adjoint(pose: ArrayLike) -> Float64:
    """Ad_T, shape (..., 3, 3), with ``T exp(xi) = exp(Ad_T xi) T``."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.ndim == 1:
        return _adjoint_single(pose.tolist())
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    ad = np.zeros((*pose.shape[:-1], 3, 3))
    ad[..., 0, 0], ad[..., 0, 1], ad[..., 0, 2] = cos, -sin, pose[..., 1]
    ad[..., 1, 0], ad[..., 1, 1], ad[..., 1, 2] = sin, cos, -pose[..., 0]
    ad[..., 2, 2] = 1.0
    return ad


def _adjoint_single(pose: list[float]) -> Float64:
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array(((cos, -sin, pose[1]), (sin, cos, -pose[0]), (0.0, 0.0, 1.0)))


def right_jacobian_inverse(xi: ArrayLike) -> Float64:
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


def best_fit(a: ArrayLike, b: ArrayLike) -> Float64:
    """The motion T, shape (3,), for which ``compose(T, a)`` is nearest to ``b``, both (n, 3) with n >= 1.

    Least squares over the positions, with a radian of heading counted as a meter.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    (ax, ay), (bx, by) = (a[:, :2] - a[:, :2].mean(axis=0)).T, (b[:, :2] - b[:, :2].mean(axis=0)).T
    turned = b[:, 2] - a[:, 2]
    angle = np.arctan2((ax * by - ay * bx + np.sin(turned)).sum(), (ax * bx + ay * by + np.cos(turned)).sum())
    rotated = transform(np.array([0.0, 0.0, angle]), a[:, :2].mean(axis=0))
    return np.array([*(b[:, :2].mean(axis=0) - rotated), float(wrap(angle))])


def interpolate(start: ArrayLike, end: ArrayLike, fraction: ArrayLike) -> Float64:
    """The pose at ``fraction`` of the motion from ``start`` to ``end``, at a constant twist."""
    return compose(start, exp(np.asarray(fraction)[..., None] * log(between(start, end))))
