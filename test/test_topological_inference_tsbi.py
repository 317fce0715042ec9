"""TSBI as a process: its answers to cuts and moves, the local maps, evidence and acceptance."""

import math
from dataclasses import replace

import numpy as np
import pytest
from ring_for_tsbi import RING, STEP, Run, ring_drive

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import Arc, AreaPose, StaleBeams
from hmt_slam_ros.messages.messages import AreaEvents, Hypotheses, Hypothesis
from hmt_slam_ros.topological_inference.branching import Branching


def test_without_an_event_the_hypothesis_stays():
    run = Run(RING)
    answer = run.keyframe(np.array([3.0, 1.0, 0.0]))
    assert answer.hypotheses == (answer.hypotheses[0],)
    hypothesis = answer.hypotheses[0]
    assert (hypothesis.id, hypothesis.parent, hypothesis.probability, hypothesis.area, hypothesis.local_areas) == (
        0,
        0,
        1.0,
        0,
        (),
    )


def test_a_cut_in_unknown_ground_makes_a_new_area():
    run = Run(RING)
    poses = ring_drive(8)
    for pose in poses[:-1]:
        run.keyframe(pose)
    (hypothesis,) = run.keyframe(poses[-1], cut=3).hypotheses
    assert (hypothesis.id, hypothesis.area, hypothesis.probability) == (0, 1, 1.0)
    assert [r.keyframe for r in hypothesis.moved_keyframes] == [5, 6, 7]
    assert np.allclose(hypothesis.moved_keyframes[0].pose, 0.0)
    assert np.allclose(hypothesis.moved_keyframes[2].pose, se2.between(poses[5], poses[7]))
    (arc,) = hypothesis.arcs
    assert (arc.source, arc.target, arc.closure) == (0, 1, False)
    assert np.allclose(arc.pose.mean, se2.between(poses[0], poses[5]))
    assert np.allclose(hypothesis.frame_change.mean, se2.between(poses[5], poses[0]))


def test_the_new_arc_has_the_uncertainty_of_the_reference_keyframe_and_the_floor():
    run = Run(RING)
    for pose in ring_drive(7):
        run.keyframe(pose)
    at_reference = run.covariances[0].copy()
    for pose in ring_drive(9)[7:8]:
        run.keyframe(pose)
    (hypothesis,) = run.keyframe(ring_drive(9)[8], cut=3).hypotheses
    floor = np.diag([0.01, 0.01, math.radians(0.2)]) ** 2
    assert np.allclose(hypothesis.arcs[0].pose.covariance, at_reference + floor)


def test_the_local_map_holds_the_area_and_those_that_are_surely_near():
    run = Run(RING)
    for pose in ring_drive(7):
        run.keyframe(pose)
    (hypothesis,) = run.keyframe(ring_drive(8)[7], cut=3).hypotheses
    assert [local.area for local in hypothesis.local_areas] == [1, 0]
    assert np.allclose(hypothesis.local_areas[0].pose, 0.0)
    assert np.allclose(hypothesis.local_areas[1].pose, hypothesis.frame_change.mean)


@pytest.mark.parametrize("mapping", [True, False])
def test_a_move_goes_to_the_known_area_and_no_keyframe_changes(mapping):
    run = Run(RING)
    poses = ring_drive(8)
    for pose in poses[:-1]:
        run.keyframe(pose)
    run.keyframe(poses[-1], cut=3)
    before = run.poses[0]
    (hypothesis,) = run.keyframe(poses[-1], moved=0, mapping=mapping).hypotheses
    assert (hypothesis.id, hypothesis.area, hypothesis.moved_keyframes, hypothesis.arcs) == (0, 0, (), ())
    assert [local.area for local in hypothesis.local_areas] == [0, 1]
    assert np.allclose(se2.compose(hypothesis.frame_change.mean, before), se2.between(poses[0], poses[-1]))


def two_areas(**changed):
    """Areas 0 and 1 along a corridor, the robot in the second; what was accepted may be changed."""
    run = Run(RING)
    for k, pose in enumerate(ring_drive(10)):
        run.keyframe(pose, cut=4 if k == 9 else 0)
    run.accept(0, **changed)
    return run, ring_drive(11)[10]


