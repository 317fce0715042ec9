"""Pieces of lines: where the stretches that were seen begin and end, shape (n, 2), m along the line."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Float64


def overlap(pieces: Float64, others: Float64) -> float:
    """What two lines have in common along them, as a share of the shorter of the two."""
    common = np.minimum(pieces[:, None, 1], others[None, :, 1]) - np.maximum(pieces[:, None, 0], others[None, :, 0])
    return float(np.maximum(common, 0.0).sum()) / max(1e-9, min(_length(pieces), _length(others)))


def joined(pieces: Float64, max_gap: float) -> Float64:
    """Pieces of one line, joined where the gap between them is no larger than ``max_gap``, m."""
    pieces = pieces[np.argsort(pieces[:, 0])]
    reached = np.maximum.accumulate(pieces[:, 1])
    first = np.concatenate(([True], pieces[1:, 0] > reached[:-1] + max_gap))
    return np.stack((pieces[first, 0], np.maximum.reduceat(pieces[:, 1], np.flatnonzero(first))), axis=1)


def middle(pieces: Float64) -> float:
    """Mean of what was seen, m along the line."""
    return 0.5 * float((pieces**2 @ (-1.0, 1.0)).sum()) / max(1e-9, _length(pieces))


def _length(pieces: Float64) -> float:
    return float((pieces[:, 1] - pieces[:, 0]).sum())
