"""Lines and free space of a virtual scan, for sensors that see less than what is around the robot.

A map errs otherwise than a laser: across its surfaces, so that a range errs the more the flatter a beam meets one; and
neighbouring beams err alike, as they end in the same cells, so that many of them tell no more of a wall than few. So a
line of a map is as uncertain as if both its ends were off by ``features.map_deviation``, each for itself, beside what
its beams say.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.grids.virtual_scan import VirtualScan
from hmt_slam_ros.landmarks.beam_labels import Rays
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_lines

# Beams that err alike; what one more line explains has to be so many times as much.
_CORRELATED_BEAMS = 2.0


def extract_map_lines(virtual: VirtualScan, features: FeatureParameters) -> Lines:
    """The lines of a virtual scan."""
    costs = replace(
        features,
        line_penalty=_CORRELATED_BEAMS * features.line_penalty,
        stray_penalty=_CORRELATED_BEAMS * features.stray_penalty,
    )
    lines = extract_lines(virtual.scan, costs, _range_deviations(virtual, features)[virtual.scan.valid])
    begins, ends = np.full(len(lines), np.inf), np.full(len(lines), -np.inf)
    np.minimum.at(begins, lines.owners, lines.segments[:, 0])
    np.maximum.at(ends, lines.owners, lines.segments[:, 1])
    of_ends = features.map_deviation**2
    middles, turn, off = 0.5 * (begins + ends), 2.0 * of_ends / (ends - begins) ** 2, 0.5 * of_ends
    own = np.stack((turn, middles * turn, middles * turn, middles * middles * turn + off), axis=1).reshape(-1, 2, 2)
    return replace(lines, covariances=lines.covariances + own)


def rays_from_virtual_scan(virtual: VirtualScan, features: FeatureParameters) -> Rays:
    """The beams of a virtual scan, also those that come into unknown ground."""
    scan = virtual.scan
    angles = scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size)
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    met, origins = scan.valid, np.zeros((scan.ranges.size, 2))
    return Rays(origins, directions, virtual.free_range, _range_deviations(virtual, features), met)


def _range_deviations(virtual: VirtualScan, features: FeatureParameters) -> Float64:
    """Of the ranges, shape (n,), m."""
    return features.map_deviation / virtual.incidence_cosine
