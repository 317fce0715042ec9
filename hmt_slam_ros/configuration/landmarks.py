"""Parameters of lines, landmarks and kinds of areas, and of the belief over places."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class FeatureParameters:
    """Lines: what a scan shows of walls, and what a room's map makes of it."""

    range_deviation: float = parameter(
        0.015, "Deviation of a range, which the covariance of a line follows from.", unit="m", low=1e-4, high=0.5
    )
    line_penalty: float = parameter(
        14.0,
        "What one more line costs when beams are sorted into lines, in squared deviations of a range.",
        low=1.0,
        high=1000.0,
    )
    stray_penalty: float = parameter(12.0, "What a beam on no line costs, likewise.", low=1.0, high=1000.0)
    min_beams: int = parameter(6, "Beams of a line at least.", low=3, high=1000)
    min_length: float = parameter(0.5, "What has to be seen of a line.", unit="m", low=0.05, high=10.0)
    max_gap: float = parameter(
        0.3, "A stretch of a line ends where nothing more is seen of it for this far.", unit="m", low=0.02, high=10.0
    )
    merge_probability: float = parameter(
        0.99,
        "Share of the segments of one line, and of a map's lines of one wall, that chi-square (2 degrees of "
        "freedom) finds to be one.",
        low=0.5,
        high=0.999999,
    )
    merge_deviation: float = parameter(
        0.01,
        "Segments are joined only where the distance of the one from the other's line is known this well.",
        unit="m",
        low=0.001,
        high=1.0,
    )
    map_merge_deviation: float = parameter(
        0.005, "The same of the lines of a map, and of what it observes.", unit="m", low=0.001, high=1.0
    )
    pair_probability: float = parameter(
        0.99999,
        "Share of true pairings of a scan's lines with the map's that chi-square admits, each and together.",
        low=0.5,
        high=0.99999999,
    )
    min_overlap: float = parameter(
        0.5,
        "Two lines are compared where they have this share of the shorter one in common along them.",
        low=0.01,
        high=1.0,
    )
    min_sightings: int = parameter(
        3,
        "A line of a map that fewer scans than this showed is forgotten at the first one that does not.",
        low=1,
        high=100,
    )
    corner_angle: float = parameter(
        15.0, "Two walls that meet make a corner up to so much from a right angle.", unit="deg", low=0.1, high=45.0
    )
    corner_gap: float = parameter(
        0.2, "Both walls of a corner are seen up to so near to it.", unit="m", low=0.01, high=2.0
    )
    landmark_size: float = parameter(
        0.2,
        "Length of each of a landmark's two walls that makes one believe in it by 1 - 1/e.",
        unit="m",
        low=0.01,
        high=10.0,
    )
    opening_min: float = parameter(0.6, "Width of an opening at least.", unit="m", low=0.1, high=10.0)
    opening_max: float = parameter(3.0, "Width of an opening at most.", unit="m", low=0.1, high=50.0)
    opening_depth: float = parameter(
        0.8, "So far behind the wall an opening is free; niches are less deep.", unit="m", low=0.1, high=10.0
    )
    opening_bias: float = parameter(
        3.3,
        "Log-odds of an opening of which a meter of the wall, a meter at either jamb and all behind is seen.",
        unit="nat",
        low=-100.0,
        high=100.0,
    )
    opening_wall: float = parameter(
        0.8, "How they change with the logarithm of what is seen of the wall.", unit="nat", low=-100.0, high=100.0
    )
    opening_jambs: float = parameter(
        1.3,
        "How they change with the logarithm of what is seen of the wall up to either jamb.",
        unit="nat",
        low=-100.0,
        high=100.0,
    )
    opening_share: float = parameter(
        1.3,
        "How they change with the logarithm of the share of the width that is seen through.",
        unit="nat",
        low=-100.0,
        high=100.0,
    )
    landmark_reach: float = parameter(
        6.0, "Landmarks that are known and farther away do not have to be seen.", unit="m", low=0.5, high=100.0
    )
    landmark_apart: float = parameter(
        0.3, "Landmarks of one kind and heading are farther apart, or one.", unit="m", low=0.01, high=2.0
    )
    landmark_detected: float = parameter(
        0.9, "Probability that a landmark which a scan should show is shown, if it is there.", low=0.01, high=0.999
    )
    landmark_detected_in_map: float = parameter(0.8, "The same of a virtual scan.", low=0.01, high=0.999)
    landmark_by_chance: float = parameter(
        0.05, "Probability that it is seen if it is there no more.", low=0.001, high=0.99
    )
    landmark_lasting: float = parameter(
        0.99, "Probability that a landmark is still there at the next scan that should show it.", low=0.5, high=1.0
    )
    landmark_lasting_away: float = parameter(
        0.8, "Times this, if the robot was away for a minute or more since the last one.", low=0.1, high=1.0
    )
    landmark_least: float = parameter(0.1, "Landmarks that are less probable are deleted.", low=0.0, high=0.9)
    portal_reach: float = parameter(
        2.0,
        "An opening is a portal between two areas where the path passes it so near to where the area changes.",
        unit="m",
        low=0.1,
        high=20.0,
    )
    map_deviation: float = parameter(
        0.02, "Deviation of a local map's surfaces, across them.", unit="m", low=1e-3, high=0.5
    )
    square_deviation: float = parameter(
        0.3, "Deviation of walls from being parallel or square to each other.", unit="deg", low=0.0, high=10.0
    )
    hallway_bias: float = parameter(
        -25.3, "Log-odds of a hallway as wide and as long as one meter.", unit="nat", low=-100.0, high=100.0
    )
    hallway_width: float = parameter(
        7.8, "How they change with the logarithm of the width.", unit="nat", low=-100.0, high=100.0
    )
    hallway_ratio: float = parameter(
        14.1, "How they change with the logarithm of length by width.", unit="nat", low=-100.0, high=100.0
    )
    hallway_sure: float = parameter(
        0.7,
        "An area that was taken for a room is taken for a hallway from this probability on, and the other way.",
        low=0.5,
        high=0.999,
    )


