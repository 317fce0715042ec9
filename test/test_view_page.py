"""The data of the live page, and how it is served, without ROS and without a browser."""

import http.client
import io
import json
import re
import socket
from dataclasses import replace
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from PIL import Image

from hmt_slam_ros.cli.arguments import build_parser
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import KeyframeHeader
from hmt_slam_ros.messages.messages import Hypotheses, Hypothesis, Keyframe
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.view.board import HISTORY_LENGTH, Board, ClientState, KeyframeHistory
from hmt_slam_ros.view.health import SystemHealth
from hmt_slam_ros.view.request_handler import PAGE
from hmt_slam_ros.view.server import PORT, PageServer, grid_png

NODES = ("slam", "rtl")


@pytest.fixture
def board():
    return Board()


@pytest.fixture
def server(board):
    server = PageServer(board, "127.0.0.1", 0)
    yield server
    server.close()


def status_of(request):
    with pytest.raises(HTTPError) as error:
        urlopen(request, timeout=10)
    return error.value.code


@pytest.mark.parametrize("width", [1, 4, 7])
def test_the_picture_of_a_grid_has_the_smallest_y_at_the_bottom_and_three_levels(width):
    cells = np.full((3, width), -1, dtype=np.int8)
    cells[0, 0], cells[1] = 100, 0
    picture = np.asarray(Image.open(io.BytesIO(grid_png(cells))))
    assert picture.shape == (3, width)
    assert picture[2].tolist() == [255] + [0] * (width - 1)
    assert set(picture[1]) == {85}
    assert not picture[0].any()


def test_a_browser_receives_what_changed_alone(board):
    seen = ClientState()
    board.put("area", "3")
    board.put("localized", True)
    assert board.wait_for_changes(seen) == {"area": "3", "localized": True, "history": {"anew": True, "events": []}}
    board.put("area", "3")
    assert board.wait_for_changes(seen) == {}
    board.put("area", "4")
    assert board.wait_for_changes(seen) == {"area": "4"}


def test_the_history_comes_once_and_whole_where_it_restarted(board):
    one, other = ClientState(), ClientState()
    for event in range(3):
        board.append_event(event)
    assert board.wait_for_changes(one)["history"] == {"anew": True, "events": [0, 1, 2]}
    board.append_event(3)
    assert board.wait_for_changes(one)["history"] == {"anew": False, "events": [3]}
    assert board.wait_for_changes(other)["history"] == {"anew": True, "events": [0, 1, 2, 3]}
    board.clear_history()
    board.append_event(7)
    assert board.wait_for_changes(one)["history"] == {"anew": True, "events": [7]}


def test_a_browser_that_missed_more_than_is_kept_gets_what_is_left(board):
    seen = ClientState()
    board.wait_for_changes(seen)
    for event in range(HISTORY_LENGTH + 5):
        board.append_event(event)
    assert board.wait_for_changes(seen)["history"]["events"] == list(range(5, HISTORY_LENGTH + 5))


def head(sequence, stamp):
    scan = Scan(stamp, np.ones(3, dtype=np.float32), -1.0, 0.1, 0.05, 30.0, np.zeros(3))
    return KeyframeHeader.from_keyframe(Keyframe(sequence, scan, 0.5 * sequence, ()))


def test_events_are_reported_once_in_order_when_both_halves_are_there_and_a_new_run_restarts(board):
    history, seen = KeyframeHistory(board), ClientState()

    def new_events(*messages):
        for message in messages:
            history.add(message)
        history.publish_complete()
        changes = board.wait_for_changes(seen).get("history", {"anew": False, "events": []})
        return changes["anew"], [event["event"] for event in changes["events"]]

    answers = [Hypotheses(k, (Hypothesis(3, 0, 0.25, 5), Hypothesis(1, 0, 0.75, 4, lost=True))) for k in range(3)]
    assert new_events(answers[1], answers[0]) == (True, [])
    assert new_events(head(1, 7_000_000_000), head(0, 5_500_000_000)) == (False, [0, 1])
    assert new_events(head(2, 9_000_000_000), answers[0], answers[1], head(0, 5_500_000_000)) == (False, [])
    assert new_events(answers[2]) == (False, [2])
    assert new_events(head(0, 20_000_000_000), answers[0]) == (True, [0])
    (event,) = board.wait_for_changes(ClientState())["history"]["events"]
    assert event == {
        "event": 0,
        "time": 20.0,
        "path_length": 0.0,
        "hypotheses": [[1, 4, 0.75, True], [3, 5, 0.25, False]],
        "live": 2,
    }


def test_the_page_its_style_and_its_scripts_are_served_and_request_nothing_from_elsewhere(server):
    kinds = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".txt": "text/plain"}
    files = {path.name: kinds[path.suffix] for path in PAGE.iterdir()}
    del files["index.html"]
    assert {"view.css", "view.js", "uplot.js", "uplot.css", "uplot.license.txt"} <= files.keys()
    for path, kind in [("", "text/html"), *files.items()]:
        with urlopen(server.url + path, timeout=10) as answer:
            assert answer.headers["Content-Type"].startswith(kind)
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
            # The name of the chart library has its address in the comment at its top.
            text = answer.read().decode().removeprefix("/*! https://github.com/leeoniya/uPlot (v1.6.32) */")
            assert "http:" not in text
            assert "https:" not in text
    assert status_of(server.url + "../server.py") == 404
    assert status_of(server.url + "board.py") == 404


