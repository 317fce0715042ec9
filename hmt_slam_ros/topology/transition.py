"""The transition model P(gamma_t | d) of Eq. (6): how probable is it, by the arcs alone, to be in a known area?

A keyframe lies in the *place* of the area whose keyframe is the nearest to it, among those near enough and in sight,
so that a parallel corridor behind a wall is another place. The robot entered an area where most of the keyframes in
question lie in its place. Under the belief of the arcs that is a probability pi(gamma); places exclude each other, so
the pi sum to 1 at most, and what is left is the probability of new ground: the paper's constant n is no constant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.area_grid import AreaGrid

_DRAWS = 512
# Log-ratio above which a cell bars the view, and the share of a line of sight that has to be known as free.
_BARRIER = 0.5
_SEEN = 0.5
_NOWHERE = -1


@dataclass(frozen=True, eq=False)
class Place:
    """An area's keyframes among those of its surroundings.

    :ivar area: the area.
    :ivar owners: shape (k,), int64, the area of every keyframe of the area and its surroundings.
    :ivar positions: shape (k, 2), where they were taken, m, area frame.
    :ivar grid: what these keyframes saw, area frame.
    """

    area: int
    owners: NDArray[np.int64]
    positions: NDArray[np.float64]
    grid: AreaGrid


class Transition(NamedTuple):
    """P(gamma | d): ``known`` {area: pi} and ``new``; the sum is 1."""

    known: dict[int, float]
    new: float


def transition(shares: Mapping[int, float], new_floor: float) -> Transition:
    """The transition model from the probability of every place by itself.

    Those were computed one by one, and may add up to more than 1 where beliefs over areas side by side disagree. New
    ground keeps at least ``new_floor``, as belief and place are models: arcs can be worse than they say, and a cupboard
    in a known room is near its keyframes.
    """
    total = sum(shares.values())
    new = max(1.0 - total, new_floor)
    scale = (1.0 - new) / total if total > 0.0 else 0.0
    return Transition({area: scale * share for area, share in shares.items()}, new if total > 0.0 else 1.0)


def owner_at(place: Place, poses: NDArray[np.float64], radius: float) -> int | None:
    """The area in whose place most of the keyframes lie, or None where most lie in no place.

    :param poses: shape (m, 3), ``area_T_base`` of the keyframes in the place's frame.
    :param radius: farthest distance to a keyframe of the place, m.
    """
    owner = int(_owners(place, poses[None, :, :2], radius)[0])
    return None if owner == _NOWHERE else owner


class Entry(NamedTuple):
    """How the keyframes come to lie in an area's place, by the arcs.

    :ivar share: pi(gamma), the probability that they do, exactly 0 where no draw says so.
    :ivar typical: squared Mahalanobis distance from the belief's mean of half of the poses in which they do.
    """

    share: float
    typical: float


def entry(place: Place, belief: PoseGaussian, poses: NDArray[np.float64], radius: float) -> Entry:
    """The probability of a place, and what poses it is made of.

    :param belief: over ``area_T_reference``.
    :param poses: shape (m, 3), ``reference_T_base`` of the keyframes.
    :param radius: farthest distance to a keyframe of the place, m.
    """
    inside = _owners(place, _drawn_positions(belief, poses), radius) == place.area
    distances = np.sum(_normal_points()[inside] ** 2, axis=1)
    return Entry(float(np.mean(inside)), float(np.median(distances)) if inside.any() else 0.0)


def entry_bound(known: NDArray[np.float64], belief: PoseGaussian, poses: NDArray[np.float64], radius: float) -> float:
    """No less than the share of :func:`entry`, whatever is around the area, from its keyframes' positions (k, 2) alone.

    One of the keyframes in question at least has to be near to one of the area's.
    """
    return float(np.mean(_any_near(_drawn_positions(belief, poses), known, radius)))


def _drawn_positions(belief: PoseGaussian, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions of keyframes (m, 3) under draws from the belief over their reference, shape (draws, m, 2)."""
    return _placed(_normal_points(), belief.mean, np.linalg.cholesky(belief.covariance), poses)


