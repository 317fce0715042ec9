"""Parameters of metric SLAM: motion, local maps, matching, the particle filter."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class SensorParameters:
    """Sensors of the robot."""

    scan_topics: str = parameter(
        "scan", "Topics of the scans, separated by commas; each may have several lasers, in frames of their own."
    )

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics of the scans."""
        return split_topics(self.scan_topics)


def split_topics(text: str) -> tuple[str, ...]:
    """Names of topics that are separated by commas, each once."""
    return tuple(dict.fromkeys(name for name in map(str.strip, text.split(",")) if name))


@dataclass(frozen=True)
class MotionParameters:
    """Odometry motion model: noise of the increment between two readings."""

    translation_from_translation: float = parameter(
        0.1, "Deviation of the traveled distance per meter traveled.", 0.0, 2.0, "m/m"
    )
    translation_from_rotation: float = parameter(
        0.001, "Deviation of the traveled distance per degree turned.", 0.0, 0.1, "m/deg"
    )
    rotation_from_translation: float = parameter(
        2.0, "Deviation of the heading per meter traveled.", 0.0, 90.0, "deg/m"
    )
    rotation_from_rotation: float = parameter(0.1, "Deviation of the heading per degree turned.", 0.0, 2.0, "deg/deg")
    translation_floor: float = parameter(0.01, "Smallest deviation of an increment's translation.", 1e-4, 1.0, "m")
    rotation_floor: float = parameter(0.2, "Smallest deviation of an increment's heading.", 1e-3, 45.0, "deg")
    acceleration: float = parameter(
        1.0,
        "Deviation of the acceleration, for prediction without odometry or against faulty odometry.",
        0.01,
        50.0,
        "m/s^2",
    )
    turn_acceleration: float = parameter(
        200.0, "Deviation of the acceleration of a turn, likewise.", 1.0, 10000.0, "deg/s^2"
    )
    fault_probability: float = parameter(
        0.01, "Probability that the odometry of a scan is wrong beyond its deviations.", 1e-9, 0.5
    )
    patience: float = parameter(
        3.0, "Time for which a scan waits for later odometry, where its own stops or jumps.", 0.0, 30.0, "s"
    )


@dataclass(frozen=True)
class LocalMapParameters:
    """Metric map of one area: occupancy grid and distance field, or lines, built from the keyframes' scans."""

    kind: str = parameter(
        "grid",
        "Local maps: grids under particles, lines in a Kalman filter, or by class (hallway: grid, room: lines).",
        choices=("grid", "lines", "by_class"),
    )
    cell: float = parameter(0.05, "Side of a grid cell.", 0.005, 1.0, "m")
    max_range: float = parameter(30.0, "Beams longer than this are ignored when the map is built.", 0.5, 200.0, "m")
    field_radius: float = parameter(0.5, "Distance at which the distance field is cut off.", 0.05, 5.0, "m")
    extent: float = parameter(
        56.0, "Half side of the local map; what lies farther from the area's origin is not kept.", 5.0, 500.0, "m"
    )
    log_odds_hit: float = parameter(0.85, "Evidence of occupancy where a beam ends.", 0.05, 3.0, "nat")
    log_odds_miss: float = parameter(0.4, "Evidence of free space where beams of a scan pass.", 0.05, 3.0, "nat")
    log_odds_limit: float = parameter(
        3.5, "Bound of a cell's evidence, so that a changed world is learned again.", 0.5, 6.0, "nat"
    )


