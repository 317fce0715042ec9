"""p(phi | gamma) of Eq. (6): does the look of a place speak for an area? Whatever the robot's pose there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.sensing import Scan

# Ranges in m between which beams are counted.
_EDGES = np.array([0.0, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.7, 8.0, 11.3, 16.0, np.inf])


def signature(scans: Sequence[Scan]) -> NDArray[np.float64]:
    """How the ranges around a place are distributed: a histogram, shape (11,), of sum 1, or 0 without any return."""
    ranges = np.concatenate([scan.ranges[scan.valid] for scan in scans]) if scans else np.zeros(0)
    counts = np.histogram(ranges, _EDGES)[0].astype(np.float64)
    return counts / max(1.0, counts.sum())


def appearance_log_ratio(query: NDArray[np.float64], candidate: NDArray[np.float64], weight: float) -> float:
    """log p(phi | candidate) / p(phi | an area at random), bounded by +-``weight``, nats.

    The Bhattacharyya coefficient of two places of one building is seldom below 1/2; so that is where the ratio ends.
    """
    coefficient = float(np.sqrt(query * candidate).sum())
    return weight * min(1.0, max(-1.0, 4.0 * coefficient - 3.0))
