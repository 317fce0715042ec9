"""Joint refinement: all overlapping pairs of scans are registered, and their poses solved for together.

Two steps alternate. Every overlapping pair of scans is linearized at the present poses, which makes it an edge of a
pose graph. This is point-to-line, so that a pair in a bare corridor determines nothing along it. Then the graph is
solved, with the edges of the motion (Lu and Milios 1997).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, propagate_covariance
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges, edge_chi2, optimize, relative_covariances
from hmt_slam_ros.hybrid_map.shortest_path import connected_neighbors, shortest_path_beliefs
from hmt_slam_ros.registration.scan_to_scan import (
    ScanSurfaces,
    normal_equations,
    weighting_from_options,
)

_SAME_PASS = 20
"""Keyframes farther apart in number than this are of different passes."""

_DISTANT_PAIRS = 5
"""Most keyframes of distant passes that are paired with one."""

_DISTANT_REACH_FACTOR = 5.0
"""Their largest distance, relative to the reach of near pairs."""

_DISTANT_MIN_SHARE = 0.03
"""Smallest share of points that they have in common."""

_DISTANT_STRIDE = 4
"""One of so many points is compared to find them."""

_TOLERANCE = 1e-3
"""Relative gain at which a solution is good enough, as the next linearization changes the graph."""

_EARLY_STRIDE = 2
"""One of so many points counts before the last linearization."""

_NEGLIGIBLE_INFORMATION = 1e-6 * np.eye(3)
"""Makes the information of a pair regular, and does not count whatever the number of pairs: 1 km."""

_SCALE = np.array([1.0, 1.0, 1.0 / 3.0])
"""Makes turns comparable with meters: a turn counts as it moves a point 3 m away."""

_MIN_INFORMATION_SHARE = 0.004
"""Smallest information along a direction relative to the largest: normals are off by some hundredths."""

_MIN_POSITION_SHARE = 0.03
"""The same among positions alone: of pairs of scans of bare walls, 181 beams with 3 cm of noise, 95 % have less.