@njit(cache=True)
def _placed(
    normal: NDArray[np.float64], mean: NDArray[np.float64], root: NDArray[np.float64], poses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Positions of the poses (m, 3) that are carried by ``mean exp(root normal)``, for each of n points (n, 3)."""
    positions = np.empty((normal.shape[0], poses.shape[0], 2))
    cos, sin = np.cos(mean[2]), np.sin(mean[2])
    for n in range(normal.shape[0]):
        a, b, c = normal[n]
        turn = root[2, 0] * a + root[2, 1] * b + root[2, 2] * c
        x, y = se2.exp_shift(root[0, 0] * a, root[1, 0] * a + root[1, 1] * b, turn)
        along, across = np.cos(mean[2] + turn), np.sin(mean[2] + turn)
        for k in range(poses.shape[0]):
            positions[n, k, 0] = mean[0] + cos * x - sin * y + along * poses[k, 0] - across * poses[k, 1]
            positions[n, k, 1] = mean[1] + sin * x + cos * y + across * poses[k, 0] + along * poses[k, 1]
    return positions


@njit(cache=True)
def _any_near(positions: NDArray[np.float64], known: NDArray[np.float64], radius: float) -> NDArray[np.bool_]:
    """Which of n draws of m positions (n, m, 2) have one within ``radius`` of one of (k, 2), shape (n,)."""
    near = np.zeros(positions.shape[0], np.bool_)
    for n in range(positions.shape[0]):
        for m in range(positions.shape[1]):
            for k in range(known.shape[0]):
                dx, dy = positions[n, m, 0] - known[k, 0], positions[n, m, 1] - known[k, 1]
                if dx * dx + dy * dy <= radius * radius:
                    near[n] = True
                    break
            if near[n]:
                break
    return near


@cache
def _normal_points() -> NDArray[np.float64]:
    """Points of a low-discrepancy sequence made normal, shape (draws, 3), the first one 0; the same at every call.

    They are the multiples of powers of the number g with g^4 = g + 1, which generalises the golden ratio.
    """
    g = 1.2207440846057596
    steps = np.arange(_DRAWS)[:, None] / g ** np.arange(1, 4)
    return np.asarray(ndtri((0.5 + steps) % 1.0), dtype=np.float64)


def _owners(place: Place, positions: NDArray[np.float64], radius: float) -> NDArray[np.int64]:
    """The area that most of the m positions (n, m, 2) belong to, shape (n,); of equals the smallest."""
    count, size = positions.shape[:2]
    nearest = _nearest_in_sight(
        positions.reshape(-1, 2),
        place.positions,
        radius,
        place.grid.log_ratio,
        place.grid.free,
        place.grid.origin,
        place.grid.cell,
    )
    owners = np.where(nearest < 0, _NOWHERE, place.owners[nearest]).reshape(count, size)
    areas = np.unique(place.owners)
    votes = np.sum(owners[:, :, None] == areas, axis=1)
    outside = 2 * votes.sum(axis=1) < size
    return np.where(outside, _NOWHERE, areas[votes.argmax(axis=1)])


@njit(cache=True)
def _nearest_in_sight(
    positions: NDArray[np.float64],
    keyframes: NDArray[np.float64],
    radius: float,
    log_ratio: NDArray[np.float32],
    free: NDArray[np.bool_],
    origin: NDArray[np.float64],
    cell: float,
) -> NDArray[np.int64]:
    """Index of the nearest keyframe within ``radius`` that can be seen from every position, or -1."""
    found = np.full(positions.shape[0], -1)
    distance2 = np.empty(keyframes.shape[0])
    for n in range(positions.shape[0]):
        for k in range(keyframes.shape[0]):
            distance2[k] = (keyframes[k, 0] - positions[n, 0]) ** 2 + (keyframes[k, 1] - positions[n, 1]) ** 2
        while found[n] < 0:
            nearest = distance2.argmin()
            if distance2[nearest] > radius * radius:
                break
            if _in_sight(positions[n], keyframes[nearest], log_ratio, free, origin, cell):
                found[n] = nearest
            distance2[nearest] = np.inf
    return found


@njit(cache=True)
def _in_sight(
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    log_ratio: NDArray[np.float32],
    free: NDArray[np.bool_],
    origin: NDArray[np.float64],
    cell: float,
) -> bool:
    """Whether no known surface lies between two points and most of the way is known to be free."""
    rows, columns = free.shape
    steps = int(np.ceil(np.hypot(end[0] - start[0], end[1] - start[1]) / (0.5 * cell))) + 1
    seen = 0
    for s in range(steps):
        share = s / steps
        c = int(np.floor((start[0] + share * (end[0] - start[0]) - origin[0]) / cell))
        r = int(np.floor((start[1] + share * (end[1] - start[1]) - origin[1]) / cell))
        if not (0 <= c < columns and 0 <= r < rows):
            continue
        if log_ratio[r, c] > _BARRIER:
            return False
        seen += free[r, c]
    return seen >= _SEEN * steps
