"""Consistency of scans and maps: the likelihood ratio of "same place" to "similar place", from contradictions.

Corridors look like corridors, so a good fit says little. Contradictions decide: surfaces where a map knows free space,
or known walls that a beam passes. In the same place they are few, since doors move and people walk; in a similar place
an opening is missing or a pillar stands. Neighboring samples are on one object, so a stretch of wall counts as one; and
the rate of contradictions differs between places. Both together give the beta-binomial distribution
(docs/decisions/0016-contradiction-evidence.md).

People, new objects and closed doors end a beam early. Only a removed object lets it pass, or a wrong pose: among
people, passed walls are the best evidence for a displaced robot.

Line maps (:mod:`hmt_slam_ros.landmarks.line_filter`) find walls differently and count them alike. Other checks differ:

- whether the end of a beam is in free space (``count_agreement`` of ``scan_to_map`` and of area grids);
- the sum of log-ratios against a match (``branch_and_bound``);
- the class of a point by one scan, without a map (:mod:`hmt_slam_ros.sensors.polar_scan`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.se2 import transform_point
from hmt_slam_ros.grids.patches import FAR, PATCH, GridView, field_at
from hmt_slam_ros.registration.scan_to_map import count_agreement


class Agreement(NamedTuple):
    """Counts of surface samples in a map.

    :ivar samples: number of samples.
    :ivar on_surface: samples on known surfaces.
    :ivar in_free_space: samples that contradict: in known free space, or behind a known wall.
    """

    samples: int
    on_surface: int
    in_free_space: int

    @property
    def matched_share(self) -> float:
        """Share of the samples on known surfaces."""
        return self.on_surface / max(1, self.samples)


class ConsistencyTest(NamedTuple):
    """Likelihood ratio of contradictions: beta distributions of their rate over independent stretches of wall.

    Both distributions have the same second parameter, so that the ratio falls with every contradiction.

    :ivar extra_rate: rate of contradictions in a similar place, at the best fit, less that in the same place.
    :ivar concentration: number of stretches after which the rate of a place is known.
    :ivar correlated_samples: number of samples that count as one stretch.
    """

    extra_rate: float
    concentration: float
    correlated_samples: float

    def log_likelihood_ratio(self, found: Agreement, usual: float) -> float:
        """log p(found | same place) / p(found | similar place), nats.

        :param usual: rate of contradictions in the same place.
        """
        on, free = found.on_surface / self.correlated_samples, found.in_free_space / self.correlated_samples
        return self._log_ratio(on, free, usual)

    def log_ratio_in_similar_place(self, samples: int, usual: float) -> float:
        """The log-likelihood ratio, nats, with as many contradictions as a similar place has on average.

        :param samples: number of samples, all on surfaces or contradicting.
        :param usual: rate of contradictions in the same place.
        """
        stretches, odds = samples / self.correlated_samples, usual + self.extra_rate
        free = stretches * odds / (1.0 + odds)
        return self._log_ratio(stretches - free, free, usual)

    def _log_ratio(self, on: float, free: float, usual: float) -> float:
        """:meth:`log_likelihood_ratio` of numbers of stretches."""
        same, similar = usual * self.concentration, (usual + self.extra_rate) * self.concentration
        return self._log_probability(same, on, free) - self._log_probability(similar, on, free)

    def _log_probability(self, a: float, on: float, free: float) -> float:
        return _log_beta(a + free, self.concentration + on) - _log_beta(a, self.concentration)


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


MAP_IN_MAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=5.0)
"""Surfaces of one map, a sample every 0.2 m, in another.

Rates are shares of samples. The values understate contradictions on purpose, since real buildings have more than the
training worlds: docs/reports/2026-11-22-evidence.md.
"""

SCAN_IN_STORED_MAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=10.0)
"""Surfaces of one scan, a sample every 0.2 m, in a stored map; half of them are in the next scan, too.

As ``MAP_IN_MAP``, with twice the correlation. Its effect on relocalization: docs/reports/validation.md.
"""

SCAN_IN_SUBMAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=20.0)
"""Beams of one scan in the submap; the scans before and after have the same beams.

Chosen on training data, without a report: docs/decisions/0016-contradiction-evidence.md.
"""

WALLS_OF_SUBMAP = ConsistencyTest(extra_rate=0.1, concentration=500.0, correlated_samples=5.0)
"""Known walls that the beams of one scan hit or pass, a sample every 0.2 m, from the same place or from any other.

