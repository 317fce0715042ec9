"""How far from the most probable hypothesis the others have the robot: a belief with several peaks, as one Gaussian."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.processes.replica import FIRST_AREA, Replica
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reachable


def ambiguity(replica: Replica, poses: Mapping[int, NDArray[np.float64]]) -> NDArray[np.float64]:
    """The second moment of the robot's pose under all live hypotheses, about its pose under the most probable one.

    p(x) = sum_h P(h) p(x | h) has the covariance of its peaks besides that within each. All are placed along the least
    uncertain paths, so that what they differ in is what they claim.

    :param poses: {hypothesis: ``area_T_base`` in the hypothesis's area, shape (3,)}.
    :returns: shape (3, 3), of x, y along the axes of the map, m, and the heading, rad; 0 where one hypothesis is left.
    """
    found = np.zeros((3, 3))
    if len(replica.maps) == 1:
        return found
    placed = {h: _in_map(replica.maps[h], replica.areas[h], poses[h]) for h in replica.maps}
    best = placed[replica.best]
    if best is None:
        return found
    for hypothesis, pose in placed.items():
        if pose is not None:
            away = pose - best
            away[2] = se2.wrap(away[2])
            found += replica.probabilities[hypothesis] * np.outer(away, away)
    return found


def _in_map(hybrid_map: HybridMap, area: int, pose: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """``map_T_base``, or None where no arc joins the area with the first."""
    frame = reachable(hybrid_map, FIRST_AREA, until=(area,)).get(area)
    return None if frame is None else se2.compose(frame.mean, pose)
