"""TSBI's answers to area events beside the hypotheses: what is pruned, and the localization status."""

import numpy as np
import pytest
from ring_for_tsbi import RING, Run, ring_drive
from test_topological_inference_tsbi import ring_with_two_hypotheses

from hmt_slam_ros.messages.map_changes import PrunedKeyframe, StaleBeams
from hmt_slam_ros.messages.messages import AreaEvents, Hypothesis
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution
from hmt_slam_ros.topological_inference.tsbi import Tsbi


@pytest.mark.parametrize("revised", [False, True])
def test_keyframes_are_pruned_and_beams_dropped_unless_a_revision_may_move_them(revised):
    run, poses = Run(RING), ring_drive(9)
    for k, pose in enumerate(poses[:8]):
        run.keyframe(pose, cut=3 if k == 7 else 0)
    if revised:
        run.accept(0, revised_hypotheses=(Hypothesis(0, 0, 1.0, 1), Hypothesis(0, 0, 0.5, 1)))
    run.stale_beams = (StaleBeams(0, np.array([3, 4]), np.zeros(0, dtype=np.int64), np.zeros(0)),)
    pruned = (PrunedKeyframe(2, 0),)
    run._answer = lambda sequence, _events: run.tsbi.handle(AreaEvents(sequence, (), pruned))
    (answer,) = run.keyframe(poses[8])
    assert answer.pruned_keyframes == (() if revised else pruned)
    assert answer.stale_beams == (() if revised else run.stale_beams)
    assert run.tsbi.state.revised_hypotheses == ()


def test_the_localization_status_is_that_of_the_newest_search(monkeypatch):
    """Of two hypotheses the second finds a distribution; when none does, the last one holds."""
    run, found = ring_with_two_hypotheses(), []
    branch = Tsbi._branch

    def with_distribution(tsbi, parent, event, keyframe):
        return branch(tsbi, parent, event, keyframe)._replace(pose_distribution=found.pop(0))

    monkeypatch.setattr(Tsbi, "_branch", with_distribution)
    first, second = (PoseDistribution((), np.zeros(0)) for _ in range(2))
    for distributions, expected in (((None, first), first), ((None, None), first), ((second, None), second)):
        found[:] = distributions
        run.keyframe(run.true_pose)
        assert run.tsbi._pose_distribution is expected


@pytest.mark.parametrize(("apart", "localized"), [(0.7, True), (5.0, False)])
def test_a_robot_that_two_hypotheses_have_in_two_places_is_not_localized(apart, localized):
    run = ring_with_two_hypotheses(apart)
    assert not run.tsbi.localization.localized  # as after a restart
    run.keyframe(run.true_pose)
    assert run.tsbi.localization.localized == localized
    run.accept(2)
    assert run.tsbi.localization.localized
