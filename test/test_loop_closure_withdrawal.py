"""The histories and closures of a path without one of its closures, step by step."""

from dataclasses import replace

import numpy as np
import pytest
from test_loop_closure_revision import (
    FALSE,
    MATCH,
    NEXT,
    ODOMETRY,
    corridor,
    drive_with,
    false_account,
    make_closure,
    path_of,
)

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, area_pair
from hmt_slam_ros.loop_closure.closure_history import (
    AcceptedPath,
    MapRollback,
    MapSnapshot,
    PathStep,
    _ClosureDependents,
    _reassign_step,
    apply_area_merge,
    map_as_measured,
    merge_arc_keyframes,
    split_history,
    withdraw_closure,
)
from hmt_slam_ros.loop_closure.closure_revision import Explanation, _as_hypothesis
from hmt_slam_ros.messages.map_changes import AreaMerge


def as_tuples(history):
    return [(s.event, s.area_before, s.area_after, s.new_arcs, set(s.joined_keyframes)) for s in history]


def test_the_history_without_a_closure_has_the_numbers_that_areas_have_then():
    """The robot falsely enters area 0, drives to 1, and leaves it for 4; later it comes to 5, in which nothing hangs
    on the closure."""
    before = false_account()
    hybrid_map = before.hybrid_map.branch()
    hybrid_map.set_keyframe(60, 5, np.zeros(3))
    hybrid_map.set_arc(4, 5, PoseGaussian(np.array([2.0, 1.0, 0.3]), ODOMETRY), closure=False)
    history = (*before.history, PathStep(60, 4, 5, ((4, 5),), frozenset({60})))
    found = withdraw_closure(
        replace(before, hybrid_map=hybrid_map, history=history, area=5), before.closures[0].closure_id, 9
    )
    assert as_tuples(found.history) == [
        (10, 0, 1, ((0, 1),), {10}),
        (20, 1, 2, ((1, 2),), {20}),
        (30, 2, 3, ((2, 3),), {30}),
        (40, 3, 9, ((3, 9),), {39}),
        (43, 9, 9, (), set()),
        (50, 9, 4, ((4, 9),), {50}),
        (60, 4, 5, ((4, 5),), {60}),
    ]
    # The arc from the layer leads to the same pose, seen from where the layer begins.
    at = se2.compose(before.hybrid_map.arc(0, 1).mean, before.hybrid_map.arc(1, 4).mean)
    np.testing.assert_allclose(found.hybrid_map.arc(9, 4).mean, at, atol=1e-12)
    np.testing.assert_allclose(found.hybrid_map.arc(3, 9).mean, before.closures[0].pose.mean, atol=1e-12)


@pytest.mark.parametrize("known", [1, 8])
def test_an_arc_from_the_layer_has_its_own_area_in_place_of_the_known_one_whichever_comes_first(known):
    closure = drive_with((80, 6, 0, FALSE)).closures[0]
    layer = _ClosureDependents(corridor(2)[0], closure, arcs={area_pair(known, 4): known})
    step = PathStep(50, known, 4, (area_pair(known, 4), (2, 3), (0, 6)), frozenset({50}))
    found = _reassign_step(step, True, False, layer, 5)
    assert as_tuples([found]) == [(50, 5, 4, ((4, 5), (2, 3), (5, 6)), {50})]
    outside = _reassign_step(step, False, True, layer, 6)
    assert as_tuples([outside]) == [(50, known, 6, ((4, 6), (2, 3)), {50})]


def test_an_explanation_moves_keyframes_that_change_their_area_or_their_pose():
    """Keyframe 0 keeps both, 1 is elsewhere in its area, 10 has the same pose in area 2, and 11 goes on in 3."""
    hybrid_map = corridor(3)[0]
    hybrid_map.commit()
    changed = hybrid_map.branch()
    pose = np.array([0.5, 0.3, 0.2])
    changed.set_keyframe(1, 0, pose)
    for keyframe, area in ((10, 2), (11, 3)):
        at = hybrid_map.keyframes(1)[keyframe]
        changed.remove_keyframe(keyframe, 1)
        changed.set_keyframe(keyframe, area, at)
    changed.remove_arc(0, 1)
    arc = PoseGaussian(NEXT, MATCH)
    changed.set_arc(2, 3, arc, closure=True)
    path = AcceptedPath(changed, (), (), 3, np.zeros(3), np.array([1.0, 2.0, 0.3]))
    found = _as_hypothesis(Explanation(path, (), 0.6), 4, hybrid_map)
    assert (found.id, found.parent, found.probability, found.area) == (4, 4, 0.6, 3)
    assert [(m.keyframe, m.previous_area, m.area) for m in found.moved_keyframes] == [(1, 0, 0), (10, 1, 2), (11, 1, 3)]
    np.testing.assert_array_equal(found.moved_keyframes[0].pose, pose)
    np.testing.assert_array_equal(found.frame_change.mean, [1.0, 2.0, 0.3])
    assert [(a.source, a.target, a.closure) for a in found.arcs] == [(2, 3, True)]
    assert [(ends.source, ends.target) for ends in found.removed_arcs] == [(0, 1)]


