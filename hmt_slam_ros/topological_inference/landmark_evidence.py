"""What landmarks say for topological inference: the protocol behind which the second paper is a plug-in.

Landmarks are the prior of where a lost robot is, and propose loops of which the arcs say nothing. Who gives topological
inference something that does both is said where processes are made.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.messages import Notice
from hmt_slam_ros.topological_inference.global_localization import PoseDistribution


class LandmarkEvidence(Protocol):
    """Weighs places of a map by landmarks, and proposes loops."""

    def weigh(
        self, where: PoseDistribution, hybrid_map: HybridMap, poses: Mapping[int, Float64], before: int
    ) -> PoseDistribution:
        """Places with what landmarks say of them.

        :param poses: {keyframe: ``reference_T_base`` (3,)} of what the robot saw, m and rad.
        :param before: the map is that of the keyframes before this one.
        """
        ...

    def prepare_places(self, maps: Iterable[tuple[HybridMap, int]]) -> None:
        """Between looks, gather a share of what :meth:`weigh` will ask for.

        :param maps: each with the keyframe before which it is.
        """
        ...

    def propose_loop(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with an arc where landmarks propose a loop; the map itself where they do not.

        :param area: the robot's.
        """
        ...

    def prepare_loops(self, hybrid_map: HybridMap, area: int) -> None:
        """Between cuts, gather a share of what :meth:`propose_loop` will ask for.

        :param area: the robot's.
        """
        ...

    def notices(self) -> list[Notice]:
        """What was proposed since this was asked last, for a person."""
        ...

    def localized(self) -> None:
        """It is known where the robot is."""
        ...

    def forget_scans(self) -> None:
        """Work out anew what is made of scans, of which some have changed."""
        ...
