"""Beams as free space around the robot, of real and virtual scans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.virtual_scan import VirtualScan
from hmt_slam_ros.sensors import Scan


class Rays(NamedTuple):
    """Beams with their free ranges, those of a scan in the order of bearing.

    :ivar origins: shape (n, 2), m.
    :ivar directions: shape (n, 2), unit vectors.
    :ivar free_range: shape (n,), m.
    :ivar deviations: shape (n,), of these, m.
    :ivar hit: shape (n,), whether a surface is at the end; else what follows is unknown.
    """

    origins: Float64
    directions: Float64
    free_range: Float64
    deviations: Float64
    hit: Bool

    def move(self, pose: Float64) -> Rays:
        """The beams in another frame, in which theirs has a pose, shape (3,)."""
        turned = se2.transform(np.array([0.0, 0.0, pose[2]]), self.directions)
        return self._replace(origins=se2.transform(pose, self.origins), directions=turned)


def join_rays(parts: Sequence[Rays]) -> Rays:
    """The beams of several scans, one after the other."""
    return parts[0] if len(parts) == 1 else Rays(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def rays_from_scan(scan: Scan, features: FeatureParameters) -> Rays:
    """The beams of a scan with a return."""
    beams = scan.beams
    lengths = np.hypot(*beams.T)
    deviations = np.full(len(beams), features.range_deviation)
    directions = beams / np.maximum(lengths, 1e-9)[:, None]
    return Rays(scan.origins, directions, lengths, deviations, np.ones(len(beams), np.bool_))


def rays_from_virtual_scan(virtual: VirtualScan, features: FeatureParameters) -> Rays:
    """The beams of a virtual scan, with those that end in unknown ground."""
    scan = virtual.scan
    angles = scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size)
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    met, origins = scan.valid, np.zeros((scan.ranges.size, 2))
    return Rays(origins, directions, virtual.free_range, range_deviations_of_map(virtual, features), met)


def range_deviations_of_map(virtual: VirtualScan, features: FeatureParameters) -> Float64:
    """Deviations of the ranges of a virtual scan, which grow with the angle of incidence, shape (n,), m."""
    return features.map_deviation / virtual.incidence_cosine
