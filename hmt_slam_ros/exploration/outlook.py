"""What a keyframe shows of the place where it was taken: whether that is a hallway, and which doors lead off it.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.1: thin and long open spaces are hallways, others are rooms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.features import Features
from hmt_slam_ros.features.doors import jambs_of, up_to_doors
from hmt_slam_ros.features.extraction import extract_lines
from hmt_slam_ros.features.hallway import free_space, log_odds
from hmt_slam_ros.features.openings import openings_of
from hmt_slam_ros.features.rays import rays_of
from hmt_slam_ros.sensing import Scan


class Outlook(NamedTuple):
    """What a scan shows.

    :ivar hallway: whether the robot is in a hallway; one that sees too little of what is around it is not.
    :ivar doors: shape (n, 4), x and y of both jambs of each door, m, in the frame of the base.
    """

    hallway: bool
    doors: Float64


def outlook_of(scan: Scan, features: Features, door: float) -> Outlook:
    """What a scan shows.

    :param door: an opening up to so wide is a door, a wider one a hallway, m.
    """
    rays = rays_of(scan, features)
    openings = openings_of(extract_lines(scan, features), rays, features)
    narrow = openings.widths <= door
    doors = jambs_of(openings.poses[narrow], openings.widths[narrow])
    within = np.minimum(rays.free, up_to_doors(rays.origins, rays.directions, doors))
    space = free_space(rays._replace(free=within))
    return Outlook(space is not None and log_odds(space, features) > 0.0, doors)


def crosses(ways: Float64, doors: Float64) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which of some straight ways pass any of the doors.

    :param ways: shape (n, 4), x and y of both ends, m.
    :param doors: shape (m, 4), likewise, in the same frame.
    :returns: shape (n,).
    """
    a, b = ways[:, None, :2], ways[:, None, 2:]
    c, d = doors[None, :, :2], doors[None, :, 2:]
    apart = (_side(a, b, c) > 0.0) != (_side(a, b, d) > 0.0)
    through = (_side(c, d, a) > 0.0) != (_side(c, d, b) > 0.0)
    return np.asarray((apart & through).any(axis=1))


def _side(a: Float64, b: Float64, p: Float64) -> Float64:
    """Above 0 where p is to the left of the line from a to b."""
    along, to = b - a, p - a
    return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])
