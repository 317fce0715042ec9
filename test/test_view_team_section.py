"""The robots of a team on the live page, without ROS and without a browser."""

import json

import numpy as np
import pytest

from hmt_slam_ros.messages.team import TeamPlacement, Verdict
from hmt_slam_ros.view.team_section import MAX_ROBOTS, TeamSection

# Bob's map in Ann's: 4 m ahead, turned to the left.
PLACE = np.array([4.0, 0.0, 0.5 * np.pi])


def placement(robot, first, second, verdict=Verdict.JOINED, probability=0.999, pose=PLACE):
    return TeamPlacement(robot, first, second, verdict, probability, 1.0 - probability, pose)


def section_of(robot, *placements):
    section = TeamSection()
    section.robot = robot
    for each in placements:
        section.note_placement(each)
    return section


def test_a_joined_robot_is_where_its_map_has_it():
    section = section_of("ann", placement("ann", "ann", "bob"))
    section.robot_poses["bob"] = [2.0, 1.0, 0.0]
    section.maps["bob"] = {"tag": "1", "origin": [0.0, 0.0], "size": [5.0, 3.0]}
    (row,) = section.content()
    assert (row["name"], row["verdict"], row["probability"], row["joined"]) == ("bob", "joined", 0.999, True)
    assert row["frame"] == pytest.approx(PLACE, abs=1e-4)
    assert row["robot"] == pytest.approx([3.0, 2.0, 0.5 * np.pi], abs=1e-4)
    assert row["map"]["tag"] == "1"
    json.dumps(section.content(), allow_nan=False)


def test_the_second_robot_of_a_pair_sees_the_first_by_the_inverse():
    (row,) = section_of("bob", placement("ann", "ann", "bob")).content()
    assert row["frame"] == pytest.approx([0.0, 4.0, -0.5 * np.pi], abs=1e-4)


def test_a_robot_that_is_not_joined_has_its_answer_and_no_place():
    (row,) = section_of("ann", placement("ann", "ann", "bob", Verdict.OPEN, 0.7)).content()
    assert row == {"name": "bob", "verdict": "open", "probability": 0.7, "apart": 0.3, "joined": False}


def test_robots_that_others_join_are_joined():
    section = section_of("ann", placement("ann", "ann", "bob"), placement("bob", "bob", "cid"))
    bob, cid = section.content()
    assert (cid["verdict"], cid["joined"]) == (None, True)
    assert cid["frame"][:2] == pytest.approx([4.0, 4.0], abs=1e-4)
    assert abs(cid["frame"][2]) == pytest.approx(np.pi, abs=1e-4)
    assert bob["joined"]


def test_nothing_is_shown_while_the_own_name_is_unknown_and_strangers_are_bounded():
    section = section_of("", placement("ann", "ann", "bob"))
    assert section.content() == []
    section.robot = "ann"
    for number in range(100):
        section.note_placement(placement(f"r{number}", "ann", f"r{number}", Verdict.APART))
    assert len(section.content()) <= MAX_ROBOTS
