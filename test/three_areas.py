"""Three keyframe events: the robot enters two new areas, and the last may have closed a loop to the first, or not."""

import numpy as np
from worlds import scan_in, two_rooms

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import Arc, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypotheses, Hypothesis, HypothesisEstimate, Keyframe
from hmt_slam_ros.registration.consistency import Clutter

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND + 250_000_000
STEP = np.array([1.0, 0.0, 0.5])
SPREAD = np.diag([0.02, 0.02, 0.01]) ** 2


def belief(pose):
    return PoseGaussian(np.asarray(pose, dtype=np.float64), SPREAD)


def keyframe(number, area, pose):
    scan = scan_in(two_rooms(), (2.0 + 0.5 * number, 3.0, 0.0), START + number * SECOND)
    return Keyframe(
        number, scan, 1.0 * number, (HypothesisEstimate(0, area, belief(pose), True, 0.0, 0.0, Clutter(), 12.0),)
    )


def new_area(hypothesis, probability, number, *arcs):
    """The hypothesis under which the robot enters the area of a number with the keyframe of that number."""
    source = number - 1
    back = belief(STEP).inverse()
    moved = (MovedKeyframe(number, source, number, np.zeros(3)),)
    return Hypothesis(hypothesis, 0, probability, number, back, moved, (Arc(source, number, belief(STEP)), *arcs))


def chain():
    """The messages, in the order of the chain."""
    closure = Arc(0, 2, belief([1.8, 0.6, 1.0]), closure=True)
    return [
        keyframe(0, 0, np.zeros(3)),
        Hypotheses(0, (Hypothesis(0, 0, 1.0, 0),)),
        keyframe(1, 0, STEP),
        Hypotheses(1, (new_area(0, 1.0, 1),)),
        keyframe(2, 1, STEP),
        Hypotheses(2, (new_area(1, 0.75, 2, closure), new_area(2, 0.2, 2)), unexamined=0.05),
    ]
