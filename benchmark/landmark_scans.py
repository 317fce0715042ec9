"""Keyframes of simulated drives, as metric SLAM chooses them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2

Array = NDArray[np.float64]


def keyframes_of(poses: Array, configuration: Configuration) -> list[int]:
    """Numbers of the scans of a drive that are keyframes, by the distances of metric SLAM."""
    options, found = configuration.filter, [0]
    for k in range(1, len(poses)):
        away = se2.between(poses[found[-1]], poses[k])
        turned = abs(away[2]) > math.radians(options.keyframe_angle)
        if turned or math.hypot(away[0], away[1]) > options.keyframe_distance:
            found.append(k)
    return found
