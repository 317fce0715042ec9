"""What the acceptance of closures changed in the map, and how that is taken back.

Alignment and refinement move the keyframes of the areas that a closure joined, and let the arcs around them agree with
it, whether it is true or false. What was stored in these areas since was placed beside keyframes that had been moved,
and goes back with the nearest of them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.common_map import ArcValue, Pair
from hmt_slam_ros.topology.hybrid_map import HybridMap

Pose = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Undo:
    """Values before an acceptance.

    :ivar keyframes: {keyframe: its area, ``area_T_base``, shape (3,)}.
    :ivar arcs: {arc: its value}.
    """

    keyframes: Mapping[int, tuple[int, Pose]]
    arcs: Mapping[Pair, ArcValue]

    def but_for(self, arcs: Collection[Pair]) -> Undo:
        """The same, leaving alone some arcs."""
        return Undo(self.keyframes, {pair: value for pair, value in self.arcs.items() if pair not in arcs})

    def without(self, area: int) -> Undo:
        """The same, leaving alone what is around an area that became part of another.

        Its keyframes go back with the nearest of the other's.
        """
        return Undo(
            {keyframe: place for keyframe, place in self.keyframes.items() if place[0] != area},
            {pair: value for pair, value in self.arcs.items() if area not in pair},
        )

    def apply_to_arcs(self, hybrid_map: HybridMap) -> None:
        """Give the arcs that are still there their former values."""
        for pair, value in self.arcs.items():
            if hybrid_map.arc_value(*pair) is not None:
                hybrid_map.set_arc(*pair, value.pose, closure=value.closure)


class Return:
    """The way back of what is stored in areas whose keyframes an acceptance moved."""

    def __init__(self, undo: Undo, hybrid_map: HybridMap) -> None:
        """:param hybrid_map: as it is, with what is to be undone."""
        self._undo = undo
        placed = {
            keyframe: (area, former, hybrid_map.keyframes(area)[keyframe])
            for keyframe, (area, former) in undo.keyframes.items()
            if keyframe in hybrid_map.keyframes(area)
        }
        self._areas: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        for area in {area for area, _, _ in placed.values()}:
            own = [(former, now) for where, former, now in placed.values() if where == area]
            former, now = (np.array(poses) for poses in zip(*own, strict=True))
            self._areas[area] = (former, now)

    def at(self, area: int, pose: Pose) -> Pose:
        """``former_T_now`` of an area's frame for what is beside a pose in it, shape (3,)."""
        if area not in self._areas:
            return np.zeros(3)
        former, now = self._areas[area]
        nearest = int(np.argmin(np.hypot(*(now[:, :2] - pose[:2]).T)))
        return se2.compose(former[nearest], se2.inverse(now[nearest]))

    def placed(self, area: int, pose: Pose) -> Pose:
        """Where something at a pose in an area was before, shape (3,)."""
        return se2.compose(self.at(area, pose), pose)

    def arc(self, source: int, target: int, belief: PoseGaussian) -> PoseGaussian:
        """The belief over ``source_T_target`` of an arc that was measured since."""
        one = self.at(source, belief.mean)
        other = self.at(target, belief.inverse().mean)
        return PoseGaussian(se2.compose(se2.compose(one, belief.mean), se2.inverse(other)), belief.covariance)

    def keyframes(self, hybrid_map: HybridMap) -> None:
        """Put all keyframes of the areas where they were before, or would have been stored."""
        for area in self._areas:
            for keyframe, pose in list(hybrid_map.keyframes(area).items()):
                known = self._undo.keyframes.get(keyframe)
                there = known is not None and known[0] == area
                hybrid_map.place(keyframe, area, known[1] if known and there else self.placed(area, pose))

    def arcs(self, hybrid_map: HybridMap, since: Collection[Pair]) -> None:
        """Undo the arcs, and correct those that were measured since."""
        for a, b in since:
            value = hybrid_map.arc_value(a, b)
            if value is not None and (a, b) not in self._undo.arcs:
                hybrid_map.set_arc(a, b, self.arc(a, b, value.pose), closure=value.closure)
        self._undo.apply_to_arcs(hybrid_map)
