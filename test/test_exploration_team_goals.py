"""Goals that explorers of a team send one another, and the frontiers that these leave."""

import numpy as np
import pytest

from hmt_slam_ros.exploration.team_goals import GoalsOfRobot, RobotTarget, free_frontiers
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.team import TeamGoal, TeamPlace

HALLWAY, ROOM = False, True
PLACES = {0: (False, np.array([0.0, 0.0])), 1: (False, np.array([4.0, 0.0])), 2: (True, np.array([2.0, 0.0]))}


@pytest.mark.parametrize(
    ("targets", "left"),
    [
        ([], [0, 1, 2]),
        # Who goes to one frontier in a room sees the others of the room.
        ([RobotTarget("bob", PLACES[0], 9.0)], [2]),
        ([RobotTarget("bob", (False, np.array([-2.0, 0.0])), 9.0)], [1, 2]),
        ([RobotTarget("bob", PLACES[2], 9.0)], [0, 1]),
        # What one robot takes to be in a hallway, and the other one in a room, is one frontier all the same.
        ([RobotTarget("bob", (True, np.array([0.5, 0.0])), 9.0)], [1]),
        ([RobotTarget("bob", PLACES[0], 9.0), RobotTarget("dan", PLACES[2], 9.0)], []),
        # A robot that is nearer by more than 5 m goes there.
        ([RobotTarget("bob", PLACES[0], 11.0)], [0, 1, 2]),
    ],
)
def test_goals_of_others_are_left_to_them(targets, left):
    own = {0: (ROOM, 5.5), 1: (ROOM, 7.0), 2: (HALLWAY, 5.0)}
    assert list(free_frontiers(own, PLACES, targets)) == left


def test_of_two_robots_with_one_goal_the_nearer_one_goes_on():
    """Each decides by what both have sent, whatever its path is by now: so never both go on, and never both turn."""
    random = np.random.default_rng(7)
    for _ in range(1000):
        sent = dict(zip(("ann", "bob"), random.choice([3.0, 5.0, 8.0], 2).tolist(), strict=True))
        goes_on = []
        for robot, other in (("ann", "bob"), ("bob", "ann")):
            own = {0: (ROOM, float(random.uniform(0.0, 10.0)))}
            targets, own_target = (
                [RobotTarget(other, PLACES[1], sent[other])],
                RobotTarget(robot, PLACES[0], sent[robot]),
            )
            goes_on += [robot for _ in free_frontiers(own, PLACES, targets, own_target)]
        assert goes_on == [min(sent, key=lambda name: (sent[name], name))]


def goal(stamp=None, newest_stamp=0, reached_last=False):
    """A goal beside the keyframe of a stamp."""
    place = None if stamp is None else TeamPlace("bob", stamp, np.zeros(3))
    return TeamGoal("bob", newest_stamp, reached_last, False, place, False, 5.0)


def goals_of(*sent):
    goals = GoalsOfRobot()
    for each in sent:
        goals.add(each, 0)
    return goals


def test_a_goal_counts_while_it_is_sent_again():
    goals = goals_of(goal(3))
    assert goals.last(30 * NANOSECONDS).place.stamp == 3
    assert goals.last(31 * NANOSECONDS) is None
    goals.add(goal(), 31 * NANOSECONDS)
    # That it drives nowhere is not sent again.
    assert goals.last(1000 * NANOSECONDS).place is None


def earlier_stamps(goals, now=0):
    """The stamps of goals that were left, negative where the robot did not reach them."""
    return [each.place.stamp if was_reached else -each.place.stamp for each, was_reached in goals.earlier(now)]


def test_a_goal_that_was_left_counts_until_the_ground_from_there_has_arrived():
    goals = goals_of(goal(3), goal(3), goal(5, newest_stamp=7, reached_last=True), goal(newest_stamp=9))
    assert earlier_stamps(goals) == [3, -5]
    assert [place.stamp for place in goals.reached] == [3]
    goals.add_ground(7)
    assert earlier_stamps(goals) == [-5]
    assert earlier_stamps(goals, 61 * NANOSECONDS) == []
    goals.add_ground(9)
    assert earlier_stamps(goals) == []


def test_ground_may_come_before_the_goal():
    goals = goals_of(goal(3))
    goals.add_ground(9)
    goals.add(goal(5, newest_stamp=9, reached_last=True), 0)
    assert earlier_stamps(goals) == []
    goals.add(goal(6, newest_stamp=10, reached_last=True), 0)
    assert earlier_stamps(goals) == [5]


def test_the_number_of_goals_that_were_left_is_bounded():
    goals = goals_of(*(goal(n, newest_stamp=n, reached_last=True) for n in range(1, 100)))
    assert earlier_stamps(goals) == list(range(91, 99))