def test_the_page_has_no_nats():
    texts = {path.name: path.read_text() for path in PAGE.iterdir() if path.name != "uplot.js"}
    assert [name for name, text in texts.items() if re.search(r"\bnats?\b", text)] == []
    node = (PAGE.parents[1] / "ros" / "publishing_nodes.py").read_text()
    assert not re.search(r"\bnats\b", node)


def test_the_map_is_sent_to_those_who_do_not_have_it(board, server):
    assert status_of(server.url + "map.png") == 404
    tag = board.put_map_image(grid_png(np.zeros((5, 5), dtype=np.int8)))
    with urlopen(server.url + "map.png", timeout=10) as answer:
        assert answer.headers["ETag"] == f'"{tag}"'
        assert answer.read().startswith(b"\x89PNG")
    assert status_of(Request(server.url + "map.png", headers={"If-None-Match": f'"{tag}"'})) == 304
    board.put_map_image(grid_png(np.full((5, 5), 100, dtype=np.int8)))
    with urlopen(Request(server.url + "map.png", headers={"If-None-Match": f'"{tag}"'}), timeout=10) as answer:
        assert answer.status == 200


def test_messages_are_streamed_and_viewers_are_counted(board, server):
    assert not board.is_watched
    with urlopen(server.url + "news", timeout=10) as stream:
        assert json.loads(stream.readline().decode().removeprefix("data: "))["history"]["anew"]
        assert stream.readline() == b"\n"
        board.put("area", "5")
        assert json.loads(stream.readline().decode().removeprefix("data: ")) == {"area": "5"}
        assert board.is_watched


def test_a_page_of_another_site_gets_nothing(server):
    assert status_of(Request(server.url + "snapshot.json", headers={"Host": "evil.example"})) == 403
    assert status_of(Request(server.url + "snapshot.json", data=b"{}")) == 403
    assert status_of(Request(server.url + "snapshot.json", data=b"{}", method="PUT")) == 501
    with urlopen(Request(server.url + "snapshot.json", headers={"Host": "localhost:8800"}), timeout=10) as answer:
        assert json.load(answer) == {"history": {"anew": True, "events": []}}


def test_the_command_line_names_the_port_of_the_node():
    options = build_parser().parse_args(["replay", "log", "--out", "out", "--view"])
    assert options.view == PORT
    assert build_parser().parse_args(["replay", "log", "--out", "out"]).view is None


def test_a_port_in_use_and_an_address_that_is_none_are_reported_in_a_sentence(board):
    sentence = r"cannot listen on 127\.0\.0\.1, port \d+ .*give another port"
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(HmtSlamError, match=sentence):
        PageServer(board, "127.0.0.1", taken.getsockname()[1])
    with pytest.raises(HmtSlamError, match="address = here is no IP address"):
        PageServer(board, "here", 0)


def test_browsers_beyond_the_twentieth_stream_take_the_place_of_the_oldest(server):
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    streams = [http.client.HTTPConnection("127.0.0.1", port, timeout=10) for _ in range(21)]
    answers = []
    for stream in streams:
        stream.request("GET", "/news")
        answers.append(stream.getresponse())
    assert [answer.status for answer in answers] == [200] * 21
    assert answers[0].read().startswith(b"data: ")  # and ends
    for stream in streams:
        stream.close()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 10**5000], ids=["nan", "infinity", "5001 digits"])
def test_what_is_no_json_does_not_reach_the_page(board, value):
    with pytest.raises(HmtSlamError, match="robot of the page is no JSON"):
        board.put("robot", {"pose": [value]})
    assert json.loads(json.dumps(board.wait_for_changes(ClientState()), allow_nan=False)) == {
        "history": {"anew": True, "events": []}
    }


def test_an_event_that_cannot_be_shown_is_refused(board):
    history = KeyframeHistory(board)
    for message in (
        replace(head(0, 5), sequence=-1),
        head(0, 10**400),
        replace(head(0, 5), path_length=float("nan")),
        Hypotheses(0, (Hypothesis(3, 0, float("inf"), 5),)),
        Hypotheses(10**30, ()),
    ):
        with pytest.raises(HmtSlamError, match=r" = .* is none of a keyframe event: run the same version everywhere"):
            history.add(message)
    history.publish_complete()
    assert board.wait_for_changes(ClientState())["history"]["events"] == []


def test_diagnostics_of_a_stranger_stay_small_and_finite():
    health = SystemHealth(NODES)
    for number in range(2000):
        health.update(f"stranger {number}", 0, "m" * 10_000, {f"{k}": "v" * 10_000 for k in range(200)}, 0.0)
    for now, busy in ((1.0, "nan s"), (2.0, "inf s"), (3.0, "-inf s")):
        health.update("slam", 0, "running", {"busy": busy}, now)
        assert json.dumps(health.rows(now), allow_nan=False)
    rows = health.rows(3.0)
    assert len(rows) <= 102
    assert len(json.dumps(rows)) < 20_000_000


