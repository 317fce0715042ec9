"""Joint refinement of many scans: all overlapping pairs are registered at once, and the poses solved for together.

Where a way comes near no other, those of other ways that share most walls with it, however few.

Iterates between two steps: every overlapping pair of scans is linearized at the present poses (point-to-line, so that
a pair in a bare corridor says nothing about the direction along it), which makes it an edge of a pose graph; the graph,
with the edges of the motion, is solved (Lu and Milios 1997).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges, optimize, relative_covariances
from hmt_slam_ros.hybrid_map.shortest_path import connected_neighbors, shortest_path_beliefs
from hmt_slam_ros.registration.scan_to_scan import ScanSurfaces, normal_equations, weighting_from_options

# Keyframes farther apart in number than this were taken on two ways.
_SAME_TRAVERSAL = 20
# Where ways keep apart: so many keyframes of other ways, within so many times the reach, that share at least so much of
# their points; one out of so many points tells who they are.
_DISTANT_PAIRS, _DISTANT_REACH_FACTOR, _DISTANT_MIN_SHARE, _DISTANT_STRIDE = 5, 5.0, 0.03, 4


class ScanPairs(NamedTuple):
    """Scans that may overlap.

    :ivar rows: shape (m, 2), each pair once, ascending.
    :ivar min_share: shape (m,), the share of the points of the first that has to meet the second for the two to be
        registered with each other.
    """

    rows: Int64
    min_share: Float64


def linked_areas(hybrid_map: HybridMap) -> dict[int, frozenset[int]]:
    """Every area with itself and the areas up to two arcs away: what lies near otherwise does so by chance."""
    one = {area: {area, *connected_neighbors(hybrid_map, area)} for area in hybrid_map.area_ids()}
    return {area: frozenset().union(*(one[next_one] for next_one in near)) for area, near in one.items()}


def nearest_keyframes(
    poses: NDArray[np.float64],
    areas: NDArray[np.int64],
    query_poses: NDArray[np.float64],
    query_areas: NDArray[np.int64],
    linked: Mapping[int, Collection[int]],
    reach: float,
    count: int,
) -> list[NDArray[np.int64]]:
    """The nearest keyframes around given poses, in place and heading, in areas that the topology links.

    :param poses: shape (n, 3), of the keyframes; ``areas`` (n,) theirs.
    :param query_poses: shape (m, 3); ``query_areas`` (m,) theirs.
    :param linked: {area: areas whose keyframes may lie in the same place}; what is near by chance only is not matched.
    :param reach: largest distance, m.
    :param count: keyframes at most.
    :returns: m arrays of rows of ``poses``, nearest first; a radian counts as a meter.
    """
    known = np.unique(np.concatenate((areas, query_areas)))
    allowed = np.array([[other in linked[area] for other in known.tolist()] for area in known.tolist()])
    rows = _nearest_rows(
        poses, np.searchsorted(known, areas), query_poses, np.searchsorted(known, query_areas), allowed, reach, count
    )
    return [own[own >= 0] for own in rows]


def certain_areas(hybrid_map: HybridMap, deviation: float) -> dict[int, frozenset[int]]:
    """Every area with those that lie where they are thought to be, to a deviation in m, as seen from either of both."""
    areas = hybrid_map.area_ids()
    seen = {area: shortest_path_beliefs(hybrid_map, area, cost_limit=deviation**2).keys() for area in areas}
    return {area: frozenset(other for other in areas if other in seen[area] or area in seen[other]) for area in areas}


def add_distant_pairs(
    pairs: ScanPairs,
    surfaces: ScanSurfaces,
    poses: NDArray[np.float64],
    areas: NDArray[np.int64],
    certain: Mapping[int, Collection[int]],
    options: RefinementParameters,
) -> ScanPairs:
    """The pairs of keyframes; of those that no other way comes near, also those with other ways that share most walls.

    In a hall, two ways that keep apart see the same walls, and only these hold the one where the other is.

    :param pairs: of keyframes that are near each other.
    :param surfaces: of the keyframes.
    :param poses: shape (n, 3), of the keyframes in the order in which they were taken; ``areas`` (n,) theirs.
    :param certain: {area: areas that lie where they are thought to be, so that the same walls meet}.
    """
    met = np.abs(np.diff(pairs.rows, axis=1)[:, 0]) > _SAME_TRAVERSAL
    alone = np.setdiff1d(np.arange(len(poses)), pairs.rows[met])
    far = [(i, k) for i in alone.tolist() for k in _most_overlapping(i, surfaces, poses, areas, certain, options)]
    rows = np.unique(np.sort(np.array(far, dtype=np.int64).reshape(-1, 2), axis=1), axis=0)
    return ScanPairs(
        np.concatenate((pairs.rows, rows)), np.concatenate((pairs.min_share, np.full(len(rows), _DISTANT_MIN_SHARE)))
    )


def _most_overlapping(
    row: int,
    surfaces: ScanSurfaces,
    poses: NDArray[np.float64],
    areas: NDArray[np.int64],
    certain: Mapping[int, Collection[int]],
    options: RefinementParameters,
) -> list[int]:
    """The keyframes of other ways that share most walls with one, most first."""
    numbers = np.arange(len(poses))
    within = np.hypot(*(poses[:, :2] - poses[row, :2]).T) <= _DISTANT_REACH_FACTOR * options.reach
    held = np.isin(areas, sorted(certain[int(areas[row])]))
    others = np.flatnonzero((np.abs(numbers - row) > _SAME_TRAVERSAL) & within & held)
    one = np.full(len(others), row)
    other_T_one = se2.between(poses[others], poses[one])
    share = normal_equations(
        surfaces,
        one,
        surfaces,
        others,
        other_T_one,
        options.first_gate,
        weighting_from_options(options),
        _DISTANT_STRIDE,
    )[2]
    most = np.argsort(-share, kind="stable")[:_DISTANT_PAIRS]
    found: list[int] = others[most[share[most] >= _DISTANT_MIN_SHARE]].tolist()
    return found


@njit(cache=True)
def _nearest_rows(
    poses: Float64, areas: Int64, seen_from: Float64, seen_from_areas: Int64, allowed: Bool, reach: float, count: int
) -> Int64:
    """:func:`nearest_keyframes` as an array (m, count), filled up with -1; ``allowed[a, b]`` where b is linked with
    a."""
    rows, costs = np.full((len(seen_from), count), -1), np.empty(count)
    for i in range(len(seen_from)):
        held = 0
        for k in range(len(poses)):
            dx, dy = poses[k, 0] - seen_from[i, 0], poses[k, 1] - seen_from[i, 1]
            squared = dx * dx + dy * dy
            if squared > reach * reach or not allowed[seen_from_areas[i], areas[k]]:
                continue
            turn = poses[k, 2] - seen_from[i, 2]
            cost = np.sqrt(squared) + abs(turn - 2.0 * np.pi * np.floor(turn / (2.0 * np.pi) + 0.5))
            if held == count and cost >= costs[count - 1]:
                continue
            held = min(held + 1, count)
            at = held - 1
            while at > 0 and costs[at - 1] > cost:
                costs[at], rows[i, at] = costs[at - 1], rows[i, at - 1]
                at -= 1
            costs[at], rows[i, at] = cost, k
    return rows


def scan_pairs(around: list[NDArray[np.int64]], least_share: float) -> ScanPairs:
    """Every pair of different rows; of row i with each of ``around[i]``."""
    pairs = {(min(i, j), max(i, j)) for i, rows in enumerate(around) for j in rows.tolist() if i != j}
    return ScanPairs(np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2), np.full(len(pairs), least_share))


# The graph changes with the next linearization: it need not be solved to the last digit.
_TOLERANCE = 1e-3
# Before the last linearization one out of so many points serves.
_EARLY_STRIDE = 2
# Keeps the information of a pair regular: 3 m and 3 rad.
_PRIOR_INFORMATION = 0.1 * np.eye(3)
# The same where it is to say nothing, whatever the number of pairs: 1 km.
_NEGLIGIBLE_INFORMATION = 1e-6 * np.eye(3)
# A turn counts like the meters by which it moves a point 3 m away. Along a direction a pair tells something where its
# information is at least this share of the largest: normals are off by some hundredths.
_SCALE, _MIN_INFORMATION_SHARE = np.array([1.0, 1.0, 1.0 / 3.0]), 0.004


def refine_jointly(
    surfaces: ScanSurfaces,
    poses: NDArray[np.float64],
    pairs: ScanPairs,
    motion_edges: Edges,
    options: RefinementParameters,
    fixed: int = 0,
) -> NDArray[np.float64]:
    """The poses that agree best with all registrations and the motion between them.

    :param surfaces: of n scans.
    :param poses: shape (n, 3), ``map_T_base`` to start from.
    :param pairs: scans that may overlap.
    :param motion_edges: edges of the motion, which join all scans; they hold the directions that walls leave open.
    :param fixed: the scan that stays.
    :returns: shape (n, 3).
    """
    gates = np.geomspace(options.first_gate, options.last_gate, options.iterations)
    for k, gate in enumerate(gates.tolist(), start=1):
        every = _EARLY_STRIDE if k < len(gates) else 1
        edges = _concatenate_edges(motion_edges, _register_pairs(surfaces, poses, pairs, gate, every, options))
        poses = optimize(poses, edges, fixed, marginals=False, tolerance=_TOLERANCE).poses
    return poses


def relative_beliefs(
    surfaces: ScanSurfaces,
    poses: NDArray[np.float64],
    pairs: ScanPairs,
    motion_edges: Edges,
    options: RefinementParameters,
    between: NDArray[np.int64],
) -> list[PoseGaussian]:
    """How certain refined poses are relative to each other.

    Overlapping pairs see the same walls and are not independent, so only a share of their information counts. And noise
    of the normals has each pair tell a little of every direction, which adds up: what is so little does not count.

    :param poses: shape (n, 3), that registrations and motion agree on.
    :param motion_edges: edges of the motion, all as uncertain as they are.
    :param between: shape (k, 2), scans i and j.
    :returns: beliefs over ``i_T_j``.
    """
    registered = _register_pairs(surfaces, poses, pairs, options.last_gate, 1, options)
    information = options.certainty * _drop_weak_directions(_invert(registered.covariances)) + _NEGLIGIBLE_INFORMATION
    edges = _concatenate_edges(motion_edges, replace(registered, covariances=_invert(information)))
    means = se2.between(poses[between[:, 0]], poses[between[:, 1]])
    return list(map(PoseGaussian, means, relative_covariances(poses, edges, between)))


def _invert(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.inv(matrices).astype(np.float64, copy=False)


def _drop_weak_directions(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Information (m, 3, 3) without the directions of which there is next to none."""
    scale = np.outer(_SCALE, _SCALE)
    values, vectors = np.linalg.eigh(information * scale)
    kept = np.where(values > _MIN_INFORMATION_SHARE * values[:, -1:], values, 0.0)
    found: NDArray[np.float64] = np.einsum("mij,mj,mkj->mik", vectors, kept, vectors) / scale
    return found


def _register_pairs(
    surfaces: ScanSurfaces,
    poses: NDArray[np.float64],
    pairs: ScanPairs,
    gate: float,
    stride: int,
    options: RefinementParameters,
) -> Edges:
    """One Gauss-Newton step of every pair on its own, as edges from the second scan to the first."""
    one, other = pairs.rows.T
    relative = se2.between(poses[other], poses[one])
    information, gradient, share = normal_equations(
        surfaces, one, surfaces, other, relative, gate, weighting_from_options(options), stride
    )
    meets = share >= pairs.min_share
    information = information[meets] + _PRIOR_INFORMATION
    step = -np.linalg.solve(information, gradient[meets, :, None])[..., 0]
    return Edges(
        other[meets],
        one[meets],
        se2.compose(relative[meets], se2.exp(step)),
        np.linalg.inv(information),
    )


def _concatenate_edges(motion: Edges, registered: Edges) -> Edges:
    return Edges(
        np.concatenate((motion.sources, registered.sources)),
        np.concatenate((motion.targets, registered.targets)),
        np.concatenate((motion.poses, registered.poses)),
        np.concatenate((motion.covariances, registered.covariances)),
    )
