"""The live page in a real browser, without ROS."""

import json
import time
from itertools import combinations

import numpy as np
import pytest
from browser import Browser, find_browser, screenshot_folder
from map_for_page import BEST, OTHER, alternatives, evidence, history, topology

from hmt_slam_ros.messages.team import TeamPlacement, Verdict
from hmt_slam_ros.results.plots import color_of
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.commands import Commands
from hmt_slam_ros.view.map_sections import MapSections
from hmt_slam_ros.view.server import PageServer, grid_png
from hmt_slam_ros.view.team_section import TeamSection

pytestmark = pytest.mark.skipif(
    find_browser() is None, reason="the page is looked at in a browser: apt install chromium"
)


def points(keyframe):
    """Surfaces beside a keyframe."""
    return np.array([[1.0, 0.1 * k] for k in range(20)])


class Shown:
    """A board, and the page that shows it in a browser."""

    def __init__(self, folder):
        self.board, self.commands = Board(), Commands(is_allowed=True)
        self._server = PageServer(self.board, "127.0.0.1", 0, commands=self.commands)
        self.url, self.browser = self._server.url, Browser(folder / "profile")
        self.browser.size(1280, 800)
        self.browser.open(self.url)

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
    assert lines_of(page, "robots") == [
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


@pytest.fixture
def screenshots(tmp_path):
    return screenshot_folder(tmp_path)


@pytest.fixture
def map_page(page):
    """The page with a map of two hypotheses; the walls and the past of its keyframes are there."""
    board, sections = page.board, MapSections(page.board)
    for keyframe in range(24):
        board.walls.add(keyframe, points(keyframe))
    board.clear_history()
    for event in history(24):
        board.append_event(event)
    for events in (8, 16, 24):
        sections.add_topology(topology(count=events // 4, events=events))
    sections.add_evidence(evidence())
    sections.add_alternatives(alternatives())
    board.put("robot", {"pose": [10.0, 0.0, 1.5], "ellipse": [0.2, 0.1, 0.0], "deviation": 0.1, "turn": 1.0})
    page.until(lambda: page.drawing.get("areas") == 6 and page.drawing["bars"] == 2)
    yield page
    if page.drawing["selected"] is not None:
        press(page, OTHER)
        page.until(lambda: page.drawing["selected"] is None)


def lines_of(page, name):
    return [line.strip() for line in page.text(name).split("\n") if line.strip()]


def press(page, hypothesis):
    page.browser.evaluate(f"document.querySelector('[data-hypothesis=\"{hypothesis}\"]').click()")


def test_a_selected_hypothesis_shows_its_map_its_pose_and_what_speaks_for_and_against_it(map_page, screenshots):
    best = map_page.drawing
    assert best["candidates"] == [[0, 5]]
    assert (best["closures"], best["others"], best["walls"], best["path"]) == (1, 1, 0, 24)
    assert lines_of(map_page, "reasons") == [
        "Area 5 #7 now 90.0 %",
        "closes 5 with 0, 60.0 % then",
        "12.4 m of walls match",
        "0.8 m of walls are seen through",
        "odometry and arcs alone: 3.0 %",
    ]
    map_page.browser.screenshot(screenshots / "best_hypothesis.png")
    press(map_page, OTHER)
    map_page.until(lambda: map_page.drawing["selected"] == OTHER and map_page.drawing["walls"] == 24)
    other = map_page.drawing
    assert (other["closures"], other["arcs"], other["areas"], other["path"]) == (0, 5, 6, 24)
    assert other["robot"] != best["robot"]
    shift = np.subtract(other["spots"][5]["at"], best["spots"][5]["at"])
    assert np.hypot(*shift) > 20
    assert map_page.text("banner") == "Map under hypothesis Area 5 #12"
    assert lines_of(map_page, "reasons") == [
        "Area 5 #12 now 10.0 %",
        "is on new ground, area 5, 40.0 % then",
        "does not close 0 with 5, as the most probable one does",
    ]
    map_page.browser.screenshot(screenshots / "other_hypothesis.png")
    map_page.board.append_event({**history(25)[-1], "hypotheses": [[BEST, 5, 1.0, False]], "live": 1})
    map_page.until(lambda: map_page.drawing["selected"] is None)
    assert "Hypothesis #12 has ended" in map_page.text("hint")


def test_the_colors_of_a_hypothesis_are_those_of_the_plots(page):
    for number in (0, 1, 7, 12, 345):
        expected = [round(255.0 * channel) for channel in color_of(number)]
        found = page.browser.evaluate(
            f"""import('./draw.js').then(({{ colour }}) => {{
                const context = new OffscreenCanvas(1, 1).getContext('2d');
                context.fillStyle = colour({number});
                context.fillRect(0, 0, 1, 1);
                return [...context.getImageData(0, 0, 1, 1).data].slice(0, 3);
            }})"""
        )
        assert np.abs(np.subtract(found, expected)).max() <= 3, number


def is_shown(page, name):
    return page.browser.evaluate(f"document.getElementById('{name}').offsetParent !== null")


def corner_of(page, selector):
    """Left, top, width and height of an element, px."""
    return page.browser.evaluate(
        f"(({{left, top, width, height}}) => [left, top, width, height])"
        f"(document.querySelector('{selector}').getBoundingClientRect())"
    )


def drag(page, start, end):
    """Press at one pixel of the plan, and let go at another."""
    left, top, _, _ = corner_of(page, "#plan")
    for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
        page.browser.send("Input.dispatchMouseEvent", type=kind, x=left + x, y=top + y, button="left", clickCount=1)


def test_buttons_are_there_where_the_node_allows_them_for_those_who_have_the_token(map_page, screenshots):
    page = map_page
    assert not is_shown(page, "controls")
    page.board.put("controls", True)
    page.until(lambda: "open the page by the address that view logged" in page.text("outcome"))
    assert not is_shown(page, "save")
    page.browser.open("about:blank")
    page.browser.open(f"{page.url}#token={page.commands.token}")
    page.until(lambda: page.drawing.get("areas") == 6 and is_shown(page, "save"))
    page.browser.evaluate("document.getElementById('save').click()")
    page.until(lambda: [command.kind for command in page.commands.take()] == ["save"])
    page.browser.evaluate("document.getElementById('goal').click()")
    spot = page.drawing["spots"][3]
    drag(page, spot["at"], [spot["at"][0], spot["at"][1] - 60])
    taken = []
    page.until(lambda: taken.extend(page.commands.take()) or taken)
    assert taken[0].kind == "goal"
    assert np.allclose(taken[0].pose, [-10.0, 0.0, 0.5 * np.pi], atol=0.1)
    middle = page.drawing["middle"]
    page.board.put("command", {"level": "good", "text": "goal -10.00, 0.00 m", "paused": True})
    page.until(lambda: page.text("outcome") == "goal -10.00, 0.00 m" and page.text("pause") == "Go on")
    assert page.drawing["middle"] == middle
    page.browser.screenshot(screenshots / "buttons.png")
    page.browser.evaluate("document.getElementById('statement').value = 'same 3 5 by ann'")
    page.browser.evaluate("document.querySelector('#state button').click()")
    page.until(lambda: [command.statement for command in page.commands.take()] == ["same 3 5 by ann"])
    page.board.put("controls", False)
    page.until(lambda: not is_shown(page, "controls") and not is_shown(page, "state"))
    page.board.put("recording", {"bag": "monday", "time": 1_137_834_225, "ended": True})
    page.until(lambda: page.text("recording").startswith("monday, ended "))


def test_the_path_and_the_past_are_whole_after_a_reload(map_page, screenshots):
    page = map_page
    page.browser.open("about:blank")
    page.browser.open(page.url)
    page.until(lambda: page.drawing.get("path") == 24 and page.drawing["events"] == 24)
    assert page.text("when") == "now"
    page.browser.evaluate(
        "(() => { const time = document.getElementById('time'); time.value = 1; "
        "time.dispatchEvent(new Event('input')) })()"
    )
    page.until(lambda: page.drawing["past"] == 15 and page.drawing["walls"] == 16)
    assert (page.drawing["path"], page.drawing["areas"]) == (16, 4)
    assert page.text("live") == "2 live after 8 m"
    assert page.text("when") == "0:08 of 0:16"
    assert page.text("banner") == "Map of the past"
    page.browser.screenshot(screenshots / "past.png")
    page.board.put("past", [*page.board.past.index(), [24, 1025.0]])  # the run goes on
    page.until(lambda: page.text("when") == "0:08 of 0:17")
    assert page.browser.evaluate("document.getElementById('time').value") == "1"
    page.browser.evaluate("document.getElementById('now').click()")
    page.until(lambda: page.drawing["past"] is None and page.drawing["path"] == 24)


def test_layers_are_hidden_and_shown(map_page):
    page = map_page
    page.board.put("scan", [1.0, 0.0, 1.0, 0.5])
    page.board.put("particles", [[10.0, 0.1, 0.0]])
    page.board.put("goal", [3.0, 4.0, 0.0])
    page.board.put("look", [10.1, 0.0, 0.0])  # the robot is there
    page.board.put("marks", {"lift 2": {"area": 1, "at": [0.5, 0.0]}, "door": {"area": 99, "at": [0.0, 0.0]}})
    page.board.put("rooms", [["room 1", 4.0, 3.0], ["room 2 by door 12", -4.0, -3.0]])
    corner, opening = [500, 500, 540, 500, 500, 500, 500, 540], [-500, 0, -500, 90]
    page.board.put("landmarks", {"corners": corner, "convex_corners": corner, "openings": opening})
    counts = {"scan": 2, "particles": 1, "goals": 1, "marks": 1, "areas": 6, "path": 24, "arcs": 6, "covariances": 6}
    counts |= {"rooms": 2, "landmarks": 3}
    page.until(lambda: {name: page.drawing[name] for name in counts} == counts)
    for name, count in counts.items():
        box = f"document.querySelector('[data-layer={name}]')"
        page.browser.evaluate(f"{box}.click()")
        page.until(lambda name=name, count=count: page.drawing[name] < count)
        page.browser.evaluate(f"{box}.click()")
        page.until(lambda name=name, count=count: page.drawing[name] == count)
    page.board.put("look", [5.0, 5.0, 0.0])
    page.until(lambda: page.drawing["goals"] == 2)
    page.board.append_event({**history(25)[-1], "live": 1})
    page.until(lambda: page.drawing["goals"] == 1)
    press(page, OTHER)  # rooms and landmarks are where the most probable hypothesis has them
    page.until(lambda: (page.drawing["selected"], page.drawing["rooms"], page.drawing["landmarks"]) == (OTHER, 0, 0))
    legend = page.browser.evaluate("document.getElementById('legend').textContent")
    for title in ("Scan", "Particles", "Goals", "Marks", "Path, corrected", "Landmarks", "Room names"):
        assert title in legend


def test_the_chart_has_axes_and_says_what_is_under_the_pointer(map_page):
    page = map_page
    page.board.put("events", [{"event": 12, "kind": "accepted", "text": "closure of 2 with 0 accepted"}])
    left, top, width, height = corner_of(page, ".u-over")

    def reading():
        x, y = left + width * 12.2 / 23.0, top + 0.5 * height
        page.browser.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        return page.text("reading")

    page.until(lambda: "accepted" in reading())
    assert reading() == "0:12: #7 area 5 90.0 %, #12 area 5 10.0 % · closure of 2 with 0 accepted"


TEXTS = ("ink", "soft", "good", "waiting", "attention", "fault", "area")
SIGNS = ("wall", "path", "area", "here", "arc", "closure", "robot", "scan", "particle", "goal", "mark", "landmark")


def luminance(color):
    """Relative luminance of "#rrggbb", by WCAG 2."""
    channels = np.array([int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
    linear = np.where(channels <= 0.03928, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def contrast(page, name, ground):
    style = "getComputedStyle(document.documentElement).getPropertyValue('--{}').trim()"
    shades = sorted(luminance(page.browser.evaluate(style.format(color))) for color in (name, ground))
    return (shades[1] + 0.05) / (shades[0] + 0.05)


@pytest.mark.parametrize("is_dark", [False, True], ids=["light", "dark"])
def test_texts_and_signs_have_enough_contrast_on_their_grounds(map_page, is_dark, screenshots):
    page = map_page
    page.browser.dark(is_dark)
    try:
        low = {(name, ground) for name in TEXTS for ground in ("card", "ground") if contrast(page, name, ground) < 4.5}
        low |= {
            (name, ground) for name in SIGNS for ground in ("free", "unknown") if contrast(page, name, ground) < 3.0
        }
        assert low == set()
        press(page, OTHER)
        page.until(lambda: page.drawing["walls"] == 24)
        page.browser.screenshot(screenshots / f"other_hypothesis_{'dark' if is_dark else 'light'}.png")
    finally:
        page.browser.dark(False)


def overlaps(one, other):
    """Whether two cards with names overlap; their height is 20 px."""
    return abs(one["u"] - other["u"]) < one["half"] + other["half"] and abs(one["v"] - other["v"]) < 20


def test_on_a_phone_everything_is_in_one_column_and_can_be_pressed_and_names_of_rooms_read(map_page, screenshots):
    page = map_page
    page.board.put("rooms", [[f"room {k}", 1.0 * k, 4.0 - 8.0 * (k % 2)] for k in range(8)])
    page.board.put("controls", True)
    page.browser.open("about:blank")
    page.browser.size(390, 844, mobile=True, ratio=2.0)
    try:
        page.browser.open(f"{page.url}#token={page.commands.token}")
        page.until(lambda: page.drawing.get("areas") == 6 and is_shown(page, "goal") and page.drawing["bars"] == 2)
        assert page.browser.evaluate("document.documentElement.scrollWidth - window.innerWidth") == 0
        small = page.browser.evaluate(
            "[...document.querySelectorAll('button, summary, input[type=range]')]"
            ".filter((one) => one.offsetParent && one.getBoundingClientRect().height < 28)"
            ".map((one) => one.id || one.className)"
        )
        assert small == []
        page.until(lambda: page.drawing["rooms"] == 8)
        assert not any(overlaps(*pair) for pair in combinations(page.drawing["cards"], 2))
        layers = "document.getElementById('layers')"
        page.browser.evaluate(f"{layers}.open = true")
        assert page.browser.evaluate(f"{layers}.scrollHeight - {layers}.clientHeight") == 0
        page.browser.evaluate(f"{layers}.open = false")
        page.browser.screenshot(screenshots / "phone_hypotheses.png", whole=True)
    finally:
        page.board.put("controls", False)
        page.board.put("rooms", [])
        page.browser.size(1280, 800)
        page.browser.open("about:blank")
        page.browser.open(page.url)
        page.until(lambda: page.drawing.get("areas") == 6)
