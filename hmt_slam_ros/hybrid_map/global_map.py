"""Where the areas of a hybrid map lie in one frame: consistent with all arcs, or along the shortest paths only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges, Solution, optimize
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs

# The reference area defines the frame; 0.1 mm and 0.006 degrees keep its covariance regular.
_REFERENCE = np.diag([1e-8, 1e-8, 1e-8])


class GlobalMap(NamedTuple):
    """Areas in the frame of the reference area.

    :ivar poses: {area: belief over ``map_T_area``}, ascending; the reference is the smallest area.
    :ivar arc_chi2: {(a, b): chi-square of the arc against these poses, 3 degrees of freedom}, a < b, ascending; empty
        for :func:`shortest_path_map`.
    """

    poses: dict[int, PoseGaussian]
    arc_chi2: dict[tuple[int, int], float]


def shortest_path_map(hybrid_map: HybridMap) -> GlobalMap:
    """Areas composed along the tree of least uncertain paths from the reference, Eq. (15).

    Arcs that the tree does not use are ignored, so a loop keeps its error as a gap.
    """
    poses = shortest_path_beliefs(hybrid_map, _reference_area(hybrid_map))
    return GlobalMap({area: _regularize(poses[area]) for area in sorted(poses)}, {})


def consistent_map(hybrid_map: HybridMap) -> GlobalMap:
    """Areas at the poses that agree best with all arcs (Lu and Milios), with their marginal covariances.

    Only areas that arcs join with the reference have a place.
    """
    areas, arcs, solution = _solve_areas(hybrid_map, marginals=True)
    assert solution.covariances is not None
    beliefs = map(PoseGaussian, solution.poses, solution.covariances)
    poses = {area: _regularize(belief) for area, belief in zip(areas, beliefs, strict=True)}
    chi2 = {(a, b): float(value) for (a, b, _), value in zip(arcs, solution.edge_chi2, strict=True)}
    return GlobalMap(poses, chi2)


def total_arc_chi2(hybrid_map: HybridMap) -> float:
    """The chi-square of all arcs against the poses that agree best with them; 3 degrees of freedom a cycle."""
    return _solve_areas(hybrid_map, marginals=False)[2].chi2


def _solve_areas(
    hybrid_map: HybridMap, *, marginals: bool
) -> tuple[list[int], list[tuple[int, int, PoseGaussian]], Solution]:
    """Areas, arcs among them, and what agrees best with these."""
    tree = shortest_path_beliefs(hybrid_map, _reference_area(hybrid_map))
    areas = sorted(tree)
    arcs = [(a, b, value.pose) for a, b, value in hybrid_map.all_arcs() if a in tree]
    row = {area: i for i, area in enumerate(areas)}
    edges = Edges(
        np.array([row[a] for a, _, _ in arcs], np.int64),
        np.array([row[b] for _, b, _ in arcs], np.int64),
        np.array([pose.mean for _, _, pose in arcs]).reshape(-1, 3),
        np.array([pose.covariance for _, _, pose in arcs]).reshape(-1, 3, 3),
    )
    return areas, arcs, optimize(np.array([tree[area].mean for area in areas]), edges, marginals=marginals)


def _reference_area(hybrid_map: HybridMap) -> int:
    return min(hybrid_map.area_ids(), default=0)


def _regularize(belief: PoseGaussian) -> PoseGaussian:
    return belief if belief.covariance.any() else PoseGaussian(belief.mean, _REFERENCE)
