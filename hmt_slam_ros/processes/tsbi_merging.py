"""Two areas that AAM found to be one, as a child of the one hypothesis."""

from __future__ import annotations

from dataclasses import replace

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.map_parts import Merged
from hmt_slam_ros.processes.tsbi_branches import Child, Parent
from hmt_slam_ros.topology.closure_search import ClosureSearch


def merged(parent: Parent, area: int, into: int, search: ClosureSearch) -> Child:
    """The child in which ``area`` is part of ``into``, or which stays as it is where their surfaces contradict.

    :param search: which compares them.
    """
    child = Child(parent.hypothesis, parent.log_weight, parent.area, parent.notes)
    belief = parent.hybrid_map.arc(into, area)
    if belief is None or not search.agree(parent.hybrid_map, into, area, belief.mean):
        return child
    child = replace(child, reload=True, merged=Merged(area, into, belief))
    if parent.area != area:
        return child
    placed = parent.hybrid_map.keyframes(area)
    covariances = {
        k: belief.compose(PoseGaussian(placed[k], covariance)).covariance
        for k, covariance in parent.notes.covariances.items()
        if k in placed
    }
    return replace(child, area=into, notes=parent.notes.entered(covariances), rebase=belief)
