"""Topological Loop Closure Acceptance: closures are aligned, spread over loops, revised on contradiction."""

from dataclasses import replace

import numpy as np
import worlds
from play_for_tlca import SPREAD, Play, belief, new_area, poses_of

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.map_changes import Arc, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis

ROOM_A = worlds.drive((1.0, 2.0), (4.5, 3.0), (4.0, 5.0))
ROOM_B = worlds.drive((7.0, 3.0), (10.0, 4.0))


def closing_play(error, spread=SPREAD, refinement=0):
    """Drive room A (area 0) and room B (area 1), come back into A and close the loop with an error in its frame."""
    play = Play(refinement)
    for pose in ROOM_A:
        play.step(places=[(0, 0, se2.between(ROOM_A[0], pose))], world=pose)
    a_T_b = se2.between(ROOM_A[0], ROOM_B[0])
    first = play.k + 1
    for i, pose in enumerate(ROOM_B):
        area, where = (0, se2.between(ROOM_A[0], pose)) if i == 0 else (1, se2.between(ROOM_B[0], pose))
        moved = MovedKeyframe(first, 0, 1, np.zeros(3))
        hypothesis = (
            Hypothesis(0, 0, 1.0, 1, belief(se2.inverse(a_T_b)), (moved,), (Arc(0, 1, belief(a_T_b)),))
            if i == 0
            else Hypothesis(0, 0, 1.0, 1)
        )
        play.step(hypothesis, places=[(0, area, where)], world=pose)
    back = worlds.drive((3.5, 2.0), (2.0, 3.5))
    first = play.k + 1
    for pose in back[:-1]:
        play.step(Hypothesis(0, 0, 1.0, 1), places=[(0, 1, se2.between(ROOM_B[0], pose))], world=pose)
    in_b, in_a = se2.between(ROOM_B[0], back), se2.compose(error, se2.between(ROOM_A[0], back))
    b_T_a = se2.compose(in_b[0], se2.inverse(in_a[0]))
    moved = tuple(MovedKeyframe(first + i, 1, 0, pose) for i, pose in enumerate(in_a))
    hypothesis = Hypothesis(0, 0, 1.0, 0, belief(se2.inverse(b_T_a)), moved, (Arc(1, 0, belief(b_T_a, spread), True),))
    verdict = play.step(hypothesis, places=[(0, 1, in_b[-1])], world=back[-1])
    return play, verdict, first, se2.between(ROOM_A[0], back), a_T_b


def test_keyframes_that_closed_a_loop_are_finely_aligned_with_the_area_and_the_arc_with_them():
    error = np.array([0.1, -0.08, 0.02])
    play, verdict, first, truth, a_T_b = closing_play(error)
    assert [r.keyframe for r in verdict.moved_keyframes] == list(range(first, first + len(truth)))
    for r, true in zip(verdict.moved_keyframes, truth, strict=True):
        assert (r.previous_area, r.area) == (0, 0)
        assert np.hypot(*(r.pose[:2] - true[:2])) < 0.03
        np.testing.assert_array_equal(play.process._replica.maps[0].keyframes(0)[r.keyframe], r.pose)
    off = se2.between(a_T_b, play.arc(0, 1).mean)
    assert np.hypot(*off[:2]) < 0.04
    assert abs(np.degrees(off[2])) < 0.3
    assert play.notices == []


def test_after_an_acceptance_the_keyframes_of_both_areas_are_refined_jointly_and_their_arc_with_them():
    play, verdict, first, truth, a_T_b = closing_play(np.array([0.1, -0.08, 0.02]), refinement=4)
    placed = play.process._replica.maps[0]
    assert {r.keyframe for r in verdict.moved_keyframes} == {*placed.keyframes(0), *placed.keyframes(1)}
    assert all(r.previous_area == r.area for r in verdict.moved_keyframes)
    for i, true in enumerate(truth):
        assert np.hypot(*(placed.keyframes(0)[first + i][:2] - true[:2])) < 0.02
    off = se2.between(a_T_b, play.arc(0, 1).mean)
    assert np.hypot(*off[:2]) < 0.03


def test_an_arc_found_between_areas_that_keep_their_keyframes_is_finely_aligned():
    play = Play()
    for pose in ROOM_A:
        play.step(places=[(0, 0, se2.between(ROOM_A[0], pose))], world=pose)
    play.step(new_area(0, 0, 1.0, 1, [6.0, 0.0, 0.0]), world=ROOM_B[0])
    # Area 2 is taken for new ground, though it lies in the first room.
    again = worlds.drive((3.5, 2.0), (2.0, 3.5))
    play.step(new_area(0, 0, 1.0, 2, [0.0, 6.0, 0.0], source=1), world=again[0])
    for pose in again[1:]:
        play.step(Hypothesis(0, 0, 1.0, 2), places=[(0, 2, se2.between(again[0], pose))], world=pose)
    truth = se2.between(again[0], ROOM_A[0])
    found = belief(se2.compose(truth, [0.1, -0.1, 0.02]))
    verdict = play.step(Hypothesis(0, 0, 1.0, 2, None, (), (Arc(2, 0, found, True),)), places=[])
    assert verdict.moved_keyframes == ()
    (arc,) = verdict.arcs
    assert arc.closure
    off = se2.between(truth, play.arc(2, 0).mean)
    assert np.hypot(*off[:2]) < 0.03
    assert abs(np.degrees(off[2])) < 0.3


def test_a_closure_with_a_large_certainty_is_not_moved_beyond_its_gate():
    error = np.array([0.2, -0.15, 0.0])
    _, verdict, *_ = closing_play(error, np.diag([0.01**2, 0.01**2, 0.005**2]))
    assert verdict.moved_keyframes == ()


