"""What messages say of the map: where its areas are, what joins them, and how it changes; immutable values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry.gaussian import PoseGaussian

Pose = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class AreaPose:
    """Where an area is in the globally consistent map.

    :ivar area: its id.
    :ivar pose: belief over ``map_T_area``.
    """

    area: int
    pose: PoseGaussian


@dataclass(frozen=True, eq=False, slots=True)
class LocalArea:
    """An area that the local map must hold.

    :ivar area: its id.
    :ivar pose: shape (3,), ``current_T_area``.
    """

    area: int
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class InitialPose:
    """Where the robot is, as somebody says.

    :ivar area: a known area.
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
    :ivar closure: whether the arc closed a loop, that is, led into an area that was already known.
    """

    source: int
    target: int
    pose: PoseGaussian
    closure: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class ArcEnds:
    """Two areas between which an arc is taken out.

    :ivar source: the smaller.
    :ivar target: the larger.
    """

    source: int
    target: int


@dataclass(frozen=True, eq=False, slots=True)
class AreaMerge:
    """Two areas that are one, with all keyframes and arcs.

    :ivar area: the one that becomes part of the other.
    :ivar into: the other.
    :ivar pose: belief over ``into_T_area``, as the arc had it that joined the two.
    """

    area: int
    into: int
    pose: PoseGaussian


@dataclass(frozen=True, eq=False, slots=True)
class MovedKeyframe:
    """A keyframe that is in another area now, or at another pose.

    :ivar keyframe: its number.
    :ivar previous_area: the area in which it was.
    :ivar area: the area to which it belongs now.
    :ivar pose: shape (3,), ``area_T_base``.
    """

    keyframe: int
    previous_area: int
    area: int
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class StaleBeams:
    """What a keyframe's scan says of the world that is not so any more.

    :ivar keyframe: its number.
    :ivar removed: numbers of the beams whose end is gone, ascending.
    :ivar occluded: numbers of the beams in whose way something came to stand, ascending.
    :ivar starts: from where on each of these still holds, m from the laser.
    """

    keyframe: int
    removed: tuple[int, ...]
    occluded: tuple[int, ...] = ()
    starts: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class PrunedKeyframe:
    """A keyframe of ground that others hold as well.

    :ivar keyframe: its number.
    :ivar area: the area in which it is.
    """

    keyframe: int
    area: int
