"""The way through way-points: straight lines, arcs of constant curvature that round the corners, turns on the spot."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2

_SHARPEST = math.radians(120.0)  # beyond it the robot stops and turns on the spot
_NOTHING = 1e-9


class Path(NamedTuple):
    """Stretches of constant curvature, one after the other.

    :ivar starts: shape (n, 3), ``world_T_base`` where each begins, m and rad.
    :ivar lengths: shape (n,), m; 0 for a turn on the spot.
    :ivar turns: shape (n,), rad, positive to the left.
    """

    starts: NDArray[np.float64]
    lengths: NDArray[np.float64]
    turns: NDArray[np.float64]

    @property
    def on_the_spot(self) -> NDArray[np.bool_]:
        """Stretches on which the robot only turns, shape (n,)."""
        return self.lengths == 0.0

    @property
    def sizes(self) -> NDArray[np.float64]:
        """How far to go on each stretch, shape (n,): m, or rad on the spot."""
        return np.where(self.on_the_spot, np.abs(self.turns), self.lengths)

    def pose(self, stretch: NDArray[np.intp], gone: NDArray[np.float64]) -> NDArray[np.float64]:
        """``world_T_base`` (k, 3) after going a part of a stretch, in the unit of `sizes`; both of shape (k,)."""
        share = gone / self.sizes[stretch]
        twists = np.stack((self.lengths[stretch], np.zeros(stretch.size), self.turns[stretch]), axis=1)
        return se2.compose(self.starts[stretch], se2.exp(share[:, None] * twists))


def path_through(points: NDArray[np.float64], rounding: float) -> Path:
    """The way through way-points.

    :param points: shape (k, 2), m.
    :param rounding: radius of the arcs at corners, m; smaller where a leg is too short for it.
    :raises HmtSlamError: where all way-points are one.
    """
    legs = np.diff(points, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    apart = lengths > _NOTHING
    if not apart.any():
        raise HmtSlamError("the route has no two different way-points: give at least two.")
    lengths, headings = lengths[apart], np.arctan2(legs[apart, 1], legs[apart, 0])
    turns = se2.wrap(np.diff(headings))
    cuts = _cuts(lengths, turns, rounding)
    stretches: list[tuple[float, float]] = []
    for k, length in enumerate(lengths.tolist()):
        before, after = (cuts[k - 1] if k else 0.0), (cuts[k] if k < turns.size else 0.0)
        stretches.append((length - before - after, 0.0))
        if k < turns.size and abs(turns[k]) > _NOTHING:
            radius = after / math.tan(0.5 * abs(turns[k])) if after else 0.0
            stretches.append((radius * abs(turns[k]), turns[k]))
    return _joined(np.array([*points[0], headings[0]]), [part for part in stretches if max(map(abs, part)) > _NOTHING])


def _cuts(lengths: NDArray[np.float64], turns: NDArray[np.float64], rounding: float) -> NDArray[np.float64]:
    """How far before and behind each corner its arc begins and ends, m; 0 for a turn on the spot."""
    room = 0.5 * np.minimum(lengths[:-1], lengths[1:])
    sharp = np.abs(turns) > _SHARPEST
    half = 0.5 * np.where(sharp, 0.0, np.abs(turns))
    return np.where(sharp, 0.0, np.minimum(rounding * np.tan(half), room))


def _joined(start: NDArray[np.float64], stretches: list[tuple[float, float]]) -> Path:
    starts = [start]
    for length, turn in stretches:
        starts.append(se2.compose(starts[-1], se2.exp(np.array([length, 0.0, turn]))))
    lengths, turns = np.array(stretches).T
    return Path(np.array(starts[:-1]), lengths, turns)