@dataclass(frozen=True)
class MatchingParameters:
    """Scan matching: correlative search for the start, Gauss-Newton on the distance field for precision."""

    max_points: int = parameter(200, "Beams of a scan that are matched; evenly thinned.", 10, 5000)
    iterations: int = parameter(20, "Gauss-Newton steps at most.", 1, 200)
    sigma_hit: float = parameter(
        0.1, "Deviation sigma_hit of a beam's end point from the nearest wall.", 0.005, 1.0, "m"
    )
    sigma_match: float = parameter(
        0.04, "Deviation of a beam's end point from its wall when a pose is refined.", 0.002, 1.0, "m"
    )
    robust_scale: float = parameter(
        0.15, "Scale of the Cauchy weight on the distance of a beam's end point to the nearest wall.", 0.01, 5.0, "m"
    )
    random_returns: float = parameter(0.1, "Share z_rand of returns that no wall of the map explains.", 1e-4, 0.9)
    unknown_range: float = parameter(
        10.0, "Distance over which a return is equally likely anywhere in unknown space.", 0.5, 200.0, "m"
    )
    sharpness: float = parameter(
        1.0, "Exponent on a scan's likelihood in the proposal of a particle's pose.", 1e-3, 10.0
    )
    temper: float = parameter(
        0.05, "Exponent on a scan's likelihood in the weights, since neighboring beams are correlated.", 1e-4, 1.0
    )
    beam_noise: float = parameter(
        0.5, "Variance of single beams in the covariance of a match, in units of `sigma_match` squared.", 0.0, 100.0
    )
    block_noise: float = parameter(
        1.5, "Factor on the variance that neighboring beams, taken together, show in a match.", 0.0, 100.0
    )
    map_age: float = parameter(
        2.0,
        "Mean age of the local map in keyframes; divides a keyframe's part of the drift where the map determines it.",
        1.0,
        100.0,
    )
    matched_distance: float = parameter(
        0.15, "A beam whose end point is this close to a wall counts as matched.", 0.01, 5.0, "m"
    )
    matched_fraction: float = parameter(
        0.6, "Below this share of matched beams the correlative search looks for a better start.", 0.0, 1.0
    )
    search_distance: float = parameter(0.4, "Half side of the window of the correlative search.", 0.0, 10.0, "m")
    search_angle: float = parameter(
        15.0, "Half width of the angular window of the correlative search.", 0.0, 180.0, "deg"
    )
    search_step: float = parameter(1.5, "Angular step of the correlative search.", 0.1, 30.0, "deg")
    wide_distance: float = parameter(
        1.5, "Half side of the window at most, where the prediction is uncertain.", 0.0, 10.0, "m"
    )
    wide_angle: float = parameter(
        90.0, "Half width of the angular window at most, where the prediction is uncertain.", 0.0, 180.0, "deg"
    )


@dataclass(frozen=True)
class FilterParameters:
    """Metric SLAM: the Rao-Blackwellized particle filter of each hypothesis and the keyframe rule."""

    particles: int = parameter(12, "Metric particles M of every hypothesis.", 1, 1000)
    ess_fraction: float = parameter(
        0.5, "Resample when the effective sample size falls below this share of the particles.", 0.0, 1.0
    )
    keyframe_distance: float = parameter(0.5, "A keyframe is taken after this distance traveled.", 0.05, 10.0, "m")
    keyframe_angle: float = parameter(20.0, "A keyframe is taken after this angle turned.", 1.0, 180.0, "deg")
    covariance_inflation: float = parameter(
        4.0, "Factor on the covariance of a match against the prediction, as its beams are correlated.", 0.1, 100.0
    )
    max_scans_waiting_for_odometry: int = parameter(
        15, "Scans that wait for the first odometry at most; four times as many after odometry has come.", 1, 100000
    )
    contradiction_evidence: float = parameter(
        4.0,
        "Evidence of a scan for a displacement at which it becomes a keyframe at once.",
        0.0,
        100.0,
        "nat",
        expert=True,
    )
    new_surface: float = parameter(
        0.5, "Length of new surface for which mode `lifelong` stores a keyframe.", 0.1, 10.0, "m", expert=True
    )
    changed_surface: float = parameter(
        0.3,
        "Length of surface in known free space for which mode `lifelong` stores a keyframe.",
        0.1,
        10.0,
        "m",
        expert=True,
    )
