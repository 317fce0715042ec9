"""Place recognition: the appearance of scans, and perceptual aliasing.

A scan's descriptor is the distribution of its ranges, which depends neither on the robot's heading nor on the number of
beams, and little on the position in a room. Two descriptors differ by Wasserstein's distance in the logarithm of the
range. Since places of one building look alike, an area is compared with the median area of the building.

Perceptual aliasing: new ground often resembles known places. A match with a known area is evidence for it only as far
as such matches are rare where the keyframes surely do not lie. This is the average place of Cummins and Newman (2008),
but counted in this building.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy

from hmt_slam_ros.arrays import Bool, Float32, Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration.area_to_area import MatchSettings, best_pose
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.sensors import Scan

DESCRIPTOR_SIZE = 32
"""Size of a descriptor: quantiles of the logarithm of the range."""

_FIRST_ROWS = 256
"""Rows of a table of descriptors at first."""

_MIN_RANGE = 0.3
"""Shorter ranges count as this, m."""

_MAX_RANGE = 20.0
"""Longer ranges count as this, and beams without a return, m."""

_MIN_DISTANCE = 1e-3
"""Smallest distance between descriptors that differs from 0."""

RATIO_AT_MEDIAN = -0.3
"""log p(similarity | same place) / p(similarity | another) at the median.

From docs/reports/2026-11-22-appearance.md.
"""

RATIO_SLOPE = 1.44
"""Its slope over the similarity, from the same fit."""

_TRAVEL_COVARIANCE = np.diag([1.5, 0.7, math.radians(6.0)]) ** 2
"""Prior of a robot that travels the way of another, in either direction: m, m and rad, squared."""

_HEADINGS = (np.zeros(3), np.array([0.0, 0.0, math.pi]))
"""The two directions of travel."""

_GATE = 6.25
"""Squared Mahalanobis distance up to which is searched: 90 % of 3 degrees of freedom."""

_MARGIN = 1.0
"""Margin of a search for the best match only, nats."""

MIN_LOG_RATIO = 0.25 * math.log(3.0)
"""Smallest mean log-ratio of a match, nats: a quarter of the samples on surfaces matches anywhere."""

_PRIOR_COUNT = 2.0
"""Negative samples that the prior counts for."""

_MAX_NEGATIVES = 64
"""Negative samples that are kept (docs/decisions/0017-perceptual-aliasing.md)."""

_ALIASING_PERSISTENCE = 0.4
"""Largest probability that a similar place is still similar at the next keyframes.

