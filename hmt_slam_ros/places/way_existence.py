"""Whether a way of the chart is still there: what keyframes see of it, one after the other.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: what is expected and not seen loses existence, Eqs. (4) and (5),
and is deleted below a minimum; so are ways between nodes here, as `features.existence` has it for landmarks. A way was
driven along, so that it was there. A keyframe in its middle that sees along it sees each piece of it free, which is a
sight of that piece, or sees up to what stands in it, which is a miss of the piece where that stands, and tells nothing
of those behind. A way is there as surely as the piece of it that is doubted most.
"""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Float64, Int8
from hmt_slam_ros.configuration.features import Features
from hmt_slam_ros.features.existence import Existence
from hmt_slam_ros.places.floor import DIRECTIONS, Floor
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import opposite
from hmt_slam_ros.places.wall_landmarks import Stretch

# Length of a piece, how far a keyframe tells of a way, and how far from its middle it is at most, m. Sectors are 5
# degrees wide, so that farther on the beams along the middle of a narrow hallway may meet its walls.
_PIECE, _REACH, _MIDDLE = 0.5, 5.0, 0.5

_UNSEEN, _FREE, _BLOCKED = range(3)


def existence_of(floor: Floor, way: Stretch, features: Features) -> float:
    """Probability that a way that was driven along is still there.

    :param floor: with the keyframes around, the way being in its frame.
    """
    pieces = max(1, round((way.end - way.begin) / _PIECE))
    order = np.argsort(floor.keyframes, kind="stable")
    ahead = _seen(floor, way, pieces)[order]
    start = way.at + (way.begin + way.end) * DIRECTIONS[way.direction]
    back = _seen(floor, way._replace(at=start, direction=opposite(way.direction)), pieces)[order, ::-1]
    doubted = np.any((ahead == _BLOCKED) | (back == _BLOCKED), axis=0)
    return min((_of_piece(np.maximum(ahead, back)[:, k], features) for k in np.flatnonzero(doubted)), default=1.0)


def _seen(floor: Floor, way: Stretch, pieces: int) -> Int8:
    """What each keyframe sees of each piece of a way, looking along it in its direction, shape (n, pieces)."""
    away = floor.places - way.at
    along = away @ DIRECTIONS[way.direction] - way.begin
    beside = away @ DIRECTIONS[(way.direction + 1) % QUARTERS]
    clear = floor.clear[:, way.direction]
    ends = along + np.minimum(clear, _REACH)
    edges: Float64 = np.linspace(0.0, way.end - way.begin, pieces + 1)
    first, last = edges[None, :-1], edges[None, 1:]
    ahead = (np.abs(beside) <= _MIDDLE)[:, None] & (last > along[:, None])
    free = ahead & (last <= ends[:, None])
    blocked = ahead & (clear < _REACH)[:, None] & (first <= ends[:, None]) & (ends[:, None] < last)
    return np.where(blocked, _BLOCKED, np.where(free, _FREE, _UNSEEN)).astype(np.int8)


def _of_piece(seen: Int8, features: Features) -> float:
    """Probability that a piece is there by what keyframes saw of it, in their order, shape (n,)."""
    existence = Existence(1.0)
    for one in seen[seen != _UNSEEN].tolist():
        existence = existence.after_miss(features) if one == _BLOCKED else existence.after_sight(1.0, features)
    return existence.probability
