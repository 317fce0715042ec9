"""How a correction of the robot's pose reaches map -> odom: at one stroke, or little by little."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2

Pose = NDArray[np.float64]

# A correction that is larger is no correction: the robot is elsewhere.
_FARTHEST, _TURN = 2.0, math.radians(45.0)


class CorrectionSmoother:
    """map -> odom as it is shown, which follows what is known of it.

    What is left of a correction is a motion of the robot, so that far from odometry's origin a turn does not swing it
    to and fro; it fades as exp(-t / time).
    """

    def __init__(self) -> None:
        self._stamp = 0
        self._map_T_odom: Pose | None = None

    def smooth(self, stamp: int, map_T_odom: Pose, odom_T_base: Pose, time_constant: float) -> Pose:
        """``map_T_odom`` to be shown, shape (3,).

        :param stamp: of the odometry, ns.
        :param map_T_odom: as it is known, shape (3,).
        :param odom_T_base: shape (3,).
        :param time_constant: in which a correction falls to a third, s; 0 for at once.
        """
        seconds = 1e-9 * (stamp - self._stamp)
        if self._map_T_odom is None or time_constant <= 0.0 or seconds < 0.0:
            self._map_T_odom = map_T_odom
        else:
            known = se2.compose(map_T_odom, odom_T_base)
            left = se2.log(se2.between(known, se2.compose(self._map_T_odom, odom_T_base)))
            if math.hypot(left[0], left[1]) > _FARTHEST or abs(left[2]) > _TURN:
                left = np.zeros(3)
            base = se2.compose(known, se2.exp(math.exp(-seconds / time_constant) * left))
            self._map_T_odom = se2.compose(base, se2.inverse(odom_T_base))
        self._stamp = stamp
        return self._map_T_odom
