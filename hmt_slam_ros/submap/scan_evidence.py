"""Is the robot where a hypothesis has it? What a scan says of that, by the map of what is around."""

from __future__ import annotations

from typing import NamedTuple

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.grids.free_space import count_hits_and_violations
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.registration.consistency import SCAN_IN_SUBMAP, WALLS_OF_SUBMAP, Agreement, Clutter, OutlierRate
from hmt_slam_ros.registration.scan_to_map import count_agreement


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
