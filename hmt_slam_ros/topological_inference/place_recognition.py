"""Place recognition: which areas a scan looks like, and how often the building looks like itself (perceptual aliasing).

A scan looks like the distribution of its ranges: how much of it is wall at hand, how much free space beyond. That does
not depend on the robot's heading, on the number of beams, and little on where in a room it stands. Two looks differ by
as much as one distribution has to be moved to become the other (Wasserstein's distance), in the logarithm of the range.
Places of one building look alike, in some more than in others; so what counts is by how much an area looks more like
the keyframes than the building's average area does.

New ground is seldom like nothing that is known: corridors look like corridors. That keyframes fit into a known area
speaks for it only as far as such a fit is rare where they surely do not lie (as the average place of Cummins and Newman
2008, but counted on this building): in one where every corridor is like the next it tells next to nothing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import softmax

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration.area_to_area import MatchSettings, best_pose
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.sensors import Scan

DESCRIPTOR_SIZE = 32
"""Numbers that a look takes: quantiles of the logarithm of the range."""

# Ranges are told apart between these, m; a beam without a return counts as the farthest.
_NEAREST, _FARTHEST = 0.3, 20.0
# The smallest mean distance of two looks that is told from none.
_SAME = 1e-3
# log p(likeness | same place) / p(likeness | another) is this, fitted by `python -m benchmark appearance`.
RATIO_AT_MEDIAN, RATIO_SLOPE = -0.3, 1.44


def describe_scan(scan: Scan) -> Float64:
    """The look of a scan: quantiles of log(range / 1 m) over all beams, shape (SIZE,)."""
    ranges = np.where(scan.valid, scan.ranges, _FARTHEST).astype(np.float64)
    ordered = np.sort(np.clip(ranges, _NEAREST, _FARTHEST)) if ranges.size else np.array([_FARTHEST])
    return np.log(ordered[((np.arange(DESCRIPTOR_SIZE) + 0.5) / DESCRIPTOR_SIZE * ordered.size).astype(np.int64)])


def descriptor_log_ratio(similarity: Float64) -> Float64:
    """log p(phi | the area) / p(phi | another area of the building), nats, from a likeness, of any shape."""
    return np.asarray(RATIO_AT_MEDIAN + RATIO_SLOPE * similarity, dtype=np.float64)


class ScanDescriptors:
    """The looks of keyframes, each worked out once."""

    def __init__(self, scans: Mapping[int, Scan]) -> None:
        """:param scans: {keyframe: scan}, which may grow."""
        self._scans = scans
        self._descriptors: dict[int, Float64] = {}

    def clear(self) -> None:
        """Keep no look, as scans have changed."""
        self._descriptors.clear()

    def similarity(self, keyframes: Collection[int], areas: Sequence[Collection[int]]) -> Float64:
        """How much more areas look like some keyframes than the median of them does, shape (len(areas),).

        :param keyframes: those in question.
        :param areas: the keyframes of every area, at least one each.
        :returns: log of the ratio of the distances: 0 for the median, above 0 where an area looks more alike.
        """
        if not areas:
            return np.zeros(0)
        first = np.cumsum([0, *map(len, areas)])
        distances = _distances(self._stack(keyframes), self._stack([k for area in areas for k in area]), first)
        logarithms = np.log(np.maximum(distances, _SAME))
        return np.asarray(np.median(logarithms) - logarithms, dtype=np.float64)

    def area_probabilities(self, keyframes: Collection[int], areas: Mapping[int, Collection[int]]) -> dict[int, float]:
        """p(gamma | phi): the probability of every area by its look alone; they sum to 1.

        :param keyframes: those in question.
        :param areas: {area: its keyframes, at least one}.
        """
        likeness = self.similarity(keyframes, list(areas.values()))
        weights = softmax(descriptor_log_ratio(likeness)) if areas else likeness
        return dict(zip(areas, weights.tolist(), strict=True))

    def _stack(self, keyframes: Collection[int]) -> Float64:
        for keyframe in keyframes:
            if keyframe not in self._descriptors:
                self._descriptors[keyframe] = describe_scan(self._scans[keyframe])
        return np.array([self._descriptors[keyframe] for keyframe in keyframes]).reshape(-1, DESCRIPTOR_SIZE)


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


# Where a robot would be that drives where another drove before, or the other way: 1.5 m along, 0.7 m across, 6 degrees.
_DRIVEN_COVARIANCE = np.diag([1.5, 0.7, math.radians(6.0)]) ** 2
_HEADINGS = (np.zeros(3), np.array([0.0, 0.0, math.pi]))
# Squared Mahalanobis distance up to which is searched: 90 % of 3 degrees of freedom.
_GATE = 6.25
# Only the best is asked for, and that not where a quarter of the samples at most is on surfaces: so much fits anywhere.
_MARGIN, _MIN_LOG_RATIO = 1.0, 0.25 * math.log(3.0)  # nat
# As much as so many places counts what is believed before any was tried; so many are kept.
_PRIOR_COUNT, _MAX_NEGATIVES = 2.0, 64
# What looks like another place at one spot does so in so many cases, at most, at the next.
_ALIASING_PERSISTENCE = 0.4
# How far the share of one and the same place varies.
_SHARE_TOLERANCE = 0.02


class NegativeSample(NamedTuple):
    """A place in which the keyframes do not lie: its map, and ``map_T_base`` of a robot there, shape (3,)."""

    grid: AreaGrid
    pose: NDArray[np.float64]


def best_shares(query: AreaGrid, negatives: Iterable[NegativeSample], settings: MatchSettings) -> list[float]:
    """How large a share of the keyframes' surfaces is on known ones, where they fit best in each of the places.

    :param query: map of the keyframes, in the frame of the first of them.
    """
    near = replace(settings, gate=_GATE, margin=_MARGIN, min_log_ratio=_MIN_LOG_RATIO)
    found = []
    for place in negatives:
        poses = [
            best_pose(query, place.grid, PoseGaussian(place.pose + turn, _DRIVEN_COVARIANCE), near)
            for turn in _HEADINGS
        ]
        best = max((pose for pose in poses if pose is not None), key=lambda pose: pose[1], default=None)
        found.append(0.0 if best is None else place.grid.compare(query.points, best[0]).matched_share)
    return found


@dataclass
class PerceptualAliasing:
    """What was counted so far.

    :ivar prior: probability that keyframes fit into a place where they do not lie, before any was tried.
    :ivar negative_shares: of the places that were tried last.
    """

    prior: float
    negative_shares: deque[float] = field(default_factory=partial(deque, maxlen=_MAX_NEGATIVES))

    def add_negatives(self, shares: Iterable[float]) -> None:
        """Keep what keyframes found in places where they do not lie."""
        self.negative_shares.extend(shares)

    def log_distinctiveness(self, share: float, *, already_expected: bool) -> float:
        """-log of the probability that keyframes elsewhere fit as well or better, nats.

        :param already_expected: whether earlier keyframes fitted, from which it follows that these lie in the place.
        """
        as_well = sum(other > share - _SHARE_TOLERANCE for other in self.negative_shares)
        rarity = math.log((_PRIOR_COUNT + len(self.negative_shares)) / (_PRIOR_COUNT * self.prior + as_well))
        return min(rarity, -math.log(_ALIASING_PERSISTENCE)) if already_expected else rarity
