"""Loops that landmarks propose to TSBI: known areas are looked for as if an arc closed the loop.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.5, as a generator of candidates: the belief over places tells which
areas may be one, and how they lie to each other, without any prior by the arcs (places/map_loops.py). What is proposed
is no evidence and stays no arc. It is where keyframes are laid into known areas, and whether they fit there decides
(topology/closure_search.py).
"""

from __future__ import annotations

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.places.area_views import AreaViews
from hmt_slam_ros.places.map_loops import MapLoop, MapLoops
from hmt_slam_ros.processes.messages import Notice
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reached
from hmt_slam_ros.topology.unknown import telling_arc

PROBABLE = 0.5
"""Hypotheses of this probability are asked for loops."""

# Keyframes that are looked at ahead, at a time.
_AHEAD = 32

_TEXT = (
    "landmarks on the way from area {} to area {} are those up to area {}: a loop is looked for there, and nothing is "
    "to do"
)


class LoopProposals:
    """Supposes arcs."""

    def __init__(self, configuration: Configuration, views: AreaViews) -> None:
        """:param views: what areas show."""
        self._loops, self._views = MapLoops(configuration, views), views
        # Areas whose position is known this well, m, are told from others by the arcs, or looked for all the same.
        self._told_by_arcs = min(configuration.places.spacing, configuration.tsbi.prior_limit)
        self._untold: list[MapLoop] = []
        self._told: set[tuple[int, int]] = set()

    def proposed(self, hybrid_map: HybridMap) -> MapLoop | None:
        """The newest loop that landmarks propose and no arc closes; None for none."""
        loop = self._loops.newest(hybrid_map)
        return None if loop is None or telling_arc(hybrid_map, loop.area, loop.other) is not None else loop

    def supposed(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with an arc where one is proposed; the map itself where none is, and where the arcs know all.

        :param area: the robot's.
        """
        loop = self.proposed(hybrid_map) if self._is_asked(hybrid_map, area) else None
        if loop is None:
            return hybrid_map
        self._untold.append(loop)
        supposed = hybrid_map.branch()
        supposed.set_arc(loop.area, loop.other, loop.pose, closure=False)
        return supposed

    def look_ahead(self, hybrid_map: HybridMap, area: int) -> None:
        """Between cuts, look up a part of what areas show, which the next cut would ask for.

        :param area: the robot's.
        """
        if self._is_asked(hybrid_map, area):
            areas = ((known, hybrid_map.keyframes(known)) for known in hybrid_map.area_ids())
            self._views.look_ahead(areas, _AHEAD)

    def _is_asked(self, hybrid_map: HybridMap, area: int) -> bool:
        """Whether the arcs leave open where an area is, seen from that of the robot."""
        return len(reached(hybrid_map, area, self._told_by_arcs**2).areas) < len(hybrid_map.area_ids())

    def notices(self) -> list[Notice]:
        """What was proposed since this was asked last, each pair of areas once."""
        new = {(loop.area, loop.other): loop for loop in self._untold if (loop.area, loop.other) not in self._told}
        self._untold.clear()
        self._told.update(new)
        return [Notice("tsbi", _TEXT.format(loop.begin, loop.area, loop.other)) for loop in new.values()]
