"""Whether a stored area is a hallway or a room, from its keyframes alone."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.features.hallway import AreaClass, area_class, free_space
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.local_map.virtual_lines import rays_of_map
from hmt_slam_ros.local_map.virtual_scan import virtual_scan
from hmt_slam_ros.sensing import Scan

# Beams of the virtual scans, and how far they go, m.
_BEAMS, _REACH = 360, 10.0


class AreaKinds:
    """Tells areas apart, one after the other; what it needs to do so is made once."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping, self._features = mapping, mapping.configuration.features

    def of(self, scans: Iterable[Scan], poses: Float64) -> AreaClass | None:
        """What an area is; None where too little is known around its keyframes.

        :param scans: of its keyframes, in the order in which they were taken.
        :param poses: shape (n, 3), their ``area_T_base``, m and rad.
        """
        table = self._mapping.pool.empty_table()
        for scan, pose in zip(scans, poses, strict=True):
            self._mapping.insert(table[None], np.ascontiguousarray(pose[None]), scan)
        view = self._mapping.pool.view(table)
        virtual = (virtual_scan(view, pose, _BEAMS, _REACH) for pose in poses)
        spaces = [space for own in virtual if (space := free_space(rays_of_map(own, self._features)))]
        self._mapping.pool.release(table)
        return area_class(spaces, self._features) if spaces else None
