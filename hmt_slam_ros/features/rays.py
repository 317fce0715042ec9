"""Beams of a scan, real or virtual, as what is known of the free space around the robot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.features import Features
from hmt_slam_ros.sensing import Scan


class Rays(NamedTuple):
    """How far beams go through free space, in the order of their bearing.

    :ivar origins: shape (n, 2), where they begin, m.
    :ivar directions: shape (n, 2), unit vectors.
    :ivar free: shape (n,), m.
    :ivar deviations: shape (n,), of these, m.
    :ivar met: shape (n,), whether there is a surface; else it is not known how the beam goes on.
    """

    origins: Float64
    directions: Float64
    free: Float64
    deviations: Float64
    met: Bool


def rays_of(scan: Scan, features: Features) -> Rays:
    """The beams of a scan with a return."""
    beams = scan.beams
    lengths = np.hypot(*beams.T)
    deviations = np.full(len(beams), features.range_deviation)
    directions = beams / np.maximum(lengths, 1e-9)[:, None]
    return Rays(scan.origins, directions, lengths, deviations, np.ones(len(beams), np.bool_))
