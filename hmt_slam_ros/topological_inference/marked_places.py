"""Where marks put a lost robot (docs/decisions/0088-marks-of-a-lost-robot.md).

A mark that was visited before puts the robot's keyframes at a pose, if it is right. So the prior over the places of the
map is a mixture of "it is no evidence", which leaves it flat, and "they are where it was visited".
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.same_place import areas_of
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.marks import PLACEMENT_COVARIANCE, MarkMemory, MarkVisit, agreement2

_MAX_MARKS = 8
"""Marks that count in a search, the newest."""

_SIGMA = 1.0
"""Largest deviation of an area's position beside that of an earlier visit, m: that of an arc traveled once."""

_GATE = chi_square_gate(0.999)
"""Gate of the squared Mahalanobis distance between a candidate and a pose by a right mark."""
"""Gate of the squared Mahalanobis distance between a candidate and a pose by a right mark."""


class MarkedPose(NamedTuple):
    """The pose of keyframes by a mark and one of its earlier visits.

    :ivar area: of the earlier visit.
    :ivar belief: over ``area_T_reference``, the first of the keyframes.
    """

    area: int
    belief: PoseGaussian


@dataclass(frozen=True, eq=False)
class MarkedPlaces:
    """Where marks put the keyframes of a lost robot.

    :ivar marks: the poses by each mark, one of which is right if the mark is.
    :ivar wrong_share: prior probability that a mark is wrong.
    :ivar arc_scale2: factor on the covariance of arcs.
    """

    marks: tuple[tuple[MarkedPose, ...], ...] = ()
    wrong_share: float = 1.0
    arc_scale2: float = 1.0

    @property
    def log_unmarked(self) -> float:
        """Log of the factor on the prior of places where no mark puts the keyframes, nats."""
        return len(self.marks) * math.log(self.wrong_share)

    def area_factors(self, areas: Collection[int], flat: float) -> dict[int, float]:
        """{area: factor on its prior}.

        :param flat: prior of each.
        """
        factors = dict.fromkeys(areas, 1.0)
        for poses in self.marks:
            counts = {area: sum(pose.area == area for pose in poses) for area in areas}
            for area, count in counts.items():
                factors[area] *= self._mix(count / len(poses), flat)
        return factors

    def log_factors(self, hybrid_map: HybridMap, candidates: Sequence[PoseCandidate], flat: float) -> list[float]:
        """Log of the factor on the prior of each candidate, nats.

        :param flat: prior of each.
        """
        logs = [0.0] * len(candidates)
        targets = {candidate.area for candidate in candidates}
        for poses in self.marks:
            agreements = np.zeros(len(candidates))
            for pose in poses:
                paths = self._paths(hybrid_map, pose.area, targets)
                agreements += [_agreement(paths, pose, candidate) for candidate in candidates]
            for n, agreement in enumerate((agreements / len(poses)).tolist()):
                logs[n] += math.log(self._mix(agreement, flat))
        return logs

    def _mix(self, agreement: float, flat: float) -> float:
        """The mixture of both priors, as a factor on the flat one."""
        return self.wrong_share + (1.0 - self.wrong_share) * agreement / flat

    def _paths(self, hybrid_map: HybridMap, area: int, targets: Collection[int]) -> dict[int, PoseGaussian]:
        """{other area: belief over ``area_T_other``} of those beside an area."""
        if not hybrid_map.has_area(area):
            return {}
        paths = shortest_path_beliefs(hybrid_map, area, _SIGMA**2, targets=targets)
        return {other: PoseGaussian(path.mean, self.arc_scale2 * path.covariance) for other, path in paths.items()}


NO_MARKS = MarkedPlaces()


class MarkedPlaceFinder:
    """Finds where marks put keyframes."""

    def __init__(self, configuration: Configuration) -> None:
        self._wrong_share = configuration.marks.wrong_share
        self._arc_scale2 = configuration.tsbi.prior_scale**2

    def find(
        self, hybrid_map: HybridMap, poses: Mapping[int, Float64], before: int, memory: MarkMemory
    ) -> MarkedPlaces:
        """The poses of keyframes by the marks that are visited at them, and were before.

        :param poses: {keyframe: ``reference_T_base`` (3,)}.
        :param before: the map is that of the keyframes before this one.
        """
        marks = []
        for visit, earlier in memory.repeated_visits(poses):
            known = [one for one in earlier if one.keyframe < before]
            areas = areas_of(hybrid_map, {one.keyframe for one in known})
            found = [
                _marked_pose(hybrid_map, areas[one.keyframe], one, visit, poses[visit.keyframe])
                for one in known
                if one.keyframe in areas
            ]
            if found:
                marks.append((visit.first_event, tuple(found)))
        newest = sorted(marks, key=lambda mark: mark[0])[-_MAX_MARKS:]
        if not newest:
            return NO_MARKS
        return MarkedPlaces(tuple(found for _, found in newest), self._wrong_share, self._arc_scale2)


def _marked_pose(hybrid_map: HybridMap, area: int, earlier: MarkVisit, visit: MarkVisit, pose: Float64) -> MarkedPose:
    """The pose of the reference by two visits of a mark.

    :param area: that of the earlier visit.
    :param pose: ``reference_T_base`` of the later one's keyframe, shape (3,).
    """
    keyframe = PoseGaussian(hybrid_map.keyframes(area)[earlier.keyframe], PLACEMENT_COVARIANCE)
    reference = PoseGaussian(se2.inverse(pose), PLACEMENT_COVARIANCE)
    return MarkedPose(area, keyframe.compose(earlier.pose.inverse()).compose(visit.pose).compose(reference))


def _agreement(paths: Mapping[int, PoseGaussian], pose: MarkedPose, candidate: PoseCandidate) -> float:
    """How well a candidate agrees with a pose by a mark: 0 beyond the gate, 1 for half of the right ones."""
    path = paths.get(candidate.area)
    if path is None:
        return 0.0
    distance2 = path.compose(candidate.mode.measured).mahalanobis2(pose.belief)
    return agreement2(distance2) if distance2 <= _GATE else 0.0
