"""Joint refinement: all overlapping pairs of scans are registered, and their poses solved for together.

Two steps alternate. Every overlapping pair of scans is linearized at the present poses, which makes it an edge of a
pose graph. This is point-to-line, so that a pair in a bare corridor determines nothing along it. Then the graph is
solved, with the edges of the motion (Lu and Milios 1997). Around a closure, the cost does not grow with the map.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import csc_matrix
from scipy.sparse.csgraph import connected_components

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges, consistent_map, optimize, relative_covariances
from hmt_slam_ros.hybrid_map.shortest_path import connected_neighbors, shortest_path_beliefs
from hmt_slam_ros.registration.scan_to_scan import (
    ScanSurfaces,
    extract_surfaces,
    normal_equations,
    weighting_from_options,
)
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import path_covariance

_SAME_TRAVERSAL = 3
"""Largest difference in number of successive keyframes of one traversal of an area."""

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

_PRIOR_INFORMATION = 0.1 * np.eye(3)
"""Makes the information of a pair regular: 3 m and 3 rad."""

_NEGLIGIBLE_INFORMATION = 1e-6 * np.eye(3)
"""The same where it must not count, whatever the number of pairs: 1 km."""

_SCALE = np.array([1.0, 1.0, 1.0 / 3.0])
"""Makes turns comparable with meters: a turn counts as it moves a point 3 m away."""

_MIN_INFORMATION_SHARE = 0.004
"""Smallest information along a direction relative to the largest: normals are off by some hundredths."""

_RIGID_COVARIANCE = np.diag([1e-6, 1e-6, 1e-6])
"""Covariance of keyframes in an area that moves as a rigid body: 1 mm and 0.06 degrees."""

_CLOSURE_ARC_INFLATION = 10.0
"""Factor on the covariance of a closure's arc, while its scans are registered, which places them better."""

_NEW_TRAVERSAL_ANGLE = np.radians(10.0)
"""Deviation of the heading between two traversals of an area, rad."""

KeyframeEdge = tuple[int, int, PoseGaussian]


class ScanPairs(NamedTuple):
    """Scans that may overlap.

    :ivar rows: shape (m, 2), each pair once, ascending.
    :ivar min_share: shape (m,), smallest share of the points of the first near the second for a registration.
    """

    rows: Int64
    min_share: Float64


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
) -> Float64:
    """The poses that agree best with all registrations and the motion between them.

    :param surfaces: of n scans.
    :param poses: shape (n, 3), ``map_T_base`` to start from.
    :param pairs: scans that may overlap.
    :param motion_edges: edges of the motion, which connect all scans, also along the directions that walls leave open.
    :param fixed: the scan that stays.
    :returns: shape (n, 3).
    """
    gates = np.geomspace(options.first_gate, options.last_gate, options.iterations)
    for k, gate in enumerate(gates.tolist(), start=1):
        stride = _EARLY_STRIDE if k < len(gates) else 1
        edges = _concatenate_edges(motion_edges, _register_pairs(surfaces, poses, pairs, gate, stride, options))
        poses = optimize(poses, edges, fixed, marginals=False, tolerance=_TOLERANCE).poses
    return poses


def relative_beliefs(
    surfaces: ScanSurfaces,
    poses: Float64,
    pairs: ScanPairs,
    motion_edges: Edges,
    options: RefinementParameters,
    between: Int64,
) -> list[PoseGaussian]:
    """Beliefs over refined poses relative to each other, ``i_T_j``.

    Overlapping pairs see the same walls and are not independent, so only a share of their information counts. Noise of
    the normals gives each pair a little information along every direction, which would add up: it is dropped.

    :param poses: shape (n, 3), refined.
    :param motion_edges: edges of the motion, with their true covariances.
    :param between: shape (k, 2), scans i and j.
    """
    registered = _register_pairs(surfaces, poses, pairs, options.last_gate, 1, options)
    information = options.certainty * _drop_weak_directions(_invert(registered.covariances)) + _NEGLIGIBLE_INFORMATION
    edges = _concatenate_edges(motion_edges, replace(registered, covariances=_invert(information)))
    means = se2.between(poses[between[:, 0]], poses[between[:, 1]])
    return list(map(PoseGaussian, means, relative_covariances(poses, edges, between)))


def _invert(matrices: Float64) -> Float64:
    return np.linalg.inv(matrices).astype(np.float64, copy=False)


def _drop_weak_directions(information: Float64) -> Float64:
    """Information (m, 3, 3) without directions along which there is next to none."""
    scale = np.outer(_SCALE, _SCALE)
    values, vectors = np.linalg.eigh(information * scale)
    kept = np.where(values > _MIN_INFORMATION_SHARE * values[:, -1:], values, 0.0)
    return np.asarray(np.einsum("mij,mj,mkj->mik", vectors, kept, vectors) / scale, dtype=np.float64)