def test_an_area_becomes_part_of_another_and_the_robot_goes_on_there():
    run, pose = two_areas()
    into = run.replica.maps[0].arc(0, 1)
    before = {k: se2.compose(into.mean, at) for k, at in run.replica.maps[0].keyframes(1).items()}
    (hypothesis,) = run.keyframe(pose, merged=(1, 0)).hypotheses
    assert (hypothesis.id, hypothesis.probability, hypothesis.area, hypothesis.moved_keyframes, hypothesis.arcs) == (
        0,
        1.0,
        0,
        (),
        (),
    )
    assert (hypothesis.area_merge.area, hypothesis.area_merge.into) == (1, 0)
    assert [local.area for local in hypothesis.local_areas] == [0]
    np.testing.assert_allclose(hypothesis.frame_change.mean, into.mean, atol=1e-12)
    np.testing.assert_allclose(hypothesis.area_merge.pose.covariance, into.covariance, atol=1e-12)
    hybrid_map = run.replica.maps[0]
    assert hybrid_map.area_ids() == [0]
    assert list(hybrid_map.all_arcs()) == []
    for keyframe, at in before.items():
        np.testing.assert_allclose(hybrid_map.keyframes(0)[keyframe], at, atol=1e-12)
    # And is then left as any other.
    for further in ring_drive(16)[11:]:
        run.keyframe(further)
    (hypothesis,) = run.keyframe(ring_drive(17)[16], cut=3).hypotheses
    assert (hypothesis.area, hypothesis.arcs[0].source) == (2, 0)


def test_a_robot_that_is_in_neither_of_two_areas_stays_where_it_is():
    run, _ = two_areas()
    for further in ring_drive(20)[10:]:
        run.keyframe(further)
    run.keyframe(ring_drive(21)[20], cut=3)
    (hypothesis,) = run.keyframe(ring_drive(22)[21], merged=(1, 0)).hypotheses
    assert (hypothesis.area, hypothesis.frame_change, hypothesis.area_merge.into) == (2, None, 0)
    assert hypothesis.local_areas[0].area == 2
    assert 1 not in [local.area for local in hypothesis.local_areas]
    assert run.replica.maps[0].neighbors(2) == [0]


def test_areas_whose_surfaces_contradict_each_other_stay_two():
    wrong = PoseGaussian(se2.compose(se2.between(*ring_drive(7)[[0, 6]]), [0.0, 0.6, 0.0]), STEP)
    run, pose = two_areas(arcs=(Arc(0, 1, wrong, closure=True),))
    (hypothesis,) = run.keyframe(pose, merged=(1, 0)).hypotheses
    assert (hypothesis.area, hypothesis.frame_change, hypothesis.area_merge, hypothesis.local_areas) == (
        1,
        None,
        None,
        (),
    )


def test_turning_back_into_tracked_ground_is_no_new_area():
    """The robot goes back along the corridor: the local map tracks it there, so there is nothing to choose."""
    run = Run(RING)
    poses = ring_drive(16)
    for k, pose in enumerate(poses):
        run.keyframe(pose, cut=6 if k == 12 else 0)
    for pose in poses[2:6][::-1]:
        turned = np.array([pose[0], pose[1], math.pi])
        run.keyframe(turned)
    (hypothesis,) = run.keyframe(np.array([*poses[1][:2], math.pi]), cut=5).hypotheses
    assert (hypothesis.area, hypothesis.probability, hypothesis.arcs) == (0, 1.0, ())
    assert {r.area for r in hypothesis.moved_keyframes} == {0}


def test_ground_tracked_by_way_of_another_area_is_joined_by_a_measured_arc():
    """The robot is back in area 0, which the local map holds, but only area 1 has an arc to it."""
    settings = Configuration()
    settings = replace(settings, tsbi=replace(settings.tsbi, local_sigma=0.3))
    run = Run(RING, configuration=settings, field_of_view=2 * np.pi, beams=241)
    poses = ring_drive(20)
    for k, pose in enumerate(poses):
        run.keyframe(pose, cut=4 if k in (8, 14) else 0)
    assert run.replica.maps[0].arc(2, 0) is None
    run.stored = False
    answers = [run.keyframe(np.array([*poses[k][:2], math.pi])) for k in (14, 8, 2, 2, 2)]
    (arc,) = [arc for answer in answers for hypothesis in answer.hypotheses for arc in hypothesis.arcs]
    assert (arc.source, arc.target, arc.closure) == (2, 0, True)
    reference = min(run.replica.maps[0].keyframes(2))
    assert np.allclose(arc.pose.mean, se2.between(poses[reference], poses[0]), atol=0.03)
    assert np.sqrt(arc.pose.covariance[1, 1]) < 0.2
    assert answers[-1].hypotheses[0].probability == 1.0


def ring_with_two_hypotheses(apart=1.0):
    """Two live hypotheses that have the robot ``apart``, m, as TSBI would have made them."""
    run = Run(RING)
    run.keyframe(np.array([3.0, 1.0, 0.0]))
    split_in_two(run, np.array([apart, 0.0, 0.0]))
    return run


