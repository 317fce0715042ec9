"""What scans and maps contradict: the consistency tests of Eq. (6), the free-space check, and scans in submaps.

Corridors look like corridors: that one fits into another says little, however many beams say so, as those that made
buildings put walls beside walls. Whether it is the same one shows in what cannot be: surfaces where the map knows free
space. In the same place few are, as doors move and people walk; in a place that only looks alike, an opening is missing
here and a pillar stands there. Neighbouring samples are of one door or pillar, so that a stretch of wall counts as one;
and some places have changed more than others, so that the share that contradicts is not the same everywhere: both
together are the beta-binomial distribution.

Who walks by, what was put there and a door that was closed end a beam early. Only what was taken away lets it pass, or
that it was not sent from there: where people walk, this tells best whether the robot is where it should be.

Maps of lines (:mod:`hmt_slam_ros.landmarks.line_filter`) find the walls differently and count them alike. Three other
checks ask something else:

- whether the end of a beam, not its way, is in free space (``count_agreement`` of ``scan_to_map`` and of area grids);
- by how much that speaks against a match, as a sum of log-ratios (``branch_and_bound``);
- what one scan says of a place without any map (:mod:`hmt_slam_ros.sensors.polar_scan`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.se2 import transform_point
from hmt_slam_ros.grids.patches import FAR, PATCH, GridView, field_at
from hmt_slam_ros.registration.scan_to_map import count_agreement


class Agreement(NamedTuple):
    """Surface samples in a map.

    :ivar samples: how many there are.
    :ivar on_surface: how many are on known surfaces.
    :ivar in_free_space: how many contradict: they are in space that is known to be free, or behind a wall that is
        known.
    """

    samples: int
    on_surface: int
    in_free_space: int

    @property
    def matched_share(self) -> float:
        """Share of all samples that are on known surfaces."""
        return self.on_surface / max(1, self.samples)


class ConsistencyTest(NamedTuple):
    """Which share of the samples contradicts a map: beta distributions over independent stretches of wall.

    Both have the same second parameter, so that the ratio falls with every contradiction.

    :ivar extra_rate: by how much the share is larger in a place that looks alike, where the samples fit best.
    :ivar concentration: after about as many stretches a place is known by what contradicts there.
    :ivar correlated_samples: samples that count as one.
    """

    extra_rate: float
    concentration: float
    correlated_samples: float

    def log_likelihood_ratio(self, found: Agreement, usual: float) -> float:
        """log p(found | same place) / p(found | alike), nats.

        :param usual: share that contradicts in the same place.
        """
        on, free = found.on_surface / self.correlated_samples, found.in_free_space / self.correlated_samples
        same, alike = usual * self.concentration, (usual + self.extra_rate) * self.concentration
        return self._log_probability(same, on, free) - self._log_probability(alike, on, free)

    def _log_probability(self, a: float, on: float, free: float) -> float:
        return _log_beta(a + free, self.concentration + on) - _log_beta(a, self.concentration)


MAP_IN_MAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=5.0)
"""The surfaces of one map, one sample every 0.2 m, in another."""

SCAN_IN_STORED_MAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=10.0)
"""The surfaces of one scan, one sample every 0.2 m, in a map of long before; the next scan sees half of them again."""

SCAN_IN_SUBMAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=20.0)
"""The beams of one scan in the map of what the robot saw around: the scans before and after see the same."""

WALLS_OF_SUBMAP = ConsistencyTest(extra_rate=0.1, concentration=500.0, correlated_samples=5.0)
"""The known walls that the beams of one scan end on or pass, one sample every 0.2 m, seen from there or from anywhere
else."""

WALLS_OF_MAP = ConsistencyTest(extra_rate=0.01, concentration=500.0, correlated_samples=20.0)
"""The same of two maps, the walls of each and the scans of the other, where the surfaces fit: most scans of a map see
the same walls, and where another place fits, hardly a wall is not where it should be."""


class OutlierRate(NamedTuple):
    """What contradicted so far where a hypothesis has the robot: some buildings are full of clutter.

    One that is wrong learns from its own contradictions too, but a few scans weigh little against all before.

    :ivar inliers: stretches on known surfaces.
    :ivar outliers: stretches that contradicted.
    """

    inliers: float = 100.0
    outliers: float = 0.75

    @property
    def rate(self) -> float:
        """Share that contradicts."""
        return self.outliers / (self.inliers + self.outliers)

    def update(self, found: Agreement, correlated_samples: float) -> OutlierRate:
        """With one more scan counted."""
        return OutlierRate(
            self.inliers + found.on_surface / correlated_samples,
            self.outliers + found.in_free_space / correlated_samples,
        )


class Clutter(NamedTuple):
    """What speaks against the place in which a hypothesis has the robot, usually.

    :ivar beam_outlier_rate: share of the beams that contradict its map.
    :ivar wall_outlier_rate: share of the known walls that they pass.
    """

    beam_outlier_rate: float = 0.0
    wall_outlier_rate: float = 0.0


NO_CLUTTER = Clutter()


WALLS_OUTLIER_RATE = 0.001
"""Share of the walls that are passed in another map of the same place, at least."""

MAPS_OUTLIER_RATE = OutlierRate().rate
"""Share of a map's surfaces that contradict another map of the same place: as a run begins, since maps are compared too
seldom to learn it."""


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


# A beam passes a wall if nothing is known within this distance of it before and behind, m: others run along the wall.
_CLEARANCE = 0.2
BEHIND = 0.4
"""A beam that passes a wall ends at least so far behind it, m."""

SAMPLE_SPACING = 0.2
"""Of surfaces, one sample every so many m counts."""

MAX_SAMPLE_GAP = 0.6
"""A wall was passed where samples of it are so near to each other, m: a single one may be the jamb of a door."""

# Part of a cell by which a beam is followed near surfaces.
_STEP = 0.7


class WallSamples(NamedTuple):
    """Samples of walls, taken in the order of the beams.

    :ivar total: how many count.
    :ivar x: where the last of all is, with ``y``, m or cells.
    """

    total: int
    x: float
    y: float


NO_SAMPLES = WallSamples(0, -np.inf, -np.inf)


@njit(cache=True)
def add_wall_hit(samples: WallSamples, x: float, y: float, spacing: float) -> WallSamples:
    """With the end of one more beam on a wall, if it is not too near to the last sample."""
    if np.hypot(x - samples.x, y - samples.y) < spacing:
        return samples
    return WallSamples(samples.total + 1, x, y)


@njit(cache=True)
def add_wall_passed(samples: WallSamples, x: float, y: float, spacing: float, gap: float) -> WallSamples:
    """With the place where one more beam passes a wall: one that is too far from the last sample does not count."""
    between = np.hypot(x - samples.x, y - samples.y)
    if between < spacing:
        return samples
    return WallSamples(samples.total + (between <= gap), x, y)


@njit(cache=True)
def count_hits_and_violations(
    points: Float64, laser: Float64, pose: Float64, view: GridView, near: int
) -> tuple[int, int]:
    """How many samples of known surfaces the beams of a scan end on, and of how many they pass.

    :param points: ends of the beams in their order, shape (n, 2 or more), m, base frame.
    :param laser: where the beams begin, shape (2,), likewise.
    :param pose: ``map_T_base``, shape (3,).
    :param near: quantised distance to a surface below which a beam ends on it.
    """
    cos, sin = np.cos(pose[2]) / view.cell, np.sin(pose[2]) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = pose[0] / view.cell + half, pose[1] / view.cell + half
    from_u, from_v = transform_point(u, v, cos, sin, laser[0], laser[1])
    apart, together = SAMPLE_SPACING / view.cell, MAX_SAMPLE_GAP / view.cell
    met, passed = NO_SAMPLES, NO_SAMPLES
    for i in range(points.shape[0]):
        to_u, to_v = transform_point(u, v, cos, sin, points[i, 0], points[i, 1])
        if field_at(view, int(to_u), int(to_v)) < near:
            met = add_wall_hit(met, to_u, to_v, apart)
        share = _first_wall_passed(view, from_u, from_v, to_u, to_v)
        if share >= 0.0:
            wall_u, wall_v = from_u + share * (to_u - from_u), from_v + share * (to_v - from_v)
            passed = add_wall_passed(passed, wall_u, wall_v, apart, together)
    return met.total, passed.total


@njit(cache=True)
def _first_wall_passed(view: GridView, from_u: float, from_v: float, to_u: float, to_v: float) -> float:
    """Share of a beam, in cells, up to the first wall that it passes; -1 where it passes none."""
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
    """A scan in a map.

    :ivar ends: of its beams, on surfaces and in free space.
    :ivar walls: samples of known ones that beams end on, and that they pass.
    """

    ends: Agreement
    walls: Agreement


class ScanEvidence(NamedTuple):
    """What a scan says of whether the robot is there.

    :ivar log_evidence: log p(scan | it is) / p(scan | it is in a place that looks alike), nats.
    :ivar log_kidnapping_ratio: log p(scan | it was displaced before it) / p(scan | it was not), nats.
    """

    log_evidence: float
    log_kidnapping_ratio: float


NO_EVIDENCE = ScanEvidence(0.0, 0.0)


class ClutterEstimate(NamedTuple):
    """What scans were like so far where a hypothesis has the robot.

    :ivar beam_outliers: what contradicted its map.
    :ivar wall_outliers: which of its walls the beams passed.
    """

    beam_outliers: OutlierRate = OutlierRate()
    wall_outliers: OutlierRate = OutlierRate()

    @property
    def clutter(self) -> Clutter:
        """What contradicts usually."""
        return Clutter(self.beam_outliers.rate, self.wall_outliers.rate)

    def evaluate(self, found: MapAgreement) -> ScanEvidence:
        """What a scan says."""
        log_evidence = SCAN_IN_SUBMAP.log_likelihood_ratio(found.ends, self.beam_outliers.rate)
        return ScanEvidence(
            log_evidence, -log_evidence - WALLS_OF_SUBMAP.log_likelihood_ratio(found.walls, self.wall_outliers.rate)
        )

    def update(self, found: MapAgreement) -> ClutterEstimate:
        """With one more scan."""
        return ClutterEstimate(
            self.beam_outliers.update(found.ends, SCAN_IN_SUBMAP.correlated_samples),
            self.wall_outliers.update(found.walls, WALLS_OF_SUBMAP.correlated_samples),
        )


def compare_with_map(points: Float64, laser: Float64, pose: Float64, view: GridView, near: int) -> MapAgreement:
    """Lay a scan into a map.

    :param points: surfels of the scan, shape (n, 4), m, base frame.
    :param laser: where the beams begin, shape (2,), likewise.
    :param pose: ``map_T_base``, shape (3,).
    :param near: quantised distance to a surface below which a beam ends on it.
    """
    met, passed = count_hits_and_violations(points, laser, pose, view, near)
    ends = Agreement(len(points), *count_agreement(points, pose, view, near, 2 * near))
    return MapAgreement(ends, Agreement(met + passed, met, passed))
