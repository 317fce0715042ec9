"""Every parameter of the system, declared once: default, unit, range and description.

The ROS parameters, the YAML files, ``--set`` and docs/parameters.md all follow from this tree, so a new parameter is
one line here. Angles are in degrees, for the people who set them; the code that uses one calls ``math.radians`` there.
After a change run ``scripts/generate_docs.py``, which brings config/hmt_slam.yaml and docs/parameters.md up to date.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class Motion:
    """Odometry motion model: noise of the increment between two readings."""

    translation_from_translation: float = parameter(
        0.1, "Deviation of the travelled distance per metre travelled.", unit="m/m", low=0.0, high=2.0
    )
    translation_from_rotation: float = parameter(
        0.001, "Deviation of the travelled distance per degree turned.", unit="m/deg", low=0.0, high=0.1
    )
    rotation_from_translation: float = parameter(
        2.0, "Deviation of the heading per metre travelled.", unit="deg/m", low=0.0, high=90.0
    )
    rotation_from_rotation: float = parameter(
        0.1, "Deviation of the heading per degree turned.", unit="deg/deg", low=0.0, high=2.0
    )
    translation_floor: float = parameter(
        0.01, "Smallest deviation of an increment's translation.", unit="m", low=1e-4, high=1.0
    )
    rotation_floor: float = parameter(
        0.2, "Smallest deviation of an increment's heading.", unit="deg", low=1e-3, high=45.0
    )


@dataclass(frozen=True)
class LocalMap:
    """Metric map of one area: occupancy grid and distance field, built from the keyframes' scans."""

    cell: float = parameter(0.05, "Side of a grid cell.", unit="m", low=0.005, high=1.0)
    max_range: float = parameter(
        30.0, "Beams longer than this are ignored when the map is built.", unit="m", low=0.5, high=200.0
    )
    field_radius: float = parameter(
        0.5, "Distance at which the distance field is cut off.", unit="m", low=0.05, high=5.0
    )


@dataclass(frozen=True)
class Matching:
    """Scan matching: correlative search for the start, Gauss-Newton on the distance field for precision."""

    search_distance: float = parameter(
        0.3, "Half side of the window of the correlative search.", unit="m", low=0.0, high=10.0
    )
    search_angle: float = parameter(
        10.0, "Half width of the angular window of the correlative search.", unit="deg", low=0.0, high=180.0
    )
    sigma_hit: float = parameter(
        0.1, "Deviation sigma_hit of a beam's end point from the nearest wall.", unit="m", low=0.005, high=1.0
    )
    temper: float = parameter(
        0.1, "Exponent on a scan's likelihood, since neighbouring beams are correlated.", low=1e-4, high=1.0
    )
    iterations: int = parameter(20, "Gauss-Newton steps at most.", low=1, high=200)


@dataclass(frozen=True)
class Filter:
    """Metric SLAM: the Rao-Blackwellized particle filter of each hypothesis and the keyframe rule."""

    particles: int = parameter(12, "Metric particles M of every hypothesis.", low=1, high=1000)
    ess_fraction: float = parameter(
        0.5, "Resample when the effective sample size falls below this share of the particles.", low=0.0, high=1.0
    )
    keyframe_distance: float = parameter(
        0.5, "A keyframe is taken after this distance travelled.", unit="m", low=0.05, high=10.0
    )
    keyframe_angle: float = parameter(
        20.0, "A keyframe is taken after this angle turned.", unit="deg", low=1.0, high=180.0
    )


@dataclass(frozen=True)
class AreaAbstraction:
    """AAM: partition of the keyframes into areas by normalized cut."""

    ncut_threshold: float = parameter(
        0.35,
        "Cut the area where Shi and Malik's NCut = cut/assoc(A,V) + cut/assoc(B,V) is below this; smaller values "
        "make larger areas.",
        low=0.0,
        high=2.0,
    )
    min_cluster: int = parameter(5, "Keyframes of an area at least.", low=1, high=1000)
    overlap_radius: float = parameter(
        0.2, "Two scan points this close count as the same sensed space.", unit="m", low=0.01, high=2.0
    )


@dataclass(frozen=True)
class TopologicalInference:
    """TSBI: the distribution over topological paths."""

    max_hypotheses: int = parameter(16, "Topological hypotheses N kept after a reduction.", low=1, high=1000)
    gate_probability: float = parameter(
        0.999,
        "Share of true revisits that the chi-square gate on the arc prior (3 degrees of freedom) lets pass.",
        low=0.5,
        high=0.999999,
    )
    temper: float = parameter(
        0.1, "Exponent on the evidence of a scan in the weight of a hypothesis.", low=1e-4, high=1.0
    )


@dataclass(frozen=True)
class LoopClosureAcceptance:
    """TLCA: acceptance of the dominant topological path and the globally consistent map."""

    accept_probability: float = parameter(
        0.99, "A path is accepted when its probability reaches this value.", low=0.5, high=1.0
    )
    accept_keyframes: int = parameter(
        3, "Keyframes over which the probability has to hold since the hypotheses parted.", low=1, high=1000
    )
    accept_distance: float = parameter(
        2.0,
        "Distance over which the probability has to hold since the hypotheses parted.",
        unit="m",
        low=0.0,
        high=1000.0,
    )
    arc_sigma_floor: float = parameter(
        0.01, "Smallest deviation of an arc's translation.", unit="m", low=1e-4, high=1.0
    )
    arc_angle_floor: float = parameter(0.2, "Smallest deviation of an arc's angle.", unit="deg", low=1e-3, high=45.0)


@dataclass(frozen=True)
class RealTimeLocalization:
    """RTL: the pose at the rate of the odometry."""

    publish_tf: bool = parameter(True, "Publish map -> odom on /tf.")


@dataclass(frozen=True)
class Robot:
    """The simulated robot that replays a log."""

    rate: float = parameter(1.0, "Speed of the replay relative to real time.", low=0.01, high=1000.0)
    start: float = parameter(0.0, "Seconds of the log to skip.", unit="s", low=0.0, high=1e6)
    duration: float = parameter(0.0, "Seconds of the log to play; 0 plays all of it.", unit="s", low=0.0, high=1e6)
    loop: bool = parameter(False, "Start again at the end of the log.")
    paced: bool = parameter(True, "Wait for the acknowledgement of earlier scans, so that none is lost.")
    window: int = parameter(20, "Scans under way without an acknowledgement, when paced.", low=1, high=10000)


@dataclass(frozen=True)
class Configuration:
    """All parameters. Build one with ``loading.load_configuration`` or ``flat.with_changes``, which check it.

    :ivar seed: the one seed that all random numbers are derived from.
    """

    seed: int = parameter(0, "Seed of all random numbers of a run.", low=0, high=2**31 - 1)
    motion: Motion = field(default_factory=Motion)
    local_map: LocalMap = field(default_factory=LocalMap)
    matching: Matching = field(default_factory=Matching)
    filter: Filter = field(default_factory=Filter)
    aam: AreaAbstraction = field(default_factory=AreaAbstraction)
    tsbi: TopologicalInference = field(default_factory=TopologicalInference)
    tlca: LoopClosureAcceptance = field(default_factory=LoopClosureAcceptance)
    rtl: RealTimeLocalization = field(default_factory=RealTimeLocalization)
    robot: Robot = field(default_factory=Robot)


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
)
