"""Refinement around a closure: joint refinement of the areas that it joined, at a cost that does not grow."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges, consistent_map
from hmt_slam_ros.hybrid_map.shortest_path import connected_neighbors
from hmt_slam_ros.loop_closure.joint_refinement import (
    ScanPairs,
    nearest_keyframes,
    refine_jointly,
    relative_beliefs,
    scan_pairs,
)
from hmt_slam_ros.registration.scan_to_scan import ScanSurfaces, extract_surfaces
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import path_covariance

_SAME_TRAVERSAL = 3
"""Largest difference in number of successive keyframes of one traversal of an area."""

_RIGID_COVARIANCE = np.diag([1e-6, 1e-6, 1e-6])
"""Covariance of keyframes in an area that moves as a rigid body: 1 mm and 0.06 degrees."""

_CLOSURE_ARC_INFLATION = 10.0
"""Factor on the covariance of a closure's arc, while its scans are registered, which places them better."""

_NEW_TRAVERSAL_ANGLE = np.radians(10.0)
"""Deviation of the heading between two traversals of an area, rad."""

KeyframeEdge = tuple[int, int, PoseGaussian]


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
        # The refinement pairs surfaces that are this near to each other at its start, m.
        self._capture = configuration.refinement.first_gate

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
        edges = stack_edges(self._edges(hybrid_map, areas, closed, _CLOSURE_ARC_INFLATION), ids)
        fixed = ids.index(_reference_keyframe(hybrid_map, closed[0]))
        refined_poses = refine_jointly(surfaces, poses, pairs, edges, self._options, fixed)
        refined = _split_by_area(hybrid_map, dict(zip(ids, refined_poses, strict=True)), areas, closed)
        motion_edges = stack_edges(self._edges(hybrid_map, areas, areas), ids)
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
            before = refined.arcs[a, b]
            arcs[a, b] = PoseGaussian(before.mean, _with_open_positions(covariance, before.covariance, self._capture))
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
        yield from arc_edges(hybrid_map, areas, inflation)

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


def _with_open_positions(covariance: Float64, before: Float64, capture: float) -> Float64:
    """A covariance after a refinement, with that of before along positions that were known no better than it captures.

    A refinement ends at the next structure that looks alike, and its covariance is that of this one.

    :param before: of the same arc, shape (3, 3).
    :param capture: distance within which the refinement finds its structure, m.
    """
    values, vectors = np.linalg.eigh(before[:2, :2])
    is_open = values > capture**2
    opened = covariance.copy()
    opened[:2, :2] += (vectors[:, is_open] * values[is_open]) @ vectors[:, is_open].T
    return opened


def _connected_groups(hybrid_map: HybridMap, closed: Collection[int]) -> list[list[int]]:
    """The closed areas and those one arc away, in groups that arcs connect, each ascending."""
    arcs = np.array([(area, other) for area in closed for other in (area, *connected_neighbors(hybrid_map, area))])
    areas, rows = np.unique(arcs, return_inverse=True)
    graph = scipy.sparse.csc_matrix((np.ones(len(arcs)), rows.reshape(-1, 2).T), shape=(areas.size, areas.size))
    groups, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return [areas[labels == group].tolist() for group in range(groups)]


def _reference_keyframe(hybrid_map: HybridMap, area: int) -> int:
    return next(iter(hybrid_map.keyframes(area)))


def arc_edges(hybrid_map: HybridMap, areas: Collection[int], inflation: float = 1.0) -> Iterator[KeyframeEdge]:
    """The arcs between given areas as edges between their first keyframes.

    :param inflation: factor on the covariances of arcs that closed a loop.
    """
    for a, b, arc in hybrid_map.all_arcs():
        if a in areas and b in areas:
            first, second = _reference_keyframe(hybrid_map, a), _reference_keyframe(hybrid_map, b)
            first_T_a = PoseGaussian.from_pose(se2.inverse(hybrid_map.keyframes(a)[first]))
            b_T_second = PoseGaussian.from_pose(hybrid_map.keyframes(b)[second])
            covariance = (inflation if arc.closure else 1.0) * arc.pose.covariance
            a_T_b = PoseGaussian(arc.pose.mean, covariance)
            yield first, second, first_T_a.compose(a_T_b).compose(b_T_second)


def _rigid_edges(hybrid_map: HybridMap, area: int) -> Iterator[KeyframeEdge]:
    poses = hybrid_map.keyframes(area)
    reference = _reference_keyframe(hybrid_map, area)
    for keyframe in poses:
        if keyframe != reference:
            yield reference, keyframe, PoseGaussian(se2.between(poses[reference], poses[keyframe]), _RIGID_COVARIANCE)


def stack_edges(edges: Iterable[KeyframeEdge], ids: list[int]) -> Edges:
    """Edges between keyframes as edges between their rows in ``ids``."""
    row, stacked = {keyframe: i for i, keyframe in enumerate(ids)}, list(edges)
    return Edges(
        np.array([row[first] for first, _, _ in stacked], dtype=np.int64),
        np.array([row[second] for _, second, _ in stacked], dtype=np.int64),
        np.array([belief.mean for _, _, belief in stacked]).reshape(-1, 3),
        np.array([belief.covariance for _, _, belief in stacked]).reshape(-1, 3, 3),
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
