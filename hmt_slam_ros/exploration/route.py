"""Ways through an HMT map: over keyframes, each place given in the frame of one, so that they move with the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reachable


@dataclass(frozen=True, eq=False)
class Route:
    """A way.

    :ivar keyframes: n of them.
    :ivar points: shape (n, 2), m, each in the frame of its keyframe's base.
    """

    keyframes: tuple[int, ...]
    points: Float64

    @classmethod
    def over(cls, first: Float64, keyframes: list[int], last: Float64) -> Route:
        """Over places where keyframes were taken.

        :param first: shape (i, 2), a way to the first keyframe in its frame, m.
        :param last: shape (k, 2), a way from the last keyframe on in its frame, m.
        """
        names = (*[keyframes[0]] * len(first), *keyframes, *[keyframes[-1]] * len(last))
        return cls(names, np.concatenate((first, np.zeros((len(keyframes), 2)), last)))


class Frames:
    """Where keyframes are as a robot sees them that is in one area of a map."""

    def __init__(self, hybrid_map: HybridMap, area: int) -> None:
        self.area = area
        self._areas = {other: belief.mean for other, belief in reachable(hybrid_map, area).items()}
        self._poses = {
            keyframe: (other, pose) for other in self._areas for keyframe, pose in hybrid_map.keyframes(other).items()
        }

    def __contains__(self, keyframe: object) -> bool:
        """Whether a keyframe is in the map still."""
        return keyframe in self._poses

    def knows(self, route: Route) -> bool:
        """Whether all its keyframes are in the map still."""
        return all(keyframe in self._poses for keyframe in route.keyframes)

    def placed(self, keyframe: int) -> tuple[int, Float64]:
        """The area of a keyframe, and its pose in that (3,)."""
        return self._poses[keyframe]

    def pose(self, keyframe: int) -> Float64:
        """``area_T_keyframe`` (3,)."""
        area, pose = self._poses[keyframe]
        return se2.compose(self._areas[area], pose)

    def way(self, route: Route, pose: Float64) -> Float64:
        """The places of a route (n, 2) in the frame of the base, m.

        :param pose: ``area_T_base`` (3,).
        """
        frames = {keyframe: self.pose(keyframe) for keyframe in dict.fromkeys(route.keyframes)}
        placed = np.array([frames[keyframe] for keyframe in route.keyframes])
        return se2.transform(se2.inverse(pose), se2.transform(placed, route.points))
