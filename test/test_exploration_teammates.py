"""Frontiers that are left to the other robots of a team."""

import numpy as np
import pytest
import worlds

from hmt_slam_ros.exploration.teammates import Teammates, choose_frontier, group_frontiers
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import ForeignGround, ForeignKeyframe
from hmt_slam_ros.messages.team import MAX_ROBOTS, TeamGoal, TeamPlace

HALLWAY, ROOM = False, True
SCAN = worlds.scan_in(worlds.box(-5.0, -5.0, 5.0, 5.0), (0.0, 0.0, 0.0), stamp=0)


def ground(robot, *keyframes):
    return ForeignGround(robot, tuple(ForeignKeyframe(k, 3, np.zeros(3), SCAN) for k in keyframes))


@pytest.mark.parametrize(
    ("own", "others", "chosen"),
    [
        ({0: (HALLWAY, 5.0), 1: (ROOM, 1.0)}, {}, 0),
        # The other one is nearer to it.
        ({0: (HALLWAY, 5.0), 1: (HALLWAY, 6.0)}, {"bob": {0: (HALLWAY, 2.0), 1: (HALLWAY, 9.0)}}, 1),
        ({0: (HALLWAY, 5.0), 1: (HALLWAY, 6.0)}, {"bob": {0: (HALLWAY, 3.5), 1: (HALLWAY, 2.0)}}, 0),
        # One frontier is left, and it is the other's.
        ({0: (ROOM, 5.0)}, {"bob": {0: (ROOM, 2.0)}}, None),
        ({0: (ROOM, 5.0)}, {"bob": {}}, 0),
        # The first by name goes, unless the other is certainly nearer.
        ({0: (ROOM, 5.0)}, {"dan": {0: (ROOM, 2.0)}}, 0),
        ({0: (ROOM, 8.0)}, {"dan": {0: (ROOM, 2.0)}}, None),
        # Three robots, each another one.
        (
            {0: (ROOM, 5.0), 1: (ROOM, 6.0), 2: (ROOM, 9.0)},
            {"abe": {0: (ROOM, 1.0), 1: (ROOM, 3.5)}, "bob": {1: (ROOM, 1.0)}},
            2,
        ),
    ],
)
def test_each_robot_has_a_frontier_of_its_own(own, others, chosen):
    assert choose_frontier(own, others, {0: 0, 1: 1, 2: 2}, "cid") == chosen


def test_no_two_go_to_one_room():
    own = {0: (ROOM, 4.0), 1: (ROOM, 5.0), 2: (ROOM, 20.0)}
    others = {"bob": {0: (ROOM, 3.0), 1: (ROOM, 9.0), 2: (ROOM, 30.0)}}
    assert choose_frontier(own, others, {0: 0, 1: 1, 2: 2}, "cid") == 1
    assert choose_frontier(own, others, {0: 0, 1: 0, 2: 2}, "cid") == 2


def test_frontiers_of_a_room_are_a_group():
    in_rooms = {3: (0.0, 0.0), 4: (4.0, 0.0), 6: (9.0, 0.0), 7: (9.0, 3.0)}
    in_hallways = {8: (2.0, 0.0), 9: (9.5, 0.0)}
    frontiers = {n: (n in in_hallways, np.array(place)) for n, place in (in_rooms | in_hallways).items()}
    # The last one is the frontier 6, which one keyframe takes to be in a room, and another one in a hallway.
    assert group_frontiers(frontiers) == {3: 3, 4: 3, 6: 6, 7: 6, 8: 8, 9: 6}


def test_of_two_robots_that_are_as_near_one_goes_and_never_both_stand():
    """Though each is shown to the other where it was up to 2.5 m ago."""
    assert choose_frontier({0: (ROOM, 5.0)}, {"bob": {0: (ROOM, 5.0)}}, {0: 0}, "ann") == 0
    assert choose_frontier({0: (ROOM, 5.0)}, {"ann": {0: (ROOM, 5.0)}}, {0: 0}, "bob") is None
    random = np.random.default_rng(5)
    for _ in range(1000):
        ann, bob = random.uniform(0.0, 10.0, 2)
        shown_ann, shown_bob = random.uniform(-2.5, 2.5, 2) + np.array([ann, bob])
        of_ann = choose_frontier({0: (ROOM, ann)}, {"bob": {0: (ROOM, shown_bob)}}, {0: 0}, "ann")
        of_bob = choose_frontier({0: (ROOM, bob)}, {"ann": {0: (ROOM, shown_ann)}}, {0: 0}, "bob")
        assert 0 in (of_ann, of_bob)


