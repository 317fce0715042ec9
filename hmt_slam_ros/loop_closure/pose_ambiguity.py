"""How far from the most probable hypothesis the others have the robot: a belief with several peaks, as one Gaussian."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import reachable
from hmt_slam_ros.messages.replica import FIRST_AREA, Replica

Frame = tuple[int, int, int]


class Ambiguity:
    """Remembers where each hypothesis has the robot's area, as long as nothing about it changes.

    :ivar frames: {(hypothesis, number of the last change of its map, area): ``map_T_area``, shape (3,), or None where
        no arc joins the area with the first}.
    """

    def __init__(self, frames: Mapping[Frame, NDArray[np.float64] | None] | None = None) -> None:
        """:param frames: to go on from."""
        self.frames = dict(frames or {})

    def of(
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
            self.frames = {}
            return found
        named = {h: (h, versions[h], replica.areas[h]) for h in replica.maps}
        self.frames = {
            name: self.frames[name] if name in self.frames else _frame(replica.maps[h], replica.areas[h])
            for h, name in named.items()
        }
        frames = {h: frame for h, name in named.items() if (frame := self.frames[name]) is not None}
        if replica.best in frames:
            placed = {h: se2.compose(frame, poses[h]) for h, frame in frames.items()}
            for hypothesis, pose in placed.items():
                away = pose - placed[replica.best]
                away[2] = se2.wrap(away[2])
                found += replica.probabilities[hypothesis] * np.outer(away, away)
        return found


def _frame(hybrid_map: HybridMap, area: int) -> NDArray[np.float64] | None:
    """``map_T_area``, or None where no arc joins the area with the first."""
    belief = reachable(hybrid_map, FIRST_AREA, until=(area,)).get(area)
    return None if belief is None else belief.mean
