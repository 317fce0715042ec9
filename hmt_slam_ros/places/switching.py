"""From the belief over places to the metric filter of a room, at its door.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.4: only a robot that is confident switches, since in the frame of a
wrong place all that follows is wrong. The first two moments of the door as the robot measures it, and of the same
door in the map, are those of the robot's pose with which the filter starts,

    area_T_base = area_T_door (base_T_door)^-1.
"""

from __future__ import annotations

from typing import NamedTuple

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.places.chart import Chart
from hmt_slam_ros.places.estimator import PlaceEstimator


class MetricStart(NamedTuple):
    """What a metric filter starts with.

    :ivar node: the robot is before its opening.
    :ivar area: in which the opening is known.
    :ivar pose: the belief over ``area_T_base``.
    """

    node: int
    area: int
    pose: PoseGaussian


def metric_start(estimator: PlaceEstimator, chart: Chart) -> MetricStart | None:
    """What the opening before the robot tells of its pose; None where it is not confident, or before no opening."""
    facing, seen = estimator.facing, estimator.openings.door_ahead()
    if facing is None or seen is None or not estimator.at_node:
        return None
    if estimator.belief is None or not estimator.belief.confident:
        return None
    node, direction = facing
    for opening in chart.nodes[node].openings:
        if opening.direction == direction:
            return MetricStart(node, opening.area, opening.located.compose(seen.inverse()))
    return None
