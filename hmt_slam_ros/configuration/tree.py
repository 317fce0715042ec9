"""Every parameter of the system: the groups, and the rules that join them.

Each parameter is declared once, in its group's class, with default, description, range and unit. ROS parameters, YAML
files, ``--set`` and docs/reference/parameters.md follow from this tree. Angles are in degrees; the code that uses one
converts it. After a change run ``scripts/generate_docs.py``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from hmt_slam_ros.configuration.landmarks import FeatureParameters, PlaceParameters
from hmt_slam_ros.configuration.metric_slam import (
    FilterParameters,
    LocalMapParameters,
    MatchingParameters,
    MotionParameters,
    SensorParameters,
)
from hmt_slam_ros.configuration.parameter import parameter
from hmt_slam_ros.configuration.robot import ExplorerParameters, PilotParameters, RealTimeParameters, RobotParameters
from hmt_slam_ros.configuration.topology import (
    AreaAbstractionParameters,
    InferenceParameters,
    LoopClosureParameters,
    MarkParameters,
    RefinementParameters,
    TeamParameters,
)


@dataclass(frozen=True)
class Configuration:
    """All parameters. ``load_configuration`` and ``with_changes`` make checked ones.

    :ivar seed: the one seed that all random numbers are derived from.
    :ivar mode: what is stored of known ground.
    """

    seed: int = parameter(0, "Seed of all random numbers of a run.", 0, 2**31 - 1)
    mode: str = parameter(
        "mapping",
        "Whether the map grows, stays as it was loaded, or follows a world that changes (lifelong).",
        choices=("mapping", "localization", "lifelong"),
    )
    sensors: SensorParameters = field(default_factory=SensorParameters)
    motion: MotionParameters = field(default_factory=MotionParameters)
    local_map: LocalMapParameters = field(default_factory=LocalMapParameters)
    matching: MatchingParameters = field(default_factory=MatchingParameters)
    filter: FilterParameters = field(default_factory=FilterParameters)
    aam: AreaAbstractionParameters = field(default_factory=AreaAbstractionParameters)
    tsbi: InferenceParameters = field(default_factory=InferenceParameters)
    tlca: LoopClosureParameters = field(default_factory=LoopClosureParameters)
    refinement: RefinementParameters = field(default_factory=RefinementParameters)
    marks: MarkParameters = field(default_factory=MarkParameters)
    team: TeamParameters = field(default_factory=TeamParameters)
    features: FeatureParameters = field(default_factory=FeatureParameters)
    places: PlaceParameters = field(default_factory=PlaceParameters)
    rtl: RealTimeParameters = field(default_factory=RealTimeParameters)
    robot: RobotParameters = field(default_factory=RobotParameters)
    explorer: ExplorerParameters = field(default_factory=ExplorerParameters)
    pilot: PilotParameters = field(default_factory=PilotParameters)


class ConsistencyRule(NamedTuple):
    """A condition that joins several parameters.

    :ivar holds: true for a configuration that makes sense.
    :ivar advice: the sentence for the user where it does not hold.
    """

    holds: Callable[[Configuration], bool]
    advice: str


_MAX_TOPICS = 8
"""Topics of scans."""

_TOPIC = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
"""Name of a topic, relative or absolute."""

CONSISTENCY_RULES: tuple[ConsistencyRule, ...] = (
    ConsistencyRule(
        lambda tree: 1 <= len(tree.sensors.topics) <= _MAX_TOPICS and all(map(_TOPIC.fullmatch, tree.sensors.topics)),
        f"sensors.scan_topics does not name 1 to {_MAX_TOPICS} topics; give such as scan, or scan_front,scan_rear",
    ),
    ConsistencyRule(
        lambda tree: tree.local_map.field_radius >= 2.0 * tree.local_map.cell,
        "local_map.field_radius has to be at least two cells; raise it or make local_map.cell smaller",
    ),
    ConsistencyRule(
        lambda tree: tree.filter.keyframe_distance <= tree.local_map.max_range,
        "filter.keyframe_distance exceeds local_map.max_range, so keyframes would not overlap; lower it",
    ),
    ConsistencyRule(
        lambda tree: (
            not tree.robot.flow_control
            or tree.filter.max_scans_waiting_for_odometry < tree.robot.max_unacknowledged_scans
        ),
        "filter.max_scans_waiting_for_odometry is not below robot.max_unacknowledged_scans, so without odometry "
        "metric SLAM would wait for scans that the paced robot holds back; lower the one or raise the other",
    ),
    ConsistencyRule(
        lambda tree: tree.robot.drive != "commands" or tree.robot.rate > 0.0,
        "robot.drive is commands and robot.rate is 0, so that time would pass before any command is there; raise the "
        "rate",
    ),
    ConsistencyRule(
        lambda tree: tree.features.opening_min < tree.features.opening_max,
        "features.opening_min is not below features.opening_max, so that no opening is found; lower the one or raise "
        "the other",
    ),
)
