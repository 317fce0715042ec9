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
    acceleration: float = parameter(
        0.5,
        "Deviation of the robot's acceleration. Without odometry, and where the scans contradict it, the next pose is "
        "predicted from the velocity.",
        unit="m/s^2",
        low=0.01,
        high=50.0,
    )
    turn_acceleration: float = parameter(
        200.0, "Deviation of the acceleration of a turn, likewise.", unit="deg/s^2", low=1.0, high=10000.0
    )
    fault_probability: float = parameter(
        0.01, "Probability that the odometry of a scan is wrong beyond its deviations.", low=1e-9, high=0.5
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
    extent: float = parameter(
        56.0, "Half side of the local map; what lies farther from the area's origin is not kept.", unit="m",
        low=5.0, high=500.0,
    )
    log_odds_hit: float = parameter(
        0.85, "Evidence of occupancy where a beam ends.", unit="nat", low=0.05, high=3.0
    )
    log_odds_miss: float = parameter(
        0.4, "Evidence of free space where beams of a scan pass.", unit="nat", low=0.05, high=3.0
    )
    log_odds_limit: float = parameter(
        3.5, "Bound of a cell's evidence, so that a changed world is learnt again.", unit="nat", low=0.5, high=6.0
    )


@dataclass(frozen=True)
class Matching:
    """Scan matching: correlative search for the start, Gauss-Newton on the distance field for precision."""

    max_points: int = parameter(200, "Beams of a scan that are matched; evenly thinned.", low=10, high=5000)
    iterations: int = parameter(20, "Gauss-Newton steps at most.", low=1, high=200)
    sigma_hit: float = parameter(
        0.1, "Deviation sigma_hit of a beam's end point from the nearest wall.", unit="m", low=0.005, high=1.0
    )
    sigma_match: float = parameter(
        0.04, "Deviation of a beam's end point from its wall when a pose is refined.", unit="m", low=0.002, high=1.0
    )
    robust_scale: float = parameter(
        0.15, "Scale of the Cauchy weight on the distance of a beam's end point to the nearest wall.", unit="m",
        low=0.01, high=5.0,
    )
    random_returns: float = parameter(
        0.1, "Share z_rand of returns that no wall of the map explains.", low=1e-4, high=0.9
    )
    unknown_range: float = parameter(
        10.0, "Distance over which a return is equally likely anywhere in unknown space.", unit="m", low=0.5, high=200.0
    )
    sharpness: float = parameter(
        1.0, "Exponent on a scan's likelihood in the proposal of a particle's pose.", low=1e-3, high=10.0
    )
    temper: float = parameter(
        0.05, "Exponent on a scan's likelihood in the weights, since neighbouring beams are correlated.",
        low=1e-4, high=1.0,
    )
    matched_distance: float = parameter(
        0.15, "A beam whose end point is this close to a wall counts as matched.", unit="m", low=0.01, high=5.0
    )
    matched_fraction: float = parameter(
        0.6, "Below this share of matched beams the correlative search looks for a better start.", low=0.0, high=1.0
    )
    search_distance: float = parameter(
        0.4, "Half side of the window of the correlative search.", unit="m", low=0.0, high=10.0
    )
    search_angle: float = parameter(
        15.0, "Half width of the angular window of the correlative search.", unit="deg", low=0.0, high=180.0
    )
    search_step: float = parameter(
        1.5, "Angular step of the correlative search.", unit="deg", low=0.1, high=30.0
    )
    wide_distance: float = parameter(
        1.5, "Half side of the window at most, where the prediction is uncertain.", unit="m", low=0.0, high=10.0
    )
    wide_angle: float = parameter(
        90.0, "Half width of the angular window at most, where the prediction is uncertain.", unit="deg", low=0.0,
        high=180.0,
    )


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
    covariance_inflation: float = parameter(
        4.0,
        "Factor on the covariance of a match, since its beams are correlated: for the arcs, and where the match is "
        "weighed against the prediction.",
        low=0.1,
        high=100.0,
    )
    patience: int = parameter(
        15,
        "Scans that wait for the first odometry at most, before they are placed by the velocity and their match; four "
        "times as many where odometry has come before.",
        low=1,
        high=100000,
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
    overlap_points: int = parameter(
        180, "Points of a scan that are compared; evenly thinned.", low=10, high=5000
    )
    persistence: int = parameter(
        2, "Keyframes in a row at which a cut, or a move into a known area, has to be found.", low=1, high=100
    )
    move_margin: float = parameter(
        0.1, "The robot moves into a known area that overlaps this much more with its scan than the present one.",
        low=0.0, high=1.0,
    )


@dataclass(frozen=True)
class TopologicalInference:
    """TSBI: the distribution over topological paths."""

    max_hypotheses: int = parameter(16, "Topological hypotheses N kept after a reduction.", low=1, high=1000)
    drop_probability: float = parameter(
        1e-6, "Hypotheses below this probability are dropped at once.", low=0.0, high=0.1
    )
    max_candidates: int = parameter(16, "Known areas that a hypothesis is compared with at a cut.", low=1, high=1000)
    max_comparisons: int = parameter(
        64, "Comparisons with known areas at a cut, shared among hypotheses by probability; each has four at least.",
        low=1, high=100000,
    )
    max_modes: int = parameter(3, "Ways to fit one known area that become hypotheses of their own.", low=1, high=100)
    gate_probability: float = parameter(
        0.999,
        "Share of true revisits that the chi-square gate on the arc prior (3 degrees of freedom) lets pass.",
        low=0.5,
        high=0.999999,
    )
    prior_scale: float = parameter(
        1.5, "Factor on the deviations of the arc prior, as drift is estimated from few particles.", low=0.1, high=10.0
    )
    prior_limit: float = parameter(
        100.0,
        "Known areas whose position is less certain than this are not looked at. After a long way round the right one "
        "is among the uncertain ones, and without it a wrong one would win.",
        unit="m",
        low=0.1,
        high=1000.0,
    )
    new_probability: float = parameter(
        0.05, "Probability of new ground at least, where the arcs point into known areas.", low=0.0, high=1.0
    )
    alike_probability: float = parameter(
        0.5, "Probability that new ground looks like another known place, such as one more corridor.", low=0.0,
        high=0.999,
    )
    place_radius: float = parameter(
        2.0, "A robot this close to a keyframe of an area, and in its sight, is in the area's place.", unit="m",
        low=0.1, high=20.0,
    )
    temper: float = parameter(
        0.3, "Exponent on the likelihood of an area's surface samples in the weight of a hypothesis.",
        low=1e-4, high=1.0,
    )
    sample_spacing: float = parameter(
        0.2, "Distance between the surface samples that areas are compared by.", unit="m", low=0.02, high=2.0
    )
    search_cell: float = parameter(
        0.1, "Side of a cell of the grids that areas are compared by.", unit="m", low=0.02, high=1.0
    )
    surface_sigma: float = parameter(
        0.1, "Deviation of a surface from where another area's map has it.", unit="m", low=0.01, high=1.0
    )
    surface_ratio: float = parameter(
        3.0, "How much likelier a surface is measured on a known surface than in unknown space.", low=1.01, high=100.0
    )
    free_ratio: float = parameter(
        0.1, "How much likelier a surface is measured in free space than in unknown space.", low=1e-4, high=0.99
    )
    appearance_weight: float = parameter(
        0.5, "Bound of the evidence that the look of a place gives.", unit="nat", low=0.0, high=20.0
    )
    recheck_keyframes: int = parameter(
        5, "Keyframes stored without a cut after which known ground is looked for.", low=1, high=1000
    )
    local_sigma: float = parameter(
        0.1, "An area whose position is at least this certain, about as certain as a wall, is in the local map.",
        unit="m", low=0.01, high=5.0,
    )
    local_reach: float = parameter(
        12.0, "An area with a keyframe this close to the robot's area is part of the local map.", unit="m",
        low=0.5, high=200.0,
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
    contradiction_probability: float = parameter(
        0.999,
        "Share of true closures that fit the rest of the map by the chi-square test of their cycles (3 degrees of "
        "freedom); one that does not opens the question again which of them is false.",
        low=0.5,
        high=0.999999,
    )
    arc_sigma_floor: float = parameter(
        0.01, "Smallest deviation of an arc's translation.", unit="m", low=1e-4, high=1.0
    )
    arc_angle_floor: float = parameter(0.2, "Smallest deviation of an arc's angle.", unit="deg", low=1e-3, high=45.0)
    global_map: str = parameter(
        "consistent",
        "Poses of the areas: consistent with all arcs (Lu and Milios), or along the shortest paths only (Dijkstra).",
        choices=("consistent", "shortest_path"),
    )


@dataclass(frozen=True)
class Refinement:
    """Refinement of the poses by registering the scans with each other, when a path is accepted and at the end."""

    iterations: int = parameter(4, "Linearisations of all pairs of keyframes.", low=0, high=100)
    neighbours: int = parameter(15, "Keyframes that a keyframe is registered with at most.", low=1, high=1000)
    scan_neighbours: int = parameter(
        4, "Keyframes that a scan between keyframes is registered with at most.", low=1, high=100
    )
    reach: float = parameter(
        4.0, "Scans taken farther apart than this are not registered with each other.", unit="m", low=0.1, high=100.0
    )
    max_points: int = parameter(360, "Points of a scan that are registered; evenly thinned.", low=10, high=5000)
    first_gate: float = parameter(
        0.4, "A point and a wall meet within this distance at the first linearisation.", unit="m", low=0.01, high=5.0
    )
    last_gate: float = parameter(0.15, "The same at the last linearisation.", unit="m", low=0.01, high=5.0)
    min_share: float = parameter(
        0.1, "Two scans overlap when at least this share of their points meet.", low=0.01, high=1.0
    )
    sigma: float = parameter(0.05, "Deviation of a point from its wall.", unit="m", low=0.001, high=1.0)
    robust_scale: float = parameter(
        0.05, "Scale of the Cauchy weight on the distance of a point from its wall.", unit="m", low=0.001, high=5.0
    )
    temper: float = parameter(
        0.3, "Exponent on the likelihood, since beams and overlapping pairs are correlated.", low=1e-4, high=1.0
    )
    patience: float = parameter(
        50.0, "A pair of scans whose chi-square exceeds this loses weight.", low=1.0, high=1e6
    )
    motion_patience: float = parameter(
        10.0, "A motion between two keyframes whose chi-square exceeds this loses weight.", low=1.0, high=1e6
    )
    scan_sigma: float = parameter(
        0.1, "Deviation of a scan's place relative to its keyframe before it is registered.", unit="m",
        low=0.001, high=5.0,
    )
    scan_angle: float = parameter(
        3.0, "Deviation of a scan's heading relative to its keyframe before it is registered.", unit="deg",
        low=0.01, high=90.0,
    )


@dataclass(frozen=True)
class RealTimeLocalization:
    """RTL: the pose at the rate of the odometry."""

    publish_tf: bool = parameter(True, "Publish map -> odom on /tf.")
    max_speed: float = parameter(
        10.0, "Odometry that moves faster than this between two readings was reset.", unit="m/s", low=0.1, high=1000.0
    )
    max_turn_rate: float = parameter(
        720.0, "Odometry that turns faster than this between two readings was reset.", unit="deg/s", low=1.0, high=1e5
    )


@dataclass(frozen=True)
class Robot:
    """The simulated robot that replays a log."""

    rate: float = parameter(
        1.0, "Speed of the replay relative to real time; 0 is as fast as possible.", low=0.0, high=1000.0
    )
    start: float = parameter(0.0, "Seconds of the log to skip.", unit="s", low=0.0, high=1e6)
    duration: float = parameter(0.0, "Seconds of the log to play; 0 plays all of it.", unit="s", low=0.0, high=1e6)
    loop: bool = parameter(False, "Start again at the end of the log; the stamps go on increasing.")
    paced: bool = parameter(True, "Wait for the acknowledgement of earlier scans, so that none is lost.")
    window: int = parameter(20, "Scans under way without an acknowledgement, when paced.", low=1, high=10000)
    scan_listeners: int = parameter(
        1, "Start when this many subscribers of the scans are there; 0 waits for none.", low=0, high=100
    )
    odometry_listeners: int = parameter(
        1, "Start when this many subscribers of the odometry are there; 0 waits for none.", low=0, high=100
    )
    patience: float = parameter(10.0, "Wait this long for the subscribers.", unit="s", low=0.0, high=3600.0)


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
    refinement: Refinement = field(default_factory=Refinement)
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
    Rule(
        lambda tree: not tree.robot.paced or tree.filter.patience < tree.robot.window,
        "filter.patience is not below robot.window, so without odometry metric SLAM would wait for scans that the "
        "paced robot holds back; lower the one or raise the other",
    ),
)
