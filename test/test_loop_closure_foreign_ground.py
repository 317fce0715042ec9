"""Ground of another robot becomes part of the map, with numbers of its own; what the robot saw itself stays."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from play_for_tlca import Play, belief, new_area

from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.loop_closure.foreign_ground import ForeignNumbers, GroundTaker, next_foreign_keyframe
from hmt_slam_ros.loop_closure.tlca import Tlca
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.team import JoinedGround, JoiningArc, SharedArea, SharedScan

STEP = belief([4.0, 0.0, 0.0])
JOIN = belief([1.0, 2.0, 0.5])


def scans(*keyframes, since=0):
    """The scans of keyframes, each of its own time."""
    return tuple(SharedScan(1, k, replace(worlds.blank_scan(), stamp=since + k)) for k in keyframes)


def area(number, *keyframes, arcs=()):
    return SharedArea(2, number, keyframes, tuple(np.array([k, 0.0, 0.0]) for k in keyframes), tuple(arcs))


GROUND = JoinedGround(
    "ann",
    "1",
    scans(0, 1, 5),
    (area(0, 0, 1), area(7, 5, arcs=[Arc(0, 7, STEP)])),
    (JoiningArc(1, 7, JOIN),),
)


def own_map():
    """Two areas of the robot's own."""
    hybrid_map = HybridMap()
    for k in range(2):
        hybrid_map.set_keyframe(k, k, np.zeros(3))
    hybrid_map.set_arc(0, 1, STEP, closure=False)
    hybrid_map.commit()
    return hybrid_map


def take_over(hybrid_map, ground=GROUND, numbers=None, observed=(), first=2):
    """The map with the ground, and the numbers."""
    numbers = numbers or ForeignNumbers(ground.session)
    next_keyframe = next_foreign_keyframe(
        {ground.robot: numbers}, (k for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area))
    )
    taken, numbers = GroundTaker(hybrid_map, numbers, observed, first, next_keyframe).take_over(ground)
    replica = Replica({}, {0: hybrid_map})
    replica._add_foreign_ground(hybrid_map, taken)
    hybrid_map.commit()
    return taken, numbers, replica.scans


def test_areas_and_keyframes_get_numbers_that_nobody_has():
    hybrid_map = own_map()
    taken, numbers, kept = take_over(hybrid_map)
    assert numbers.areas == {0: 2, 7: 3} and numbers.keyframes == {0: -2, 1: -3, 5: -4}
    assert {new.keyframe: (new.area, new.pose[0]) for new in taken.keyframes} == {-2: (2, 0), -3: (2, 1), -4: (3, 5)}
    assert hybrid_map.area_ids() == [0, 1, 2, 3]
    assert kept.keys() == {-2, -3, -4}
    np.testing.assert_array_equal(hybrid_map.arc(2, 3).mean, STEP.mean)
    np.testing.assert_array_equal(hybrid_map.arc(1, 3).mean, JOIN.mean)
    assert hybrid_map.arc_value(1, 3).closure


def test_what_comes_again_adds_nothing_and_what_is_new_is_added():
    hybrid_map = own_map()
    _, numbers, _ = take_over(hybrid_map)
    more = replace(GROUND, scans=scans(0, 1, 5, 6, 9), areas=(area(0, 0, 1, 6), area(8, 9, arcs=[Arc(7, 8, STEP)])))
    taken, again, _ = take_over(hybrid_map, more, numbers, first=4)
    assert [(new.keyframe, new.area) for new in taken.keyframes] == [(-5, 2), (-6, 4)]
    assert again.areas == {0: 2, 7: 3, 8: 4}
    assert hybrid_map.neighbors(3) == [1, 2, 4]


def test_arcs_follow_the_other_robot_but_where_the_robot_was_itself():
    hybrid_map = own_map()
    _, numbers, _ = take_over(hybrid_map)
    moved = belief([4.5, 0.0, 0.0])
    other = replace(GROUND, areas=(area(7, 5, arcs=[Arc(0, 7, moved)]),))
    take_over(hybrid_map, other, numbers)
    np.testing.assert_array_equal(hybrid_map.arc(2, 3).mean, moved.mean)
    taken, _, _ = take_over(hybrid_map, replace(GROUND, areas=(area(7, 5),)), numbers, observed=[(2, 3)])
    assert taken.removed_arcs == ()
    taken, _, _ = take_over(hybrid_map, replace(GROUND, areas=(area(7, 5),)), numbers)
    assert [(ends.source, ends.target) for ends in taken.removed_arcs] == [(2, 3)]
    assert hybrid_map.neighbors(3) == [1]


