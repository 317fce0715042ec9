"""Every parameter of the system: the groups, and the rules that join them.

Each parameter is declared once, in ``metric``, ``topological``, ``features``, ``places``, ``live`` or ``explorer``:
default, unit, range and description. The ROS parameters, the YAML files, ``--set`` and docs/parameters.md all follow
from this tree, so a new parameter is one line here. Angles are in degrees, for the people who set them; the code that
uses one calls ``math.radians`` there. After a change run ``scripts/generate_docs.py``, which brings
config/hmt_slam.yaml and docs/parameters.md up to date.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from hmt_slam_ros.configuration.landmarks import Features, Places
from hmt_slam_ros.configuration.metric_slam import Filter, LocalMap, Matching, Motion
from hmt_slam_ros.configuration.parameter import parameter
from hmt_slam_ros.configuration.robot import Exploration, Piloting, RealTimeLocalization, Robot
from hmt_slam_ros.configuration.topology import AreaAbstraction, LoopClosureAcceptance, Refinement, TopologicalInference


@dataclass(frozen=True)
class Configuration:
    """All parameters. Build one with ``loading.load_configuration`` or ``flat.with_changes``, which check it.

    :ivar seed: the one seed that all random numbers are derived from.
    :ivar mode: what is done with known ground.
    """

    seed: int = parameter(0, "Seed of all random numbers of a run.", low=0, high=2**31 - 1)
    mode: str = parameter(
        "mapping",
        "Whether the map grows, or the robot only finds its place in a map that stays as it was loaded, or the map "
        "follows a world that changes: it is added to only where something is new, and what is no more is left out.",
        choices=("mapping", "localization", "lifelong"),
    )
    motion: Motion = field(default_factory=Motion)
    local_map: LocalMap = field(default_factory=LocalMap)
    matching: Matching = field(default_factory=Matching)
    filter: Filter = field(default_factory=Filter)
    aam: AreaAbstraction = field(default_factory=AreaAbstraction)
    tsbi: TopologicalInference = field(default_factory=TopologicalInference)
    tlca: LoopClosureAcceptance = field(default_factory=LoopClosureAcceptance)
    refinement: Refinement = field(default_factory=Refinement)
    features: Features = field(default_factory=Features)
    places: Places = field(default_factory=Places)
    rtl: RealTimeLocalization = field(default_factory=RealTimeLocalization)
    robot: Robot = field(default_factory=Robot)
    explorer: Exploration = field(default_factory=Exploration)
    pilot: Piloting = field(default_factory=Piloting)


class Rule(NamedTuple):
    """A condition that joins several parameters.

    :ivar holds: true for a configuration that makes sense.
    :ivar advice: the sentence for the user where it does not hold.
    """

    holds: Callable[[Configuration], bool]
    advice: str


RULES: tuple[Rule, ...] = (
    Rule(
        lambda tree: tree.local_map.field_radius >= 2.0 * tree.local_map.cell,
        "local_map.field_radius has to be at least two cells; raise it or make local_map.cell smaller",
    ),
    Rule(
        lambda tree: tree.filter.keyframe_distance <= tree.local_map.max_range,
        "filter.keyframe_distance exceeds local_map.max_range, so keyframes would not overlap; lower it",
    ),
    Rule(
        lambda tree: not tree.robot.paced or tree.filter.patience < tree.robot.window,
        "filter.patience is not below robot.window, so without odometry metric SLAM would wait for scans that the "
        "paced robot holds back; lower the one or raise the other",
    ),
    Rule(
        lambda tree: tree.robot.drive != "commands" or tree.robot.rate > 0.0,
        "robot.drive is commands and robot.rate is 0, so that time would pass before any command is there; raise the "
        "rate",
    ),
    Rule(
        lambda tree: tree.features.opening_min < tree.features.opening_max,
        "features.opening_min is not below features.opening_max, so that no opening is found; lower the one or raise "
        "the other",
    ),
)
