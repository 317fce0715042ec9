"""Parameters of the belief over places."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class Places:
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
        True, "Whether landmarks weigh the places where a robot may be that woke up somewhere or was carried."
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
