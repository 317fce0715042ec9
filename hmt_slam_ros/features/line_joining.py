"""Which lines of a stochastic map are one."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.features.merging import Gate
from hmt_slam_ros.geometry import se2


def most_alike(lines: Float64, covariance: Float64, middles: Float64, gate: Gate) -> tuple[int, int] | None:
    """The two lines that differ least, if there are two that are one.

    :param lines: alpha and r, shape (n, 2), rad and m.
    :param covariance: of all of them, shape (2 n, 2 n).
    :param middles: of what was seen of each, shape (n,), m along it.
    :returns: numbers, the smaller one first; None where none of the lines are one.
    """
    count = len(lines)
    one, other = np.triu_indices(count, 1)
    blocks = covariance.reshape(count, 2, count, 2).transpose(0, 2, 1, 3)
    # S of Eq. (13) of Tomatis et al.
    spread = blocks[one, one] + blocks[other, other] - blocks[one, other] - blocks[other, one]
    difference = lines[one] - lines[other]
    difference[:, 0] = se2.wrap(difference[:, 0])
    distance2 = np.einsum("ni,nij,nj->n", difference, np.linalg.inv(spread), difference)
    variance = np.minimum(_variance(spread, middles[one]), _variance(spread, middles[other]))
    distance2[variance > gate.deviation**2] = np.inf
    least = int(np.argmin(distance2)) if count > 1 else -1
    return (int(one[least]), int(other[least])) if least >= 0 and distance2[least] <= gate.distance2 else None


def _variance(spread: Float64, along: Float64) -> Float64:
    """Of the distance of a point of a line from another one, shape (n,), m^2.

    :param spread: covariance of the difference of alpha and r, shape (n, 2, 2).
    :param along: where the point is on the line, shape (n,), m.
    """
    return along * along * spread[:, 0, 0] - 2.0 * along * spread[:, 0, 1] + spread[:, 1, 1]
