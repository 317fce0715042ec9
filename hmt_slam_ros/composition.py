"""Composition: makes processes with the plug-ins of Tomatis et al. that a configuration asks for.

Lines, landmarks and places implement three protocols: `submap.local_filter.FilterFactory`,
`area_abstraction.doors.OpeningDetector` and `topological_inference.landmark_evidence.LandmarkEvidence`. They are
imported only where the configuration needs them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from hmt_slam_ros.configuration import Configuration

if TYPE_CHECKING:
    from hmt_slam_ros.area_abstraction.aam import Aam
    from hmt_slam_ros.area_abstraction.doors import OpeningDetector
    from hmt_slam_ros.area_abstraction.partition import AamState
    from hmt_slam_ros.messages.replica import Replica
    from hmt_slam_ros.metric_slam.slam import SlamState
    from hmt_slam_ros.metric_slam.speculation import SpeculativeSlam
    from hmt_slam_ros.sensors import Scan
    from hmt_slam_ros.submap.local_filter import FilterFactory
    from hmt_slam_ros.submap.local_mapping import LocalMapping
    from hmt_slam_ros.topological_inference.branching import Branching
    from hmt_slam_ros.topological_inference.global_localization import LandmarkEvidence
    from hmt_slam_ros.topological_inference.tsbi import Tsbi, TsbiState


def metric_slam(configuration: Configuration, state: SlamState | None = None) -> SpeculativeSlam:
    """Metric SLAM, with line filters where ``local_map.kind`` asks for them.

    :param state: state from which it continues, None for the start.
    """
    from hmt_slam_ros.metric_slam.speculation import SpeculativeSlam  # noqa: PLC0415

    return SpeculativeSlam(configuration, state, filters_for(configuration))


def filters_for(configuration: Configuration) -> Callable[[LocalMapping], FilterFactory]:
    """The class of filter factories that ``local_map.kind`` asks for."""
    if configuration.local_map.kind == "grid":
        from hmt_slam_ros.submap.particle_filter import ParticleFilters  # noqa: PLC0415

        return ParticleFilters
    from hmt_slam_ros.landmarks.line_filter import FilterSelector  # noqa: PLC0415

    return FilterSelector


def area_abstraction(configuration: Configuration, state: AamState | None = None) -> Aam:
    """The AAM, with an opening detector where ``aam.area_policy`` needs one.

    :param state: state from which it continues, None for the start.
    """
    from hmt_slam_ros.area_abstraction.aam import Aam  # noqa: PLC0415

    return Aam(configuration, state, _opening_detector(configuration))


def _opening_detector(configuration: Configuration) -> OpeningDetector | None:
    if configuration.aam.area_policy != "both":
        return None
    from hmt_slam_ros.landmarks.area_landmarks import LandmarkOpeningDetector  # noqa: PLC0415

    return LandmarkOpeningDetector(configuration)


def topological_inference(configuration: Configuration, state: TsbiState | None = None) -> Tsbi:
    """TSBI, with the evidence of landmarks where ``places.prior`` or ``places.loops`` asks for it.

    :param state: state from which it continues, None for the start.
    """
    from hmt_slam_ros.topological_inference.tsbi import Tsbi  # noqa: PLC0415

    return Tsbi(configuration, branching, state)


def branching(configuration: Configuration, replica: Replica) -> Branching:
    """The branching of TSBI, with the evidence of landmarks where the configuration asks for it.

    :param replica: maps of the live hypotheses.
    """
    from hmt_slam_ros.topological_inference.branching import Branching  # noqa: PLC0415

    return Branching(configuration, replica, landmark_evidence)


def landmark_evidence(configuration: Configuration, scans: Mapping[int, Scan]) -> LandmarkEvidence | None:
    """The evidence of landmarks, None where the configuration does not ask for it.

    :param scans: {keyframe: scan} of the map and of the last keyframes.
    """
    if not (configuration.places.prior or configuration.places.loops):
        return None
    from hmt_slam_ros.places.landmark_evidence import PlaceEvidence  # noqa: PLC0415

    return PlaceEvidence(configuration, scans)
