"""Robots that are lost in a hallway of an institute, and go on until they know where they are."""

from __future__ import annotations

import numpy as np

from benchmark.belief import Estimate, recovery
from benchmark.institute_maps import InstituteMap
from benchmark.institute_missions import Steered, axis_of
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.places.place_graph import state_of
from hmt_slam_ros.simulation.scenario import Scenario

RELOCATIONS = 2
"""In a building."""

FAR, _TIME = 60.0, 300.0
"""Way of a relocation at most, m, and its time, s."""


def relocations_of(institute: InstituteMap, scenario: Scenario, configuration: Configuration) -> list[list[Estimate]]:
    """The estimates of robots that are lost at first."""
    random = np.random.default_rng([scenario.settings.seed, 2])
    return [_relocation(institute, scenario, configuration, random) for _ in range(RELOCATIONS)]


def _relocation(
    institute: InstituteMap, scenario: Scenario, configuration: Configuration, random: np.random.Generator
) -> list[Estimate]:
    edges = list({(edge.start, edge.leaving): edge for edge in institute.chart.edges}.values())
    lengths = np.array([edge.distance[0] for edge in edges])
    edge = edges[int(random.choice(len(lengths), p=lengths / lengths.sum()))]
    ahead = np.array((random.uniform(0.2, 0.8) * edge.distance[0], 0.0, 0.0))
    start = se2.compose(axis_of(institute, state_of(edge.start, edge.leaving)), ahead)
    steered = Steered(institute, scenario, configuration, start)
    steered.pilot.go(None)
    end = steered.robot.stamp + _TIME * NANOSECONDS
    while steered.robot.travelled < FAR and steered.robot.stamp < end and recovery(steered.estimates) is None:
        steered.step()
    return steered.estimates