def test_steps_before_an_event_are_kept_apart_from_those_from_it_on():
    history = corridor(5)[1]
    for event, count in ((5, 0), (10, 0), (11, 1), (20, 1), (21, 2), (99, 4)):
        earlier, later = split_history(history, event)
        assert len(earlier) == count
        assert earlier + later == history


def test_a_closure_whose_robot_never_entered_leaves_no_arc_in_the_history():
    before = drive_with((80, 6, 0, FALSE))
    found = withdraw_closure(before, before.closures[0].closure_id, 100)
    assert as_tuples(found.history) == [*as_tuples(before.history[:-1]), (80, 6, 6, (), set())]
    assert found.history[:-1] == before.history[:-1]
    assert withdraw_closure(before, (81, (0, 6)), 100) is before


def test_a_closure_that_was_found_from_the_layer_begins_in_it():
    """From falsely entered area 0 the robot goes on to 1, and sees area 2 from there."""
    before = false_account()
    hybrid_map = before.hybrid_map.branch()
    belief = PoseGaussian(np.array([0.5, -6.0, 0.7]), MATCH)
    hybrid_map.remove_arc(1, 2)
    hybrid_map.set_arc(1, 2, belief, closure=True)
    second = replace(before.closures[0], closure_id=(44, (1, 2)), near=1, far=2, pose=belief)
    other = PoseGaussian(2.0 * NEXT, ODOMETRY)
    third = replace(before.closures[0], closure_id=(12, (1, 3)), near=1, far=3, pose=other)
    hybrid_map.set_arc(1, 3, other, closure=True)
    history = (*before.history[:-1], PathStep(44, 1, 1, ((1, 2),)), before.history[-1])
    path = replace(before, hybrid_map=hybrid_map, history=history, closures=(third, *before.closures, second))
    found = withdraw_closure(path, before.closures[0].closure_id, 9)
    assert as_tuples(found.history)[-2:] == [(44, 9, 9, ((2, 9),), set()), (50, 9, 4, ((4, 9),), {50})]
    assert [(c.closure_id, c.near, c.far) for c in found.closures] == [((12, (1, 3)), 1, 3), ((44, (1, 2)), 9, 2)]
    expected = se2.compose(before.hybrid_map.arc(0, 1).mean, belief.mean)
    np.testing.assert_allclose(found.closures[1].pose.mean, expected, atol=1e-12)
    np.testing.assert_allclose(found.closures[1].pose.covariance, MATCH, atol=1e-12)
    assert found.closures[0].pose is third.pose
    np.testing.assert_allclose(found.hybrid_map.arc(9, 2).mean, expected, atol=1e-12)
    assert found.hybrid_map.arc_value(9, 2).closure


def test_what_was_stored_before_the_robot_entered_is_no_part_of_the_layer():
    """Keyframe 45 of area 1 was stored before event 46, at which the robot came from area 0 and had closed a loop."""
    before = false_account()
    late = (*before.history[:-2], PathStep(46, 0, 1, ()), before.history[-1])
    found = withdraw_closure(replace(before, history=late), before.closures[0].closure_id, 9)
    assert sorted(found.hybrid_map.keyframes(1)) == [10, 11, 45]
    assert sorted(found.hybrid_map.keyframes(9)) == [39, 41, 42]
    at_event = (*before.history[:-2], PathStep(45, 0, 1, ()), before.history[-1])
    found = withdraw_closure(replace(before, history=at_event), before.closures[0].closure_id, 9)
    assert sorted(found.hybrid_map.keyframes(1)) == [10, 11, 45]


