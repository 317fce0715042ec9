"""Is the robot where a hypothesis has it? What a scan says of that, by the map of what is around."""

from __future__ import annotations

from typing import NamedTuple

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.grids.free_space import met_and_passed
from hmt_slam_ros.grids.patches import MapView
from hmt_slam_ros.registration.consistency import SCAN, SIGHT, Agreement, Clutter, Usual
from hmt_slam_ros.registration.scan_to_map import agreement


class Compared(NamedTuple):
    """A scan in a map.

    :ivar ends: of its beams, on surfaces and in free space.
    :ivar walls: samples of known ones that beams end on, and that they pass.
    """

    ends: Agreement
    walls: Agreement


class Judgement(NamedTuple):
    """What a scan says of whether the robot is there.

    :ivar log_evidence: log p(scan | it is) / p(scan | it is in a place that looks alike), nats.
    :ivar doubt: log p(scan | it was displaced before it) / p(scan | it was not), nats.
    """

    log_evidence: float
    doubt: float


NOTHING_SAID = Judgement(0.0, 0.0)


class Experience(NamedTuple):
    """What scans were like so far where a hypothesis has the robot.

    :ivar ends: what contradicted its map.
    :ivar walls: which of its walls the beams passed.
    """

    ends: Usual = Usual()
    walls: Usual = Usual()

    @property
    def clutter(self) -> Clutter:
        """What contradicts usually."""
        return Clutter(self.ends.share, self.walls.share)

    def judge(self, found: Compared) -> Judgement:
        """What a scan says."""
        log_evidence = SCAN.log_ratio(found.ends, self.ends.share)
        return Judgement(log_evidence, -log_evidence - SIGHT.log_ratio(found.walls, self.walls.share))

    def after(self, found: Compared) -> Experience:
        """With one more scan."""
        return Experience(self.ends.after(found.ends, SCAN.stretch), self.walls.after(found.walls, SIGHT.stretch))


def compared(points: Float64, laser: Float64, pose: Float64, view: MapView, near: int) -> Compared:
    """Lay a scan into a map.

    :param points: surfels of the scan, shape (n, 4), m, base frame.
    :param laser: where the beams begin, shape (2,), likewise.
    :param pose: ``map_T_base``, shape (3,).
    :param near: quantised distance to a surface below which a beam ends on it.
    """
    met, passed = met_and_passed(points, laser, pose, view, near)
    ends = Agreement(len(points), *agreement(points, pose, view, near, 2 * near))
    return Compared(ends, Agreement(met + passed, met, passed))