def well(health, now, **messages):
    for name in NODES:
        level, text = messages.get(name, (0, "running"))
        health.update(name, level, text, {"busy": f"{0.25 * now:.3f} s"}, now)


def test_where_no_node_runs_the_page_says_what_to_start():
    verdict = SystemHealth(NODES).verdict(5.0)
    assert verdict["level"] == "waiting"
    assert "ros2 launch hmt_slam_ros mapping.launch.py" in verdict["advice"]


def test_a_node_that_is_missing_or_fell_silent_is_named():
    health = SystemHealth(NODES)
    health.update("slam", 0, "running", {}, 0.0)
    assert health.verdict(1.0)["text"] == "rtl is not running."
    assert [health.verdict(now)["level"] for now in (1.0, 10.5)] == ["waiting", "fault"]
    well(health, 2.0)
    health.update("slam", 0, "running", {}, 20.0)
    assert health.verdict(20.5) | {"advice": ""} == {
        "level": "fault",
        "text": "rtl says nothing, for 18 s.",
        "advice": "",
    }
    assert [row["level"] for row in health.rows(20.5)] == ["good", "fault"]


def test_no_pose_is_a_fault_but_not_after_the_end_of_a_log():
    health = SystemHealth(NODES)
    well(health, 0.0)
    assert health.verdict(1.0)["level"] == "waiting"
    health.last_pose_at = 0.5
    assert health.verdict(1.0) == {"level": "good", "text": "All is well.", "advice": ""}
    assert health.verdict(5.0)["text"] == "No pose for 4 s."
    health.robot_state = "ended"
    assert health.verdict(5.0)["level"] == "good"


def test_a_second_system_is_named_for_as_long_as_it_is_received():
    health = SystemHealth(NODES, last_pose_at=1.0)
    well(health, 0.0)
    health.second_system = "two"
    assert health.verdict(1.0) == {
        "level": "attention",
        "text": "A second system runs here: two.",
        "advice": "Give each system a namespace or a ROS_DOMAIN_ID of its own.",
    }
    health.second_system = ""
    health.update("rtl", 0, "running", {"second system": "2 publishers of pose"}, 1.0)
    assert health.verdict(1.0)["text"] == "A second system runs here: 2 publishers of pose."
    health.update("rtl", 0, "running", {}, 2.0)
    health.last_pose_at = 2.0
    assert health.verdict(2.0)["level"] == "good"


def test_a_node_that_is_halted_is_named_rather_than_the_pose_that_does_not_come():
    health = SystemHealth(NODES)
    well(health, 0.0)
    health.update("rtl", 0, "inactive", {"state": "inactive"}, 0.0)
    new_events = {"level": "waiting", "text": "rtl is inactive.", "advice": "ros2 lifecycle set /rtl activate"}
    assert health.verdict(1.0) == new_events
    assert health.rows(1.0)[1]["level"] == "waiting"
    health.update("rtl", 0, "running", {"state": "active"}, 1.0)
    assert "no pose came yet" in health.verdict(2.0)["text"]


def test_nodes_that_compile_are_no_alarm_and_the_longest_time_left_is_shown():
    health = SystemHealth(NODES)
    for name, left in zip(NODES, (12, 40), strict=True):
        text = f"compiling kernels, {left} s left"
        health.update(name, 0, text, {"state": "inactive", "kernels": text}, 0.0)
    assert health.verdict(1.0)["level"] == "waiting"
    assert health.verdict(1.0)["text"] == "rtl and slam: compiling kernels, 40 s left."
    assert [(row["level"], row["message"]) for row in health.rows(1.0)] == [
        ("waiting", "compiling kernels, 12 s left"),
        ("waiting", "compiling kernels, 40 s left"),
    ]
    health.update("rtl", 0, "inactive", {"state": "inactive", "kernels": "63 loaded"}, 1.0)
    assert health.verdict(1.0)["text"] == "slam: compiling kernels, 12 s left."


def test_errors_come_before_warnings_which_end_with_the_level_of_the_node():
    health = SystemHealth(NODES, last_pose_at=100.0, is_localized=False)
    well(health, 0.0, slam=(1, "the wheels slip"))
    assert health.verdict(1.0) == {"level": "attention", "text": "slam warns.", "advice": "the wheels slip"}
    well(health, 99.0)
    assert health.rows(100.0)[0] | {"values": 0} == {
        "name": "slam",
        "level": "good",
        "message": "running",
        "values": 0,
        "load": 0.25,
    }
    assert health.verdict(100.0)["text"].startswith("The robot's place is not known yet")
    well(health, 100.0, slam=(1, "the wheels slip"), rtl=(2, "the chain has a gap"))
    assert health.verdict(100.0) == {"level": "fault", "text": "rtl has a fault.", "advice": "the chain has a gap"}
