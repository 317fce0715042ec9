"""Parameters of the topological processes, and of the refinement of what they accept."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class AreaAbstractionParameters:
    """AAM: partition of the keyframes into areas by normalized cut, with doors or without."""

    area_policy: str = parameter(
        "ncut",
        "Where an area ends: at normalized cuts (ncut), or at normalized cuts of which openings that the path passes "
        "are a part (both).",
        choices=("ncut", "both"),
    )
    portal_factor: float = parameter(
        0.1, "By both: factor on the overlap of keyframes with an opening between them.", low=0.0, high=1.0
    )
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
    overlap_points: int = parameter(180, "Points of a scan that are compared; evenly thinned.", low=10, high=5000)
    confirmations: int = parameter(
        2, "Keyframes in a row at which a cut, or a move into a known area, has to be found.", low=1, high=100
    )
    move_margin: float = parameter(
        0.1,
        "The robot moves into a known area that overlaps this much more with its scan than the present one.",
        low=0.0,
        high=1.0,
    )


@dataclass(frozen=True)
class InferenceParameters:
    """TSBI: the distribution over topological paths."""

    max_hypotheses: int = parameter(16, "Topological hypotheses N kept after a reduction.", low=1, high=1000)
    drop_probability: float = parameter(
        1e-6, "Hypotheses below this probability are dropped at once.", low=0.0, high=0.1
    )
    max_candidates: int = parameter(16, "Known areas that a hypothesis is compared with at a cut.", low=1, high=1000)
    max_comparisons: int = parameter(
        64,
        "Comparisons with known areas at a cut, shared among hypotheses by probability; each has four at least.",
        low=1,
        high=100000,
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
    aliasing_prior: float = parameter(
        0.25,
        "Probability that keyframes fit into a place of the building where they do not lie, before any was tried; what "
        "is found where they surely do not lie is counted from then on.",
        low=0.001,
        high=1.0,
    )
    place_radius: float = parameter(
        2.0,
        "A robot this close to a keyframe of an area, and in its sight, is in the area's place.",
        unit="m",
        low=0.1,
        high=20.0,
    )
    temper: float = parameter(
        0.3,
        "Exponent on the likelihood of an area's surface samples in the weight of a hypothesis.",
        low=1e-4,
        high=1.0,
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
    recheck_keyframes: int = parameter(
        5, "Keyframes stored without a cut after which known ground is looked for.", low=1, high=1000
    )
    local_sigma: float = parameter(
        0.1,
        "An area whose position is at least this certain, about as certain as a wall, is in the local map.",
        unit="m",
        low=0.01,
        high=5.0,
    )
    local_reach: float = parameter(
        12.0,
        "An area with a keyframe this close to the robot's area is part of the local map.",
        unit="m",
        low=0.5,
        high=200.0,
    )


@dataclass(frozen=True)
class LoopClosureParameters:
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
class RefinementParameters:
    """Refinement of the poses by registering the scans with each other, when a path is accepted and at the end."""

    iterations: int = parameter(4, "Linearizations of all pairs of keyframes.", low=0, high=100)
    neighbors: int = parameter(15, "Keyframes that a keyframe is registered with at most.", low=1, high=1000)
    scan_neighbors: int = parameter(
        4, "Keyframes that a scan between keyframes is registered with at most.", low=1, high=100
    )
    reach: float = parameter(
        4.0, "Scans taken farther apart than this are not registered with each other.", unit="m", low=0.1, high=100.0
    )
    max_points: int = parameter(360, "Points of a scan that are registered; evenly thinned.", low=10, high=5000)
    first_gate: float = parameter(
        0.4, "A point and a wall meet within this distance at the first linearization.", unit="m", low=0.01, high=5.0
    )
    last_gate: float = parameter(0.15, "The same at the last linearization.", unit="m", low=0.01, high=5.0)
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
    certainty: float = parameter(
        0.1,
        "Share of the registrations' information that counts in the covariances of refined arcs.",
        low=1e-4,
        high=1.0,
    )
    scan_sigma: float = parameter(
        0.1,
        "Deviation of a scan's place relative to its keyframe before it is registered.",
        unit="m",
        low=0.001,
        high=5.0,
    )
    scan_angle: float = parameter(
        3.0,
        "Deviation of a scan's heading relative to its keyframe before it is registered.",
        unit="deg",
        low=0.01,
        high=90.0,
    )
