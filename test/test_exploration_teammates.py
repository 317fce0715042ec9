"""Frontiers that are left to the other robots of a team."""

import numpy as np
import pytest
import worlds

from hmt_slam_ros.exploration.teammates import Teammates, choose_frontier
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import ForeignGround, ForeignKeyframe

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
        # One frontier is left, and it is the other's, where that is certainly nearer.
        ({0: (ROOM, 5.0)}, {"bob": {0: (ROOM, 2.0)}}, None),
        ({0: (ROOM, 5.0)}, {"bob": {0: (ROOM, 4.0)}}, 0),
        ({0: (ROOM, 5.0)}, {"bob": {}}, 0),
        # Three robots, each another one.
        (
            {0: (ROOM, 5.0), 1: (ROOM, 6.0), 2: (ROOM, 9.0)},
            {"bob": {0: (ROOM, 1.0), 1: (ROOM, 3.5)}, "cid": {1: (ROOM, 1.0)}},
            2,
        ),
    ],
)
def test_each_robot_has_a_frontier_of_its_own(own, others, chosen):
    assert choose_frontier(own, others) == chosen


def test_where_a_robot_is_shows_in_its_newest_ground():
    teammates = Teammates()
    teammates.add(ground("bob", -2, -3))
    teammates.add(ground("cid", -4))
    teammates.add(ground("bob", -5))
    assert teammates.positions() == {"bob": -5, "cid": -4}
    assert teammates.new_keyframes == [-2, -3, -4, -5]


def test_nothing_is_left_to_a_robot_that_maps_no_more():
    teammates = Teammates()
    teammates.update(100 * NANOSECONDS)
    teammates.add(ground("bob", -2))
    teammates.update(150 * NANOSECONDS)
    teammates.add(ground("cid", -3))
    teammates.add(ground("bob"))
    teammates.update(170 * NANOSECONDS)
    assert teammates.positions() == {"cid": -3}
