"""Joint refinement around a loop closure that was just accepted, at a cost that does not grow with the whole map."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.csgraph import connected_components

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
from hmt_slam_ros.sensors.motion_model import path_covariance

# Keyframes this far apart in number were taken on one way through an area.
_SAME_TRAVERSAL = 3
# An area that only lies beside the closure moves as a whole: 1 mm and 0.06 degrees.
_RIGID_COVARIANCE = np.diag([1e-6, 1e-6, 1e-6])
# The scans that measured an arc that closed a loop are registered with each other, which places them better: the factor
# on its covariance meanwhile.
_CLOSURE_ARC_INFLATION = 10.0

KeyframeEdge = tuple[int, int, PoseGaussian]


@dataclass(frozen=True, eq=False)
class RefinedClosure:
    """What changed.

    :ivar keyframes: {area: {keyframe: ``area_T_base``, shape (3,)}} of the areas that the closure joined.
    :ivar arcs: {(a, b): belief over ``a_T_b``} between these areas and those around them. The covariance is new between
        areas that both were refined, and elsewhere the one that the arc had.
    """

    keyframes: dict[int, dict[int, NDArray[np.float64]]]
    arcs: dict[tuple[int, int], PoseGaussian]


class ClosureRefinement:
    """Refines the keyframes of the areas that a closure joined; the areas around them move as rigid bodies.

    The frame of an area stays where its keyframes move least, so that the map around the robot does not jump.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._options = configuration.refinement
        self._motion = configuration.motion
        self._max_range = configuration.local_map.max_range

    def refine(self, hybrid_map: HybridMap, scans: Mapping[int, Scan], closed_areas: Collection[int]) -> RefinedClosure:
        """Refine the surroundings of closures.

        :param scans: of all keyframes.
        :param closed_areas: the areas that closures joined.
        """
        found = RefinedClosure({}, {})
        for areas in _connected_groups(hybrid_map, closed_areas) if self._options.iterations else ():
            part = self._refine_group(hybrid_map, scans, areas, [area for area in areas if area in closed_areas])
            found = RefinedClosure(found.keyframes | part.keyframes, found.arcs | part.arcs)
        return found

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
        found = refine_jointly(surfaces, poses, pairs, edges, self._options, fixed)
        taken = _split_by_area(hybrid_map, dict(zip(ids, found, strict=True)), areas, closed)
        soft = _stack_edges(self._edges(hybrid_map, areas, areas), ids)
        return self._with_covariances(taken, surfaces, found, pairs, soft, ids)

    def _with_covariances(
        self,
        taken: RefinedClosure,
        surfaces: ScanSurfaces,
        poses: NDArray[np.float64],
        pairs: ScanPairs,
        motion: Edges,
        ids: list[int],
    ) -> RefinedClosure:
        """The same with the covariances of arcs between areas that were refined, by a keyframe near to each origin."""
        origins = {
            area: min(kept, key=lambda k: _distance_from_origin(kept[k])) for area, kept in taken.keyframes.items()
        }
        between = [pair for pair in taken.arcs if pair[0] in origins and pair[1] in origins]
        if not between:
            return taken
        rows = np.array([[ids.index(origins[area]) for area in pair] for pair in between])
        beliefs = relative_beliefs(surfaces, poses, pairs, motion, self._options, rows)
        arcs = {}
        for (a, b), belief in zip(between, beliefs, strict=True):
            a_T_one, b_T_other = taken.keyframes[a][origins[a]], taken.keyframes[b][origins[b]]
            known = (
                PoseGaussian.from_pose(a_T_one).compose(belief).compose(PoseGaussian.from_pose(se2.inverse(b_T_other)))
            )
            arcs[a, b] = PoseGaussian(taken.arcs[a, b].mean, known.covariance)
        return replace(taken, arcs=taken.arcs | arcs)

    def _scan_pairs(self, poses: NDArray[np.float64], areas: NDArray[np.int64]) -> ScanPairs:
        """The keyframes that may overlap; all these areas are at most two arcs apart."""
        linked = dict.fromkeys(areas.tolist(), frozenset(areas.tolist()))
        count = self._options.neighbors + 1
        around = nearest_keyframes(poses, areas, poses, areas, linked, self._options.reach, count)
        return scan_pairs(around, self._options.min_share)

    def _edges(
        self, hybrid_map: HybridMap, areas: list[int], closed: Collection[int], inflation: float = 1.0
    ) -> Iterable[KeyframeEdge]:
        """What holds the keyframes together besides their scans.

        :param inflation: factor on the covariances of arcs that closed a loop.
        """
        for area in areas:
            yield from self._motion_edges(hybrid_map, area) if area in closed else _rigid_edges(hybrid_map, area)
        for a, b, arc in hybrid_map.all_arcs():
            if a in areas and b in areas:
                one, other = _reference_keyframe(hybrid_map, a), _reference_keyframe(hybrid_map, b)
                a_T_one, b_T_other = hybrid_map.keyframes(a)[one], hybrid_map.keyframes(b)[other]
                covariance = (inflation if arc.closure else 1.0) * arc.pose.covariance
                one_T_b = PoseGaussian.from_pose(se2.inverse(a_T_one)).compose(PoseGaussian(arc.pose.mean, covariance))
                yield one, other, one_T_b.compose(PoseGaussian.from_pose(b_T_other))

    def _motion_edges(self, hybrid_map: HybridMap, area: int) -> Iterable[KeyframeEdge]:
        """The keyframes of one way through an area by the motion between them, a later way by its first to the area."""
        poses = hybrid_map.keyframes(area)
        for one, other in pairwise(sorted(poses)):
            step = se2.between(poses[one], poses[other])
            yield one, other, PoseGaussian(step, self._step_covariance(step, other - one))

    def _step_covariance(self, step: NDArray[np.float64], passed: int) -> NDArray[np.float64]:
        if passed > _SAME_TRAVERSAL:
            return np.diag([self._options.first_gate**2, self._options.first_gate**2, np.radians(10.0) ** 2])
        return path_covariance(float(np.hypot(step[0], step[1])), abs(float(step[2])), self._motion)


def _connected_groups(hybrid_map: HybridMap, closed: Collection[int]) -> list[list[int]]:
    """The areas joined and those one arc away, in groups that arcs join, each ascending."""
    arcs = np.array([(area, other) for area in closed for other in (area, *connected_neighbors(hybrid_map, area))])
    areas, rows = np.unique(arcs, return_inverse=True)
    graph = csc_matrix((np.ones(len(arcs)), rows.reshape(-1, 2).T), shape=(areas.size, areas.size))
    groups, labels = connected_components(graph, directed=False)
    return [areas[labels == group].tolist() for group in range(groups)]


def _reference_keyframe(hybrid_map: HybridMap, area: int) -> int:
    return next(iter(hybrid_map.keyframes(area)))


def _distance_from_origin(pose: NDArray[np.float64]) -> float:
    return float(np.hypot(pose[0], pose[1]) + abs(pose[2]))


def _rigid_edges(hybrid_map: HybridMap, area: int) -> Iterable[KeyframeEdge]:
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
    hybrid_map: HybridMap, poses: Mapping[int, NDArray[np.float64]], areas: list[int], closed: Collection[int]
) -> RefinedClosure:
    """Keyframes in the frames of their areas, and the arcs between these frames."""
    frames = {}
    for area in areas:
        before = hybrid_map.keyframes(area)
        frames[area] = se2.best_fit(list(before.values()), [poses[keyframe] for keyframe in before])
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
