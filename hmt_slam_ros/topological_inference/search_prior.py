"""The prior over the pose of keyframes that are searched in the whole map.

It is flat over the areas, and leaves ``UNMAPPED_PRIOR`` to unmapped ground. A pose hint replaces the flat prior by one
as wide as its covariance. Marks make it a mixture (docs/decisions/0088-marks-of-a-lost-robot.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import connected_areas
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.marked_places import NO_MARKS, MarkedPlaces
from hmt_slam_ros.topological_inference.pose_distribution import UNMAPPED_PRIOR

Pose = Float64

_HINT_DEVIATIONS = 4.0
"""Deviations of a pose hint beyond which no area is searched."""


@dataclass(frozen=True, eq=False)
class PoseHint:
    """The pose of a keyframe that a person gave.

    :ivar keyframe: its number.
    :ivar area: a known area.
    :ivar pose: belief over ``area_T_base`` of the keyframe.
    """

    keyframe: int
    area: int
    pose: PoseGaussian

    def at_first(self, poses: Mapping[int, Pose]) -> PoseHint | None:
        """The hint for the first of keyframes; None unless its own is one of them.

        :param poses: {keyframe: ``frame_T_base`` (3,)} in any frame.
        """
        if self.keyframe not in poses:
            return None
        first = next(iter(poses))
        hinted_T_first = PoseGaussian.from_pose(se2.between(poses[self.keyframe], poses[first]))
        return PoseHint(first, self.area, self.pose.compose(hinted_T_first))

    def areas_within_reach(self, hybrid_map: HybridMap, radius: float, before: int) -> set[int]:
        """The areas in which the keyframe may be.

        :param radius: largest distance to a keyframe of an area's place, m.
        :param before: the map is that of the keyframes before this one.
        """
        if not hybrid_map.has_area(self.area):
            return set()
        reach = radius + _HINT_DEVIATIONS * math.sqrt(float(np.linalg.eigvalsh(self.pose.covariance[:2, :2]).max()))
        near = set()
        for area, belief in connected_areas(hybrid_map, self.area).items():
            if min(hybrid_map.keyframes(area), default=before) >= before:
                continue
            offsets = keyframe_positions(hybrid_map, area, belief.mean) - self.pose.mean[:2]
            if np.hypot(*offsets.T).min() <= reach:
                near.add(area)
        return near

    def log_priors(self, hybrid_map: HybridMap, candidates: Sequence[PoseCandidate]) -> dict[int, float]:
        """{number of a candidate: log-prior, nats, relative to the best that there could be}.

        Candidates in areas that are not connected with that of the hint have none.
        """
        if not hybrid_map.has_area(self.area):
            return {}
        beliefs = connected_areas(hybrid_map, self.area)
        priors = {}
        for n, candidate in enumerate(candidates):
            if candidate.area in beliefs:
                pose = beliefs[candidate.area].compose(candidate.mode.measured)
                difference = se2.log(se2.between(self.pose.mean, pose.mean))
                distance = float(difference @ np.linalg.solve(self.pose.covariance + pose.covariance, difference))
                priors[n] = math.log(1.0 - UNMAPPED_PRIOR) - 0.5 * distance
        return priors


@dataclass(frozen=True, eq=False)
class SearchPrior:
    """What is known of the pose of a search's reference beside scans; flat without a hint and marks.

    :ivar hint: by a person.
    :ivar marks: where marks put it; none with a hint.
    """

    hint: PoseHint | None = None
    marks: MarkedPlaces = NO_MARKS

    @property
    def log_unmapped(self) -> float:
        """Log of the weight of unmapped ground, nats."""
        return math.log(UNMAPPED_PRIOR) + self.marks.log_unmarked

    def admitted_areas(
        self, hybrid_map: HybridMap, areas: Mapping[int, float], radius: float, before: int
    ) -> dict[int, float]:
        """Those of areas, {area: probability by its appearance}, in which the reference may be.

        :param radius: largest distance to a keyframe of an area's place, m.
        :param before: the map is that of the keyframes before this one.
        """
        if self.hint is None:
            return dict(areas)
        near = self.hint.areas_within_reach(hybrid_map, radius, before)
        return {area: probability for area, probability in areas.items() if area in near}

    def weigh_areas(self, areas: Mapping[int, float], flat: float) -> dict[int, float]:
        """{area: probability by its appearance, with the factor of marks}.

        :param areas: {area: probability by its appearance}.
        :param flat: prior of each.
        """
        factors = self.marks.area_factors(areas, flat)
        return {area: probability * factors[area] for area, probability in areas.items()}

    def log_priors(self, hybrid_map: HybridMap, candidates: Sequence[PoseCandidate], flat: float) -> list[float]:
        """Log of the prior of each candidate without marks, nats: by the hint, or flat.

        :param flat: prior of each area.
        """
        by_hint = {} if self.hint is None else self.hint.log_priors(hybrid_map, candidates)
        return [by_hint.get(n, math.log(flat)) for n in range(len(candidates))]

    def log_mark_factors(self, hybrid_map: HybridMap, candidates: Sequence[PoseCandidate], flat: float) -> list[float]:
        """Log of the factor of marks on the prior of each candidate, nats.

        :param flat: prior of each area.
        """
        return self.marks.log_factors(hybrid_map, candidates, flat)

    def without_marks(self) -> SearchPrior:
        """The prior by the hint alone."""
        return SearchPrior(self.hint)


FLAT_PRIOR = SearchPrior()