def test_of_two_robots_that_are_as_near_never_both_go_where_there_is_more():
    random = np.random.default_rng(6)
    for _ in range(1000):
        ann, bob = random.uniform(0.0, 10.0, 2)
        shown_ann, shown_bob = random.uniform(-2.5, 2.5, 2) + np.array([ann, bob])
        far = {1: (ROOM, 50.0), 2: (ROOM, 60.0)}
        of_ann = choose_frontier(
            {0: (ROOM, ann), **far}, {"bob": {0: (ROOM, shown_bob), **far}}, {0: 0, 1: 1, 2: 2}, "ann"
        )
        of_bob = choose_frontier(
            {0: (ROOM, bob), **far}, {"ann": {0: (ROOM, shown_ann), **far}}, {0: 0, 1: 1, 2: 2}, "bob"
        )
        assert None not in (of_ann, of_bob) and (of_ann, of_bob) != (0, 0)


def test_where_a_robot_is_shows_in_its_newest_ground():
    teammates = Teammates()
    teammates.add(ground("bob", -2, -3))
    teammates.add(ground("cid", -4))
    teammates.add(ground("bob", -5))
    assert teammates.positions({-2, -3, -4, -5}) == {"bob": -5, "cid": -4}
    # What the roadmap does not have yet shows nothing.
    assert teammates.positions({-2, -3}) == {"bob": -3}
    assert teammates.new_keyframes == [-2, -3, -4, -5]


def test_nothing_is_left_to_a_robot_that_maps_no_more():
    teammates = Teammates()
    teammates.update(100 * NANOSECONDS)
    teammates.add(ground("bob", -2))
    teammates.update(150 * NANOSECONDS)
    teammates.add(ground("cid", -3))
    teammates.add(ground("bob"))
    teammates.update(170 * NANOSECONDS)
    assert teammates.positions({-2, -3}) == {"cid": -3}


def goal(robot, place=None):
    return TeamGoal(robot, 0, False, False, place, False, 5.0)


def test_goals_of_other_robots_are_kept():
    teammates = Teammates("ann")
    teammates.add_goal(goal("ann"))
    assert not (teammates.goals or teammates.has_new_goals)
    for n in range(MAX_ROBOTS + 5):
        teammates.add_goal(goal(f"robot {n}"))
    assert teammates.has_new_goals and len(teammates.goals) == MAX_ROBOTS
    teammates.add_goal(goal("robot 1", TeamPlace("ann", 1, np.zeros(3))))
    assert teammates.goals["robot 1"].last(0).place is not None


def test_an_explorer_without_a_name_is_in_no_team():
    teammates = Teammates()
    teammates.add_goal(goal("bob"))
    assert not teammates.goals


def test_robots_know_a_place_by_the_stamp_of_a_scan():
    """Keyframes have other numbers in the map of each robot."""
    scans = [worlds.scan_in(worlds.box(-5.0, -5.0, 5.0, 5.0), (0.0, 0.0, 0.0), stamp=n) for n in range(4)]
    ann, bob = Teammates("ann"), Teammates("bob")
    ann.add(ForeignGround("bob", (ForeignKeyframe(-2, 3, np.zeros(3), scans[2]),)))
    bob.add(ForeignGround("ann", (ForeignKeyframe(-7, 3, np.zeros(3), scans[1]),)))
    of_ann, of_bob = {0: scans[0], 1: scans[1], -2: scans[2]}, {0: scans[1], 4: scans[2], -7: scans[1]}
    in_bob = bob.keyframes_by_scan(of_bob)
    for keyframe, same in ((1, -7), (-2, 4), (0, None)):
        place = ann.place_at(keyframe, np.zeros(3), of_ann)
        assert in_bob.get((place.owner, place.stamp)) == same
    assert ann.place_at(-2, np.zeros(3), of_ann).owner == "bob"
    # Another robot's keyframe of the same stamp is another one.
    assert (in_bob["bob", 1], in_bob["ann", 1]) == (0, -7)