def _register_pairs(
    surfaces: ScanSurfaces, poses: Float64, pairs: ScanPairs, gate: float, stride: int, options: RefinementParameters
) -> Edges:
    """One Gauss-Newton step of every pair on its own, as edges from the second scan to the first."""
    first, second = pairs.rows.T
    relative = se2.between(poses[second], poses[first])
    information, gradient, share = normal_equations(
        surfaces, first, surfaces, second, relative, gate, weighting_from_options(options), stride
    )
    overlaps = share >= pairs.min_share
    information = information[overlaps] + _PRIOR_INFORMATION
    step = -np.linalg.solve(information, gradient[overlaps, :, None])[..., 0]
    measured = se2.compose(relative[overlaps], se2.exp(step))
    return Edges(second[overlaps], first[overlaps], measured, np.linalg.inv(information))


def _concatenate_edges(motion: Edges, registered: Edges) -> Edges:
    return Edges(
        np.concatenate((motion.sources, registered.sources)),
        np.concatenate((motion.targets, registered.targets)),
        np.concatenate((motion.poses, registered.poses)),
        np.concatenate((motion.covariances, registered.covariances)),
    )


@dataclass(frozen=True, eq=False)
class RefinedClosure:
    """The result of a refinement.

    :ivar keyframes: {area: {keyframe: ``area_T_base``, shape (3,)}} of the areas that the closure joined.
    :ivar arcs: {(a, b): belief over ``a_T_b``} between these areas and those around them. The covariance is new if both
        areas were refined; else it is that of the arc.
    """

    keyframes: dict[int, dict[int, Float64]]
    arcs: dict[tuple[int, int], PoseGaussian]


