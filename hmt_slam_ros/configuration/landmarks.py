"""Parameters of lines, landmarks and classes of areas, and of the belief over places."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class FeatureParameters:
    """Lines of walls in scans, line maps of rooms, and landmarks."""

    range_deviation: float = parameter(
        0.015, "Deviation of a range, which the covariance of a line follows from.", 1e-4, 0.5, "m"
    )
    line_penalty: float = parameter(
        14.0, "Cost of one more line when beams are assigned to lines, in squared range deviations.", 1.0, 1000.0
    )
    stray_penalty: float = parameter(12.0, "What a beam on no line costs, likewise.", 1.0, 1000.0)
    min_beams: int = parameter(6, "Beams of a line at least.", 3, 1000)
    min_length: float = parameter(0.5, "What has to be seen of a line.", 0.05, 10.0, "m")
    max_gap: float = parameter(
        0.3, "A stretch of a line ends where nothing more is seen of it for this far.", 0.02, 10.0, "m"
    )
    merge_probability: float = parameter(
        0.99, "Share of the segments of one wall that the chi-square test (2 degrees of freedom) joins.", 0.5, 0.999999
    )
    merge_deviation: float = parameter(
        0.01, "Segments are joined only where their distance is known this well.", 0.001, 1.0, "m"
    )
    map_merge_deviation: float = parameter(
        0.005, "The same of the lines of a map, and of what it observes.", 0.001, 1.0, "m"
    )
    pair_probability: float = parameter(
        0.99999, "Share of true pairings of scan lines with map lines that the chi-square gates admit.", 0.5, 0.99999999
    )
    min_overlap: float = parameter(
        0.5, "Two lines are compared where they have this share of the shorter one in common along them.", 0.01, 1.0
    )
    min_sightings: int = parameter(
        3, "A line of a map that fewer scans than this showed is forgotten at the first one that does not.", 1, 100
    )
    corner_angle: float = parameter(
        15.0, "Two walls that meet make a corner up to this much from a right angle.", 0.1, 45.0, "deg"
    )
    corner_gap: float = parameter(0.2, "Both walls of a corner are seen up to this near to it.", 0.01, 2.0, "m")
    landmark_size: float = parameter(
        0.2, "Length of each of a landmark's two walls at which its confidence is 1 - 1/e.", 0.01, 10.0, "m"
    )
    opening_min: float = parameter(0.6, "Width of an opening at least.", 0.1, 10.0, "m")
    opening_max: float = parameter(3.0, "Width of an opening at most.", 0.1, 50.0, "m")
    opening_depth: float = parameter(
        0.8, "An opening is free up to this far behind the wall; niches are less deep.", 0.1, 10.0, "m"
    )
    opening_bias: float = parameter(
        3.3,
        "Log-odds of an opening: a meter of the wall, a meter at each jamb and all behind are seen.",
        -100.0,
        100.0,
        "nat",
    )
    opening_wall: float = parameter(
        0.8, "How they change with the logarithm of the seen length of the wall.", -100.0, 100.0, "nat"
    )
    opening_jambs: float = parameter(
        1.3, "How they change with the logarithm of the seen length of the wall at each jamb.", -100.0, 100.0, "nat"
    )
    opening_share: float = parameter(
        1.3, "How they change with the logarithm of the share of the width that is seen through.", -100.0, 100.0, "nat"
    )
    landmark_reach: float = parameter(
        6.0, "Landmarks that are known and farther away do not have to be seen.", 0.5, 100.0, "m"
    )
    landmark_apart: float = parameter(
        0.3, "Landmarks of one kind and heading are farther apart, or one.", 0.01, 2.0, "m"
    )
    landmark_detected: float = parameter(
        0.9, "Probability that a landmark which a scan should show is shown, if it is there.", 0.01, 0.999
    )
    landmark_detected_in_map: float = parameter(0.8, "The same of a virtual scan.", 0.01, 0.999)
    landmark_by_chance: float = parameter(0.05, "Probability that it is seen if it is there no more.", 0.001, 0.99)
    landmark_lasting: float = parameter(
        0.99, "Probability that a landmark is still there at the next scan that should show it.", 0.5, 1.0
    )
    landmark_lasting_away: float = parameter(
        0.8, "Times this, if the robot was away for a minute or more since the last one.", 0.1, 1.0
    )
    landmark_least: float = parameter(0.1, "Landmarks that are less probable are deleted.", 0.0, 0.9)
    portal_reach: float = parameter(
        2.0, "An opening that the path passes this near to a change of area is a portal.", 0.1, 20.0, "m"
    )
    map_deviation: float = parameter(0.02, "Deviation of a local map's surfaces, across them.", 1e-3, 0.5, "m")
    square_deviation: float = parameter(
        0.3, "Deviation of walls from being parallel or square to each other.", 0.0, 10.0, "deg"
    )
    hallway_bias: float = parameter(
        -25.3, "Log-odds of a hallway as wide and as long as one meter.", -100.0, 100.0, "nat"
    )
    hallway_width: float = parameter(7.8, "How they change with the logarithm of the width.", -100.0, 100.0, "nat")
    hallway_ratio: float = parameter(
        14.1, "How they change with the logarithm of length by width.", -100.0, 100.0, "nat"
    )
    hallway_sure: float = parameter(
        0.7, "Probability from which on the class of an area changes to the other one.", 0.5, 0.999
    )


@dataclass(frozen=True)
class PlaceParameters:
    """Landmarks along hallways, and the belief over places."""

    reach: float = parameter(2.0, "Landmarks count up to this far ahead or back along the hallway.", 0.5, 100.0, "m")
    aside: float = parameter(2.0, "Landmarks count up to this far to its sides.", 0.1, 100.0, "m")
    detection: float = parameter(
        0.955, "Probability p_det that a landmark within reach is extracted, if it is there.", 0.01, 0.99
    )
    position_deviation: float = parameter(
        0.04, "Deviation of a landmark's place along the hallway beyond what map and measurement say.", 0.001, 2.0, "m"
    )
    heading_deviation: float = parameter(0.5, "Deviation of a corner's heading, likewise.", 0.1, 30.0, "deg")
    width_deviation: float = parameter(0.09, "Deviation of an opening's width, likewise.", 0.001, 2.0, "m")
    false_density: float = parameter(
        3e-5, "Landmarks of a kind that are extracted where there is none.", 1e-6, 10.0, "1/m"
    )
    new_density: float = parameter(
        0.001, "Landmarks of a kind that are there in known ground and not in the map.", 1e-6, 10.0, "1/m"
    )
    usual_density: float = parameter(0.027, "Landmarks of a kind that unknown ground shows.", 1e-6, 10.0, "1/m")
    true_share: float = parameter(
        0.988, "Share of the extracted landmarks that are there, the mean of their confidences.", 0.01, 0.99
    )
    noticed: float = parameter(
        0.97, "Probability that a robot notices an opening that it passes, if it is there.", 0.01, 0.999
    )
    unlisted: float = parameter(0.01, "Openings that a robot notices where the map has none.", 1e-6, 1.0, "1/m")
    slip: float = parameter(0.01, "Probability of a transition between places that the map does not hold.", 1e-9, 0.5)
    discovery: float = parameter(0.05, "Probability that the next place after an unknown one is in the map.", 1e-9, 0.5)
    spacing: float = parameter(5.0, "Mean distance between places where the map does not hold it.", 0.1, 100.0, "m")
    unmapped: float = parameter(0.05, "Probability of unknown ground when nothing is known of the pose.", 1e-9, 0.999)
    prior: bool = parameter(False, "Whether landmarks weight the pose candidates of a lost robot.")
    prior_temper: float = parameter(
        0.2, "Exponent on their likelihood against a candidate; surfaces come from the same scans.", 0.0, 1.0
    )
    loops: bool = parameter(
        False,
        "Whether landmarks propose loops: known areas that show the last places again, wherever the arcs have them.",
    )
    max_entropy: float = parameter(0.4, "The belief is confident below this entropy U_max.", 1e-6, 20.0, "nat")
    twin_share: float = parameter(
        0.9, "Share of the belief beside the first peak that the second peak of a loop holds.", 0.5, 0.999999
    )