def split_in_two(run, apart):
    """Hypothesis 1 at the robot's pose, hypothesis 2 at the pose ``apart`` from there."""
    split = Hypotheses(len(run.answers) - 1, (Hypothesis(1, 0, 0.6, 0), Hypothesis(2, 0, 0.4, 0)))
    for replica in (run.replica, run.tsbi._replica):
        replica.apply_hypotheses(split)
    states = dict.fromkeys((1, 2), run.tsbi.state.hypothesis_states[0])
    run.tsbi._state = replace(run.tsbi._state, hypothesis_states=states)
    run.poses = {1: run.poses[0], 2: se2.compose(run.poses[0], apart)}
    run.covariances = {1: STEP, 2: STEP}


def test_the_evidence_of_the_scans_shifts_the_weights():
    run = ring_with_two_hypotheses()
    first, second = sorted(run.poses)
    before = dict(run.replica.probabilities)
    run.evidence = {first: 0.0, second: 1.5}
    answer = run.keyframe(run.true_pose)
    after = {hypothesis.id: hypothesis.probability for hypothesis in answer.hypotheses}
    assert after[second] / after[first] == pytest.approx(math.exp(1.5) * before[second] / before[first])


def test_hypotheses_that_are_equivalent_become_one_with_the_weight_of_both():
    run = ring_with_two_hypotheses(apart=0.2)
    run.evidence = {1: 0.0, 2: 1.5}
    (hypothesis,) = run.keyframe(run.true_pose).hypotheses
    assert hypothesis.id == 2
    assert hypothesis.probability == pytest.approx(1.0)


def odds_after_return(keyframes, apart):
    """p(hypothesis 1) / p(hypothesis 2), which is ``apart`` from it, of a robot that is back after so many keyframes,
    relative to what it was before.
    """
    run, poses = Run(RING), ring_drive(keyframes)
    for pose in poses:
        run.keyframe(pose)
    run.keyframe(poses[4])
    split_in_two(run, np.array(apart))
    first, second = (hypothesis.probability for hypothesis in run.keyframe(poses[5]).hypotheses)
    return first / second / 1.5


def test_a_scan_is_evidence_for_or_against_known_ground():
    in_the_wall, in_new_ground = odds_after_return(60, [0.0, 0.8, 0.0]), odds_after_return(60, [50.0, 0.0, 0.0])
    assert 1.05 < in_new_ground < 2.0
    assert in_the_wall > 2.0 * in_new_ground


def test_recent_keyframes_are_no_known_ground():
    assert odds_after_return(12, [50.0, 0.0, 0.0]) == pytest.approx(1.0)


def test_what_was_computed_from_scans_is_dropped_where_beams_are_stale_and_kept_otherwise(monkeypatch):
    dropped = []
    monkeypatch.setattr(Branching, "forget_scans", lambda _: dropped.append(len(run.answers)))
    run, poses = Run(RING), ring_drive(4)
    run.keyframe(poses[0])
    run.keyframe(poses[1])
    run.stale_beams = (StaleBeams(0, np.array([3, 4]), np.zeros(0, dtype=np.int64), np.zeros(0)),)
    run.keyframe(poses[2])
    run.stale_beams = ()
    run.keyframe(poses[3])
    assert dropped == [2]


def test_acceptance_leaves_one_hypothesis():
    run = ring_with_two_hypotheses()
    run.accept(2)
    (hypothesis,) = run.keyframe(run.true_pose).hypotheses
    assert (hypothesis.id, hypothesis.parent, hypothesis.probability) == (2, 2, 1.0)


def test_the_local_map_takes_the_poses_of_the_global_map_where_they_agree():
    run = Run(RING)
    poses = ring_drive(8)
    for pose in poses[:-1]:
        run.keyframe(pose)
    run.keyframe(poses[-1], cut=3)
    nudge = np.array([0.004, -0.003, 0.001])
    placed = se2.compose(se2.between(poses[0], poses[5]), nudge)
    certain = 1e-6 * np.eye(3)
    run.accept(
        0, global_poses=(AreaPose(0, PoseGaussian(np.zeros(3), certain)), AreaPose(1, PoseGaussian(placed, certain)))
    )
    (hypothesis,) = run.keyframe(poses[-1], moved=0).hypotheses
    assert np.allclose(hypothesis.local_areas[1].pose, placed)


def test_events_of_another_keyframe_are_refused():
    run = Run(RING)
    run.keyframe(np.array([3.0, 1.0, 0.0]))
    with pytest.raises(HmtSlamError, match="area events 5 came, but the last keyframe is 0: a message was lost"):
        run.tsbi.handle(AreaEvents(5, ()))
    with pytest.raises(HmtSlamError, match="area events 0 came, but the last keyframe is none: a message was lost"):
        Run(RING).tsbi.handle(AreaEvents(0, ()))
