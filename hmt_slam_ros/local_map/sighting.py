"""A scan as the filters of a process see it."""

from __future__ import annotations

from functools import cached_property

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.features.extraction import Lines, extract_for_map
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.sensing import Scan


class Sighting:
    """A scan and what filters of either kind make of it, once for all of them and only where one asks for it.

    :ivar scan: the scan.
    """

    def __init__(self, mapping: LocalMapping, scan: Scan) -> None:
        self.scan = scan
        self._mapping = mapping

    @cached_property
    def surfels(self) -> Float64:
        """What is matched with a grid, shape (n, 4), base frame."""
        return self._mapping.matching_points(self.scan)

    @cached_property
    def lines(self) -> Lines:
        """What is compared with a map of lines."""
        return extract_for_map(self.scan, self._mapping.configuration.features)

    @property
    def laser(self) -> Float64:
        """Where the beams begin, shape (2,), likewise."""
        return self.scan.laser_pose[:2]