@dataclass(frozen=True)
class PlaceParameters:
    """Places: landmarks along hallways, and the robot's belief over where among them it is."""

    reach: float = parameter(
        2.0, "Landmarks count that are so far ahead or back along the hallway.", unit="m", low=0.5, high=100.0
    )
    aside: float = parameter(2.0, "Landmarks count that are so far to its sides.", unit="m", low=0.1, high=100.0)
    detection: float = parameter(
        0.955, "Probability p_det that a landmark within reach is extracted, if it is there.", low=0.01, high=0.99
    )
    position_deviation: float = parameter(
        0.04,
        "Deviation of a landmark's place along the hallway beyond what map and measurement say.",
        unit="m",
        low=0.001,
        high=2.0,
    )
    heading_deviation: float = parameter(
        0.5, "Deviation of a corner's heading, likewise.", unit="deg", low=0.1, high=30.0
    )
    width_deviation: float = parameter(
        0.09, "Deviation of an opening's width, likewise.", unit="m", low=0.001, high=2.0
    )
    false_density: float = parameter(
        3e-5, "Landmarks of a kind that are extracted where there is none.", unit="1/m", low=1e-6, high=10.0
    )
    new_density: float = parameter(
        0.001, "Landmarks of a kind that are there in known ground and not in the map.", unit="1/m", low=1e-6, high=10.0
    )
    usual_density: float = parameter(
        0.027, "Landmarks of a kind that unknown ground shows.", unit="1/m", low=1e-6, high=10.0
    )
    true_share: float = parameter(
        0.988, "Share of the extracted landmarks that are there, the mean of their confidences.", low=0.01, high=0.99
    )
    noticed: float = parameter(
        0.97, "Probability that a robot notices an opening that it passes, if it is there.", low=0.01, high=0.999
    )
    unlisted: float = parameter(
        0.01, "Openings that a robot notices where the map has none.", unit="1/m", low=1e-6, high=1.0
    )
    slip: float = parameter(
        0.01, "Probability of a transition between places that the map does not tell.", low=1e-9, high=0.5
    )
    discovery: float = parameter(
        0.05, "Probability that the next place after an unknown one is in the map.", low=1e-9, high=0.5
    )
    spacing: float = parameter(
        5.0, "Mean distance between places where the map does not tell it.", unit="m", low=0.1, high=100.0
    )
    unmapped: float = parameter(
        0.05,
        "Probability that the robot is in unknown ground when nothing is known of where it is.",
        low=1e-9,
        high=0.999,
    )
    prior: bool = parameter(
        False, "Whether landmarks weigh the places where a robot may be that woke up somewhere or was carried."
    )
    prior_temper: float = parameter(
        0.2,
        "Exponent on their likelihood where it speaks against a place, being made of the same scans as surfaces.",
        low=0.0,
        high=1.0,
    )
    loops: bool = parameter(
        False,
        "Whether landmarks propose loops: known areas where a map's last places are a second time, wherever the "
        "arcs have these.",
    )
    max_entropy: float = parameter(
        0.4, "The belief is confident below this entropy U_max.", unit="nat", low=1e-6, high=20.0
    )
    twin_share: float = parameter(
        0.9,
        "The second peak in the search for a loop holds this share of all that is left without the first one.",
        low=0.5,
        high=0.999999,
    )
