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


# Where a robot would be that drives where another drove before, or the other way: 1.5 m along, 0.7 m across, 6 degrees.
_ALIKE = np.diag([1.5, 0.7, math.radians(6.0)]) ** 2
_HEADINGS = (np.zeros(3), np.array([0.0, 0.0, math.pi]))
# Squared Mahalanobis distance up to which is searched: 90 % of 3 degrees of freedom.
_GATE = 6.25
# Only the best is asked for, and that not where a quarter of the samples at most is on surfaces: so much fits anywhere.
_MARGIN, _LEAST = 1.0, 0.25 * math.log(3.0)  # nat
# As much as so many places counts what is believed before any was tried; so many are kept.
_TRIED, _KEPT = 2.0, 64
# What looks like another place at one spot does so in so many cases, at most, at the next.
_ALIKE_NEXT = 0.4
# How far the share of one and the same place varies.
_SAME_SHARE = 0.02


class Elsewhere(NamedTuple):
    """A place in which the keyframes do not lie: its map, and ``map_T_base`` of a robot there, shape (3,)."""

    grid: AreaGrid
    pose: NDArray[np.float64]


def best_shares(query: AreaGrid, elsewhere: Iterable[Elsewhere], settings: MatchSettings) -> list[float]:
    """How large a share of the keyframes' surfaces is on known ones, where they fit best in each of the places.

    :param query: map of the keyframes, in the frame of the first of them.
    """
    near = replace(settings, gate=_GATE, margin=_MARGIN, least=_LEAST)
    found = []
    for place in elsewhere:
        poses = [best_pose(query, place.grid, PoseGaussian(place.pose + turn, _ALIKE), near) for turn in _HEADINGS]
        best = max((pose for pose in poses if pose is not None), key=lambda pose: pose[1], default=None)
        found.append(0.0 if best is None else place.grid.agreement(query.points, best[0]).share)
    return found


@dataclass
class Likeness:
    """What was counted so far.

    :ivar alike: probability that keyframes fit into a place where they do not lie, before any was tried.
    :ivar shares: of the places that were tried last.
    """

    alike: float
    shares: deque[float] = field(default_factory=partial(deque, maxlen=_KEPT))

    def count(self, shares: Iterable[float]) -> None:
        """Keep what keyframes found in places where they do not lie."""
        self.shares.extend(shares)

    def log_rarity(self, share: float, *, foretold: bool) -> float:
        """-log of the probability that keyframes elsewhere fit as well or better, nats.

        :param foretold: whether earlier keyframes fitted, from which it follows that these lie in the place.
        """
        as_well = sum(other > share - _SAME_SHARE for other in self.shares)
        rarity = math.log((_TRIED + len(self.shares)) / (_TRIED * self.alike + as_well))
        return min(rarity, -math.log(_ALIKE_NEXT)) if foretold else rarity