def test_a_join_that_is_withdrawn_leaves_ground_of_which_nothing_is_known():
    hybrid_map = own_map()
    joined = replace(GROUND, joining_arcs=(JoiningArc(1, 7, JOIN), JoiningArc(0, 0, JOIN)))
    _, numbers, _ = take_over(hybrid_map, joined)
    withdrawn = JoinedGround("ann", "1", (), (), ())
    taken, numbers, _ = take_over(hybrid_map, withdrawn, numbers)
    assert is_uninformative(hybrid_map.arc(0, 2)) and hybrid_map.arc(1, 3) is None
    assert [(ends.source, ends.target) for ends in taken.removed_arcs] == [(1, 3)]
    # It may be joined again.
    take_over(hybrid_map, joined, numbers)
    np.testing.assert_array_equal(hybrid_map.arc(0, 2).mean, JOIN.mean)


def test_a_map_that_goes_on_in_another_session_adds_what_is_new_in_it():
    """Robot and map were saved with keyframe 1: the other keyframes of the session before are of another drive."""
    hybrid_map = own_map()
    _, numbers, kept = take_over(hybrid_map)
    on = replace(GROUND, session="2", scans=(*scans(0, 1), *scans(5, since=100)))
    taken, again, _ = take_over(hybrid_map, on, numbers.numbers_of_session(on, kept), first=4)
    assert [(new.keyframe, new.area) for new in taken.keyframes] == [(-5, 4)]
    assert again.areas == {0: 2, 7: 4}
    # The join is that with the area of this drive.
    assert hybrid_map.arc(1, 3) is None and hybrid_map.arc_value(1, 4).closure


def test_what_was_pruned_here_stays_so_in_another_session():
    hybrid_map = own_map()
    _, numbers, kept = take_over(hybrid_map)
    del kept[numbers.keyframes[0]]
    on = replace(GROUND, session="2")
    taken, _, _ = take_over(hybrid_map, on, numbers.numbers_of_session(on, kept))
    assert taken.keyframes == ()


def test_a_map_from_scratch_has_numbers_of_its_own():
    _, numbers, kept = take_over(own_map())
    other = replace(GROUND, session="2", scans=scans(0, 1, 5, since=100))
    own = numbers.numbers_of_session(other, kept)
    assert (own.session, own.areas, own.keyframes) == ("2", {}, {})


def test_arcs_to_areas_that_are_no_more_are_left_out():
    hybrid_map = own_map()
    gone = replace(GROUND, joining_arcs=(JoiningArc(6, 7, JOIN),))
    taken, numbers, _ = take_over(hybrid_map, gone)
    assert numbers.joining_arcs == frozenset() and len(taken.arcs) == 1


def test_keyframes_without_a_scan_wait():
    taken, numbers, _ = take_over(own_map(), replace(GROUND, scans=scans(0)))
    assert [new.keyframe for new in taken.keyframes] == [-2]
    assert numbers.areas == {0: 2}


@pytest.fixture
def play():
    play = Play()
    play.start()
    play.step(new_area(0, 0, 1.0, 1, [4.0, 0.0, 0.0]))
    return play


def test_tlca_takes_it_over_with_its_next_decision(play):
    assert play.process.handle(GROUND) == []
    decision = play.step()
    assert decision.hypothesis == 0
    assert {pose.area for pose in decision.global_poses} == {0, 1, 2, 3}
    assert play.process._replica.scans.keys() >= {-2, -3, -4}
    again = Tlca(play.configuration, play.process.state)
    assert again.state.foreign_numbers["ann"].areas == {0: 2, 7: 3}
    assert play.step().foreign_ground is None


def test_ground_waits_while_there_are_several_hypotheses(play):
    play.process.handle(GROUND)
    decision = play.step(Hypothesis(1, 0, 0.6, 1), Hypothesis(2, 0, 0.4, 1), places=[(0, 1, np.zeros(3))])
    assert decision.foreign_ground is None
    assert len(Tlca(play.configuration, play.process.state).state.waiting_ground) == 1
    only = play.step(Hypothesis(1, 1, 1.0, 1), places=[(1, 1, np.zeros(3)), (2, 1, np.zeros(3))])
    assert len(only.foreign_ground.keyframes) == 3


def test_ground_of_another_session_is_other_ground(play):
    play.process.handle(GROUND)
    play.step()
    play.process.handle(replace(GROUND, session="2", scans=scans(0, 1, 5, since=100)))
    decision = play.step()
    assert [new.keyframe for new in decision.foreign_ground.keyframes] == [-5, -6, -7]
