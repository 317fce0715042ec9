"""Hypotheses at an event: each before it, and its continuations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, AreaMerge, MovedKeyframe
from hmt_slam_ros.registration.consistency import NO_CLUTTER, Clutter
from hmt_slam_ros.topological_inference.area_comparison import Fit
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution


@dataclass(frozen=True, eq=False)
class Parent:
    """A hypothesis before the event.

    :ivar log_weight: log of its probability, the newest scan's evidence included.
    :ivar probability: its probability before, in proportion to which it may examine areas.
    :ivar clutter: usual rate of contradictions of its map.
    """

    hypothesis: int
    area: int
    hybrid_map: HybridMap
    state: HypothesisState
    log_weight: float
    probability: float = 1.0
    clutter: Clutter = NO_CLUTTER

    def local_area_poses(self) -> dict[int, Float64]:
        """{area: ``area_T_other``} of the submap's other areas."""
        return {area: pose for area, pose in self.state.local_area_poses.items() if self.hybrid_map.has_area(area)}

    def covariance(self, keyframe: int) -> Float64:
        """The covariance of a keyframe's pose in the robot's area, shape (3, 3)."""
        return self.state.covariances.get(keyframe, np.zeros((3, 3)))

    def unchanged_child(self, state: HypothesisState | None = None) -> Child:
        """The child with the robot in the same area of the same map, and with this state, if one is given."""
        return Child(self.hypothesis, self.log_weight, self.area, state or self.state)


@dataclass(frozen=True, eq=False)
class Child:
    """One continuation of a hypothesis.

    :ivar parent: id of the hypothesis that it continues.
    :ivar log_weight: log of its weight, unnormalized.
    :ivar reload_local_map: whether the submap has to be loaded again.
    :ivar fit: by which keyframes lie in a known area, if they were compared with it.
    """

    parent: int
    log_weight: float
    area: int
    state: HypothesisState
    frame_change: PoseGaussian | None = None
    moved_keyframes: tuple[MovedKeyframe, ...] = ()
    arcs: tuple[Arc, ...] = ()
    reload_local_map: bool = False
    removed_arcs: tuple[ArcEnds, ...] = ()
    area_merge: AreaMerge | None = None
    fit: Fit | None = None


class Branches(NamedTuple):
    """All continuations of one hypothesis.

    :ivar closures_searched: whether known areas were searched.
    :ivar log_skipped_weight: log of the weight of those that were not examined.
    :ivar pose_distribution: of a lost robot in the map, if it was searched.
    """

    children: list[Child]
    closures_searched: bool = False
    log_skipped_weight: float = -math.inf
    pose_distribution: PoseDistribution | None = None
