"""Parameters of the topological processes and of the refinement."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class AreaAbstractionParameters:
    """AAM: partition of the keyframes into areas by normalized cut, with doors or without."""

    area_policy: str = parameter(
        "ncut",
        "Where an area ends: at normalized cuts, or at cuts that openings on the path take part in (both).",
        choices=("ncut", "both"),
    )
    portal_factor: float = parameter(
        0.1, "By both: factor on the overlap of keyframes with an opening between them.", 0.0, 1.0
    )
    ncut_threshold: float = parameter(
        0.35, "Cut an area where the normalized cut is below this; smaller values make larger areas.", 0.0, 2.0
    )
    min_cluster: int = parameter(5, "Keyframes of an area at least.", 1, 1000)
    overlap_radius: float = parameter(0.2, "Two scan points this close count as the same sensed space.", 0.01, 2.0, "m")
    overlap_points: int = parameter(180, "Points of a scan that are compared; evenly thinned.", 10, 5000)
    confirmations: int = parameter(
        2, "Keyframes in a row at which a cut, or a move into a known area, has to be found.", 1, 100
    )
    move_margin: float = parameter(0.1, "Margin in overlap by which a known area becomes the robot's area.", 0.0, 1.0)
    keyframes_per_place: int = parameter(
        2, "Keyframes of an area per place and heading; others are pruned.", 1, 100, expert=True
    )


@dataclass(frozen=True)
class InferenceParameters:
    """TSBI: the distribution over topological paths."""

    max_hypotheses: int = parameter(16, "Topological hypotheses N kept after a reduction.", 1, 1000)
    drop_probability: float = parameter(1e-6, "Hypotheses below this probability are dropped at once.", 0.0, 0.1)
    max_candidates: int = parameter(16, "Known areas that a hypothesis is compared with at a cut.", 1, 1000)
    max_comparisons: int = parameter(
        64,
        "Comparisons with known areas at a cut, shared by probability; four at least for each hypothesis.",
        1,
        100000,
    )
    max_modes: int = parameter(3, "Modes of the match into one known area that become hypotheses.", 1, 100)
    gate_probability: float = parameter(
        0.999, "Share of true revisits that the chi-square gate on the arc prior admits.", 0.5, 0.999999
    )
    prior_scale: float = parameter(
        1.5, "Factor on the deviations of the arc prior, as drift is estimated from few particles.", 0.1, 10.0
    )
    prior_limit: float = parameter(
        100.0, "Known areas whose position is less certain than this are no candidates.", 0.1, 1000.0, "m"
    )
    new_probability: float = parameter(
        0.05, "Probability of new ground at least, where the arcs point into known areas.", 0.0, 1.0
    )
    aliasing_prior: float = parameter(
        0.25, "Prior probability that keyframes fit into a wrong place; counts of this building update it.", 0.001, 1.0
    )
    place_radius: float = parameter(
        2.0, "A robot this close to a keyframe of an area, and in its sight, is in the area's place.", 0.1, 20.0, "m"
    )
    temper: float = parameter(
        0.3, "Exponent on the likelihood of an area's surface samples in the weight of a hypothesis.", 1e-4, 1.0
    )
    sample_spacing: float = parameter(
        0.2, "Distance between the surface samples that areas are compared by.", 0.02, 2.0, "m"
    )
    search_cell: float = parameter(0.1, "Side of a cell of the grids that areas are compared by.", 0.02, 1.0, "m")
    surface_sigma: float = parameter(
        0.1, "Deviation of a surface from where another area's map has it.", 0.01, 1.0, "m"
    )
    surface_ratio: float = parameter(
        3.0, "How much likelier a surface is measured on a known surface than in unknown space.", 1.01, 100.0
    )
    free_ratio: float = parameter(
        0.1, "How much likelier a surface is measured in free space than in unknown space.", 1e-4, 0.99
    )
    recheck_keyframes: int = parameter(
        5, "Keyframes stored without a cut after which known areas are searched.", 1, 1000
    )
    local_sigma: float = parameter(
        0.1, "Areas whose position is at least this certain are in the local map.", 0.01, 5.0, "m"
    )
    local_reach: float = parameter(
        12.0, "An area with a keyframe this close to the robot's area is part of the local map.", 0.5, 200.0, "m"
    )
    kidnapping_prior: float = parameter(
        1e-5,
        "Probability of a kidnapping per keyframe event, before any was counted; 1e-5 is one in 50 km.",
        1e-12,
        0.1,
        expert=True,
    )
    kidnapping_odds: float = parameter(
        3e-5, "Odds of a kidnapping at which a kidnapped hypothesis is spawned.", 1e-12, 1.0, expert=True
    )
    relocalization_probability: float = parameter(
        0.8,
        "Probability of a pose, in two searches in a row, that relocalizes a lost robot.",
        0.5,
        0.999999,
        expert=True,
    )
    hint_probability: float = parameter(
        0.9, "Probability of a pose near `initialpose`, in one search, that relocalizes.", 0.5, 0.999999, expert=True
    )
    relocalization_share: float = parameter(
        0.7, "Share of the surfaces that have to be known where a kidnapped robot relocalizes.", 0.0, 1.0, expert=True
    )
    lost_probability: float = parameter(
        0.1,
        "The robot counts as localized up to this probability of being lost, or elsewhere than it is reported.",
        0.0,
        0.5,
        expert=True,
    )


@dataclass(frozen=True)
class LoopClosureParameters:
    """TLCA: acceptance of the dominant topological path and the globally consistent map."""

    accept_probability: float = parameter(0.99, "A path is accepted when its probability reaches this value.", 0.5, 1.0)
    accept_keyframes: int = parameter(
        3, "Keyframes over which the probability has to hold since the hypotheses branched.", 1, 1000
    )
    accept_distance: float = parameter(
        2.0, "Distance over which the probability has to hold since the hypotheses branched.", 0.0, 1000.0, "m"
    )
    contradiction_probability: float = parameter(
        0.999,
        "Share of true closures that pass the chi-square test of their cycles; others start a revision.",
        0.5,
        0.999999,
    )
    arc_sigma_floor: float = parameter(0.01, "Smallest deviation of an arc's translation.", 1e-4, 1.0, "m")
    arc_angle_floor: float = parameter(0.2, "Smallest deviation of an arc's angle.", 1e-3, 45.0, "deg")
    global_map: str = parameter(
        "consistent",
        "Poses of the areas: consistent with all arcs (Lu and Milios), or along shortest paths (Dijkstra).",
        choices=("consistent", "shortest_path"),
    )
    alignment_inflation: float = parameter(
        10.0, "Factor on the covariance of an alignment of two areas, as areas bend.", 1.0, 1000.0, expert=True
    )


@dataclass(frozen=True)
class RefinementParameters:
    """Refinement of the poses by registering the scans with each other, when a path is accepted and at the end."""

    iterations: int = parameter(4, "Linearizations of all pairs of keyframes.", 0, 100)
    neighbors: int = parameter(15, "Keyframes that a keyframe is registered with at most.", 1, 1000)
    scan_neighbors: int = parameter(4, "Keyframes that a scan between keyframes is registered with at most.", 1, 100)
    reach: float = parameter(
        4.0, "Scans taken farther apart than this are not registered with each other.", 0.1, 100.0, "m"
    )
    max_points: int = parameter(360, "Points of a scan that are registered; evenly thinned.", 10, 5000)
    first_gate: float = parameter(
        0.4, "A point and a wall meet within this distance at the first linearization.", 0.01, 5.0, "m"
    )
    last_gate: float = parameter(0.15, "The same at the last linearization.", 0.01, 5.0, "m")
    min_share: float = parameter(0.1, "Two scans overlap when at least this share of their points meet.", 0.01, 1.0)
    sigma: float = parameter(0.05, "Deviation of a point from its wall.", 0.001, 1.0, "m")
    robust_scale: float = parameter(
        0.05, "Scale of the Cauchy weight on the distance of a point from its wall.", 0.001, 5.0, "m"
    )
    temper: float = parameter(
        0.3, "Exponent on the likelihood, since beams and overlapping pairs are correlated.", 1e-4, 1.0
    )
    certainty: float = parameter(
        0.1, "Share of the registrations' information that counts in the covariances of refined arcs.", 1e-4, 1.0
    )
    scan_sigma: float = parameter(
        0.1, "Deviation of a scan's place relative to its keyframe before it is registered.", 0.001, 5.0, "m"
    )
    scan_angle: float = parameter(
        3.0, "Deviation of a scan's heading relative to its keyframe before it is registered.", 0.01, 90.0, "deg"
    )


@dataclass(frozen=True)
class MarkParameters:
    """Observations of marks with names."""

    topic: str = parameter(
        "",
        "Topic of geometry_msgs/PoseWithCovarianceStamped: poses of the robot in frames that are named after marks; "
        "empty for none.",
    )
    wrong_share: float = parameter(
        0.05, "Prior probability that a mark is another one than its name says, or in another place.", 0.001, 0.5
    )


@dataclass(frozen=True)
class TeamParameters:
    """Other robots of a team."""

    uses_ground: bool = parameter(
        False,
        "Whether the ground of robots that are joined becomes part of the map. A false join then spoils it, and in "
        "buildings that repeat themselves there are some.",
    )