def test_things_move_back_with_the_nearest_of_the_moved_keyframes():
    hybrid_map = corridor(2)[0]
    former = {0: np.array([0.1, 0.2, 0.3]), 1: np.array([1.2, -0.3, -0.4])}
    snapshot = MapSnapshot({k: (0, pose) for k, pose in former.items()} | {77: (0, np.ones(3))}, {})
    rollback = MapRollback(snapshot, hybrid_map)
    for pose, keyframe in (((0.4, 0.9, 1.0), 0), ((0.6, -0.9, 2.0), 1), ((0.45, 5.0, 0.0), 0)):
        present = hybrid_map.keyframes(0)[keyframe]
        correction = se2.compose(former[keyframe], se2.inverse(present))
        np.testing.assert_allclose(rollback.correction_at(0, np.array(pose)), correction)
        np.testing.assert_allclose(rollback.former_pose(0, np.array(pose)), se2.compose(correction, pose))
    np.testing.assert_array_equal(rollback.correction_at(1, np.array([0.4, 0.9, 1.0])), np.zeros(3))
    belief = PoseGaussian(np.array([0.6, -0.9, 2.0]), ODOMETRY)
    at = rollback.former_arc(0, 1, belief)
    np.testing.assert_allclose(at.mean, rollback.former_pose(0, belief.mean))
    np.testing.assert_array_equal(at.covariance, ODOMETRY)
    back = rollback.former_arc(1, 0, belief.inverse())
    np.testing.assert_allclose(back.inverse().mean, at.mean)


def test_arcs_as_measured_are_those_of_the_earliest_snapshot_that_still_exist():
    path = drive_with((80, 6, 0, FALSE), (81, 7, 1, FALSE))
    values = [ArcValue(PoseGaussian(np.array([k, 0.5, 0.1]), ODOMETRY), closure=False) for k in (3.0, 5.0)]
    first, second = (MapSnapshot({}, {(2, 3): value, (1, 6): value}) for value in values)
    closures = (replace(path.closures[0], snapshot=first), replace(path.closures[1], snapshot=second))
    found = map_as_measured(replace(path, closures=closures))
    np.testing.assert_array_equal(found.arc(2, 3).mean, [3.0, 0.5, 0.1])
    assert found.arc(1, 6) is None
    open_again = (replace(closures[0], snapshot=None), closures[1])
    np.testing.assert_array_equal(map_as_measured(replace(path, closures=open_again)).arc(2, 3).mean, [5.0, 0.5, 0.1])
    assert not np.array_equal(path.hybrid_map.arc(2, 3).mean, [3.0, 0.5, 0.1])


def test_snapshots_lose_the_arcs_and_the_area_that_are_gone():
    value = ArcValue(PoseGaussian(np.zeros(3), ODOMETRY), closure=False)
    snapshot = MapSnapshot({1: (0, np.zeros(3)), 2: (5, np.zeros(3))}, {(0, 1): value, (1, 5): value, (5, 6): value})
    assert snapshot.without_arcs({(1, 5), (7, 8)}).arcs.keys() == {(0, 1), (5, 6)}
    assert snapshot.without_arcs({(1, 5)}).keyframes is snapshot.keyframes
    found = snapshot.without_area(5)
    assert (found.keyframes.keys(), found.arcs.keys()) == ({1}, {(0, 1)})


@pytest.mark.parametrize("turned", [False, True])
def test_a_closure_with_an_area_that_became_part_of_another_leads_to_the_same_place(turned):
    """Area 4 is part of 2, off by a pose; the closure is between 4 and 0, from either side."""
    hybrid_map, history = corridor(5)
    off = PoseGaussian(np.array([0.7, -0.3, 0.4]), MATCH)
    hybrid_map.set_arc(2, 4, off, closure=True)
    closure = make_closure(hybrid_map, 50, *((0, 4) if turned else (4, 0)))
    path = path_of(hybrid_map, history, [closure], 4)
    _, (found,) = apply_area_merge(path, AreaMerge(4, 2, off))
    assert (found.near, found.far) == ((0, 2) if turned else (2, 0))
    expected = off.inverse() if turned else off
    pair = (closure.pose, expected) if turned else (expected, closure.pose)
    np.testing.assert_allclose(found.pose.mean, se2.compose(pair[0].mean, pair[1].mean))
    np.testing.assert_allclose(found.pose.covariance, pair[0].compose(pair[1]).covariance)


def test_the_keyframes_that_observed_an_arc_go_with_it_in_a_merge():
    observed = {(0, 4): frozenset({1}), (0, 2): frozenset({2, 3}), (2, 4): frozenset({9}), (4, 7): frozenset({5})}
    merge = AreaMerge(4, 2, PoseGaussian(np.zeros(3), MATCH))
    assert merge_arc_keyframes(observed, merge) == {(0, 2): {1, 2, 3}, (2, 7): {5}}
