"""The child of a hypothesis in which the robot was displaced unnoticed: it may be anywhere, as one that woke up.

Arcs can lie: wheels slip where the scans do not tell, readings are lost, robots are carried. That is rare, but then the
scans contradict what the hypothesis has the robot see, by as many nats as a place that looks alike would explain them
better; so the odds of it are known (``LeafNotes.displaced``). The keyframes since then begin a new area, to which an
arc leads that tells nothing, and what follows is as for any robot of which nobody knows how it came there
(``tsbi_awakening``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.tsbi_awakening import UNKNOWN, credit_of, sighted_in
from hmt_slam_ros.processes.tsbi_branching import Branches, Branching, Child, Parent
from hmt_slam_ros.topology.hypothesis_tree import Spot
from hmt_slam_ros.topology.unknown import unknown

# Log-odds of a displacement from which on it is a hypothesis, of hypotheses of at least such a probability, with at
# least so many keyframes.
_LOG_ODDS, _PROBABILITY, _KEYFRAMES = math.log(3e-5), 0.05, 3


def with_displaced(branching: Branching, parent: Parent) -> Branches | None:
    """To go on, or to have been displaced; None where that is not probable enough to be asked."""
    log_odds, since = parent.notes.displaced
    late = _since(parent, since)
    if log_odds < _LOG_ODDS or parent.share < _PROBABILITY or len(late) < _KEYFRAMES:
        return None
    child = _displaced(branching, parent, late, log_odds)
    noted = replace(parent.notes, doubts={})
    return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, noted), child], True)


def displaced_or_not(parent: Parent, event: int) -> Child:
    """To go on, or, where that is less probable, to be lost: no keyframe is stored that could tell which.

    :param event: the newest; metric SLAM arrives at the next one then.
    """
    lost = event + 1 if parent.notes.displaced[0] > 0.0 else None
    notes = parent.notes if lost is None else replace(parent.notes, doubts={}, lost=lost)
    return Child(parent.hypothesis, parent.log_weight, parent.area, notes)


def _since(parent: Parent, event: int) -> list[int]:
    """The keyframes of the robot's area since an event; an area is not left without any."""
    return sorted(k for k in parent.hybrid_map.keyframes(parent.area) if k >= event)[
        0 if min(parent.hybrid_map.keyframes(parent.area), default=0) < event else 1 :
    ]


def _displaced(branching: Branching, parent: Parent, keyframes: Sequence[int], log_odds: float) -> Child:
    """The robot was displaced before the first of some keyframes of its area, which are a new one."""
    query = branching.query(parent, keyframes)
    where = branching.everywhere(parent, query.poses, keyframes[0])
    where = where.with_unmapped(UNKNOWN)
    claim = Spot(parent.area, keyframes[0], query.belief.mean)
    credit = credit_of(parent.hybrid_map, where, claim, query.poses)
    origin = PoseGaussian.exactly(np.zeros(3))
    area = branching.new_area(parent, query)
    child = branching.entered(parent, query, area, origin, unknown(query.belief.mean), log_odds + credit)
    sighted = sighted_in(where, query.poses)
    notes = replace(child.notes, doubts={}, lost=keyframes[0], claim=claim, credit=credit, sighted=sighted)
    return replace(child, notes=notes)
