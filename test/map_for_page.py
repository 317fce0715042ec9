"""A map of a ring of areas for tests of the page: one hypothesis closes it, another one does not."""

import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.alternatives import Alternative, AlternativeArea, Alternatives
from hmt_slam_ros.messages.evidence import BranchStep, Evidence, HypothesisEvidence
from hmt_slam_ros.messages.map_changes import ArcEnds
from hmt_slam_ros.messages.statements import PlaceStatement, WeighedStatement
from hmt_slam_ros.messages.topology import Topology, TopologyArc, TopologyArea, TopologyHypothesis

SECOND = 1_000_000_000
SPREAD = np.diag([0.05, 0.03, 0.02]) ** 2
DRIFT = np.array([0.05, 0.02, 0.04])  # of an area in the map that does not close
BEST, OTHER = 7, 12


def belief(pose):
    return PoseGaussian(np.asarray(pose, dtype=np.float64), SPREAD)


def ring_pose(number, count):
    angle = 2.0 * np.pi * number / count
    return np.array([10.0 * np.cos(angle), 10.0 * np.sin(angle), angle])


def topology(count=6, keyframes=4, probability=0.9, events=None):
    """A ring of areas; hypothesis ``BEST`` has the closure of the last with the first, ``OTHER`` has not.

    :param keyframes: of each area.
    """
    poses = [ring_pose(number, count) for number in range(count)]
    local = tuple(np.array([0.0, 0.5 * k, 0.5 * np.pi]) for k in range(keyframes))
    areas = tuple(
        TopologyArea(
            number,
            belief(pose),
            tuple(range(number * keyframes, (number + 1) * keyframes)),
            tuple((1000 + number * keyframes + k) * SECOND for k in range(keyframes)),
            local,
        )
        for number, pose in enumerate(poses)
    )
    arcs = [TopologyArc(n, n + 1, belief(se2.between(poses[n], poses[n + 1])), False, 1.0) for n in range(count - 1)]
    arcs.append(TopologyArc(0, count - 1, belief(se2.between(poses[0], poses[-1])), True, probability))
    hypotheses = (
        TopologyHypothesis(BEST, probability, count - 1),
        TopologyHypothesis(OTHER, 1.0 - probability, count - 1),
    )
    events = count * keyframes if events is None else events
    stated = PlaceStatement("same", 0, count - 1, "ann")
    statements = (WeighedStatement(1, 20, stated, 0, keyframes * (count - 1), 0.97, "true"),)
    stamp = (1000 + events) * SECOND
    return Topology(events, stamp, "map", hypotheses, 0.0, count - 1, local[-1], areas, tuple(arcs), statements)


def alternatives(count=6):
    """The map of ``OTHER``, which drifts."""
    pose, areas = ring_pose(0, count), []
    for number in range(count):
        areas.append(AlternativeArea(number, pose))
        step = se2.between(ring_pose(number, count), ring_pose(number + 1, count))
        pose = se2.compose(se2.compose(pose, step), DRIFT)
    one = Alternative(OTHER, count - 1, np.array([0.0, 1.5, 0.5 * np.pi]), tuple(areas), (), (ArcEnds(0, count - 1),))
    return Alternatives(24, BEST, (one,))


def evidence(count=6):
    closure = BranchStep(20, "closure", count - 1, 0, 0.6, 0.03, 12.4, 0.8)
    new = BranchStep(20, "new_area", count - 1, None, 0.4)
    return Evidence(20, (HypothesisEvidence(BEST, (closure,)), HypothesisEvidence(OTHER, (new,))))


def history(events, best=0.9):
    """Entries of the history, whose last has both hypotheses."""
    return [
        {
            "event": event,
            "time": 1000.0 + event,
            "path_length": 0.5 * event,
            "hypotheses": [[BEST, 5, best, False], [OTHER, 5, round(1.0 - best, 3), False]],
            "live": 2,
        }
        for event in range(events)
    ]
