"""Topological Loop Closure Acceptance: which path becomes definite, and when."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from play_for_tlca import HOME, SPREAD, WORLD, Play, belief, new_area, poses_of

from hmt_slam_ros.loop_closure.tlca import Tlca
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.messages import AreaEvents, Hypothesis


def test_the_first_area_lies_at_the_origin_of_the_map_with_hardly_any_uncertainty():
    verdict = Play().start()
    assert verdict.hypothesis == 0
    assert list(poses_of(verdict)) == [0]
    np.testing.assert_array_equal(poses_of(verdict)[0].mean, np.zeros(3))
    assert 0.0 < np.trace(poses_of(verdict)[0].covariance) < 1e-6


def test_without_changes_no_poses_are_published():
    play = Play()
    play.start()
    verdict = play.step(places=[(0, 0, [0.5, 0.0, 0.0])])
    assert verdict.hypothesis is None
    assert verdict.arcs == verdict.moved_keyframes == verdict.global_poses == ()


def test_the_one_hypothesis_left_is_accepted_at_once_and_its_new_area_is_placed():
    play = Play()
    play.start()
    verdict = play.step(new_area(0, 0, 1.0, 1, [4.0, 0.0, 0.5]))
    assert verdict.hypothesis == 0
    np.testing.assert_allclose(poses_of(verdict)[1].mean, [4.0, 0.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(poses_of(verdict)[1].covariance, SPREAD, atol=1e-9)


def branch(play, dominant=0.95):
    play.start()
    return play.step(new_area(1, 0, dominant, 1, [4.0, 0.0, 0.5]), new_area(2, 0, 1.0 - dominant, 1, [4.0, 1.0, 0.5]))


def both(dominant=0.95):
    return Hypothesis(1, 1, dominant, 1), Hypothesis(2, 2, 1.0 - dominant, 1)


def test_a_dominant_path_is_accepted_after_enough_keyframes_since_the_paths_parted():
    play = Play(accept_distance=0.0)
    assert branch(play).hypothesis is None
    assert [play.step(*both()).hypothesis for _ in range(2)] == [None, 1]


def test_a_dominant_path_is_accepted_after_enough_meters_since_the_paths_parted():
    play = Play(accept_keyframes=1, accept_distance=2.0)
    assert branch(play).hypothesis is None  # parted at 0.5 m
    assert [play.step(*both(), travelled=t).hypothesis for t in (1.0, 2.4, 2.5)] == [None, None, 1]


def test_the_first_hypothesis_has_its_meters_from_the_start():
    play = Play(accept_keyframes=1, accept_distance=2.0)
    play.start()
    hypotheses = Hypothesis(0, 0, 0.95, 0), Hypothesis(2, 0, 0.05, 0)
    assert play.step(*hypotheses, travelled=1.5).hypothesis is None
    both = Hypothesis(0, 0, 0.95, 0), Hypothesis(2, 2, 0.05, 0)
    assert [play.step(*both, travelled=t).hypothesis for t in (1.9, 2.0)] == [None, 0]


def test_keyframes_count_only_in_a_row():
    play = Play(accept_distance=0.0)
    branch(play)
    verdicts = [play.step(*both(p)).hypothesis for p in (0.95, 0.5, 0.95, 0.95, 0.95)]
    assert verdicts == [None, None, None, None, 1]


def test_an_undecided_question_stays_open():
    play = Play()
    branch(play, 0.6)
    assert all(play.step(*both(0.6)).hypothesis is None for _ in range(10))


def test_branching_again_starts_the_count_again():
    play = Play(accept_distance=0.0)
    branch(play)
    play.step(*both())
    again = (
        new_area(3, 1, 0.92, 2, [3.0, 0.0, 0.0], source=1),
        new_area(4, 1, 0.06, 2, [3.0, 1.0, 0.0], source=1),
        Hypothesis(2, 2, 0.02, 1),
    )
    rest = (Hypothesis(3, 3, 0.92, 2), Hypothesis(4, 4, 0.06, 2), Hypothesis(2, 2, 0.02, 1))
    assert [play.step(*hypotheses).hypothesis for hypotheses in (again, rest, rest)] == [None, None, 3]


def test_after_acceptance_only_the_accepted_hypothesis_goes_on():
    play = Play(accept_distance=0.0)
    branch(play)
    while play.step(*both()).hypothesis is None:
        pass
    verdict = play.step(Hypothesis(1, 1, 1.0, 1))
    assert verdict.hypothesis is None
    assert list(play.process._replica.maps) == [1]


def test_global_poses_follow_the_most_probable_hypothesis():
    play = Play()
    verdict = branch(play, 0.6)
    np.testing.assert_allclose(poses_of(verdict)[1].mean, [4.0, 0.0, 0.5], atol=1e-9)
    assert play.step(*both(0.6)).global_poses == ()
    verdict = play.step(*both(0.4))
    np.testing.assert_allclose(poses_of(verdict)[1].mean, [4.0, 1.0, 0.5], atol=1e-9)


def test_messages_of_others_are_ignored():
    play = Play()
    play.start()
    assert play.process.handle(AreaEvents(0, ())) == []
    assert play.process.handle(worlds.scan_at(WORLD, HOME)) == []


@pytest.mark.parametrize("unexamined", [0.0, 0.4])
def test_a_single_hypothesis_is_accepted_whatever_was_not_examined(unexamined):
    play = Play()
    play.start()
    assert play.step(new_area(0, 0, 1.0 - unexamined, 1, [4.0, 0.0, 0.0])).hypothesis == 0


def test_the_ambiguity_comes_where_hypotheses_change_and_every_two_meters():
    play = Play(accept_distance=10.0)
    branch(play, 0.6)  # at 0.5 m
    assert [found.sequence for found in play.ambiguities] == [1]
    assert play.ambiguities[0].entropy == pytest.approx(0.673, abs=0.001)
    assert "0.60 in area 1, 0.40 in area 1" in play.ambiguities[0].text
    for travelled in (1.0, 1.9, 2.1, 3.9):
        play.step(*both(0.6), travelled=travelled)
    assert [found.sequence for found in play.ambiguities] == [1, 4]
    play.step(*both(0.4), travelled=3.95)  # the other one is the most probable now
    assert [found.sequence for found in play.ambiguities] == [1, 4, 6]


def test_an_empty_ambiguity_comes_once_where_one_hypothesis_is_left():
    play = Play(accept_distance=0.0)
    branch(play)
    for _ in range(4):
        play.step(*both()) if len(play.process._replica.maps) > 1 else play.step(Hypothesis(1, 1, 1.0, 1))
    assert [(found.sequence, found.is_open) for found in play.ambiguities] == [(1, True), (3, False)]
    assert play.ambiguities[-1].looks == ()


def test_it_goes_on_with_the_same_ambiguities_from_its_state():
    play, again = Play(accept_distance=10.0), Play(accept_distance=10.0)
    branch(play, 0.6)
    again.process, again.k = Tlca(play.configuration, play.process.state), play.k
    for one in (play, again):
        one.step(*both(0.6), travelled=2.5)
    assert encode(play.ambiguities[-1]) == encode(again.ambiguities[-1])


FAR = belief([30.0, 0.0, 0.0], np.diag([3.0, 3.0, 0.2]) ** 2)


def close_loops(play, weak):
    """Areas 0 to 4 in a row, of vague distances; the robot comes from 4 into 0 again, and one path also joins 2 and 4.

    :param weak: probability of the path without that.
    """
    play.start()
    for area in range(1, 5):
        arc = Arc(area - 1, area, FAR)
        play.step(Hypothesis(0, 0, 1.0, area, belief(-FAR.mean), (), (arc,)))
    closing, further = (
        Arc(4, 0, belief([1.0, 0.0, 0.0]), closure=True),
        Arc(2, 4, belief([60.0, 0.0, 0.0]), closure=True),
    )
    weaker = Hypothesis(1, 0, weak, 0, belief([-1.0, 0.0, 0.0]), (), (closing,))
    return play.step(weaker, replace(weaker, id=2, probability=1.0 - weak, arcs=(closing, further)))


def test_a_path_is_accepted_with_those_that_close_more_loops_far_from_the_robot():
    play = Play(accept_distance=0.0)
    assert close_loops(play, 0.2).hypothesis is None
    both = Hypothesis(1, 1, 0.2, 0), Hypothesis(2, 2, 0.8, 0)
    verdicts = [play.step(*both) for _ in range(2)]
    assert [verdict.hypothesis for verdict in verdicts] == [None, 1]
    assert play.process.supports == {1: pytest.approx(1.0), 2: pytest.approx(0.8)}
    assert {(arc.source, arc.target) for arc in verdicts[-1].arcs if arc.closure} == {(4, 0)}


def test_a_path_that_closes_more_loops_and_dominates_is_accepted_by_itself():
    play = Play(accept_distance=0.0)
    close_loops(play, 0.05)
    both = Hypothesis(1, 1, 0.05, 0), Hypothesis(2, 2, 0.95, 0)
    assert [play.step(*both).hypothesis for _ in range(2)] == [None, 2]
