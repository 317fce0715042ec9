"""The arc to where a robot woke up: it joins what is mapped from there on to the map, and tells nothing of where."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reachable

# Larger than a building, m, and all headings.
_DEVIATION, _HEADING = 300.0, math.pi


def unknown(mean: NDArray[np.float64]) -> PoseGaussian:
    """A belief that could be any.

    :param mean: shape (3,), where it is drawn as long as nothing is known.
    """
    return PoseGaussian(mean, np.diag([_DEVIATION, _DEVIATION, _HEADING]) ** 2)


def joined(hybrid_map: HybridMap, area: int) -> dict[int, PoseGaussian]:
    """{other area: belief over ``area_T_other``} of those to which arcs lead that tell something, and of itself."""
    return reachable(hybrid_map, area, _DEVIATION**2)


def tells_nothing(belief: PoseGaussian) -> bool:
    """Whether a belief is about as wide as :func:`unknown`."""
    return bool(np.trace(belief.covariance[:2, :2]) > _DEVIATION**2)


def telling_arc(hybrid_map: HybridMap, a: int, b: int) -> PoseGaussian | None:
    """The belief over ``a_T_b``, or None where no arc joins the two that tells anything."""
    arc = hybrid_map.arc(a, b)
    return None if arc is None or tells_nothing(arc) else arc


def beside(hybrid_map: HybridMap, area: int) -> list[int]:
    """The areas one arc away that tells where they are, ascending."""
    return [other for other in hybrid_map.neighbours(area) if telling_arc(hybrid_map, area, other) is not None]
