"""Components: the maps of several robots as one hybrid map, joined by arcs of which nothing is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import consistent_map
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions
from hmt_slam_ros.messages.map_changes import Pose
from hmt_slam_ros.messages.team import NO_REPETITION, Repetition
from hmt_slam_ros.registration.consistency import MAPS_OUTLIER_RATE, NO_CLUTTER, Clutter
from hmt_slam_ros.sensors import Scan

_GAP = 20.0
"""Distance at which components are drawn beside one another while their place is unknown, m."""


@dataclass(frozen=True, eq=False)
class Component:
    """A map as a part of the map of a team.

    :ivar hybrid_map: its areas and arcs; it is not changed.
    :ivar scans: {keyframe: scan} of its keyframes.
    :ivar clutter: usual rate of contradictions of the map.
    :ivar repetition: what the map shows in itself.
    :ivar pose: shape (3,), of its first area in the frame of the robot's map, of which it may be a piece.
    """

    hybrid_map: HybridMap
    scans: Mapping[int, Scan]
    clutter: Clutter = NO_CLUTTER
    repetition: Repetition = NO_REPETITION
    pose: Pose = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def of_map(
        cls,
        hybrid_map: HybridMap,
        scans: Mapping[int, Scan],
        clutter: Clutter = NO_CLUTTER,
        repetition: Repetition = NO_REPETITION,
    ) -> Component:
        """The component of a whole map.

        :param scans: of its keyframes at least.
        :param clutter: usual rate of contradictions of the map.
        :param repetition: what the map shows in itself.
        """
        areas = hybrid_map.area_ids()
        return cls(
            hybrid_map.subgraph(areas),
            {keyframe: scans[keyframe] for area in areas for keyframe in hybrid_map.keyframes(area)},
            clutter,
            repetition,
        )


class Shift(NamedTuple):
    """What was added to the numbers of a component's areas and keyframes."""

    areas: int = 0
    keyframes: int = 0


@dataclass(frozen=True, eq=False)
class ComponentPair:
    """Two components as one hybrid map. The second has the larger numbers of areas and of keyframes.

    :ivar hybrid_map: of both, with an uninformative arc between their first areas.
    :ivar scans: {keyframe: scan} of both.
    :ivar known: areas of the first.
    :ivar other: areas of the second.
    :ivar first_keyframe: number from which on keyframes are those of the second.
    :ivar area_shift: added to the numbers of the second's areas.
    :ivar clutters: usual rates of contradictions of the first and of the second.
    :ivar repetitions: what the first map shows in itself, and the second.
    :ivar poses: of the first areas of both in the frames of the robots' maps, each of shape (3,).
    """

    hybrid_map: HybridMap
    scans: Mapping[int, Scan]
    known: tuple[int, ...]
    other: tuple[int, ...]
    first_keyframe: int
    area_shift: int
    clutters: tuple[Clutter, Clutter]
    repetitions: tuple[Repetition, Repetition]
    poses: tuple[Pose, Pose]

    @property
    def joint(self) -> tuple[int, int]:
        """The areas between which the uninformative arc is."""
        return self.known[0], self.other[0]

    @property
    def clutter(self) -> Clutter:
        """Usual rate of contradictions between the two: that of maps, and what either has more than that.

        That of walls is for two looks at one map, of which each counts half.
        """
        beams = sum(max(0.0, each.beam_outlier_rate - MAPS_OUTLIER_RATE) for each in self.clutters)
        return Clutter(MAPS_OUTLIER_RATE + beams, 0.5 * sum(each.wall_outlier_rate for each in self.clutters))

    def between_maps(self, pose: Pose) -> Pose:
        """``first_T_second`` of the frames of the robots' maps, shape (3,).

        :param pose: that of the first areas of both, shape (3,).
        """
        return se2.compose(se2.compose(self.poses[0], pose), se2.inverse(self.poses[1]))

    def as_one(self, hybrid_map: HybridMap) -> Component:
        """Both as one component, with another hybrid map, and the larger of the rates."""
        clutter = Clutter(*(max(rates) for rates in zip(*self.clutters, strict=True)))
        return Component(hybrid_map, self.scans, clutter, pose=self.poses[0])


def combine(first: Component, second: Component, shifts: Shift | None = None) -> ComponentPair:
    """Two components, each with one area or more, as one hybrid map.

    :param shifts: what is added to the numbers of the second; as little as possible if None.
    """
    area_shift, keyframe_shift = shifts or Shift(first.hybrid_map.max_area_id + 1, max(first.scans) + 1)
    shifted = renumber(second.hybrid_map, area_shift, keyframe_shift)
    areas = first.hybrid_map.area_ids()
    combined = first.hybrid_map.subgraph(areas)
    for area in shifted.area_ids():
        combined.changed_areas[area] = dict(shifted.keyframes(area))
    combined.changed_arcs |= {(a, b): arc for a, b, arc in shifted.all_arcs()}
    others = shifted.area_ids()
    place = uninformative_belief(_pose_beside(first.hybrid_map, shifted))
    combined.set_arc(areas[0], others[0], place, closure=False)
    combined.commit()
    scans = dict(first.scans) | {keyframe + keyframe_shift: scan for keyframe, scan in second.scans.items()}
    return ComponentPair(
        combined,
        scans,
        known=tuple(areas),
        other=tuple(others),
        first_keyframe=keyframe_shift,
        area_shift=area_shift,
        clutters=(first.clutter, second.clutter),
        repetitions=(first.repetition, second.repetition),
        poses=(first.pose, second.pose),
    )


def renumber(hybrid_map: HybridMap, area_shift: int, keyframe_shift: int) -> HybridMap:
    """The same map with other numbers of its areas and keyframes.

    :param area_shift: added to the number of each area; ``keyframe_shift`` to that of each keyframe.
    """
    shifted = HybridMap()
    for area in hybrid_map.area_ids():
        keyframes = hybrid_map.keyframes(area)
        shifted.changed_areas[area + area_shift] = {k + keyframe_shift: pose for k, pose in keyframes.items()}
    for a, b, arc in hybrid_map.all_arcs():
        shifted.changed_arcs[a + area_shift, b + area_shift] = arc
    shifted.commit()
    return shifted


def _pose_beside(first: HybridMap, second: HybridMap) -> Float64:
    """A pose of the second map's first area in the first's, shape (3,), at which neither lies over the other."""
    x = _positions(first)[:, 0].max() - _positions(second)[:, 0].min() + _GAP
    return np.array([x, 0.0, 0.0])


def _positions(hybrid_map: HybridMap) -> Float64:
    """Positions of all keyframes in the frame of the first area, shape (n, 2), m."""
    poses = consistent_map(hybrid_map).poses
    return np.concatenate([keyframe_positions(hybrid_map, area, belief.mean) for area, belief in poses.items()])
