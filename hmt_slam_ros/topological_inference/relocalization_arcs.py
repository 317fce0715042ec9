"""The arcs between the map of before a robot was lost and the areas since: drawn at a pose hint, and refuted."""

from __future__ import annotations

from collections.abc import Iterator

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative, shortest_path_beliefs, uninformative_belief
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.hypothesis_tree import Lost
from hmt_slam_ros.topological_inference.search_prior import PoseHint

Pose = Float64


def hinted_pose(parent: Parent, area: int, pose_hint: PoseHint) -> Pose:
    """The mean of a pose hint in the frame of another area, ``area_T_base``, shape (3,)."""
    between = shortest_path_beliefs(parent.hybrid_map, area, targets=(pose_hint.area,)).get(pose_hint.area)
    return pose_hint.pose.mean if between is None else se2.compose(between.mean, pose_hint.pose.mean)


def hinted_arcs(parent: Parent, since: int, pose_hint: PoseHint, pose: Pose) -> tuple[Arc, ...]:
    """The uninformative arc with the mean at which the areas since then agree with a pose hint.

    :param pose: ``area_T_base`` of the hint's keyframe, in the robot's area.
    """
    for known, new, arc in _arcs_from_before(parent, since):
        if is_uninformative(arc):
            mean = se2.compose(hinted_pose(parent, known, pose_hint), se2.between(pose, _area_frame(parent, new)))
            return (Arc(known, new, uninformative_belief(mean)),)
    return ()


def refuted_arcs(parent: Parent, lost: Lost, known: int, belief: PoseGaussian, gate: float) -> tuple[Arc, ...]:
    """The arcs into the areas since the robot was lost that do not admit the pose found, as uninformative ones.

    It was moved before the first keyframe of these areas then, and the arc is no evidence.

    :param known: the area in which the robot was found.
    :param belief: over ``robot_area_T_known``.
    """
    refuted = []
    for before, new, arc in _arcs_from_before(parent, lost.since):
        to_known = shortest_path_beliefs(parent.hybrid_map, before, targets=(known,)).get(known)
        if to_known is None or is_uninformative(arc):
            continue
        found = to_known.compose(belief.inverse()).compose(PoseGaussian.from_pose(_area_frame(parent, new)))
        if arc.mahalanobis2(found) > gate:
            refuted.append(Arc(before, new, uninformative_belief(found.mean)))
    return tuple(refuted)


def _arcs_from_before(parent: Parent, since: int) -> Iterator[tuple[int, int, PoseGaussian]]:
    """The arcs by which the areas of before and those since a keyframe are joined: (known, new, ``known_T_new``)."""
    for known, new, arc in parent.hybrid_map.all_arcs():
        first, second = (min(parent.hybrid_map.keyframes(area), default=-1) for area in (known, new))
        if first < since <= second:
            yield known, new, arc.pose


def _area_frame(parent: Parent, area: int) -> Pose:
    """``robot_area_T_area`` of an area that arcs join to the robot's, shape (3,)."""
    return shortest_path_beliefs(parent.hybrid_map, parent.area, targets=(area,))[area].mean
