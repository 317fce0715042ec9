"""The landmarks of Tomatis, Nourbakhsh and Siegwart (2003) as evidence for topological inference."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.messages import Notice
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.loop_proposals import LoopProposer
from hmt_slam_ros.places.relocalization_prior import RelocalizationPrior
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.topological_inference.global_localization import PoseDistribution


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
