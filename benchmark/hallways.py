"""Depths of poses in the rooms of simulated buildings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation.scenario import Scenario

Array = NDArray[np.float64]


def depth_in_rooms(scenario: Scenario, poses: Array) -> Array:
    """How deep poses (n, 3) are in a room, m, shape (n,); below 0 for those outside of all, by the distance."""
    deepest = np.full(len(poses), -np.inf)
    for room in scenario.building.rooms:
        local = np.abs(se2.transform(se2.inverse(room[:3]), poses[:, :2]))
        deepest = np.maximum(deepest, (0.5 * room[3:] - local).min(axis=1))
    return deepest
