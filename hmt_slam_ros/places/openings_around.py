"""The openings around a robot, followed in the frame along the walls (wall_frame.py) for as long as they are near."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hmt_slam_ros.configuration.features import Features
from hmt_slam_ros.features.corners import NO_CORNERS
from hmt_slam_ros.features.heading import QUARTER
from hmt_slam_ros.features.landmark_map import Landmark, LandmarkMap
from hmt_slam_ros.features.landmarks import OPENING, both
from hmt_slam_ros.features.openings import NO_OPENINGS, Openings
from hmt_slam_ros.features.rays import Rays
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.places.wall_frame import ALONG, WallFrame

# One believes in openings from this confidence and so many sightings on, more than they were missed. They are so far
# beside the robot at most, m, within this angle of square to its hallway, rad.
_LEAST, _SIGHTINGS, _ASIDE, _ASKEW = 0.5, 2, 2.5, math.radians(20.0)
# What is so far away is forgotten, m.
_FORGET = 8.0


class OpeningsAround:
    """Openings around a robot.

    :ivar seen: in the last scan, the frame of the base.
    """

    def __init__(self, features: Features) -> None:
        self._features = features
        # Who walks by hides what is there.
        self._around = LandmarkMap(replace(features, landmark_least=0.0))
        self.seen = NO_OPENINGS

    def observe(self, frame: WallFrame, openings: Openings, rays: Rays) -> None:
        """Follow what a scan shows.

        :param frame: where it was taken.
        :param rays: its beams.
        """
        self.seen = openings
        self._around.observe(frame.pose_belief, both(NO_CORNERS, openings), rays)
        near = (one for one in self._around.landmarks if math.dist(one.pose.mean[:2], frame.place) < _FORGET)
        self._around.landmarks = list(near)

    def beside(self, frame: WallFrame) -> Iterator[Landmark]:
        """The openings to the sides of a robot's hallway that one believes in, in the frame along the walls."""
        for one in self._around.landmarks:
            heading = float(one.pose.mean[2]) - QUARTER * frame.axis
            beside = float((one.pose.mean[:2] - frame.place) @ frame.left)
            side = math.copysign(1.0, beside) * math.sin(heading)
            existence = one.existence
            believed = existence.confidence >= _LEAST and existence.seen >= max(_SIGHTINGS, existence.missed)
            if one.kind == OPENING and believed and abs(beside) <= _ASIDE and side > math.cos(_ASKEW):
                yield one

    def door_ahead(self) -> PoseGaussian | None:
        """The belief over ``base_T_opening`` of the nearest opening that the robot looks through; None for none.

        None, too, for one that it sees less exactly along a wall than walls are square: who hides most of a wall may
        be a part of its line.
        """
        seen = self.seen
        ahead = (seen.confidences >= _LEAST) & (seen.poses[:, 0] > 0.0) & (np.abs(seen.poses[:, 2]) <= ALONG)
        ahead &= np.abs(seen.poses[:, 1]) <= 0.5 * seen.widths
        if not ahead.any():
            return None
        k = int(np.argmin(np.where(ahead, seen.poses[:, 0], np.inf)))
        if seen.covariances[k, 2, 2] > math.radians(self._features.square_deviation) ** 2:
            return None
        return PoseGaussian(seen.poses[k], seen.covariances[k])
