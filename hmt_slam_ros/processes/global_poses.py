"""Where the areas lie in the map, looked up in what TLCA said last, without a copy of it all."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.map_parts import AreaPose


class GlobalPoses(Mapping[int, PoseGaussian]):
    """{area: belief over ``map_T_area``}; taking over a message costs the same however many areas it has."""

    def __init__(self, areas: Sequence[AreaPose] = ()) -> None:
        """:param areas: ordered by id, as ``Accepted.global_poses`` is."""
        self._areas = areas

    @property
    def areas(self) -> tuple[AreaPose, ...]:
        """All of them, ordered by id."""
        return tuple(self._areas)

    def __getitem__(self, area: int) -> PoseGaussian:
        place = bisect_left(self._areas, area, key=attrgetter("area"))
        if place == len(self._areas) or self._areas[place].area != area:
            raise KeyError(area)
        return self._areas[place].pose

    def __iter__(self) -> Iterator[int]:
        return (entry.area for entry in self._areas)

    def __len__(self) -> int:
        return len(self._areas)
