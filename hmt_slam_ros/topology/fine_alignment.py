"""Fine alignment of keyframes that joined an area with the keyframes that it held before."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.chi_square import gate
from hmt_slam_ros.local_map import matching
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.local_map.patches import MapView
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.sensing.surfels import moved

Placed = tuple[Scan, NDArray[np.float64]]


class FineAlignment:
    """Moves several scans as one rigid body onto the map of several others.

    Gauss-Newton on the map's distance field with Cauchy weights and the closure's own uncertainty as prior, which holds
    the directions that the walls leave open, such as along a corridor.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._mapping = LocalMapping(configuration)
        self._alignment = self._mapping.alignment._replace(inflation=1.0 / configuration.matching.temper)
        self._gate = gate(configuration.tsbi.gate_probability)

    def offset(
        self, known: Iterable[Placed], joined: Iterable[Placed], covariance: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """The motion in the area's frame by which the joined keyframes fit better.

        :param known: (scan, ``area_T_base``) of the keyframes that the area held before.
        :param joined: (scan, ``area_T_base``) of those that joined.
        :param covariance: shape (3, 3), how uncertain the closure put them there, in the area's frame.
        :returns: ``D``, shape (3,), that makes ``area_T_base`` into ``D * area_T_base``; None where nothing fits better
            within the gate of the closure.
        """
        table = self._mapping.pool.empty_table()
        for scan, pose in known:
            self._mapping.insert(table[None], pose[None], scan)
        points = np.concatenate(
            [
                np.zeros((0, 4)),
                *(moved(pose, self._mapping.matching_points(scan)) for scan, pose in joined),
            ]
        )
        found = self._aligned(points, covariance, self._mapping.pool.view(table))
        self._mapping.pool.release(table)
        return found

    def _aligned(
        self, points: NDArray[np.float64], covariance: NDArray[np.float64], view: MapView
    ) -> NDArray[np.float64] | None:
        stay = np.zeros(3)
        information = np.linalg.inv(covariance).astype(np.float64, copy=False)
        found, _ = matching.align(points, stay, matching.Prior(stay, information), view, self._alignment)
        if found @ information @ found > self._gate:
            return None
        before, after = (matching.log_ratio(points, *pose, view, self._mapping.model) for pose in (stay, found))
        return found if after > before else None
