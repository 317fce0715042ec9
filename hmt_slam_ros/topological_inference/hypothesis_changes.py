"""The children of a hypothesis that follow what other processes found: two areas are one, or a closure was false."""

from __future__ import annotations

import math
from dataclasses import replace

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaMerge, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.topological_inference.branches import Child, Parent
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState


def merge_areas(parent: Parent, area: int, into: int, search: ClosureSearch) -> Child:
    """The child in which ``area`` is part of ``into``, or an unchanged one where their surfaces contradict.

    :param search: compares them.
    """
    child = parent.unchanged_child()
    belief = parent.hybrid_map.arc(into, area)
    if belief is None or not search.is_same_place(parent.hybrid_map, into, area, belief.mean):
        return child
    child = replace(child, reload_local_map=True, area_merge=AreaMerge(area, into, belief))
    if parent.area != area:
        return child
    poses = parent.hybrid_map.keyframes(area)
    covariances = {
        k: belief.compose(PoseGaussian(poses[k], covariance)).covariance
        for k, covariance in parent.state.covariances.items()
        if k in poses
    }
    return replace(child, area=into, state=parent.state.after_area_change(covariances), frame_change=belief)


def apply_revision(parent: Parent, explanation: Hypothesis, newest: int) -> Child:
    """The child that follows one of TLCA's explanations; all areas may be compared again.

    :param explanation: it lacks the keyframe that came since.
    :param newest: that keyframe.
    """
    moved = explanation.moved_keyframes
    if explanation.frame_change is not None and newest in parent.hybrid_map.keyframes(parent.area):
        pose = se2.compose(explanation.frame_change.mean, parent.hybrid_map.keyframes(parent.area)[newest])
        moved += (MovedKeyframe(newest, parent.area, explanation.area, pose),)
    return Child(
        parent.hypothesis,
        parent.log_weight + math.log(explanation.probability),
        explanation.area,
        _state_after_revision(parent, explanation, {m.keyframe for m in moved if m.area == explanation.area}),
        explanation.frame_change,
        moved,
        explanation.arcs,
        reload_local_map=True,
        removed_arcs=explanation.removed_arcs,
    )


def _state_after_revision(parent: Parent, explanation: Hypothesis, moved: set[int]) -> HypothesisState:
    """The state without comparisons; in another area, only of the keyframes that moved there."""
    state = replace(parent.state, matched_keyframes={}, comparison=None, unlinked_overlap=None, statement_evidence=None)
    if explanation.area == parent.area:
        return state
    covariances = {keyframe: covariance for keyframe, covariance in state.covariances.items() if keyframe in moved}
    unmatched = tuple(keyframe for keyframe in state.unmatched_keyframes if keyframe in moved)
    return HypothesisState(
        covariances,
        unmatched_keyframes=unmatched,
        statement_evidence=None,
        compared_statement=state.compared_statement,
    )
