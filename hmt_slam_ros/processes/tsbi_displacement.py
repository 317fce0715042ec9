"""The child of a hypothesis in which the robot was displaced unnoticed, the arcs tell nothing, and it is elsewhere.

Arcs can lie: wheels slip where the scans do not tell, readings are lost, robots are carried. That is rare, but then a
scan contradicts what the hypothesis has the robot see, by as many nats as a place that looks alike would explain it
better; so the odds of it are known (``LeafNotes.displaced``). Such a robot may be anywhere. Where it is found, it goes
on there, and no arc says how it came: the map is not bent, and what was mapped between is left where it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmt_slam_ros.processes.tsbi_branching import Branches, Branching, Parent

# Odds of a displacement from which on the robot is looked for, by hypotheses of at least such a probability, with at
# least so many keyframes.
_ODDS, _PROBABILITY, _KEYFRAMES = 1e-3, 0.05, 3
_NOTHING = 1e-300


def with_displaced(branching: Branching, parent: Parent, keyframes: Sequence[int], branches: Branches) -> Branches:
    """The continuations of a hypothesis, and that in which the robot was displaced, if that is found.

    :param keyframes: the newest of the robot's area.
    :param branches: the other continuations; if it is found, none of them asks again.
    """
    odds, since = parent.notes.displaced
    placed = parent.hybrid_map.keyframes(parent.area)
    late = [keyframe for keyframe in keyframes if keyframe >= since and keyframe in placed]
    if odds < _ODDS or parent.share < _PROBABILITY or len(late) < _KEYFRAMES:
        return branches
    query = branching.query(parent, late)
    fit, skipped = branching.search.anywhere(parent.hybrid_map, parent.area, query, since)
    log_skipped = float(np.logaddexp(branches.log_skipped, parent.log_weight + math.log(odds * skipped + _NOTHING)))
    if fit is None:
        return branches._replace(looked=True, log_skipped=log_skipped)
    sure = replace(parent, notes=replace(parent.notes, doubts={}))
    child = branching.entered(sure, query, fit.area, fit.mode.pose, None, math.log(odds) + fit.log_weight)
    others = [replace(other, notes=replace(other.notes, doubts={})) for other in branches.children]
    return Branches([*others, child], True, log_skipped)
