"""Topological Loop Closure Acceptance: what becomes of an arc that is observed again."""

import numpy as np
from play_for_tlca import SPREAD, Play, belief, new_area, poses_of

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import fuse
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative, uninformative_belief
from hmt_slam_ros.messages.map_changes import Arc, AreaMerge, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis


def revisit(pose, area=1, source=0, closure=False):
    """The only hypothesis goes over the arc again and observes it at ``pose``."""
    return Hypothesis(0, 0, 1.0, area, belief(se2.inverse(pose)), (), (Arc(source, area, belief(pose), closure),))


def test_an_arc_that_is_traveled_again_becomes_the_product_of_both_observations():
    play = Play()
    play.start()
    first, second = [4.0, 0.0, 0.5], [4.1, 0.05, 0.49]
    play.step(new_area(0, 0, 1.0, 1, first))
    play.step(Hypothesis(0, 0, 1.0, 0, belief(first)))
    verdict = play.step(revisit(second))
    product = fuse([belief(first), belief(second)])
    (arc,) = verdict.arcs
    assert (arc.source, arc.target, arc.closure) == (0, 1, False)
    np.testing.assert_allclose(arc.pose.mean, product.mean, atol=1e-9)
    np.testing.assert_allclose(arc.pose.covariance, product.covariance, atol=1e-9)
    np.testing.assert_allclose(play.arc(0, 1).mean, product.mean, atol=1e-9)
    np.testing.assert_allclose(poses_of(verdict)[1].mean, product.mean, atol=1e-9)


def test_an_arc_traveled_the_other_way_is_the_same_arc():
    play = Play()
    play.start()
    first, second = [4.0, 0.0, 0.5], [4.1, 0.05, 0.49]
    play.step(new_area(0, 0, 1.0, 1, first))
    back = belief(second).inverse()
    play.step(Hypothesis(0, 0, 1.0, 0, belief(second), (), (Arc(1, 0, back),)))
    product = fuse([belief(first), belief(second)])
    np.testing.assert_allclose(play.arc(0, 1).mean, product.mean, atol=1e-6)
    np.testing.assert_allclose(play.arc(0, 1).covariance, product.covariance, atol=1e-6)


def test_an_arc_seen_twice_before_acceptance_counts_both_times():
    play = Play(accept_distance=0.0)
    first, second = [4.0, 0.0, 0.5], [4.1, 0.05, 0.49]
    play.start()
    play.step(new_area(1, 0, 0.95, 1, first), Hypothesis(2, 0, 0.05, 0))
    again = Hypothesis(1, 1, 0.95, 1, None, (), (Arc(0, 1, belief(second)),))
    play.step(again, Hypothesis(2, 2, 0.05, 0))
    verdict = play.step(Hypothesis(1, 1, 0.95, 1), Hypothesis(2, 2, 0.05, 0))
    assert verdict.hypothesis == 1
    product = fuse([belief(first), belief(second)])
    np.testing.assert_allclose(play.arc(0, 1, 1).mean, product.mean, atol=1e-9)
    np.testing.assert_allclose(play.arc(0, 1, 1).covariance, product.covariance, atol=1e-9)


def test_an_uninformative_arc_replaces_what_was_observed():
    play = Play()
    play.start()
    play.step(new_area(0, 0, 1.0, 1, [4.0, 0.0, 0.5]))
    unknown = uninformative_belief(np.array([9.0, 2.0, 1.0]))
    verdict = play.step(Hypothesis(0, 0, 1.0, 1, None, (), (Arc(0, 1, unknown),)))
    (arc,) = verdict.arcs
    np.testing.assert_allclose(arc.pose.mean, unknown.mean)
    assert is_uninformative(play.arc(0, 1))


