"""The five processes, made as a configuration asks for them: here the second paper is plugged into the first.

Lines, landmarks and places come in by three protocols: `submap.local_filter.FilterFactory`,
`area_abstraction.doors.OpeningDetector` and `topological_inference.landmark_evidence.LandmarkEvidence`. They are
imported where the configuration asks for them, and by nothing else of the core.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from hmt_slam_ros.configuration import Configuration

if TYPE_CHECKING:
    from hmt_slam_ros.area_abstraction.aam import Aam
    from hmt_slam_ros.area_abstraction.doors import OpeningDetector
    from hmt_slam_ros.area_abstraction.partition import AamState
    from hmt_slam_ros.loop_closure.tlca import Tlca, TlcaState
    from hmt_slam_ros.messages.replica import Replica
    from hmt_slam_ros.metric_slam.slam import MetricSlam, SlamState
    from hmt_slam_ros.real_time_localization.rtl import Rtl, RtlState
    from hmt_slam_ros.sensors import Scan
    from hmt_slam_ros.submap.local_filter import FilterFactory
    from hmt_slam_ros.submap.local_mapping import LocalMapping
    from hmt_slam_ros.topological_inference.branching import Branching
    from hmt_slam_ros.topological_inference.global_localization import LandmarkEvidence
    from hmt_slam_ros.topological_inference.tsbi import Tsbi, TsbiState


def metric_slam(configuration: Configuration, state: SlamState | None = None) -> MetricSlam:
    """Metric SLAM, with filters over lines where ``local_map.kind`` asks for them.

    :param state: to go on from.
    """
    from hmt_slam_ros.metric_slam.slam import MetricSlam  # noqa: PLC0415

    return MetricSlam(configuration, state, filters_for(configuration))


def filters_for(configuration: Configuration) -> Callable[[LocalMapping], FilterFactory]:
    """What makes the filters of areas."""
    if configuration.local_map.kind == "grid":
        from hmt_slam_ros.submap.particle_filter import ParticleFilters  # noqa: PLC0415

        return ParticleFilters
    from hmt_slam_ros.landmarks.line_filter import FilterSelector  # noqa: PLC0415

    return FilterSelector


def area_abstraction(configuration: Configuration, state: AamState | None = None) -> Aam:
    """The AAM, with a detector of openings where ``aam.area_policy`` asks for doors.

    :param state: to go on from.
    """
    from hmt_slam_ros.area_abstraction.aam import Aam  # noqa: PLC0415

    return Aam(configuration, state, _opening_detector(configuration))


def _opening_detector(configuration: Configuration) -> OpeningDetector | None:
    if configuration.aam.area_policy == "ncut":
        return None
    from hmt_slam_ros.landmarks.area_landmarks import LandmarkOpeningDetector  # noqa: PLC0415

    return LandmarkOpeningDetector(configuration)


def topological_inference(configuration: Configuration, state: TsbiState | None = None) -> Tsbi:
    """TSBI, with the evidence of landmarks where ``places.prior`` or ``places.loops`` asks for it.

    :param state: to go on from.
    """
    from hmt_slam_ros.topological_inference.tsbi import Tsbi  # noqa: PLC0415

    return Tsbi(configuration, branching, state)


def loop_closure(configuration: Configuration, state: TlcaState | None = None) -> Tlca:
    """TLCA.

    :param state: to go on from.
    """
    from hmt_slam_ros.loop_closure.tlca import Tlca  # noqa: PLC0415

    return Tlca(configuration, state)


def real_time_localization(configuration: Configuration, state: RtlState | None = None) -> Rtl:
    """Real-time localization.

    :param state: to go on from.
    """
    from hmt_slam_ros.real_time_localization.rtl import Rtl  # noqa: PLC0415

    return Rtl(configuration, state)


def branching(configuration: Configuration, replica: Replica) -> Branching:
    """What makes the children of hypotheses, with the evidence of landmarks where that is asked for.

    :param replica: the maps of the live hypotheses.
    """
    from hmt_slam_ros.topological_inference.branching import Branching  # noqa: PLC0415

    return Branching(configuration, replica, landmark_evidence)


def landmark_evidence(configuration: Configuration, scans: Mapping[int, Scan]) -> LandmarkEvidence | None:
    """The evidence of landmarks, None where the configuration asks for none.

    :param scans: {keyframe: scan} of the map, and of what the robot saw last.
    """
    if not (configuration.places.prior or configuration.places.loops):
        return None
    from hmt_slam_ros.places.landmark_evidence import PlaceEvidence  # noqa: PLC0415

    return PlaceEvidence(configuration, scans)
