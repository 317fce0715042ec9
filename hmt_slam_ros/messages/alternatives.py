"""The message with the maps of the live hypotheses beside the most probable one, as changes against its map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.map_changes import ArcEnds, Pose
from hmt_slam_ros.messages.replica import Replica

MAX_ALTERNATIVES = 10
"""Hypotheses of a message, the most probable."""


@dataclass(frozen=True, eq=False, slots=True)
class AlternativeArea:
    """An area in the map of a hypothesis.

    :ivar area: id of the area.
    :ivar pose: shape (3,), ``map_T_area``, m and rad.
    :ivar has_own_keyframes: whether ``keyframes`` replaces what the most probable hypothesis has in this area.
    :ivar keyframes: numbers of its n keyframes; those of other robots are below -1.
    :ivar poses: ``area_T_base`` of each, shape (3,), m and rad.
    """

    area: int
    pose: Pose
    has_own_keyframes: bool = False
    keyframes: tuple[int, ...] = ()
    poses: tuple[Pose, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class AlternativeArc:
    """An arc that the most probable hypothesis lacks.

    :ivar source: the area with the smaller id.
    :ivar target: the area with the larger id.
    :ivar closure: whether it closes a loop.
    """

    source: int
    target: int
    closure: bool


@dataclass(frozen=True, eq=False, slots=True)
class Alternative:
    """A live hypothesis.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the robot's area.
    :ivar pose: shape (3,), ``area_T_base`` of the robot at the newest keyframe event, m and rad.
    :ivar areas: all its areas that arcs join to the map's frame, ordered by id.
    :ivar arcs: arcs that it has and the most probable one lacks, ordered by their ends.
    :ivar missing_arcs: arcs that it lacks and the most probable one has, likewise.
    """

    hypothesis: int
    area: int
    pose: Pose
    areas: tuple[AlternativeArea, ...]
    arcs: tuple[AlternativeArc, ...]
    missing_arcs: tuple[ArcEnds, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Alternatives:
    """tlca -> view, other programs: how the maps of the other live hypotheses differ from that in ``topology``.

    :ivar events: number of keyframe events that the maps have.
    :ivar best: the most probable hypothesis.
    :ivar hypotheses: the others, the most probable first; of many the first ten.
    """

    events: int
    best: int
    hypotheses: tuple[Alternative, ...]

    @classmethod
    def from_replica(
        cls,
        replica: Replica,
        area_poses: Mapping[int, Mapping[int, Float64]],
        robot_poses: Mapping[int, Float64],
        events: int,
    ) -> Alternatives:
        """The alternatives of a replica.

        :param area_poses: {hypothesis that is shown: {area: ``map_T_area``, shape (3,)}}, ordered by probability.
        :param robot_poses: {hypothesis: ``area_T_base`` of the robot, shape (3,)}.
        :param events: number of keyframe events.
        """
        best = replica.best_hypothesis
        shown = [_alternative(replica, h, poses, robot_poses[h]) for h, poses in area_poses.items()]
        return cls(events, best, tuple(shown))


def alternative_hypotheses(replica: Replica) -> list[int]:
    """The hypotheses of a message: those beside the most probable one, the most probable first."""
    probabilities, best = replica.probabilities, replica.best_hypothesis
    return sorted(probabilities.keys() - {best}, key=lambda h: (-probabilities[h], h))[:MAX_ALTERNATIVES]


def _alternative(replica: Replica, hypothesis: int, area_poses: Mapping[int, Float64], pose: Float64) -> Alternative:
    own, best = replica.maps[hypothesis], replica.maps[replica.best_hypothesis]
    changed = {area for area in {*own.changed_areas, *best.changed_areas} if _differs(own, best, area)}
    pairs = sorted({*own.changed_arcs, *best.changed_arcs})
    arcs = [(pair, own.arc_value(*pair), best.arc_value(*pair)) for pair in pairs]
    return Alternative(
        hypothesis,
        replica.robot_areas[hypothesis],
        pose,
        tuple(_area(own, area, area_poses[area], is_changed=area in changed) for area in sorted(area_poses)),
        tuple(AlternativeArc(a, b, arc.closure) for (a, b), arc, other in arcs if arc and not other),
        tuple(ArcEnds(a, b) for (a, b), arc, other in arcs if other and not arc),
    )


def _differs(own: HybridMap, best: HybridMap, area: int) -> bool:
    """Whether an area has other keyframes or poses than the most probable hypothesis has in it."""
    if own.has_area(area) != best.has_area(area):
        return True
    one, other = (known.keyframes(area) if known.has_area(area) else {} for known in (own, best))
    return one.keys() != other.keys() or any(not np.array_equal(pose, other[k]) for k, pose in one.items())


def _area(hybrid_map: HybridMap, area: int, pose: Float64, *, is_changed: bool) -> AlternativeArea:
    if not is_changed or not hybrid_map.has_area(area):
        return AlternativeArea(area, pose)
    keyframes = hybrid_map.keyframes(area)
    return AlternativeArea(area, pose, True, tuple(keyframes), tuple(keyframes.values()))
