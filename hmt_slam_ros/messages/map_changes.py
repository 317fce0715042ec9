"""Parts of messages that describe the map and its changes, as immutable values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.sensors import Scan

Pose = NDArray[np.float64]
"""Shape (3,): x, y, m, and heading, rad."""


@dataclass(frozen=True, eq=False, slots=True)
class AreaPose:
    """The pose of an area in the global map.

    :ivar area: id of the area.
    :ivar pose: belief over ``map_T_area``.
    """

    area: int
    pose: PoseGaussian


@dataclass(frozen=True, eq=False, slots=True)
class LocalArea:
    """An area of the submap.

    :ivar area: id of the area.
    :ivar pose: shape (3,), ``current_T_area``.
    """

    area: int
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class InitialPose:
    """A pose of the robot that a person gives.

    :ivar area: id of a known area.
    :ivar pose: belief over ``area_T_base``.
    """

    area: int
    pose: PoseGaussian


@dataclass(frozen=True, eq=False, slots=True)
class Arc:
    """A directed arc of the topological graph.

    :ivar source: area a.
    :ivar target: area b.
    :ivar pose: belief over ``a_T_b``, Eq. (9).
    :ivar closure: whether the arc closed a loop, that is, leads into an area that was already known.
    """

    source: int
    target: int
    pose: PoseGaussian
    closure: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class ArcEnds:
    """The two areas of an arc that is removed.

    :ivar source: the smaller id.
    :ivar target: the larger id.
    """

    source: int
    target: int


@dataclass(frozen=True, eq=False, slots=True)
class AreaMerge:
    """The merge of an area into another, with all keyframes and arcs.

    :ivar area: the area that becomes part of the other.
    :ivar into: the other area.
    :ivar pose: belief over ``into_T_area``, that of the arc between the two.
    """

    area: int
    into: int
    pose: PoseGaussian


@dataclass(frozen=True, eq=False, slots=True)
class MovedKeyframe:
    """A keyframe with a new area or pose.

    :ivar keyframe: number of the keyframe.
    :ivar previous_area: area before the change.
    :ivar area: area after the change.
    :ivar pose: shape (3,), ``area_T_base``.
    """

    keyframe: int
    previous_area: int
    area: int
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class StaleBeams:
    """Beams of a keyframe's scan that newer scans refute.

    :ivar keyframe: number of the keyframe.
    :ivar removed: numbers of the beams whose surface is gone, ascending.
    :ivar occluded: numbers of the beams that a new surface blocks, ascending.
    :ivar starts: distance from the laser from which each occluded beam is still valid, m.
    """

    keyframe: int
    removed: tuple[int, ...]
    occluded: tuple[int, ...] = ()
    starts: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class PrunedKeyframe:
    """A redundant keyframe that is removed.

    :ivar keyframe: number of the keyframe.
    :ivar area: area of the keyframe.
    """

    keyframe: int
    area: int


@dataclass(frozen=True, eq=False, slots=True)
class ForeignKeyframe:
    """A keyframe that another robot mapped.

    :ivar keyframe: its number in the robot's map, below ``NO_KEYFRAME``.
    :ivar area: its area there.
    :ivar pose: shape (3,), ``area_T_base``.
    :ivar scan: its scan.
    """

    keyframe: int
    area: int
    pose: Pose
    scan: Scan


@dataclass(frozen=True, eq=False, slots=True)
class ForeignGround:
    """What becomes part of the robot's map of the ground of another one, with the robot's numbers.

    :ivar robot: name of the other one.
    :ivar keyframes: those that are new.
    :ivar arcs: arcs that are new or replaced, also to areas of the robot's own ground.
    :ivar removed_arcs: arcs that are removed.
    """

    robot: str
    keyframes: tuple[ForeignKeyframe, ...] = ()
    arcs: tuple[Arc, ...] = ()
    removed_arcs: tuple[ArcEnds, ...] = ()
