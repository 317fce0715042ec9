"""Where a closure lies, by all that was seen in the two areas until it was accepted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, match_moments
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.registration import scan_to_map
from hmt_slam_ros.registration.area_to_area import MatchSettings, match_areas
from hmt_slam_ros.registration.likelihood_grid import AreaGrid, GridModel, build_area_grid
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.scan import transform_surfels
from hmt_slam_ros.submap.local_mapping import LocalMapping

PlacedScan: TypeAlias = tuple[Scan, NDArray[np.float64]]


class AreaAlignment:
    """Lays several scans as one rigid body onto several others.

    First all poses are searched that the closure's own uncertainty admits: a step downhill from where it put the scans
    ends at the next likeness, which along a bare wall or across a hall may be meters away. From the best of them,
    Gauss-Newton on the map's distance field with Cauchy weights goes on below the width of the search's cells.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._model = GridModel.from_configuration(configuration)
        self._settings = MatchSettings.from_options(configuration.tsbi)
        self._mapping = LocalMapping(configuration)
        self._alignment = self._mapping.alignment._replace(inflation=1.0 / configuration.matching.temper)
        self._gate = chi_square_gate(configuration.tsbi.gate_probability)
        self._inflation = configuration.tlca.alignment_inflation

    def align(
        self, known: Sequence[PlacedScan], joined: Sequence[PlacedScan], closure: PoseGaussian
    ) -> PoseGaussian | None:
        """The belief over ``known_T_joined`` by the scans alone, all ways to fit taken together.

        :param known: (scan, ``known_T_base``) of the keyframes that the area held before.
        :param joined: (scan, ``joined_T_base``) of those that joined it.
        :param closure: belief over ``known_T_joined``, as TSBI found it with what is around the area as well.
        :returns: None where the scans tell no more than the closure did.
        """
        modes = match_areas(self._build_grid(joined), self._build_grid(known), closure, self._settings).modes
        found = match_moments([(mode.measured, mode.log_mass) for mode in modes]) if modes else closure
        if np.linalg.det(found.covariance) >= np.linalg.det(closure.covariance):
            return None
        table = self._mapping.pool.empty_table()
        for scan, pose in known:
            self._mapping.insert_scan(table[None], pose[None], scan)
        start = [
            transform_surfels(se2.compose(found.mean, pose), self._mapping.matching_surfels(scan))
            for scan, pose in joined
        ]
        offset = self._refine_offset(np.concatenate(start), closure, found, self._mapping.pool.view(table))
        self._mapping.pool.release(table)
        covariance = min(self._inflation * found.covariance, closure.covariance, key=np.linalg.det)
        return PoseGaussian(se2.compose(offset, found.mean), covariance)

    def _build_grid(self, placed: Sequence[PlacedScan]) -> AreaGrid:
        poses = np.array([pose for _, pose in placed]).reshape(-1, 3)
        return build_area_grid([scan for scan, _ in placed], poses, self._model)

    def _refine_offset(
        self, points: NDArray[np.float64], closure: PoseGaussian, found: PoseGaussian, view: GridView
    ) -> NDArray[np.float64]:
        """The motion ``D`` in the area's frame, shape (3,), that makes ``found`` fit better.

        What walls leave open the closure holds, and what was found is not left for another likeness.
        """
        held, near = (np.linalg.inv(belief.inverse().covariance) for belief in (closure, found))
        stay = np.zeros(3)
        prior = scan_to_map.Prior(stay, held.astype(np.float64, copy=False))
        offset, _ = scan_to_map.align(points, stay, prior, view, self._alignment)
        return offset if offset @ near @ offset <= self._gate else stay
