"""p(phi | gamma) of Eq. (6): does the look of a place speak for an area? Whatever the robot's pose there.

A scan looks like the distribution of its ranges: how much of it is wall at hand, how much free space beyond. That does
not depend on the robot's heading, on the number of beams, and little on where in a room it stands. Two looks differ by
as much as one distribution has to be moved to become the other (Wasserstein's distance), in the logarithm of the range.
Places of one building look alike, in some more than in others; so what counts is by how much an area looks more like
the keyframes than the building's average area does.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numba import njit
from scipy.special import softmax

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.sensing import Scan

SIZE = 32
"""Numbers that a look takes: quantiles of the logarithm of the range."""

# Ranges are told apart between these, m; a beam without a return counts as the farthest.
_NEAREST, _FARTHEST = 0.3, 20.0
# The smallest mean distance of two looks that is told from none.
_SAME = 1e-3
# log p(likeness | same place) / p(likeness | another) is this, fitted by `python -m benchmark appearance`.
RATIO_AT_MEDIAN, RATIO_SLOPE = -0.3, 1.44


def look(scan: Scan) -> Float64:
    """The look of a scan: quantiles of log(range / 1 m) over all beams, shape (SIZE,)."""
    ranges = np.where(scan.valid, scan.ranges, _FARTHEST).astype(np.float64)
    ordered = np.sort(np.clip(ranges, _NEAREST, _FARTHEST)) if ranges.size else np.array([_FARTHEST])
    return np.log(ordered[((np.arange(SIZE) + 0.5) / SIZE * ordered.size).astype(np.int64)])


def log_ratio(likeness: Float64) -> Float64:
    """log p(phi | the area) / p(phi | another area of the building), nats, from a likeness, of any shape."""
    return np.asarray(RATIO_AT_MEDIAN + RATIO_SLOPE * likeness, dtype=np.float64)


class Looks:
    """The looks of keyframes, each worked out once."""

    def __init__(self, scans: Mapping[int, Scan]) -> None:
        """:param scans: {keyframe: scan}, which may grow."""
        self._scans = scans
        self._known: dict[int, Float64] = {}

    def clear(self) -> None:
        """Keep no look, as scans have changed."""
        self._known.clear()

    def likeness(self, keyframes: Collection[int], areas: Sequence[Collection[int]]) -> Float64:
        """How much more areas look like some keyframes than the median of them does, shape (len(areas),).

        :param keyframes: those in question.
        :param areas: the keyframes of every area, at least one each.
        :returns: log of the ratio of the distances: 0 for the median, above 0 where an area looks more alike.
        """
        if not areas:
            return np.zeros(0)
        first = np.cumsum([0, *map(len, areas)])
        distances = _distances(self._of(keyframes), self._of([k for area in areas for k in area]), first)
        logarithms = np.log(np.maximum(distances, _SAME))
        return np.asarray(np.median(logarithms) - logarithms, dtype=np.float64)

    def shares(self, keyframes: Collection[int], areas: Mapping[int, Collection[int]]) -> dict[int, float]:
        """p(gamma | phi): the probability of every area by its look alone; they sum to 1.

        :param keyframes: those in question.
        :param areas: {area: its keyframes, at least one}.
        """
        likeness = self.likeness(keyframes, list(areas.values()))
        weights = softmax(log_ratio(likeness)) if areas else likeness
        return dict(zip(areas, weights.tolist(), strict=True))

    def _of(self, keyframes: Collection[int]) -> Float64:
        for keyframe in keyframes:
            if keyframe not in self._known:
                self._known[keyframe] = look(self._scans[keyframe])
        return np.array([self._known[keyframe] for keyframe in keyframes]).reshape(-1, SIZE)


@njit(cache=True)
def _distances(asked: Float64, known: Float64, first: Float64) -> Float64:
    """The mean over the looks asked for (n, SIZE) of the distance to the nearest one of every area.

    :param known: shape (k, SIZE), the looks of the areas one after the other.
    :param first: shape (areas + 1,), where those of each area begin.
    """
    means = np.zeros(first.size - 1)
    for area in range(means.size):
        for n in range(asked.shape[0]):
            nearest = np.inf
            for k in range(first[area], first[area + 1]):
                distance = 0.0
                for q in range(asked.shape[1]):
                    distance += abs(asked[n, q] - known[k, q])
                nearest = min(nearest, distance)
            means[area] += nearest / (asked.shape[0] * asked.shape[1])
    return means
