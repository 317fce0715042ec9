"""Parameters of metric SLAM: motion, local maps, matching, the particle filter."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class MotionParameters:
    """Odometry motion model: noise of the increment between two readings."""

    translation_from_translation: float = parameter(
        0.1, "Deviation of the traveled distance per meter traveled.", unit="m/m", low=0.0, high=2.0
    )
    translation_from_rotation: float = parameter(
        0.001, "Deviation of the traveled distance per degree turned.", unit="m/deg", low=0.0, high=0.1
    )
    rotation_from_translation: float = parameter(
        2.0, "Deviation of the heading per meter traveled.", unit="deg/m", low=0.0, high=90.0
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
        1.0,
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
class LocalMapParameters:
    """Metric map of one area: occupancy grid and distance field, or lines, built from the keyframes' scans."""

    kind: str = parameter(
        "grid",
        "What maps of areas are made of: occupancy grids under particles, lines in a Kalman filter, or by what "
        "an area is, grids in hallways and lines in rooms.",
        choices=("grid", "lines", "by_class"),
    )
    cell: float = parameter(0.05, "Side of a grid cell.", unit="m", low=0.005, high=1.0)
    max_range: float = parameter(
        30.0, "Beams longer than this are ignored when the map is built.", unit="m", low=0.5, high=200.0
    )
    field_radius: float = parameter(
        0.5, "Distance at which the distance field is cut off.", unit="m", low=0.05, high=5.0
    )
    extent: float = parameter(
        56.0,
        "Half side of the local map; what lies farther from the area's origin is not kept.",
        unit="m",
        low=5.0,
        high=500.0,
    )
    log_odds_hit: float = parameter(0.85, "Evidence of occupancy where a beam ends.", unit="nat", low=0.05, high=3.0)
    log_odds_miss: float = parameter(
        0.4, "Evidence of free space where beams of a scan pass.", unit="nat", low=0.05, high=3.0
    )
    log_odds_limit: float = parameter(
        3.5, "Bound of a cell's evidence, so that a changed world is learned again.", unit="nat", low=0.5, high=6.0
    )


@dataclass(frozen=True)
class MatchingParameters:
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
        0.15,
        "Scale of the Cauchy weight on the distance of a beam's end point to the nearest wall.",
        unit="m",
        low=0.01,
        high=5.0,
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
        0.05,
        "Exponent on a scan's likelihood in the weights, since neighboring beams are correlated.",
        low=1e-4,
        high=1.0,
    )
    beam_noise: float = parameter(
        0.5,
        "Variance of single beams in the covariance of a match, in units of ``sigma_match`` squared.",
        low=0.0,
        high=100.0,
    )
    block_noise: float = parameter(
        1.5, "Factor on the variance that neighboring beams, taken together, show in a match.", low=0.0, high=100.0
    )
    map_age: float = parameter(
        2.0,
        "Mean age of the local map in keyframes: what a keyframe adds to the drift is less than its own error by this "
        "factor, along directions that the map determines.",
        low=1.0,
        high=100.0,
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
    search_step: float = parameter(1.5, "Angular step of the correlative search.", unit="deg", low=0.1, high=30.0)
    wide_distance: float = parameter(
        1.5, "Half side of the window at most, where the prediction is uncertain.", unit="m", low=0.0, high=10.0
    )
    wide_angle: float = parameter(
        90.0,
        "Half width of the angular window at most, where the prediction is uncertain.",
        unit="deg",
        low=0.0,
        high=180.0,
    )


@dataclass(frozen=True)
class FilterParameters:
    """Metric SLAM: the Rao-Blackwellized particle filter of each hypothesis and the keyframe rule."""

    particles: int = parameter(12, "Metric particles M of every hypothesis.", low=1, high=1000)
    ess_fraction: float = parameter(
        0.5, "Resample when the effective sample size falls below this share of the particles.", low=0.0, high=1.0
    )
    keyframe_distance: float = parameter(
        0.5, "A keyframe is taken after this distance traveled.", unit="m", low=0.05, high=10.0
    )
    keyframe_angle: float = parameter(
        20.0, "A keyframe is taken after this angle turned.", unit="deg", low=1.0, high=180.0
    )
    covariance_inflation: float = parameter(
        4.0,
        "Factor on the covariance of a match where it is weighed against the prediction, since its beams are "
        "correlated.",
        low=0.1,
        high=100.0,
    )
    max_scans_waiting_for_odometry: int = parameter(
        15,
        "Scans that wait for the first odometry at most, before they are placed by the velocity and their match; four "
        "times as many where odometry has come before.",
        low=1,
        high=100000,
    )
