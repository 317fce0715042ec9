"""Where keyframes are in a map, and the bounds within which they are looked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.agreement import Agreement
from hmt_slam_ros.topology.area_grid import AreaGrid
from hmt_slam_ros.topology.area_matching import Mode
from hmt_slam_ros.topology.surroundings import stacked

# Deviation of an answer's position at most, m.
_SHARP = 0.2


class Located(NamedTuple):
    """Where keyframes are.

    :ivar area: in whose place.
    :ivar mode: how they lie there.
    :ivar found: their surfaces in the map of the place.
    """

    area: int
    mode: Mode
    found: Agreement


def is_certain(located: Located) -> bool:
    """Whether the surfaces alone say where, also along corridors."""
    variance = float(np.linalg.eigvalsh(located.mode.measured.covariance[:2, :2])[-1])
    return variance <= _SHARP**2


def reach_of(
    positions: NDArray[np.float64], query: AreaGrid, poses: Mapping[int, NDArray[np.float64]], radius: float
) -> NDArray[np.float64]:
    """The smallest and the largest (x, y) of the middle of the query's points where a keyframe of it is near one of
    some positions, shape (2, 2).

    :param positions: shape (n, 2), m.
    :param poses: {keyframe: ``reference_T_base``} of the query.
    :param radius: how near, m.
    """
    middle = query.points.mean(axis=0) if len(query.points) else np.zeros(2)
    lever = float(np.hypot(*(stacked(poses)[:, :2] - middle).T).max())
    reach = radius + lever
    return np.array([positions.min(axis=0) - reach, positions.max(axis=0) + reach])