def test_an_arc_is_fused_only_on_acceptance():
    play = Play()
    play.start()
    first, second = [4.0, 0.0, 0.5], [4.1, 0.05, 0.49]
    play.step(new_area(0, 0, 1.0, 1, first))
    play.step(Hypothesis(0, 0, 1.0, 0, belief(first)))
    arcs = (Arc(0, 1, belief(second), True),)
    verdict = play.step(Hypothesis(1, 0, 0.6, 1, None, (), arcs), new_area(2, 0, 0.4, 2, [1.0, 5.0, 0.0]))
    assert verdict.hypothesis is None
    assert verdict.arcs == ()
    np.testing.assert_allclose(play.arc(0, 1, 1).mean, second, atol=1e-12)
    np.testing.assert_allclose(play.arc(0, 1, 2).mean, first, atol=1e-12)


def test_the_same_keyframes_do_not_make_an_arc_more_certain_twice():
    play = Play()
    play.start()
    pose = [4.0, 0.0, 0.0]
    play.step(places=[(0, 0, [4.5, 0.0, 0.0])])
    there = MovedKeyframe(1, 0, 1, np.array([0.5, 0.0, 0.0]))
    hypothesis = Hypothesis(0, 0, 1.0, 1, belief(se2.inverse(pose)), (there,), (Arc(0, 1, belief(pose)),))
    play.step(hypothesis)
    again = MovedKeyframe(1, 1, 1, np.array([0.5, 0.0, 0.0]))
    play.step(Hypothesis(0, 0, 1.0, 1, None, (again,), (Arc(0, 1, belief(pose)),)))
    np.testing.assert_allclose(play.arc(0, 1).covariance, SPREAD, rtol=1e-6, atol=1e-12)


def test_arcs_are_never_more_certain_than_the_floor():
    play = Play(arc_sigma_floor=0.08, arc_angle_floor=1.0)
    play.start()
    pose = [4.0, 0.0, 0.0]
    for _ in range(4):
        play.step(revisit(pose))
    sigma = np.sqrt(np.diag(play.arc(0, 1).covariance))
    assert np.all(sigma[:2] >= 0.08 - 1e-12)
    assert np.degrees(sigma[2]) >= 1.0 - 1e-9


def test_two_areas_that_are_one_are_definite_at_once_and_the_loop_stays_closed():
    play = Play()
    play.start()
    for area in (1, 2, 3):
        play.step(new_area(0, 0, 1.0, area, [2.0, 0.0, np.pi / 2], source=area - 1))
    play.step(new_area(0, 0, 1.0, 4, [2.0, 0.0, np.pi / 2], source=3))
    home = Arc(4, 0, belief(np.zeros(3), 0.01 * SPREAD), True)
    before = play.step(Hypothesis(0, 0, 1.0, 4, None, (), (home,)))
    assert sorted(poses_of(before)) == [0, 1, 2, 3, 4]
    into = play.arc(0, 4)
    verdict = play.step(Hypothesis(0, 0, 1.0, 0, into, area_merge=AreaMerge(4, 0, into)))
    assert verdict.hypothesis == 0
    assert (verdict.arcs, verdict.moved_keyframes, verdict.revised_hypotheses) == ((), (), ())
    poses = poses_of(verdict)
    assert sorted(poses) == [0, 1, 2, 3]
    for area in poses:
        apart = se2.between(poses_of(before)[area].mean, poses[area].mean)
        assert np.hypot(*apart[:2]) < 0.01
        assert np.degrees(abs(apart[2])) < 0.1
    assert play.process._replica.robot_areas == {0: 0}
    # What is found again of the arc that is left is fused with it, as always.
    sharp = play.arc(0, 3).covariance
    play.step(new_area(0, 0, 1.0, 5, [1.0, 0.0, 0.0]))
    play.step(Hypothesis(0, 0, 1.0, 3, belief([2.0, 0.0, np.pi / 2]), (), (Arc(0, 3, play.arc(0, 3), True),)))
    assert np.trace(play.arc(0, 3).covariance) < np.trace(sharp)