Chosen on training data; it detects kidnapping: docs/decisions/0026-kidnapping-detection.md.
"""

WALLS_OF_MAP = ConsistencyTest(extra_rate=0.01, concentration=500.0, correlated_samples=20.0)
"""Walls of each of two maps and scans of the other, where their surfaces fit.

Most scans of a map have the same walls, and in a similar place that fits, hardly a wall is passed: 1 % in ``nested``,
up to 6 % in ``office``, none in the right place (docs/reports/validation.md, "Kidnapping while driving").
"""

WALLS_OUTLIER_RATE = 0.001
"""Smallest share of the walls that are passed in another map of the same place."""

_CLEARANCE = 0.2
"""Distance before and behind a wall that has to be clear of surfaces where a beam passes, m: else it runs along it."""

BEHIND = 0.4
"""Length of a beam behind a wall from which it passes the wall, m."""

SAMPLE_SPACING = 0.2
"""Distance between samples of surfaces, m."""

MAX_SAMPLE_GAP = 0.6
"""Distance between two samples of a passed wall at most, m: a single sample may be the jamb of a door."""

_STEP = 0.7
"""Step along a beam near surfaces, cells."""


class OutlierRate(NamedTuple):
    """Rate of contradictions so far, at the poses of a hypothesis: some buildings are full of clutter.

    A wrong hypothesis learns from its own contradictions, too, but a few scans change the rate little.

    :ivar inliers: stretches on known surfaces; at first a prior of 100.
    :ivar outliers: stretches that contradicted; at first a prior of 0.75.
    """

    inliers: float = 100.0
    outliers: float = 0.75

    @property
    def rate(self) -> float:
        """Share of the stretches that contradict."""
        return self.outliers / (self.inliers + self.outliers)

    def update(self, found: Agreement, correlated_samples: float) -> OutlierRate:
        """The rate with one more scan."""
        return OutlierRate(
            self.inliers + found.on_surface / correlated_samples,
            self.outliers + found.in_free_space / correlated_samples,
        )


MAPS_OUTLIER_RATE = OutlierRate().rate
"""Share of a map's surfaces that contradict another map of the same place: the initial rate, as comparisons are few."""


class Clutter(NamedTuple):
    """Usual contradictions at the poses of a hypothesis.

    :ivar beam_outlier_rate: share of the beams that contradict its map.
    :ivar wall_outlier_rate: share of the known walls that beams pass.
    """

    beam_outlier_rate: float = 0.0
    wall_outlier_rate: float = 0.0


NO_CLUTTER = Clutter()


class WallSamples(NamedTuple):
    """Samples of walls, in the order of the beams.

    :ivar total: number of samples.
    :ivar x: position of the last sample, with ``y``, m or cells.
    """

    total: int
    x: float
    y: float


NO_SAMPLES = WallSamples(0, -np.inf, -np.inf)


@njit(cache=True)
def add_wall_hit(samples: WallSamples, x: float, y: float, spacing: float) -> WallSamples:
    """The samples with the end of one more beam on a wall, unless it is too near to the last sample."""
    if np.hypot(x - samples.x, y - samples.y) < spacing:
        return samples
    return WallSamples(samples.total + 1, x, y)


@njit(cache=True)
def add_wall_passed(samples: WallSamples, x: float, y: float, spacing: float, gap: float) -> WallSamples:
    """The samples with the point where one more beam passes a wall; it counts only near the last sample."""
    between = np.hypot(x - samples.x, y - samples.y)
    if between < spacing:
        return samples
    return WallSamples(samples.total + (between <= gap), x, y)


@njit(cache=True)
def count_hits_and_violations(
    points: Float64, laser: Float64, pose: Float64, view: GridView, near: int
) -> tuple[int, int]:
    """The number of samples of known surfaces that the beams of a scan hit, and of those that they pass.

    :param points: ends of the beams in their order, shape (n, 2 or more), m, base frame.
    :param laser: position of the laser, shape (2,), m, base frame.
    :param pose: ``map_T_base``, shape (3,).
    :param near: quantized distance to a surface below which a beam ends on it.
    """
    cos, sin = np.cos(pose[2]) / view.cell, np.sin(pose[2]) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = pose[0] / view.cell + half, pose[1] / view.cell + half
    from_u, from_v = transform_point(u, v, cos, sin, laser[0], laser[1])
    spacing, gap = SAMPLE_SPACING / view.cell, MAX_SAMPLE_GAP / view.cell
    hit, passed = NO_SAMPLES, NO_SAMPLES
    for i in range(points.shape[0]):
        to_u, to_v = transform_point(u, v, cos, sin, points[i, 0], points[i, 1])
        if field_at(view, int(to_u), int(to_v)) < near:
            hit = add_wall_hit(hit, to_u, to_v, spacing)
        share = _first_wall_passed(view, from_u, from_v, to_u, to_v)
        if share >= 0.0:
            wall_u, wall_v = from_u + share * (to_u - from_u), from_v + share * (to_v - from_v)
            passed = add_wall_passed(passed, wall_u, wall_v, spacing, gap)
    return hit.total, passed.total


