"""A question that TLCA opened again, as children of the one hypothesis that had been accepted."""

from __future__ import annotations

import math
from dataclasses import replace

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.processes.map_parts import Relabelled
from hmt_slam_ros.processes.messages import Leaf
from hmt_slam_ros.processes.tsbi_branches import Child, Parent
from hmt_slam_ros.topology.hypothesis_tree import LeafNotes


def reopened(parent: Parent, leaf: Leaf, newest: int) -> Child:
    """The child that believes one of TLCA's explanations; all areas may be compared again.

    :param leaf: the explanation; of the keyframes that came since TLCA spoke it does not know.
    :param newest: the newest keyframe.
    """
    relabelled = leaf.relabelled
    if leaf.rebase is not None and newest in parent.hybrid_map.keyframes(parent.area):
        pose = se2.compose(leaf.rebase.mean, parent.hybrid_map.keyframes(parent.area)[newest])
        relabelled += (Relabelled(newest, parent.area, leaf.area, pose),)
    return Child(
        parent.hypothesis,
        parent.log_weight + math.log(leaf.probability),
        leaf.area,
        _notes(parent, leaf, {r.keyframe for r in relabelled if r.area == leaf.area}),
        leaf.rebase,
        relabelled,
        leaf.arcs,
        reload=True,
        withdrawn=leaf.withdrawn,
    )


def _notes(parent: Parent, leaf: Leaf, moved: set[int]) -> LeafNotes:
    """Without what was compared; where the robot is in another area now, of the keyframes that it took along."""
    notes = replace(parent.notes, compared={}, astray=None)
    if leaf.area == parent.area:
        return notes
    covariances = {keyframe: covariance for keyframe, covariance in notes.covariances.items() if keyframe in moved}
    return LeafNotes(covariances, unchecked=tuple(keyframe for keyframe in notes.unchecked if keyframe in moved))