From docs/decisions/0017-perceptual-aliasing.md.
"""

_SHARE_TOLERANCE = 0.02
"""Variation of the matched share at one place."""


def describe_scan(scan: Scan) -> Float64:
    """The descriptor of a scan: quantiles of log(range / 1 m) over all beams, shape (DESCRIPTOR_SIZE,)."""
    return _log_quantiles(scan.ranges, scan.valid)


@njit(cache=True)
def _log_quantiles(ranges: Float32, valid: Bool) -> Float64:
    """The logarithms of DESCRIPTOR_SIZE quantiles of the ranges (n,), m, with the longest for those not valid."""
    count = max(1, ranges.size)
    limited = np.full(count, _MAX_RANGE)
    for n in range(ranges.size):
        if valid[n]:
            limited[n] = min(max(np.float64(ranges[n]), _MIN_RANGE), _MAX_RANGE)
    limited.sort()
    quantiles = np.empty(DESCRIPTOR_SIZE)
    for q in range(DESCRIPTOR_SIZE):
        quantiles[q] = np.log(limited[int((q + 0.5) / DESCRIPTOR_SIZE * count)])
    return quantiles


def descriptor_log_ratio(similarity: Float64) -> Float64:
    """log p(phi | the area) / p(phi | another area of the building), nats, from a similarity, of any shape."""
    return np.asarray(RATIO_AT_MEDIAN + RATIO_SLOPE * similarity, dtype=np.float64)


class ScanDescriptors:
    """The descriptors of keyframes, each computed once."""

    def __init__(self, scans: Mapping[int, Scan]) -> None:
        """:param scans: {keyframe: scan}, which may grow."""
        self._scans = scans
        self._rows: dict[int, int] = {}
        self._table: Float64 = np.empty((_FIRST_ROWS, DESCRIPTOR_SIZE))

    def clear(self) -> None:
        """Drop all descriptors, as scans have changed."""
        self._rows.clear()

    def similarity(self, keyframes: Collection[int], areas: Sequence[Collection[int]]) -> Float64:
        """Similarity of areas to some keyframes relative to the median area, shape (len(areas),).

        :param keyframes: those in question.
        :param areas: the keyframes of every area, at least one each.
        :returns: log of the ratio of the distances: 0 for the median, above 0 for a more similar area.
        """
        if not areas:
            return np.zeros(0)
        first = np.cumsum([0, *map(len, areas)])
        distances = _distances(self._stack(keyframes), self._stack([k for area in areas for k in area]), first)
        logarithms = np.log(np.maximum(distances, _MIN_DISTANCE))
        return np.asarray(np.median(logarithms) - logarithms, dtype=np.float64)

    def area_probabilities(self, keyframes: Collection[int], areas: Mapping[int, Collection[int]]) -> dict[int, float]:
        """p(gamma | phi): the probability of every area by its appearance alone; they sum to 1.

        :param keyframes: those in question.
        :param areas: {area: its keyframes, at least one}.
        """
        similarity = self.similarity(keyframes, list(areas.values()))
        probabilities = scipy.special.softmax(descriptor_log_ratio(similarity)) if areas else similarity
        return dict(zip(areas, probabilities.tolist(), strict=True))

    def _stack(self, keyframes: Collection[int]) -> Float64:
        """The descriptors of keyframes, shape (len(keyframes), DESCRIPTOR_SIZE)."""
        for keyframe in keyframes:
            if keyframe not in self._rows:
                self._rows[keyframe] = len(self._rows)
                if len(self._rows) > len(self._table):
                    self._table = np.concatenate((self._table, np.empty_like(self._table)))
                self._table[self._rows[keyframe]] = describe_scan(self._scans[keyframe])
        return self._table[[self._rows[keyframe] for keyframe in keyframes]]


@njit(cache=True)
def _distances(query: Float64, known: Float64, first: Float64) -> Float64:
    """Mean distance of query descriptors (n, DESCRIPTOR_SIZE) to the nearest one of every area, shape (areas,).

    :param known: shape (k, DESCRIPTOR_SIZE), the descriptors of the areas one after the other.
    :param first: shape (areas + 1,), where those of each area begin.
    """
    means = np.zeros(first.size - 1)
    for area in range(means.size):
        for n in range(query.shape[0]):
            nearest = np.inf
            for k in range(first[area], first[area + 1]):
                distance = 0.0
                for q in range(query.shape[1]):
                    distance += abs(query[n, q] - known[k, q])
                nearest = min(nearest, distance)
            means[area] += nearest / (query.shape[0] * query.shape[1])
    return means


class NegativeSample(NamedTuple):
    """A place in which the keyframes do not lie: its grid, and ``map_T_base`` of a robot there, shape (3,)."""

    grid: AreaGrid
    pose: Float64


def best_share(query: AreaGrid, place: NegativeSample, settings: MatchSettings) -> tuple[float, int]:
    """The matched share of the keyframes' surfaces at their best match in a place, and the number of samples looked up.

    :param query: grid of the keyframes, in the frame of the first of them.
    """
    settings = replace(settings, gate=_GATE, margin=_MARGIN, min_log_ratio=MIN_LOG_RATIO)
    found = [
        best_pose(query, place.grid, PoseGaussian(place.pose + heading, _TRAVEL_COVARIANCE), settings)
        for heading in _HEADINGS
    ]
    best = max((match for match, _ in found if match is not None), key=lambda match: match[1], default=None)
    share = 0.0 if best is None else place.grid.compare(query.points, best[0]).matched_share
    return share, sum(work for _, work in found)


@dataclass
class PerceptualAliasing:
    """How often keyframes match places in which they do not lie.

    :ivar prior: probability of that before any was tried.
    :ivar negative_shares: matched shares in such places, the latest.
    """

    prior: float
    negative_shares: deque[float] = field(default_factory=partial(deque, maxlen=_MAX_NEGATIVES))

    def add_negatives(self, shares: Iterable[float]) -> None:
        """Add matched shares in places where the keyframes do not lie."""
        self.negative_shares.extend(shares)

    def log_distinctiveness(self, share: float, *, already_expected: bool) -> float:
        """-log of the probability that keyframes elsewhere match as well or better, nats.

        :param already_expected: whether the match follows from that of earlier keyframes.
        """
        as_good = int((np.fromiter(self.negative_shares, np.float64) > share - _SHARE_TOLERANCE).sum())
        value = math.log((_PRIOR_COUNT + len(self.negative_shares)) / (_PRIOR_COUNT * self.prior + as_good))
        return min(value, -math.log(_ALIASING_PERSISTENCE)) if already_expected else value