@njit(cache=True)
def _first_wall_passed(view: GridView, from_u: float, from_v: float, to_u: float, to_v: float) -> float:
    """Share of a beam up to the first wall that it passes, -1 for none; coordinates in cells."""
    length = max(np.hypot(to_u - from_u, to_v - from_v), 1e-9)
    du, dv = (to_u - from_u) / length, (to_v - from_v) / length
    clear, behind, quantum = _CLEARANCE / view.cell, BEHIND / view.cell, view.radius / (FAR * view.cell)
    before, wall, at = -np.inf, np.inf, 0.0
    while at < length:
        distance = quantum * field_at(view, int(from_u + at * du), int(from_v + at * dv))
        if distance >= clear:
            if wall < at:
                return wall / length
            before = at
        elif wall == np.inf and distance < 0.5 and at - before <= 2.0 * clear and at <= length - behind:
            wall = at
        elif at - wall > 2.0 * clear:
            before, wall = -np.inf, np.inf
        at += max(_STEP, distance - clear)
    return -1.0


class MapAgreement(NamedTuple):
    """Agreement of a scan with a map.

    :ivar ends: ends of its beams, on surfaces and in free space.
    :ivar walls: samples of known walls that beams hit, and that they pass.
    """

    ends: Agreement
    walls: Agreement


class ScanEvidence(NamedTuple):
    """Evidence of a scan for the pose of the robot.

    :ivar log_evidence: log p(scan | there) / p(scan | in a similar place), nats.
    :ivar log_kidnapping_ratio: log p(scan | displaced before it) / p(scan | not displaced), nats.
    """

    log_evidence: float
    log_kidnapping_ratio: float


NO_EVIDENCE = ScanEvidence(0.0, 0.0)


class ClutterEstimate(NamedTuple):
    """Rates of contradictions so far, at the poses of a hypothesis.

    :ivar beam_outliers: of the beams with its map.
    :ivar wall_outliers: of its walls with the beams.
    """

    beam_outliers: OutlierRate = OutlierRate()
    wall_outliers: OutlierRate = OutlierRate()

    @property
    def clutter(self) -> Clutter:
        """The rates alone."""
        return Clutter(self.beam_outliers.rate, self.wall_outliers.rate)

    def evaluate(self, found: MapAgreement) -> ScanEvidence:
        """The evidence of a scan."""
        log_evidence = SCAN_IN_SUBMAP.log_likelihood_ratio(found.ends, self.beam_outliers.rate)
        return ScanEvidence(
            log_evidence, -log_evidence - WALLS_OF_SUBMAP.log_likelihood_ratio(found.walls, self.wall_outliers.rate)
        )

    def update(self, found: MapAgreement) -> ClutterEstimate:
        """The estimate with one more scan."""
        return ClutterEstimate(
            self.beam_outliers.update(found.ends, SCAN_IN_SUBMAP.correlated_samples),
            self.wall_outliers.update(found.walls, WALLS_OF_SUBMAP.correlated_samples),
        )


def compare_with_map(points: Float64, laser: Float64, pose: Float64, view: GridView, near: int) -> MapAgreement:
    """The agreement of a scan with a map.

    :param points: surfels of the scan, shape (n, 4), m, base frame.
    :param laser: position of the laser, shape (2,), m, base frame.
    :param pose: ``map_T_base``, shape (3,).
    :param near: quantized distance to a surface below which a beam ends on it.
    """
    hit, passed = count_hits_and_violations(points, laser, pose, view, near)
    ends = Agreement(len(points), *count_agreement(points, pose, view, near, 2 * near))
    return MapAgreement(ends, Agreement(hit + passed, hit, passed))
