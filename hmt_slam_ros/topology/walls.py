"""Do keyframes see through walls that others know? Where their surfaces fit, this tells a place from one like it.

Doors are open in one corridor and closed in the next, a wall ends sooner, a shelf stands in front of nothing: surfaces
that are there are mostly in places that look alike, too, but not each of them, and a beam that passes where one should
be is seldom an error. The walls are those of either side, and so are the beams, as what one of them did not see of the
other may be what differs.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.agreement import Agreement
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.local_map.sight import met_and_passed
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.topology.surroundings import stacked

Pose = NDArray[np.float64]

# Keyframes see each other's walls where they are this near, m.
_NEAR = 12.0


class Walls:
    """Lays keyframes into each other's maps.

    :param scans: {keyframe: scan}, which may grow.
    """

    def __init__(self, scans: Mapping[int, Scan], configuration: Configuration) -> None:
        self._scans, self._configuration = scans, configuration

    def between(self, known: Mapping[int, Pose], seen: Mapping[int, Pose]) -> Agreement:
        """Samples of the walls of either on which beams of the other end (on), and which they pass (free).

        :param known: {keyframe: ``map_T_base`` (3,)}, of which those count that are near to the others.
        :param seen: the others, likewise.
        """
        if not known or not seen:
            return Agreement(0, 0, 0)
        middle = np.append(stacked(seen)[:, :2].mean(axis=0), 0.0)
        here = stacked(seen) - middle
        there = stacked(known) - middle
        apart = np.hypot(*(there[:, None, :2] - here[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
        near = apart <= _NEAR
        scans = [self._scans[k] for k, is_near in zip(known, near, strict=True) if is_near]
        own = [self._scans[k] for k in seen]
        mapping = LocalMapping(self._configuration)
        there = there[near]
        found = _seen_in(mapping, scans, there, own, here) + _seen_in(mapping, own, here, scans, there)
        met, passed = found.tolist()
        return Agreement(met + passed, met, passed)


def _seen_in(mapping: LocalMapping, scans: list[Scan], poses: Pose, seeing: list[Scan], at: Pose) -> NDArray[np.int64]:
    """Samples that beams of some scans end on, and that they pass, in a map of others, shape (2,).

    :param poses: shape (len(scans), 3), where the map's were taken; ``at`` is where the others were.
    """
    table = mapping.pool.empty_table()
    for scan, pose in zip(scans, poses, strict=True):
        mapping.insert(table[None], pose[None], scan)
    view = mapping.pool.view(table)
    found = [
        met_and_passed(mapping.matching_points(scan), scan.laser_pose[:2], pose, view, mapping.near)
        for scan, pose in zip(seeing, at, strict=True)
    ]
    mapping.pool.release(table)
    return np.array(found, dtype=np.int64).reshape(-1, 2).sum(axis=0)
