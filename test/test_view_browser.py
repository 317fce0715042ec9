"""The live page in a real browser, without ROS."""

import json
import time

import numpy as np
import pytest
from browser import Browser, find_browser

from hmt_slam_ros.messages.team import TeamPlacement, Verdict
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.server import PageServer, grid_png
from hmt_slam_ros.view.team_section import TeamSection

pytestmark = pytest.mark.skipif(
    find_browser() is None, reason="the page is looked at in a browser: apt install chromium"
)


class Shown:
    """A board, and the page that shows it in a browser."""

    def __init__(self, folder):
        self.board = Board()
        self._server, self.browser = PageServer(self.board, "127.0.0.1", 0), Browser(folder / "profile")
        self.browser.size(1280, 800)
        self.browser.open(self._server.url)

    def text(self, name):
        return self.browser.evaluate(f"document.getElementById('{name}').innerText")

    def until(self, condition):
        deadline = time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            time.sleep(0.1)

    @property
    def drawing(self):
        return json.loads(self.browser.evaluate("document.getElementById('plan').dataset.drawn ?? '{}'"))

    def close(self):
        self.browser.close()
        self._server.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    shown = Shown(tmp_path_factory.mktemp("browser"))
    yield shown
    complaints = shown.browser.complaints
    shown.close()
    assert complaints == []


def test_the_maps_of_joined_robots_are_drawn_and_all_are_listed(page, tmp_path):
    section = TeamSection()
    section.robot = "ann"
    place = np.array([4.0, 0.0, 0.5 * np.pi])
    section.note_placement(TeamPlacement("ann", "ann", "bob", Verdict.JOINED, 0.999, 0.001, place))
    section.note_placement(TeamPlacement("ann", "ann", "cid", Verdict.APART, 0.2, 0.8, place))
    section.robot_poses["bob"] = [2.0, 1.0, 0.0]
    cells = np.zeros((30, 50), dtype=np.int8)
    cells[[0, -1]], cells[:, [0, -1]] = 100, 100
    tag = page.board.put_map_image(grid_png(cells), "bob")
    section.maps["bob"] = {"tag": tag, "origin": [0.0, 0.0], "size": [5.0, 3.0]}
    page.board.put("robot", {"pose": [0.0, 0.0, 0.0], "ellipse": None, "deviation": 0.1, "turn": 1.0})
    page.board.put("team", section.content())
    page.until(lambda: page.drawing.get("team") == [{"name": "bob", "map": True, "robot": True}])
    page.browser.screenshot(tmp_path / "team.png")
    assert [row.strip() for row in page.text("robots").split("\n") if row.strip()] == [
        "bob",
        "joined, 99.9 %",
        "cid",
        "apart, best placement 20.0 %, apart 80.0 %",
    ]
    page.board.put("team", [])
    page.until(lambda: page.browser.evaluate("document.getElementById('team').hidden"))


def test_a_log_of_unknown_length_has_no_length(page):
    page.board.put("replay", {"state": "playing", "log": "drive", "done": 1594, "scans": 0})
    page.until(lambda: page.text("replay") == "drive: 1594 scans, playing")
    page.board.put("replay", {"state": "playing", "log": "drive", "done": 1594, "scans": 2000})
    page.until(lambda: page.text("replay") == "drive: 1594 of 2000 scans, playing")


def test_what_is_open_of_the_place_is_shown_as_a_number_of_places(page):
    page.board.put("localized", True)
    page.board.put("entropy", 0.001)
    page.until(lambda: page.text("localized") == "yes")
    page.board.put("localized", False)
    page.board.put("entropy", 0.693)
    page.until(lambda: page.text("localized") == "no, as open as 2.0 places")


def test_what_happened_is_listed_with_times(page):
    incident = {"time": 1_000_000.0, "node": "slam", "level": "attention", "text": "was started again"}
    page.board.put("incidents", [incident])
    page.until(lambda: page.text("newest").endswith(", slam"))
    page.browser.evaluate("document.getElementById('incidents').closest('details').open = true")
    page.until(lambda: "slam: was started again" in page.text("incidents"))
