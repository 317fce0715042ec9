"""The robots of a team on the live page, without ROS; the page itself in a real browser."""

import json
import time

import numpy as np
import pytest
from browser import Browser, find_browser

from hmt_slam_ros.messages.team import TeamPlacement, Verdict
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.server import PageServer, grid_png
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


@pytest.mark.skipif(find_browser() is None, reason="the page is looked at in a browser: apt install chromium")
def test_the_page_draws_the_maps_of_joined_robots_and_lists_all(tmp_path):
    board = Board()
    server, browser = PageServer(board, "127.0.0.1", 0), Browser(tmp_path / "profile")
    try:
        section = section_of("ann", placement("ann", "ann", "bob"), placement("ann", "ann", "cid", Verdict.APART, 0.2))
        section.robot_poses["bob"] = [2.0, 1.0, 0.0]
        cells = np.zeros((30, 50), dtype=np.int8)
        cells[[0, -1]], cells[:, [0, -1]] = 100, 100
        tag = board.put_map_image(grid_png(cells), "bob")
        section.maps["bob"] = {"tag": tag, "origin": [0.0, 0.0], "size": [5.0, 3.0]}
        board.put("robot", {"pose": [0.0, 0.0, 0.0], "ellipse": None, "deviation": 0.1, "turn": 1.0})
        board.put("team", section.content())
        browser.size(1280, 800)
        browser.open(server.url)
        drawn = {}
        deadline = time.monotonic() + 30.0
        while drawn.get("team") != [{"name": "bob", "map": True, "robot": True}]:
            assert time.monotonic() < deadline, drawn
            time.sleep(0.1)
            drawn = json.loads(browser.evaluate("document.getElementById('plan').dataset.drawn ?? '{}'"))
        rows = browser.evaluate("document.getElementById('robots').innerText").split("\n")
        assert [row.strip() for row in rows if row.strip()] == [
            "bob",
            "joined, 99.9 %",
            "cid",
            "apart, best placement 20.0 %, apart 80.0 %",
        ]
        browser.screenshot(tmp_path / "team.png")
        board.put("team", [])
        while not browser.evaluate("document.getElementById('team').hidden"):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        assert browser.complaints == []
    finally:
        browser.close()
        server.close()
