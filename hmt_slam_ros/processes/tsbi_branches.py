"""What becomes of a hypothesis at an event: as it was before, and each of its continuations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.agreement import NO_CLUTTER, Clutter
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.map_parts import Arc, ArcEnds, Merged, Relabelled
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.hypothesis_tree import LeafNotes
from hmt_slam_ros.topology.whereabouts import Whereabouts


@dataclass(frozen=True, eq=False)
class Parent:
    """A hypothesis before the event.

    :ivar log_weight: log of its probability, the newest scan's evidence included.
    :ivar share: its probability before, by which hypotheses share the areas that are examined at an event.
    :ivar clutter: what contradicts its map usually.
    """

    hypothesis: int
    area: int
    hybrid_map: HybridMap
    notes: LeafNotes
    log_weight: float
    share: float = 1.0
    clutter: Clutter = NO_CLUTTER

    def around(self) -> dict[int, NDArray[np.float64]]:
        """{area: ``area_T_other``} of the local map's other areas."""
        return {area: pose for area, pose in self.notes.local.items() if self.hybrid_map.has_area(area)}

    def covariance(self, keyframe: int) -> NDArray[np.float64]:
        """Of a keyframe's pose in the robot's area, shape (3, 3)."""
        return self.notes.covariances.get(keyframe, np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Child:
    """One continuation of a hypothesis.

    :ivar parent: id of the hypothesis that it continues.
    :ivar log_weight: log of its weight, unnormalised.
    :ivar reload: whether the local map has to be loaded anew.
    """

    parent: int
    log_weight: float
    area: int
    notes: LeafNotes
    rebase: PoseGaussian | None = None
    relabelled: tuple[Relabelled, ...] = ()
    arcs: tuple[Arc, ...] = ()
    reload: bool = False
    withdrawn: tuple[ArcEnds, ...] = ()
    merged: Merged | None = None


class Branches(NamedTuple):
    """All continuations of one hypothesis.

    :ivar looked: whether known areas were looked for.
    :ivar log_skipped: log of the weight of those that were not looked at.
    :ivar where: where in the map a robot may be of which nothing told how it came there, if that was asked.
    """

    children: list[Child]
    looked: bool = False
    log_skipped: float = -math.inf
    where: Whereabouts | None = None
