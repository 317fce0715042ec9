"""p(z | new ground): how well do keyframes fit into places where they surely do not lie?

New ground is seldom like nothing that is known: corridors look like corridors. A corridor fits into every other one,
far better than into unknown space, and that must not speak for a loop. So new ground is taken for a mixture: with some
probability it looks like any of the building's other places, seen from where the robot drives there; else it is like
unknown space. What is to speak for a known area has to fit better than that (as the average place of Cummins and
Newman 2008, but measured on this building).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.area_grid import AreaGrid
from hmt_slam_ros.topology.area_matching import MatchSettings, match

# Where a robot would be that drives where another drove before, or the other way: 0.5 m along, 0.3 m across, 4 degrees.
_ALIKE = np.diag([0.5, 0.3, math.radians(4.0)]) ** 2
_HEADINGS = (np.zeros(3), np.array([0.0, 0.0, math.pi]))
# Squared Mahalanobis distance up to which is searched: 90 % of 3 degrees of freedom.
_GATE = 6.25


class Elsewhere(NamedTuple):
    """A place in which the keyframes do not lie: its map, and ``map_T_base`` of a robot there, shape (3,)."""

    grid: AreaGrid
    pose: NDArray[np.float64]


def log_chance(query: AreaGrid, elsewhere: Sequence[Elsewhere], alike: float, settings: MatchSettings) -> float:
    """log p(z | new ground) / p(z | unknown space), nats.

    :param query: map of the keyframes, in the frame of the first of them.
    :param alike: probability that new ground looks like one of these places.
    """
    near = replace(settings, gate=_GATE)
    found = [
        match(query, place.grid, PoseGaussian(place.pose + heading, _ALIKE), near).log_evidence
        for place in elsewhere
        for heading in _HEADINGS
    ]
    if not found:
        return 0.0
    likeness = float(np.logaddexp.reduce(found)) - math.log(len(found))
    return float(np.logaddexp(math.log1p(-alike), math.log(alike) + likeness))
