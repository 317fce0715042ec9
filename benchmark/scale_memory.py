"""What does a stored area take?"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from benchmark.lattice import PER_AREA, Lattice, scan_at
from hmt_slam_ros.sensors import Scan

BEAMS = 181
"""Of the scans that are weighed."""

_AREAS_OF_SCANS = 100

Made = TypeVar("Made")


class Stored(NamedTuple):
    """Memory of a stored area, kB.

    :ivar graph: poses of its keyframes and its arcs.
    :ivar scans: the scans of its keyframes, as received.
    :ivar points: their end points, where something asked for them.
    """

    graph: float
    scans: float
    points: float

    @property
    def whole(self) -> float:
        """What cannot be built anew from the rest, kB."""
        return self.graph + self.scans


def stored(lattice: Lattice) -> Stored:
    """Weigh the areas of a lattice, each with its own scans."""
    graph = _weight(lattice.hybrid_map)[0] / lattice.areas
    _own(0)
    scans, kept = _weight(lambda: [_own(keyframe) for keyframe in range(_AREAS_OF_SCANS * PER_AREA)])
    points, _ = _weight(lambda: [scan.points for scan in kept])
    return Stored(graph, scans / _AREAS_OF_SCANS, points / _AREAS_OF_SCANS)


def _own(keyframe: int) -> Scan:
    return scan_at(np.zeros(3), keyframe, keyframe, BEAMS)


def _weight(make: Callable[[], Made]) -> tuple[float, Made]:
    """What something takes, kB, and the thing itself."""
    tracemalloc.start()
    try:
        made = make()
        return tracemalloc.get_traced_memory()[0] / 1e3, made
    finally:
        tracemalloc.stop()
