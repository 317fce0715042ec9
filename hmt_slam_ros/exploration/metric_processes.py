"""Where the metric processes have the robot, which run beside the pilot.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.4: the metric filter starts with what the door tells. RTL tells the
pose in which metric SLAM has the robot; whether that agrees with the door shows whether either is wrong.
"""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.chi_square import gate
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.processes.messages import Accepted, Hypotheses, Keyframe, Message, RealTimePose
from hmt_slam_ros.processes.replica import Replica
from hmt_slam_ros.sensing import Odometry
from hmt_slam_ros.sensing.odometry import OdometryBuffer
from hmt_slam_ros.topology.unknown import joined

# Two beliefs over one pose agree with this probability, both known no better than this, m, m, rad.
_AGREES = gate(0.999)
_LEAST = np.diag([0.1, 0.1, math.radians(3.0)]) ** 2
# A pose is good for so long, ns.
_FRESH = NANOSECONDS


class MetricProcesses:
    """What RTL said last, at the time of the newest scan, and the map that they have by now.

    Where the robot was lost they map on in new areas, and join these to the map as they recognize it.
    """

    def __init__(self, replica: Replica) -> None:
        """:param replica: their map at first."""
        self._replica = replica
        self._readings = OdometryBuffer()
        self._newest: RealTimePose | None = None
        self._now: PoseGaussian | None = None

    def hear(self, message: Message) -> None:
        """Take in what is newest."""
        if isinstance(message, Odometry):
            self._readings.add(message)
        elif isinstance(message, RealTimePose):
            self._newest = message
        elif isinstance(message, Keyframe | Hypotheses | Accepted):
            self._replica.hear(message)

    def carry(self, stamp: int) -> None:
        """Carry the pose on to a time, ns, or back to it."""
        self._now = None
        self._readings.at(stamp - _FRESH)
        newest = self._newest
        if newest is not None and abs(stamp - newest.stamp) <= _FRESH:
            since = se2.exp(self._readings.motion(newest.stamp, stamp))
            self._now = newest.local.compose(PoseGaussian.exactly(since))

    def told(self, area: int) -> PoseGaussian | None:
        """The belief over ``area_T_base``; None where they do not have the robot in the map.

        Metric SLAM lays what is around the robot into the frame of the robot's area as the arcs have it, and matches
        with that. So the pose relative to what is there is as good as the match, however long the way over the arcs is.
        """
        hybrid_map = self._replica.maps[self._replica.best]
        if self._now is None or self._newest is None or not hybrid_map.has_area(area):
            return None
        frame = joined(hybrid_map, area).get(self._newest.area)
        return None if frame is None else PoseGaussian.exactly(frame.mean).compose(self._now)

    def agree(self, area: int, belief: PoseGaussian) -> bool:
        """Whether they have the robot where another belief over ``area_T_base`` has it."""
        told = self.told(area)
        if told is None:
            return False
        off = se2.log(se2.between(belief.mean, told.mean))
        spread = belief.covariance + told.covariance + _LEAST
        return float(off @ np.linalg.solve(spread, off)) <= _AGREES
