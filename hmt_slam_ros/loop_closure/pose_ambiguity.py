"""How far from the most probable hypothesis the others have the robot: a belief with several peaks, as one Gaussian."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.messages.replica import FIRST_AREA, Replica

FrameKey = tuple[int, int, int]


class PoseAmbiguity:
    """Remembers where each hypothesis has the robot's area, as long as nothing about it changes.

    :ivar area_frames: {(hypothesis, number of the last change of its map, area): ``map_T_area``, shape (3,), or None
        where no arc joins the area with the first}.
    """

    def __init__(self, area_frames: Mapping[FrameKey, NDArray[np.float64] | None] | None = None) -> None:
        """:param area_frames: to go on from."""
        self.area_frames = dict(area_frames or {})

    def second_moment(
        self, replica: Replica, poses: Mapping[int, NDArray[np.float64]], versions: Mapping[int, int]
    ) -> NDArray[np.float64]:
        """The second moment of the robot's pose under all live hypotheses, about its pose under the most probable one.

        p(x) = sum_h P(h) p(x | h) has the covariance of its peaks besides that within each. All are placed along the
        least uncertain paths, so that what they differ in is what they claim.

        :param poses: {hypothesis: ``area_T_base`` in the hypothesis's area, shape (3,)}.
        :param versions: {hypothesis: number of the last change of its map}.
        :returns: shape (3, 3), of x, y along the axes of the map, m, and the heading, rad; 0 where one hypothesis is
            left.
        """
        found = np.zeros((3, 3))
        if len(replica.maps) == 1:
            self.area_frames = {}
            return found
        named = {h: (h, versions[h], replica.robot_areas[h]) for h in replica.maps}
        self.area_frames = {
            name: self.area_frames[name]
            if name in self.area_frames
            else _area_frame(replica.maps[h], replica.robot_areas[h])
            for h, name in named.items()
        }
        frames = {h: frame for h, name in named.items() if (frame := self.area_frames[name]) is not None}
        if replica.best_hypothesis in frames:
            placed = {h: se2.compose(frame, poses[h]) for h, frame in frames.items()}
            for hypothesis, pose in placed.items():
                away = pose - placed[replica.best_hypothesis]
                away[2] = se2.wrap(away[2])
                found += replica.probabilities[hypothesis] * np.outer(away, away)
        return found


def _area_frame(hybrid_map: HybridMap, area: int) -> NDArray[np.float64] | None:
    """``map_T_area``, or None where no arc joins the area with the first."""
    belief = shortest_path_beliefs(hybrid_map, FIRST_AREA, targets=(area,)).get(area)
    return None if belief is None else belief.mean
