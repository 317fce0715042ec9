"""Which openings around an area lead off a hallway that was driven along, and where in its middle they do.

An opening leads to another hallway where the robot drove along one behind it; where it did not drive through, where it
is as wide as a hallway and one sees far behind it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.features.landmark_map import Landmark, scatter_ratio
from hmt_slam_ros.features.landmarks import OPENING
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.places.floor import DIRECTIONS, Floor, off_axes, quarter_of
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import opposite

# Openings that are less probable lead nowhere.
_LEAST = 0.5
# An opening is beside a hallway that was driven along so near to it, m, at so many keyframes, which are so far from its
# wall, m, and see that wall where the opening is to this, m. An opening askew from here on, rad, is in none.
_NEAR, _FEW, _ASIDE, _OFF, _ASKEW = 3.0, 2, (0.2, 2.5), 0.5, math.radians(20.0)
# Keyframes behind an opening are so far behind it, m, and so far beside its middle at most, m; nearer to it one looks
# back into the hallway.
_BEHIND, _WITHIN = (1.5, 5.0), 1.0
# A hallway that nobody drove along is so wide, m, and one sees so far along it from its mouth, m, at least.
_WIDE, _FAR = 1.7, 7.0


class LeadingOff(NamedTuple):
    """An opening in the wall of a hallway.

    :ivar area: in which it is known.
    :ivar number: of the landmark in that area.
    :ivar landmark: as known there.
    :ivar located: the belief over its pose there, by how far its sightings are apart.
    :ivar direction: in which it leads off.
    :ivar hallway: whether to another hallway; else to a room.
    :ivar foot: shape (2,), the place before it in the hallway's middle, in the frame of the area's floor, m.
    """

    area: int
    number: int
    landmark: Landmark
    located: PoseGaussian
    direction: int
    hallway: bool
    foot: Float64


def leading_off(floor: Floor, landmarks: tuple[Landmark, ...]) -> Iterator[LeadingOff]:
    """The openings of an area that lead off hallways.

    :param floor: around the area.
    :param landmarks: of the area.
    """
    ratio = scatter_ratio(landmarks)
    for number, landmark in enumerate(landmarks):
        if landmark.kind != OPENING or landmark.existence.probability < _LEAST:
            continue
        pose = se2.compose(floor.areas[floor.area].mean, landmark.pose.mean)
        if off_axes(pose[2]) > _ASKEW:
            continue
        direction = int(quarter_of(pose[2]))
        foot = _foot(floor, pose[:2], direction)
        if foot is not None:
            hallway = _to_hallway(floor, pose[:2], direction, landmark.width)
            located = landmark.located(ratio)
            yield LeadingOff(floor.area, number, landmark, located, direction, hallway, foot)


def _foot(floor: Floor, place: Float64, direction: int) -> Float64 | None:
    """The place before an opening in the middle of the hallway that it leads off; None where it leads off none."""
    ahead, beside = _seen_from(floor, place, direction)
    wall, other = floor.clear[:, direction], floor.clear[:, opposite(direction)]
    before = (np.abs(beside) <= _NEAR) & (_ASIDE[0] <= ahead) & (ahead <= _ASIDE[1]) & (np.abs(wall - ahead) <= _OFF)
    own = before & floor.along[:, (direction + 1) % 2]
    # In a room, too, one may see into a hallway from some places.
    if own.sum() < max(_FEW, 0.5 * before.sum()):
        return None
    between = own & (other <= _ASIDE[1])
    middle = np.where(between, 0.5 * (wall - other), np.nan) if between.any() else np.zeros(len(wall))
    return place - DIRECTIONS[direction] * float(np.nanmedian(ahead[own] - middle[own]))


def _to_hallway(floor: Floor, place: Float64, direction: int, width: float) -> bool:
    """Whether an opening leads to a hallway."""
    ahead, beside = _seen_from(floor, place, direction)
    behind = (-_BEHIND[1] <= ahead) & (ahead <= -_BEHIND[0]) & (np.abs(beside) <= _WITHIN)
    if behind.any():
        return bool(floor.along[behind, direction % 2].mean() >= 0.5)
    before = (ahead > 0.0) & (ahead <= _ASIDE[1]) & (np.abs(beside) <= 0.5 * width)
    deep = floor.clear[before, direction] - ahead[before]
    return width >= _WIDE and bool(np.any(deep >= _FAR))


def _seen_from(floor: Floor, place: Float64, direction: int) -> tuple[Float64, Float64]:
    """How far a place is ahead and beside of all keyframes that look in a direction, m, shape (n,) each."""
    away = place - floor.places
    return away @ DIRECTIONS[direction], away @ DIRECTIONS[(direction + 1) % QUARTERS]