From docs/decisions/0072-open-directions.md.
"""

_GATE = chi_square_gate(0.999)
"""Squared Mahalanobis distance up to which a registration is what the arcs admit, and a motion what odometry does."""


class ScanPairs(NamedTuple):
    """Scans that may overlap.

    :ivar rows: shape (m, 2), each pair once, ascending.
    :ivar min_share: shape (m,), smallest share of the points of the first near the second for a registration.
    """

    rows: Int64
    min_share: Float64


class PairLimits(NamedTuple):
    """What registrations of pairs have to comply with.

    :ivar relative: shape (m, 3), pose of the first scan in the second before the refinement.
    :ivar information: shape (m, 3, 3), of these poses by the arcs, zero where they limit nothing.
    """

    relative: Float64
    information: Float64


def linked_areas(hybrid_map: HybridMap) -> dict[int, frozenset[int]]:
    """{area: itself and the areas up to two arcs away}; others are near by chance."""
    linked = {area: {area, *connected_neighbors(hybrid_map, area)} for area in hybrid_map.area_ids()}
    return {area: frozenset().union(*(linked[other] for other in near)) for area, near in linked.items()}


def nearest_keyframes(
    poses: Float64,
    areas: Int64,
    query_poses: Float64,
    query_areas: Int64,
    linked: Mapping[int, Collection[int]],
    reach: float,
    count: int,
) -> list[Int64]:
    """The nearest keyframes around given poses, in position and heading, in linked areas.

    :param poses: shape (n, 3), of the keyframes; ``areas`` (n,) theirs.
    :param query_poses: shape (m, 3); ``query_areas`` (m,) theirs.
    :param linked: {area: areas whose keyframes are compared}; others are near by chance.
    :param reach: largest distance, m.
    :param count: most keyframes.
    :returns: m arrays of rows of ``poses``, nearest first; a radian counts as a meter.
    """
    known = np.unique(np.concatenate((areas, query_areas)))
    allowed = np.array([[other in linked[area] for other in known.tolist()] for area in known.tolist()])
    area_rows, query_rows = np.searchsorted(known, areas), np.searchsorted(known, query_areas)
    nearest = _nearest_rows(poses, area_rows, query_poses, query_rows, allowed, reach, count)
    return [rows[rows >= 0] for rows in nearest]


def certain_areas(hybrid_map: HybridMap, deviation: float) -> dict[int, frozenset[int]]:
    """{area: areas whose position relative to it is certain to a deviation in m, seen from either of both}."""
    areas = hybrid_map.area_ids()
    near = {area: shortest_path_beliefs(hybrid_map, area, cost_limit=deviation**2).keys() for area in areas}
    return {area: frozenset(other for other in areas if other in near[area] or area in near[other]) for area in areas}


def add_distant_pairs(
    pairs: ScanPairs,
    surfaces: ScanSurfaces,
    poses: Float64,
    areas: Int64,
    certain: Mapping[int, Collection[int]],
    options: RefinementParameters,
) -> ScanPairs:
    """The pairs, and for keyframes far from all other passes those with the most overlapping keyframes of these.

    In a hall, two passes that keep apart see the same walls, and only these connect them.

    :param pairs: of keyframes that are near each other.
    :param surfaces: of the keyframes.
    :param poses: shape (n, 3), of the keyframes in the order of time; ``areas`` (n,) theirs.
    :param certain: {area: areas of certain relative position}.
    """
    is_of_two_passes = np.abs(np.diff(pairs.rows, axis=1)[:, 0]) > _SAME_PASS
    alone = np.setdiff1d(np.arange(len(poses)), pairs.rows[is_of_two_passes])
    distant = [(i, k) for i in alone.tolist() for k in _most_overlapping(i, surfaces, poses, areas, certain, options)]
    rows = np.unique(np.sort(np.array(distant, dtype=np.int64).reshape(-1, 2), axis=1), axis=0)
    min_share = np.full(len(rows), _DISTANT_MIN_SHARE)
    return ScanPairs(np.concatenate((pairs.rows, rows)), np.concatenate((pairs.min_share, min_share)))


def _most_overlapping(
    row: int,
    surfaces: ScanSurfaces,
    poses: Float64,
    areas: Int64,
    certain: Mapping[int, Collection[int]],
    options: RefinementParameters,
) -> list[int]:
    """The keyframes of other passes that share the most walls with one, most first."""
    is_near = np.hypot(*(poses[:, :2] - poses[row, :2]).T) <= _DISTANT_REACH_FACTOR * options.reach
    is_certain = np.isin(areas, sorted(certain[int(areas[row])]))
    is_other_pass = np.abs(np.arange(len(poses)) - row) > _SAME_PASS
    others = np.flatnonzero(is_other_pass & is_near & is_certain)
    rows = np.full(len(others), row)
    other_T_row = se2.between(poses[others], poses[rows])
    weighting = weighting_from_options(options)
    shares = normal_equations(
        surfaces, rows, surfaces, others, other_T_row, options.first_gate, weighting, _DISTANT_STRIDE
    )[2]
    most = np.argsort(-shares, kind="stable")[:_DISTANT_PAIRS]
    overlapping: list[int] = others[most[shares[most] >= _DISTANT_MIN_SHARE]].tolist()
    return overlapping


@njit(cache=True)
def _nearest_rows(
    poses: Float64, areas: Int64, query_poses: Float64, query_areas: Int64, allowed: Bool, reach: float, count: int
) -> Int64:
    """:func:`nearest_keyframes` as an array (m, count), filled up with -1; ``allowed[a, b]``: b is linked with a."""
    rows, costs = np.full((len(query_poses), count), -1), np.empty(count)
    for i in range(len(query_poses)):
        held = 0
        for k in range(len(poses)):
            dx, dy = poses[k, 0] - query_poses[i, 0], poses[k, 1] - query_poses[i, 1]
            squared = dx * dx + dy * dy
            if squared > reach * reach or not allowed[query_areas[i], areas[k]]:
                continue
            cost = np.sqrt(squared) + abs(se2.wrap_by_turns(poses[k, 2] - query_poses[i, 2]))
            if held == count and cost >= costs[count - 1]:
                continue
            held = min(held + 1, count)
            at = held - 1
            while at > 0 and costs[at - 1] > cost:
                costs[at], rows[i, at] = costs[at - 1], rows[i, at - 1]
                at -= 1
            costs[at], rows[i, at] = cost, k
    return rows


def scan_pairs(around: list[Int64], min_share: float) -> ScanPairs:
    """Every pair of different rows; of row i with each of ``around[i]``."""
    pairs = {(min(i, j), max(i, j)) for i, rows in enumerate(around) for j in rows.tolist() if i != j}
    return ScanPairs(np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2), np.full(len(pairs), min_share))


def refine_jointly(
    surfaces: ScanSurfaces,
    poses: Float64,
    pairs: ScanPairs,
    motion_edges: Edges,
    options: RefinementParameters,
    fixed: int = 0,
    limits: PairLimits | None = None,
    odometry: Edges | None = None,
) -> Float64:
    """The poses that agree best with all registrations and the motion between them.

    :param surfaces: of n scans.
    :param poses: shape (n, 3), ``map_T_base`` to start from.
    :param pairs: scans that may overlap.
    :param motion_edges: edges of the motion, which connect all scans, also along the directions that walls leave open.
    :param fixed: the scan that stays.
    :param limits: None where all registrations count.
    :param odometry: edges of the motion that may have the fault of a wheel.
    :returns: shape (n, 3).
    """
    gates = np.geomspace(options.first_gate, options.last_gate, options.iterations)
    for k, gate in enumerate(gates.tolist(), start=1):
        stride = _EARLY_STRIDE if k < len(gates) else 1
        registered = _register_pairs(surfaces, poses, pairs, gate, stride, options, limits)
        edges = concatenate_edges(motion_edges, registered)
        if odometry is not None:
            edges = concatenate_edges(edges, _limit_pull(odometry, poses))
        poses = optimize(poses, edges, fixed, marginals=False, tolerance=_TOLERANCE).poses
    return poses


def _limit_pull(edges: Edges, poses: Float64) -> Edges:
    """The edges with larger covariances beyond the gate, so that a fault pulls no more than at the gate (Huber 1964).

    The cost stays convex: one step from a place to its correction spreads over the whole path.
    """
    distance = np.sqrt(edge_chi2(edges, poses) / _GATE)
    return replace(edges, covariances=edges.covariances * np.maximum(1.0, distance)[:, None, None])


def pair_limits(
    hybrid_map: HybridMap, poses: Float64, pairs: ScanPairs, areas: Int64, area_T_scan: Float64
) -> PairLimits:
    """The limits of pairs by the least uncertain paths of arcs between their areas; none within an area.

    :param poses: shape (n, 3), of the scans in the map.
    :param areas: shape (n,), their areas.
    :param area_T_scan: shape (n, 3), their poses in these.
    """
    first, second = pairs.rows.T
    information = np.zeros((len(first), 3, 3))
    for area in np.unique(areas).tolist():
        rows = np.flatnonzero((areas[second] == area) & (areas[first] != area))
        others = areas[first[rows]].tolist()
        beliefs = shortest_path_beliefs(hybrid_map, area, targets=others) if others else {}
        for row, other in zip(rows.tolist(), others, strict=True):
            covariance = propagate_covariance(beliefs[other].covariance, area_T_scan[first[row]])
            information[row] = np.linalg.inv(covariance)
    return PairLimits(se2.between(poses[second], poses[first]), information)


def agree_better(
    surfaces: ScanSurfaces, before: Float64, after: Float64, pairs: ScanPairs, options: RefinementParameters
) -> bool:
    """Whether the pairs of scans agree better at the poses ``after`` than ``before``, both of shape (n, 3).

    A pair counts as much as it overlapped before, so that one that was torn apart counts against the poses after.
    """
    first, second = pairs.rows.T
    (mean, count), (mean_after, _) = (
        _mean_weights(surfaces, pairs, se2.between(poses[second], poses[first]), options.first_gate, 1, options)
        for poses in (before, after)
    )
    return bool(count @ mean_after > count @ mean)


def _mean_weights(
    surfaces: ScanSurfaces, pairs: ScanPairs, relative: Float64, gate: float, stride: int, options: RefinementParameters
) -> tuple[Float64, Float64]:
    """The mean weight of each pair's points that have a wall, and their number, at relative poses of shape (m, 3).

    Outliers cannot raise the mean, and scans that see less of the same walls do not lower it. Both are zero where a
    pair does not overlap. Normals are unit vectors, so that the trace of the information of the position is the sum of
    the weights.
    """
    first, second = pairs.rows.T
    weighting = weighting_from_options(options)
    information, _, share = normal_equations(surfaces, first, surfaces, second, relative, gate, weighting, stride)
    total = (information[:, 0, 0] + information[:, 1, 1]) * options.sigma**2 / options.temper
    count = np.where(share >= pairs.min_share, share * np.diff(surfaces.starts)[first], 0.0)
    return np.where(count > 0.0, total / np.maximum(count, 1.0), 0.0), count


def relative_beliefs(
    surfaces: ScanSurfaces,
    poses: Float64,
    pairs: ScanPairs,
    motion_edges: Edges,
    options: RefinementParameters,
    between: Int64,
) -> list[PoseGaussian]:
    """Beliefs over refined poses relative to each other, ``i_T_j``.

    Overlapping pairs see the same walls and are not independent, so only a share of their information counts.

    :param poses: shape (n, 3), refined.
    :param motion_edges: edges of the motion, with their true covariances.
    :param between: shape (k, 2), scans i and j.
    """
    registered = _register_pairs(surfaces, poses, pairs, options.last_gate, 1, options)
    edges = concatenate_edges(motion_edges, replace(registered, covariances=registered.covariances / options.certainty))
    means = se2.between(poses[between[:, 0]], poses[between[:, 1]])
    return list(map(PoseGaussian, means, relative_covariances(poses, edges, between)))


def _invert(matrices: Float64) -> Float64:
    return np.linalg.inv(matrices).astype(np.float64, copy=False)


def _without_open_position(information: Float64) -> Float64:
    """Information (m, 3, 3) without the position along which there is next to none compared with that across it."""
    values, vectors = np.linalg.eigh(information[:, :2, :2])
    is_open = values[:, 0] <= _MIN_POSITION_SHARE * values[:, 1]
    along = np.zeros((len(information), 3))
    along[:, :2] = np.where(is_open[:, None], vectors[:, :, 0], 0.0)
    across = np.eye(3) - np.einsum("mi,mj->mij", along, along)
    return across @ information @ across


def _known_directions(information: Float64) -> tuple[Float64, Float64]:
    """Information (m, 3, 3) without directions along which there is next to none, and its pseudo-inverse (m, 3, 3).

    Noise of the normals gives each pair a little information along every direction. Over many pairs it would add up.
    """
    information = _without_open_position(information)
    scale = np.outer(_SCALE, _SCALE)
    values, vectors = np.linalg.eigh(information * scale)
    known = values > _MIN_INFORMATION_SHARE * values[:, -1:]
    kept = np.einsum("mij,mj,mkj->mik", vectors, np.where(known, values, 0.0), vectors) / scale
    inverse = np.einsum("mij,mj,mkj->mik", vectors, np.where(known, 1.0 / np.where(known, values, 1.0), 0.0), vectors)
    return kept, inverse * scale


def _register_pairs(
    surfaces: ScanSurfaces,
    poses: Float64,
    pairs: ScanPairs,
    gate: float,
    stride: int,
    options: RefinementParameters,
    limits: PairLimits | None = None,
) -> Edges:
    """One Gauss-Newton step of every pair on its own, as edges from the second scan to the first.

    With limits only those count that the arcs allow, and with which the scans agree better than before the refinement.
    """
    first, second = pairs.rows.T
    relative = se2.between(poses[second], poses[first])
    information, gradient, share = normal_equations(
        surfaces, first, surfaces, second, relative, gate, weighting_from_options(options), stride
    )
    information, inverse = _known_directions(information)
    step = -np.einsum("mij,mj->mi", inverse, gradient)
    measured = se2.compose(relative, se2.exp(step))
    counts = share >= pairs.min_share
    if limits is not None:
        offset = se2.log(se2.between(limits.relative, measured))
        counts &= np.einsum("mi,mij,mj->m", offset, limits.information, offset) <= _GATE
        (before, _), (after, _) = (
            _mean_weights(surfaces, pairs, at, gate, stride, options) for at in (limits.relative, measured)
        )
        counts &= after >= before
    return Edges(
        second[counts], first[counts], measured[counts], _invert(information[counts] + _NEGLIGIBLE_INFORMATION)
    )


def concatenate_edges(motion: Edges, registered: Edges) -> Edges:
    """The edges of both."""
    return Edges(
        np.concatenate((motion.sources, registered.sources)),
        np.concatenate((motion.targets, registered.targets)),
        np.concatenate((motion.poses, registered.poses)),
        np.concatenate((motion.covariances, registered.covariances)),
    )
