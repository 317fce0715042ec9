"""The landmarks of Tomatis, Nourbakhsh and Siegwart (2003) as evidence for topological inference."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import informative_arc, shortest_paths
from hmt_slam_ros.messages.messages import Notice
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.loop_detector import (
    AreaLoop,
    AreaLoopDetector,
)
from hmt_slam_ros.places.relocalization_prior import RelocalizationPrior
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.topological_inference.global_localization import PoseDistribution

# Keyframes that are looked at ahead, at a time.
_AHEAD = 32

_TEXT = (
    "landmarks on the way from area {} to area {} are those up to area {}: a loop is looked for there, and nothing is "
    "to do"
)


class LoopProposer:
    """Supposes arcs."""

    def __init__(self, configuration: Configuration, views: AreaViewCache) -> None:
        """:param views: what areas show."""
        self._loops, self._views = AreaLoopDetector(configuration, views), views
        # Areas whose position is known this well, m, are told from others by the arcs, or looked for all the same.
        self._max_arc_deviation = min(configuration.places.spacing, configuration.tsbi.prior_limit)
        self._unreported: list[AreaLoop] = []
        self._reported: set[tuple[int, int]] = set()

    def propose(self, hybrid_map: HybridMap) -> AreaLoop | None:
        """The newest loop that landmarks propose and no arc closes; None for none."""
        loop = self._loops.newest_loop(hybrid_map)
        return None if loop is None or informative_arc(hybrid_map, loop.area, loop.other_area) is not None else loop

    def with_proposed_arc(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with an arc where one is proposed; the map itself where none is, and where the arcs know all.

        :param area: the robot's.
        """
        loop = self.propose(hybrid_map) if self._is_needed(hybrid_map, area) else None
        if loop is None:
            return hybrid_map
        self._unreported.append(loop)
        supposed = hybrid_map.branch()
        supposed.set_arc(loop.area, loop.other_area, loop.pose, closure=False)
        return supposed

    def prefetch(self, hybrid_map: HybridMap, area: int) -> None:
        """Between cuts, look up a part of what areas show, which the next cut would ask for.

        :param area: the robot's.
        """
        if self._is_needed(hybrid_map, area):
            areas = ((known, hybrid_map.keyframes(known)) for known in hybrid_map.area_ids())
            self._views.prefetch(areas, _AHEAD)

    def _is_needed(self, hybrid_map: HybridMap, area: int) -> bool:
        """Whether the arcs leave open where an area is, seen from that of the robot."""
        return len(shortest_paths(hybrid_map, area, self._max_arc_deviation**2).areas) < len(hybrid_map.area_ids())

    def notices(self) -> list[Notice]:
        """What was proposed since this was asked last, each pair of areas once."""
        new = {
            (loop.area, loop.other_area): loop
            for loop in self._unreported
            if (loop.area, loop.other_area) not in self._reported
        }
        self._unreported.clear()
        self._reported.update(new)
        return [Notice("tsbi", _TEXT.format(loop.first_area, loop.area, loop.other_area)) for loop in new.values()]


class PlaceEvidence:
    """Prior and loop proposals by landmarks, as far as ``places.prior`` and ``places.loops`` ask for them.

    :ivar views: what areas show.
    :ivar loops: proposes loops, None where that is not asked for.
    """

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        """:param scans: {keyframe: scan} of the map, and of what the robot saw last."""
        self.views = AreaViewCache(LocalMapping(configuration), scans)
        self._prior = RelocalizationPrior(configuration, self.views) if configuration.places.prior else None
        self.loops = LoopProposer(configuration, self.views) if configuration.places.loops else None

    def weigh(
        self, where: PoseDistribution, hybrid_map: HybridMap, poses: Mapping[int, Float64], before: int
    ) -> PoseDistribution:
        """Places with what landmarks say of them.

        :param poses: {keyframe: ``reference_T_base`` (3,)} of what the robot saw, m and rad.
        :param before: the map is that of the keyframes before this one.
        """
        return where if self._prior is None else self._prior.reweight(where, hybrid_map, poses, before)

    def prepare_places(self, maps: Iterable[tuple[HybridMap, int]]) -> None:
        """Between looks, gather a share of what :meth:`weigh` will ask for.

        :param maps: each with the keyframe before which it is.
        """
        if self._prior is not None:
            self._prior.prefetch(maps)

    def propose_loop(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with an arc where landmarks propose a loop; the map itself where they do not.

        :param area: the robot's.
        """
        return hybrid_map if self.loops is None else self.loops.with_proposed_arc(hybrid_map, area)

    def prepare_loops(self, hybrid_map: HybridMap, area: int) -> None:
        """Between cuts, gather a share of what :meth:`propose_loop` will ask for.

        :param area: the robot's.
        """
        if self.loops is not None:
            self.loops.prefetch(hybrid_map, area)

    def notices(self) -> list[Notice]:
        """What was proposed since this was asked last, for a person."""
        return [] if self.loops is None else self.loops.notices()

    def localized(self) -> None:
        """It is known where the robot is: what areas show is kept for loops alone."""
        if self.loops is None:
            self.views.clear()

    def forget_scans(self) -> None:
        """Work out anew what is made of scans, of which some have changed."""
        self.views.clear()
