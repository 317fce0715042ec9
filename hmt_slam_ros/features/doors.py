"""Doors: openings that are narrower than a hallway; a space ends there, whatever is seen through them."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2


def jambs_of(poses: Float64, widths: Float64) -> Float64:
    """Both jambs of openings, shape (n, 4), x and y of the left one and of the right one, m.

    :param poses: shape (n, 3), their middles with the heading through them, m and rad.
    :param widths: shape (n,), m.
    """
    across = np.stack((np.zeros_like(widths), 0.5 * widths, np.zeros_like(widths)), axis=1)
    return np.concatenate([se2.compose(poses, sign * across)[:, :2] for sign in (1.0, -1.0)], axis=1)


def up_to_doors(origins: Float64, directions: Float64, doors: Float64) -> Float64:
    """How far it is along beams to the first door that they pass, m, shape (n,); inf where there is none.

    :param origins: shape (n, 2), where beams begin, m.
    :param directions: shape (n, 2), unit vectors.
    :param doors: shape (k, 4), x and y of both jambs of each, m.
    """
    along = doors[None, :, 2:] - doors[None, :, :2]
    to = doors[None, :, :2] - origins[:, None]
    turned = _cross(directions[:, None], along)
    turned = np.where(turned == 0.0, np.nan, turned)
    away, share = _cross(to, along) / turned, _cross(to, directions[:, None]) / turned
    passed = np.where((away > 0.0) & (share >= 0.0) & (share <= 1.0), away, np.inf)
    return np.asarray(passed.min(axis=1, initial=np.inf))


def _cross(a: Float64, b: Float64) -> Float64:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
