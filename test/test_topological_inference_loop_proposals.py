"""Closures that are proposed without a prior by the arcs: the surfaces decide about them as about any other."""

import math

import numpy as np
import pytest
from ring_for_tsbi import RING, Run, ring_drive

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.places.landmark_evidence import PlaceEvidence
from hmt_slam_ros.places.loop_proposals import AreaLoop, LoopProposer

SPREAD = np.diag([0.15, 0.15, math.radians(1.5)]) ** 2
# Areas whose position is less certain than this are not looked at, m: none behind the ring.
GATED = with_changes(Configuration(), {"tsbi.prior_limit": 0.5})
LAP, LAST = 96, 120  # keyframes


class Told(LoopProposer):
    """Proposes what the test sets."""

    def __init__(self, loop, configuration, views):
        super().__init__(configuration, views)
        self.loop, self.asked = loop, 0

    def propose(self, _hybrid_map):
        self.asked += 1
        return self.loop


def frame(run, poses, area):
    """The true pose of an area."""
    keyframe, pose = next(iter(run.replica.maps[run.replica.best_hypothesis].keyframes(area).items()))
    return se2.compose(poses[keyframe], se2.inverse(pose))


def twice_into_the_first_corridor(shift, proposing=GATED):
    """Once around and on; from where the ring closes on, a loop with the first area is proposed.

    :param shift: of what is proposed from what is true, m; None for no proposal.
    :param proposing: configuration of who proposes.
    """
    run, poses = Run(RING, configuration=GATED, field_of_view=2 * np.pi, beams=241), ring_drive(LAST)
    for k, pose in enumerate(poses):
        if k == LAP + 4 and shift is not None:
            own = run.replica.robot_areas[run.replica.best_hypothesis]
            true = se2.between(frame(run, poses, own), frame(run, poses, 0))
            loop = AreaLoop(own, 0, PoseGaussian(se2.compose(np.array((*shift, 0.0)), true), SPREAD), own)
            branching = run.tsbi._branching
            branching.landmarks = PlaceEvidence(GATED, run.tsbi._replica.scans)
            branching.landmarks.loops = Told(loop, proposing, branching.landmarks.views)
        run.keyframe(pose, cut=7 if k and k % 14 == 0 else 0)
        if len(run.answers[-1].hypotheses) > 1:
            run.accept(run.replica.best_hypothesis)
    best = run.replica.maps[run.replica.best_hypothesis]
    return run, poses, [(a, b, arc) for a, b, arc in best.all_arcs() if arc.closure]


def test_nobody_proposes_where_nobody_requests_it():
    assert Run(RING).tsbi._branching.landmarks is None


def test_what_is_out_of_reach_by_the_arcs_is_closed_where_it_is_proposed():
    assert not twice_into_the_first_corridor(None)[2]
    run, poses, ((a, b, arc), *_) = twice_into_the_first_corridor((0.0, 0.0))
    off = se2.log(se2.between(arc.pose.mean, se2.between(frame(run, poses, a), frame(run, poses, b))))
    assert math.hypot(off[0], off[1]) < 0.1
    (notice,) = run.notices
    assert "from area 7 to area 7 are those up to area 0" in notice
    assert run.tsbi._branching.landmarks.loops.asked == 1


def test_nothing_is_proposed_where_the_arcs_tell_where_all_areas_are():
    run, _, closures = twice_into_the_first_corridor((0.0, 0.0), Configuration())
    assert run.tsbi._branching.landmarks.loops.asked == 0
    assert not closures


@pytest.mark.parametrize("shift", [(3.0, 0.0), (0.0, 6.0)])
def test_a_proposal_that_is_false_closes_nothing(shift):
    assert not twice_into_the_first_corridor(shift)[2]
