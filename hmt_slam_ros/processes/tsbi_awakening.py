"""A robot that woke up somewhere: it maps around itself, and is joined to the map where it is recognized.

It is not known how it came there, so that it begins a new area, to which an arc leads that tells nothing. From then on
all that it saw is looked for in the whole map, again and again, until one place has nearly all of the probability; then
a further continuation of the path closes the loop between the two maps, and TLCA decides as it does about any other.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.messages import Arc
from hmt_slam_ros.processes.tsbi_branching import Branches, Branching, Child, Parent
from hmt_slam_ros.topology.relocation import is_certain
from hmt_slam_ros.topology.unknown import unknown

Pose = NDArray[np.float64]

# Probability that the most probable place needs to have.
_ENOUGH = 0.9
# Keyframes that are laid into the map at most, the newest.
_MOST = 25


def awoken(branching: Branching, parent: Parent, keyframe: int) -> Branches:
    """The one continuation of a hypothesis where the robot may be anywhere: in a new area."""
    query = branching.query(parent, [keyframe])
    arc = unknown(query.belief.mean)
    origin = PoseGaussian.exactly(np.zeros(3))
    child = branching.entered(parent, query, branching.new_area(parent, query), origin, arc, 0.0)
    return Branches([replace(child, notes=replace(child.notes, lost=keyframe))])


def looked_for(branching: Branching, parent: Parent) -> Branches:
    """To be lost still, or where the robot was recognized."""
    assert parent.notes.lost is not None
    keyframes = _seen_since(parent, parent.notes.lost)
    reference = next(iter(keyframes.values()))
    poses = {k: se2.between(reference, pose) for k, pose in keyframes.items()}
    where = branching.search.everywhere(parent.hybrid_map, poses, parent.notes.lost)
    noted = replace(parent, notes=parent.notes.checked((), tuple(poses)))
    still = Child(parent.hypothesis, parent.log_weight, parent.area, noted.notes)
    best = where.best
    if best is None or best[1] < _ENOUGH or not is_certain(best[0]):
        return Branches([still], True, where=where)
    located, probability = best
    arc = Arc(parent.area, located.area, PoseGaussian.exactly(reference).compose(located.mode.measured.inverse()), True)
    found = Child(
        parent.hypothesis, parent.log_weight + math.log(probability), parent.area, replace(noted.notes, lost=None),
        arcs=(arc,), reload=True,
    )  # fmt: skip
    still = replace(still, log_weight=parent.log_weight + math.log(max(1.0 - probability, 1e-300)))
    return Branches([still, found], True, where=where)


def _seen_since(parent: Parent, keyframe: int) -> dict[int, Pose]:
    """The newest keyframes of the local map since one of them, {keyframe: ``area_T_base``}, ascending."""
    seen = dict(parent.hybrid_map.keyframes(parent.area))
    for area, pose in parent.around().items():
        seen |= {k: se2.compose(pose, at) for k, at in parent.hybrid_map.keyframes(area).items()}
    return {k: seen[k] for k in sorted(seen)[-_MOST:] if k >= keyframe}
