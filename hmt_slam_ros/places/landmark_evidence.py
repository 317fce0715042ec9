"""Landmarks as evidence for topological inference: the prior over places, and loop proposals.

The landmarks are those of Tomatis, Nourbakhsh and Siegwart (2003).
"""

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
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution

_MAX_PREFETCHED_KEYFRAMES = 32
"""Keyframes that are processed ahead at a time."""

_TEXT = (
    "landmarks on the way from area {} to area {} are those up to area {}: a loop is looked for there, and nothing is "
    "to do"
)


class LoopProposer:
    """Proposes arcs where landmarks show a loop."""

    def __init__(self, configuration: Configuration, views: AreaViewCache) -> None:
        self._loops, self._views = AreaLoopDetector(configuration, views), views
        # Areas with a position known this well, m, are distinguished by the arcs, or searched in any case.
        self._max_arc_deviation = min(configuration.places.spacing, configuration.tsbi.prior_limit)
        self._unreported: list[AreaLoop] = []
        self._reported: set[tuple[int, int]] = set()

    def propose(self, hybrid_map: HybridMap) -> AreaLoop | None:
        """The newest loop that landmarks show and no arc closes; None for none."""
        loop = self._loops.newest_loop(hybrid_map)
        return None if loop is None or informative_arc(hybrid_map, loop.area, loop.other_area) is not None else loop

    def with_proposed_arc(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with a proposed arc; the map itself where there is none, or where the arcs locate all areas.

        :param area: the robot's.
        """
        loop = self.propose(hybrid_map) if self._is_needed(hybrid_map, area) else None
        if loop is None:
            return hybrid_map
        self._unreported.append(loop)
        branch = hybrid_map.branch()
        branch.set_arc(loop.area, loop.other_area, loop.pose, closure=False)
        return branch

    def prefetch(self, hybrid_map: HybridMap, area: int) -> None:
        """Process some keyframes of views that the next :meth:`propose` needs.

        :param area: the robot's.
        """
        if self._is_needed(hybrid_map, area):
            areas = ((other, hybrid_map.keyframes(other)) for other in hybrid_map.area_ids())
            self._views.prefetch(areas, _MAX_PREFETCHED_KEYFRAMES)

    def _is_needed(self, hybrid_map: HybridMap, area: int) -> bool:
        """Whether the arcs do not locate all areas relative to that of the robot."""
        return len(shortest_paths(hybrid_map, area, self._max_arc_deviation**2).areas) < len(hybrid_map.area_ids())

    def notices(self) -> list[Notice]:
        """Notices of loops proposed since the last call, of each pair of areas once."""
        pairs = {(loop.area, loop.other_area): loop for loop in self._unreported}
        new = {pair: loop for pair, loop in pairs.items() if pair not in self._reported}
        self._unreported.clear()
        self._reported.update(new)
        return [Notice("tsbi", _TEXT.format(loop.first_area, loop.area, loop.other_area)) for loop in new.values()]


class PlaceEvidence:
    """Prior (``places.prior``) and loop proposals (``places.loops``) by landmarks.

    :ivar views: of areas.
    :ivar loops: proposes loops; None where ``places.loops`` is false.
    """

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        """:param scans: {keyframe: scan} of the map and of the newest keyframes."""
        self.views = AreaViewCache(LocalMapping(configuration), scans)
        self._prior = RelocalizationPrior(configuration, self.views) if configuration.places.prior else None
        self.loops = LoopProposer(configuration, self.views) if configuration.places.loops else None

    def weigh(
        self, where: PoseDistribution, hybrid_map: HybridMap, poses: Mapping[int, Float64], before: int
    ) -> PoseDistribution:
        """A distribution over poses, reweighted by landmarks.

        :param poses: {keyframe: ``reference_T_base`` (3,)} of the newest keyframes, m and rad.
        :param before: the first keyframe that is not part of the map.
        """
        return where if self._prior is None else self._prior.reweight(where, hybrid_map, poses, before)

    def prepare_places(self, maps: Iterable[tuple[HybridMap, int]]) -> None:
        """Extract a share of the landmarks that :meth:`weigh` needs.

        :param maps: each with the first keyframe that is not part of it.
        """
        if self._prior is not None:
            self._prior.prefetch(maps)

    def propose_loop(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with an arc where landmarks propose a loop; else the map itself.

        :param area: the robot's.
        """
        return hybrid_map if self.loops is None else self.loops.with_proposed_arc(hybrid_map, area)

    def prepare_loops(self, hybrid_map: HybridMap, area: int) -> None:
        """Extract a share of the landmarks that :meth:`propose_loop` needs.

        :param area: the robot's.
        """
        if self.loops is not None:
            self.loops.prefetch(hybrid_map, area)

    def notices(self) -> list[Notice]:
        """Notices of what was proposed since the last call."""
        return [] if self.loops is None else self.loops.notices()

    def on_localized(self) -> None:
        """Drop the views that only the prior needs, once the robot is localized."""
        if self.loops is None:
            self.views.clear()

    def forget_scans(self) -> None:
        """Drop all views, as scans have changed."""
        self.views.clear()