def test_a_loop_is_spread_over_its_arcs_or_left_open_as_requested():
    quarter = np.radians(88.0)
    step = [2.0, 0.0, quarter]

    def close_ring(**changes):
        play = Play(**changes)
        play.start()
        for area in (1, 2, 3):
            play.step(new_area(0, 0, 1.0, area, step, source=area - 1))
        closing = Hypothesis(0, 0, 1.0, 0, belief(se2.inverse(step)), (), (Arc(3, 0, belief(step)),))
        verdict = play.step(closing)
        poses = np.array([poses_of(verdict)[area].mean for area in (0, 1, 2, 3, 0)])
        return play, np.degrees(se2.between(poses[:-1], poses[1:])[:, 2])

    play, turns = close_ring()
    np.testing.assert_allclose(turns, 90.0, atol=1e-6)
    tree = np.array([play.process.shortest_path_poses()[area].mean for area in (0, 1, 2, 3, 0)])
    _, turns = close_ring(global_map="shortest_path")
    np.testing.assert_allclose(turns, np.degrees(se2.between(tree[:-1], tree[1:])[:, 2]), atol=1e-9)
    assert np.ptp(turns) > 5.0


def test_an_arc_that_refuses_to_fit_is_reported_once():
    play = Play()
    play.start()
    for area in (1, 2, 3):
        play.step(new_area(0, 0, 1.0, area, [2.0, 0.0, np.pi / 2], source=area - 1))
    play.step(Hypothesis(0, 0, 1.0, 0, belief(np.zeros(3)), (), (Arc(3, 0, belief([9.0, 0.0, 0.0])),)))
    assert len(play.notices) >= 1
    assert "between areas" in play.notices[0].text
    reported = {notice.text.split(" misses")[0] for notice in play.notices}
    play.step(new_area(0, 0, 1.0, 4, [2.0, 0.0, 0.0]))
    assert len(reported) == len(play.notices)


def test_the_same_messages_give_the_same_verdicts():
    one, two = (closing_play(np.array([0.1, -0.08, 0.02]))[1] for _ in range(2))
    for a, b in zip(one.global_poses, two.global_poses, strict=True):
        np.testing.assert_array_equal(a.pose.mean, b.pose.mean)
        np.testing.assert_array_equal(a.pose.covariance, b.pose.covariance)
    assert [tuple(r.pose) for r in one.moved_keyframes] == [tuple(r.pose) for r in two.moved_keyframes]


STRETCH = [4.0, 0.0, 0.0]


def two_loops(play, false_closure):
    """Areas 0 to 4 along a way, two loops closed from the last, after a false one from area 2 or without."""
    play.start()
    for area in (1, 2):
        play.step(new_area(0, 0, 1.0, area, STRETCH, source=area - 1))
    if false_closure:
        found = belief([-8.0 + 0.35, 0.0, 0.0], 0.01 * SPREAD)
        assert play.step(Hypothesis(0, 0, 1.0, 2, None, (), (Arc(2, 0, found, True),))).hypothesis == 0
    for area in (3, 4):
        play.step(new_area(0, 0, 1.0, area, STRETCH, source=area - 1))
    true = Arc(4, 0, belief([-16.0, 0.0, 0.0], 0.01 * SPREAD), True)
    other = Arc(4, 2, belief([-8.0, 0.0, 0.0], 0.01 * SPREAD), True)
    play.step(Hypothesis(0, 0, 1.0, 4, None, (), (true,)))
    return play.step(Hypothesis(0, 0, 1.0, 4, None, (), (other,)))


def test_a_contradiction_is_sent_to_tsbi_and_the_map_is_not_bent_by_it():
    play = Play(arc_sigma_floor=1e-4, arc_angle_floor=1e-3)
    before = two_loops(play, false_closure=True)
    assert before.hypothesis == 0
    assert before.global_poses == ()
    best = before.revised_hypotheses[0]
    assert [(ends.source, ends.target) for ends in best.removed_arcs] == [(0, 2)]
    assert "of all closures 2-0 is taken for false" in play.notices[-1].text
    verdict = play.step(replace(best, probability=1.0))
    assert verdict.hypothesis == 0
    assert verdict.revised_hypotheses == ()
    assert play.arc(0, 2) is None
    truth = Play(arc_sigma_floor=1e-4, arc_angle_floor=1e-3)
    last = two_loops(truth, false_closure=False)
    assert last.revised_hypotheses == ()
    for area, pose in poses_of(last).items():
        np.testing.assert_allclose(poses_of(verdict)[area].mean, pose.mean, atol=1e-6)
        np.testing.assert_allclose(poses_of(verdict)[area].covariance, pose.covariance, atol=1e-8)


def test_a_question_that_is_open_again_is_closed_as_any_other():
    play = Play(arc_sigma_floor=1e-4, arc_angle_floor=1e-3, accept_distance=0.0, accept_probability=0.98)
    best, second, *_ = two_loops(play, false_closure=True).revised_hypotheses
    assert [(ends.source, ends.target) for ends in second.removed_arcs] == [(0, 4)]
    hypotheses = replace(best, id=1, probability=0.99), replace(second, id=2, probability=0.01)
    assert play.step(*hypotheses).hypothesis is None
    both = Hypothesis(1, 1, 0.99, 4), Hypothesis(2, 2, 0.01, 4)
    assert [play.step(*both).hypothesis for _ in range(2)] == [None, 1]
    assert play.arc(0, 2, 1) is None