class ClosureRefinement:
    """Refines the keyframes of the areas that a closure joined; the areas around them move as rigid bodies.

    The frame of an area stays where its keyframes move least, so that the robot does not jump.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._options = configuration.refinement
        self._motion = configuration.motion
        self._max_range = configuration.local_map.max_range

    def refine(self, hybrid_map: HybridMap, scans: Mapping[int, Scan], closed_areas: Collection[int]) -> RefinedClosure:
        """The refined surroundings of closures.

        :param scans: of all keyframes.
        :param closed_areas: the areas that closures joined.
        """
        refined = RefinedClosure({}, {})
        for areas in _connected_groups(hybrid_map, closed_areas) if self._options.iterations else ():
            group = self._refine_group(hybrid_map, scans, areas, [area for area in areas if area in closed_areas])
            refined = RefinedClosure(refined.keyframes | group.keyframes, refined.arcs | group.arcs)
        return refined

    def _refine_group(
        self, hybrid_map: HybridMap, scans: Mapping[int, Scan], areas: list[int], closed: list[int]
    ) -> RefinedClosure:
        area_of = {keyframe: area for area in areas for keyframe in hybrid_map.keyframes(area)}
        ids = sorted(area_of)
        frames = consistent_map(hybrid_map).poses
        poses = np.array([se2.compose(frames[area_of[k]].mean, hybrid_map.keyframes(area_of[k])[k]) for k in ids])
        surfaces = extract_surfaces([scans[keyframe] for keyframe in ids], self._max_range, self._options.max_points)
        pairs = self._scan_pairs(poses, np.array([area_of[keyframe] for keyframe in ids], dtype=np.int64))
        edges = _stack_edges(self._edges(hybrid_map, areas, closed, _CLOSURE_ARC_INFLATION), ids)
        fixed = ids.index(_reference_keyframe(hybrid_map, closed[0]))
        refined_poses = refine_jointly(surfaces, poses, pairs, edges, self._options, fixed)
        refined = _split_by_area(hybrid_map, dict(zip(ids, refined_poses, strict=True)), areas, closed)
        motion_edges = _stack_edges(self._edges(hybrid_map, areas, areas), ids)
        return self._with_covariances(refined, surfaces, refined_poses, pairs, motion_edges, ids)

    def _with_covariances(
        self,
        refined: RefinedClosure,
        surfaces: ScanSurfaces,
        poses: Float64,
        pairs: ScanPairs,
        motion_edges: Edges,
        ids: list[int],
    ) -> RefinedClosure:
        """The result with new covariances of arcs between refined areas, by a keyframe near each origin."""
        origins = {
            area: min(keyframes, key=lambda k: float(np.hypot(*keyframes[k][:2]) + abs(keyframes[k][2])))
            for area, keyframes in refined.keyframes.items()
        }
        between = [pair for pair in refined.arcs if pair[0] in origins and pair[1] in origins]
        if not between:
            return refined
        rows = np.array([[ids.index(origins[area]) for area in pair] for pair in between])
        beliefs = relative_beliefs(surfaces, poses, pairs, motion_edges, self._options, rows)
        arcs = {}
        for (a, b), belief in zip(between, beliefs, strict=True):
            a_T_first = PoseGaussian.from_pose(refined.keyframes[a][origins[a]])
            second_T_b = PoseGaussian.from_pose(se2.inverse(refined.keyframes[b][origins[b]]))
            covariance = a_T_first.compose(belief).compose(second_T_b).covariance
            arcs[a, b] = PoseGaussian(refined.arcs[a, b].mean, covariance)
        return replace(refined, arcs=refined.arcs | arcs)

    def _scan_pairs(self, poses: Float64, areas: Int64) -> ScanPairs:
        """The keyframes that may overlap; all these areas are at most two arcs apart."""
        linked = dict.fromkeys(areas.tolist(), frozenset(areas.tolist()))
        count = self._options.neighbors + 1
        around = nearest_keyframes(poses, areas, poses, areas, linked, self._options.reach, count)
        return scan_pairs(around, self._options.min_share)

    def _edges(
        self, hybrid_map: HybridMap, areas: list[int], closed: Collection[int], inflation: float = 1.0
    ) -> Iterator[KeyframeEdge]:
        """The edges between keyframes besides their scans: motion, rigid areas and arcs.

        :param inflation: factor on the covariances of arcs that closed a loop.
        """
        for area in areas:
            yield from self._motion_edges(hybrid_map, area) if area in closed else _rigid_edges(hybrid_map, area)
        for a, b, arc in hybrid_map.all_arcs():
            if a in areas and b in areas:
                first, second = _reference_keyframe(hybrid_map, a), _reference_keyframe(hybrid_map, b)
                first_T_a = PoseGaussian.from_pose(se2.inverse(hybrid_map.keyframes(a)[first]))
                b_T_second = PoseGaussian.from_pose(hybrid_map.keyframes(b)[second])
                covariance = (inflation if arc.closure else 1.0) * arc.pose.covariance
                a_T_b = PoseGaussian(arc.pose.mean, covariance)
                yield first, second, first_T_a.compose(a_T_b).compose(b_T_second)

    def _motion_edges(self, hybrid_map: HybridMap, area: int) -> Iterator[KeyframeEdge]:
        """Edges between successive keyframes of an area, with wide covariances between two traversals."""
        poses = hybrid_map.keyframes(area)
        for first, second in pairwise(sorted(poses)):
            step = se2.between(poses[first], poses[second])
            yield first, second, PoseGaussian(step, self._step_covariance(step, second - first))

    def _step_covariance(self, step: Float64, number_difference: int) -> Float64:
        if number_difference > _SAME_TRAVERSAL:
            return np.diag([self._options.first_gate, self._options.first_gate, _NEW_TRAVERSAL_ANGLE]) ** 2
        return path_covariance(float(np.hypot(step[0], step[1])), abs(float(step[2])), self._motion)


def _connected_groups(hybrid_map: HybridMap, closed: Collection[int]) -> list[list[int]]:
    """The closed areas and those one arc away, in groups that arcs connect, each ascending."""
    arcs = np.array([(area, other) for area in closed for other in (area, *connected_neighbors(hybrid_map, area))])
    areas, rows = np.unique(arcs, return_inverse=True)
    graph = csc_matrix((np.ones(len(arcs)), rows.reshape(-1, 2).T), shape=(areas.size, areas.size))
    groups, labels = connected_components(graph, directed=False)
    return [areas[labels == group].tolist() for group in range(groups)]


def _reference_keyframe(hybrid_map: HybridMap, area: int) -> int:
    return next(iter(hybrid_map.keyframes(area)))


def _rigid_edges(hybrid_map: HybridMap, area: int) -> Iterator[KeyframeEdge]:
    poses = hybrid_map.keyframes(area)
    reference = _reference_keyframe(hybrid_map, area)
    for keyframe in poses:
        if keyframe != reference:
            yield reference, keyframe, PoseGaussian(se2.between(poses[reference], poses[keyframe]), _RIGID_COVARIANCE)


def _stack_edges(edges: Iterable[KeyframeEdge], ids: list[int]) -> Edges:
    row = {keyframe: i for i, keyframe in enumerate(ids)}
    sources, targets, beliefs = zip(*edges, strict=True)
    return Edges(
        np.array([row[keyframe] for keyframe in sources], dtype=np.int64),
        np.array([row[keyframe] for keyframe in targets], dtype=np.int64),
        np.array([belief.mean for belief in beliefs]),
        np.array([belief.covariance for belief in beliefs]),
    )


def _split_by_area(
    hybrid_map: HybridMap, poses: Mapping[int, Float64], areas: list[int], closed: Collection[int]
) -> RefinedClosure:
    """Keyframes in the frames of their areas, and the arcs between these frames."""
    frames = {
        area: se2.best_fit(list(hybrid_map.keyframes(area).values()), [poses[k] for k in hybrid_map.keyframes(area)])
        for area in areas
    }
    return RefinedClosure(
        {
            area: {keyframe: se2.between(frames[area], poses[keyframe]) for keyframe in hybrid_map.keyframes(area)}
            for area in sorted(closed)
        },
        {
            (a, b): PoseGaussian(se2.between(frames[a], frames[b]), arc.pose.covariance)
            for a, b, arc in hybrid_map.all_arcs()
            if a in frames and b in frames
        },
    )
