"""Relations from a trajectory that is known to be true, as in simulation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.evaluation.relations import LONG_SPAN, Relations
from hmt_slam_ros.evaluation.trajectory import StampedPoses
from hmt_slam_ros.geometry import se2

_SPACING = 1.0  # m, driven from one pose to the next
_FAR = 10  # poses
_NEAR = 3.0  # m, within which a place is the same


def true_relations(truth: StampedPoses) -> Relations:
    """Relations of every metre of a drive: to the next, to the tenth, and to where the robot was before.

    The third kind joins each pose to the nearest one, within 3 m, of more than 60 s before; over these a missed loop
    shows.

    :param truth: in the order of time.
    """
    steps = np.hypot(*np.diff(truth.poses[:, :2], axis=0).T)
    metres = np.floor(np.concatenate(([0.0], np.cumsum(steps))) / _SPACING)
    chosen = np.flatnonzero(np.diff(metres, prepend=-1.0) > 0.0)
    stamps, poses = truth.stamps[chosen], truth.poses[chosen]
    ahead = np.arange(len(chosen))
    pairs = [np.stack((ahead[:-gap], ahead[gap:]), axis=1) for gap in (1, _FAR) if len(chosen) > gap]
    starts, ends = np.concatenate([*pairs, _revisits(stamps, poses)]).T
    return Relations(stamps[starts], stamps[ends], se2.between(poses[starts], poses[ends]))


def _revisits(stamps: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.intp]:
    """Pairs (n, 2) of an earlier pose and the later one that is nearest to it."""
    pairs = []
    for k in range(len(stamps)):
        long_ago = int(np.searchsorted(stamps, stamps[k] - LONG_SPAN, side="left"))
        if long_ago:
            distances = np.hypot(*(poses[:long_ago, :2] - poses[k, :2]).T)
            nearest = int(np.argmin(distances))
            if distances[nearest] < _NEAR:
                pairs.append((nearest, k))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)
