"""What a person or another program sees of a run: the topics that RViz reads, and the live page in a real browser.

The screenshots stay in the folder HMT_SLAM_SCREENSHOTS, or in pytest's own.
"""

import json
import signal
import socket
import time
from collections import Counter
from pathlib import Path
from threading import Thread
from urllib.request import urlopen

import numpy as np
import preloaded
import pytest
from browser import Browser, Page, find_browser, screenshot_folder
from conftest import WAIT

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import HistoryPolicy, QoSProfile
from recording import Recording
from std_msgs.msg import Float64MultiArray, String
from test_ros_hostile import watch_page
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.messages.alternatives import Alternatives
from hmt_slam_ros.messages.documents import decode, encode
from hmt_slam_ros.messages.evidence import Evidence
from hmt_slam_ros.messages.map_changes import Arc, AreaPose
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, HypothesisEstimate, Keyframe
from hmt_slam_ros.messages.team import TeamPlacement, Verdict
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.map_view import MapRenderer, MapRendererState
from hmt_slam_ros.ros.topics import (
    DIAGNOSTICS,
    DOCUMENTS,
    FINISHED,
    GRAPH,
    HMT_POSE,
    MAP,
    PARTICLES,
    PMF,
    POSE,
    TFMessage,
)
from hmt_slam_ros.sensors import Scan

BUNDLED = Path(__file__).resolve().parent.parent / "data" / "malaga_one_loop"
PROCESSES = process_names()
ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL)
TIMED = {"nodes", "topics", "incidents", "past", "events", "landmarks"}
"""Sections of the page that change while nothing happens, or depend on when the page is updated."""
DESKTOP, PHONE = (1280, 800), (390, 844)


@pytest.fixture
def browser(tmp_path):
    """None where there is none."""
    browser = Browser(tmp_path / "profile") if find_browser() else None
    yield browser
    if browser is not None:
        browser.close()


@pytest.fixture
def screenshots(tmp_path):
    return screenshot_folder(tmp_path)


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def is_served(port):
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def map_picture(port):
    with urlopen(f"http://127.0.0.1:{port}/map.png", timeout=20) as answer:
        return answer.read()


def snapshot(port):
    with urlopen(f"http://127.0.0.1:{port}/snapshot.json", timeout=20) as answer:
        return json.load(answer)


def test_a_run_of_the_bundled_log_shows_itself_on_the_topics_in_a_browser_and_from_a_recording(
    listener, start, browser, screenshots, tmp_path
):
    recording = Recording(listener, tmp_path / "bag")
    maps = listener.subscribe(OccupancyGrid, MAP, topics.LATCHED)
    graphs = listener.subscribe(MarkerArray, GRAPH, topics.LATCHED)
    particles = listener.subscribe(PoseArray, PARTICLES, topics.STREAM)
    poses = listener.subscribe(PoseWithCovarianceStamped, POSE, ALL)
    local_poses = listener.subscribe(PoseWithCovarianceStamped, HMT_POSE, ALL)
    pmfs = listener.subscribe(Float64MultiArray, PMF, topics.LATCHED)
    evidences = listener.subscribe(String, DOCUMENTS[Evidence], topics.CHAIN_HISTORY)
    alternatives = listener.subscribe(String, DOCUMENTS[Alternatives], topics.CHAIN_HISTORY)
    health = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    transforms = listener.subscribe(TFMessage, "tf", ALL) if TFMessage else None
    finished = listener.subscribe(String, FINISHED, topics.CHAIN)
    port = free_port()
    nodes = [start("view", port=port)]
    page = Page(browser, listener, nodes)
    listener.until(lambda: is_served(port), alive=nodes)
    if browser is not None:
        open_before_anything_runs(page, port)
    else:
        Thread(target=watch_page, args=(port,), daemon=True).start()
    nodes += [start(name) for name in PROCESSES]
    # At full speed a reader may miss poses, since a stream keeps the last 100.
    nodes.append(start("robot", log=BUNDLED, robot__rate=8.0))
    if browser is not None:
        page.until(lambda: page.drawing.get("robot"))
        early = page.drawing["robot"]
    listener.until(lambda: bool(finished), seconds=120.0, alive=nodes)
    # What tlca draws, every 3 s, may be of before the end.
    listener.until(lambda: maps and graphs and groups_of(graphs[-1])["areas"] >= 3, alive=nodes)

    assert_map(maps[-1])
    assert_graph(graphs[-1])
    assert {len(message.poses) for message in particles} == {12}
    assert {message.header.frame_id for message in poses} == {"map"}
    assert {"area_0", "area_1", "area_2"} <= {message.header.frame_id for message in local_poses}
    assert min(len(poses), len(local_poses)) > 100
    assert_health(health)
    assert_evidence(evidences)
    assert {decode(message.data, Alternatives).best for message in alternatives}
    if transforms is not None:
        pairs = {(t.header.frame_id, t.child_frame_id) for message in transforms for t in message.transforms}
        assert ("map", "odom") in pairs
        assert ("odom", "base_link") in pairs
    listener.spin(3.5)  # tlca draws every 3 s
    assert_recorded_page(recording, nodes[0], port)
    if browser is None:
        pytest.skip("the topics are well; the page was not looked at, as there is no browser: apt install chromium")

    page.until(lambda: "ended" in page.text("replay") and page.drawing["map"])
    page.until(lambda: page.drawing["areas"] == groups_of(graphs[-1])["areas"])
    assert_page(page, port, graphs[-1], pmfs[-1])
    assert page.drawing["robot"] != early
    assert_screens(page, port, screenshots)
    assert browser.complaints == []


def assert_screens(page, port, screenshots):
    """The page at the end of the run on a desk, in the dark and on a phone."""
    drawn, known = page.drawing, snapshot(port)
    assert min(drawn["path"], drawn["scan"]) > 50
    assert sum(event["kind"] == "accepted" for event in known["events"]) == drawn["closures"]
    page.browser.screenshot(screenshots / "desktop.png")
    assert_that_it_answers_clicks(page, known["graph"])
    page.browser.dark(True)
    page.until(lambda: page.browser.evaluate("matchMedia('(prefers-color-scheme: dark)').matches"))
    page.browser.screenshot(screenshots / "dark.png")
    page.browser.dark(False)
    assert_phone(page, screenshots)


def assert_recorded_page(recording, view, live_port):
    """The page of the bag shows what the live one does."""
    with urlopen(f"http://127.0.0.1:{live_port}/news", timeout=20):
        wait_for(lambda: {"map", "landmarks"} <= snapshot(live_port).keys(), view)
    recording.close()
    live, picture, port = snapshot(live_port), map_picture(live_port), free_port()
    with preloaded.start(preloaded.COMMAND, "view", recording.folder, "--rate", "0", "--port", port) as viewer:
        wait_for(lambda: is_served(port), viewer)
        with urlopen(f"http://127.0.0.1:{port}/news", timeout=20):
            wait_for(lambda: "map" in snapshot(port) and snapshot(port)["recording"]["ended"], viewer)
        recorded, recorded_picture = snapshot(port), map_picture(port)
        viewer.send_signal(signal.SIGINT)
    assert viewer.returncode == 0
    assert recorded.keys() == live.keys() | {"recording"}
    for section in live.keys() - TIMED:
        assert recorded[section] == live[section], section
    assert recorded_picture == picture
    rows = [{(row["name"], row["level"], row["message"]) for row in page["nodes"]} for page in (live, recorded)]
    assert rows[0] == rows[1]
    assert {row["topic"] for row in live["topics"] if row["age"] is not None} == {
        row["topic"] for row in recorded["topics"] if row["age"] is not None
    }


def wait_for(condition, process):
    """Wait until a condition holds while a process runs."""
    deadline = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        assert process.poll() is None
        time.sleep(0.1)


def assert_map(grid):
    assert grid.header.frame_id == "map"
    cells = np.asarray(grid.data)
    assert grid.info.width * grid.info.height == cells.size
    assert set(np.unique(cells)) == {-1, 0, 100}
    # The loop is 20 m x 30 m, of which the laser sees most.
    assert (cells == 0).sum() * grid.info.resolution**2 > 600.0


def groups_of(graph):
    """{namespace: number of markers}."""
    return Counter(marker.ns for marker in graph.markers)


def assert_graph(graph):
    groups = groups_of(graph)
    assert groups["areas"] == groups["labels"] == groups["area_uncertainty"] >= 3
    assert groups["arc_uncertainty"] == groups["arcs"] + groups["closures"] >= 2
    arcs = [marker for marker in graph.markers if marker.ns == "arc_uncertainty"]
    assert all(0.0 < arc.scale.y <= arc.scale.x < 2.0 and "±" in arc.text for arc in arcs)


def assert_health(health):
    reported = {status.name.strip("/"): {v.key: v.value for v in status.values} for a in health for status in a.status}
    assert set(reported) == {*PROCESSES, "robot", "view"}
    assert {"memory", "peak memory", "busy", "last error"} <= set.intersection(*map(set, reported.values()))
    assert float(reported["slam"]["effective samples"].removesuffix(" of 12")) >= 1.0
    assert 1 <= int(reported["slam"]["modes of the pose"]) <= 4
    assert float(reported["slam"]["memory"].removesuffix(" MB")) > 20.0
    values = [value for array in health for status in array.status for value in status.values]
    assert max(float(value.value) for value in values if value.key == "sent Scan a second") > 1.0


def assert_evidence(evidences):
    """Why the loop was closed, until it was accepted."""
    known = [decode(message.data, Evidence) for message in evidences]
    steps = [step for one in known for hypothesis in one.hypotheses for step in hypothesis.steps]
    assert any(step.kind == "closure" and step.matched > step.contradicting for step in steps)
    assert known[-1].hypotheses == ()


def open_before_anything_runs(page, port):
    page.browser.size(*DESKTOP)
    page.browser.open(f"http://127.0.0.1:{port}/")
    page.until(lambda: "No node is heard." in page.text("verdict"))
    assert "ros2 launch hmt_slam_ros mapping.launch.py" in page.text("verdict")
    assert page.text("silent") != "all were heard"


def assert_page(page, port, graph, pmf):
    """The page shows what the topics say."""
    drawn, known, groups = page.drawing, snapshot(port), groups_of(graph)
    assert drawn["areas"] == groups["areas"]
    assert drawn["arcs"] == groups["arcs"] + groups["closures"]
    assert drawn["closures"] == groups["closures"]
    hypotheses = zip(*[iter(pmf.data)] * 3, strict=True)
    rows = [(hypothesis, area) for hypothesis, area, _ in hypotheses if hypothesis >= 0]
    assert drawn["bars"] == len(rows)
    assert [tuple(child[:2]) for child in known["history"]["events"][-1]["hypotheses"]] == rows
    assert drawn["events"] == len(known["history"]["events"]) > 50
    assert drawn["robot"] == known["robot"]["pose"]
    assert page.text("position").startswith(f"{drawn['robot'][0]:.2f}")
    assert all(name in page.text("nodes") for name in (*PROCESSES, "robot", "view"))
    assert "samples" in page.text("nodes")
    assert page.text("silent") == "all were heard"
    assert page.colors("plan") > 50
    assert page.colors("course") >= 2
    assert page.sideways == 0


def assert_that_it_answers_clicks(page, graph):
    """A click on an area says how certain its place is; the robot can be followed, and the whole map be seen again."""
    evaluate = page.browser.evaluate
    area = graph["areas"][-1]
    spot = next(drawn["at"] for drawn in page.drawing["spots"] if drawn["area"] == area["area"])
    left, top = evaluate("(({left, top}) => [left, top])(document.getElementById('plan').getBoundingClientRect())")
    page.click(left + spot[0], top + spot[1])
    page.until(lambda: page.text("hint") == area["text"])
    assert "±" in area["text"]
    evaluate("document.getElementById('follow').click()")
    page.until(lambda: page.drawing["middle"] == page.drawing["robot"][:2])
    evaluate("document.getElementById('fit').click()")
    page.until(lambda: page.drawing["middle"] != page.drawing["robot"][:2])


def assert_phone(page, screenshots):
    page.browser.size(*PHONE, mobile=True, ratio=2.0)
    page.until(lambda: page.browser.evaluate("document.getElementById('plan').clientWidth") == PHONE[0])
    page.until(lambda: page.colors("plan") > 50)
    assert page.sideways == 0
    page.browser.screenshot(screenshots / "phone.png", whole=True)
    before = spread(page.drawing["spots"])
    page.pinch(PHONE[0] / 2, 300.0, before=100.0, after=200.0)
    page.until(lambda: spread(page.drawing["spots"]) == pytest.approx(2.0 * before, rel=0.1))


def spread(positions):
    """Pixels between the first and the last area."""
    return np.hypot(*np.subtract(positions[0]["at"], positions[-1]["at"]))


def test_an_arc_that_could_be_any_has_no_ellipse():
    view = MapRenderer(Configuration(), "map", MapRendererState())
    scan = Scan(5, np.ones(3, dtype=np.float32), -1.0, 1.0, 0.05, 30.0, np.zeros(3))
    known = PoseGaussian(np.array([1.0, 2.0, 0.1]), 0.01 * np.eye(3))
    for keyframe, area in enumerate((0, 1, 2)):
        view.update(
            Keyframe(keyframe, scan, 0.0, (HypothesisEstimate(0, area, known, True, 0.0, 0.0, Clutter(), 12.0),))
        )
    arcs = (Arc(0, 1, known), Arc(1, 2, uninformative_belief(np.array([3.0, 0.0, 0.0]))))
    view.update(Hypotheses(2, (Hypothesis(0, 0, 1.0, 2, arcs=arcs, lost=True),)))
    beliefs = (known, known.compose(known), uninformative_belief(np.array([5.0, 2.0, 0.0])))
    view.update(ClosureDecision(2, global_poses=tuple(AreaPose(area, belief) for area, belief in enumerate(beliefs))))
    groups = groups_of(view.graph_markers())
    assert (groups["areas"], groups["arcs"]) == (3, 2)
    assert (groups["area_uncertainty"], groups["arc_uncertainty"]) == (2, 1)


def test_a_page_shows_the_robot_of_its_namespace_alone_and_has_its_port_alone(listener, start):
    port = free_port()
    view = start("view", "-r", "__ns:=/left", port=port)
    mouths = {
        robot: listener.node.create_publisher(DiagnosticArray, f"/{robot}/diagnostics", topics.STREAM)
        for robot in ("left", "right")
    }
    listener.until(lambda: is_served(port) and mouths["left"].get_subscription_count() > 0, alive=[view])
    second, third = start("view", port=port), start("view", port=70000)
    for robot, mouth in mouths.items():
        status = DiagnosticStatus(name=f"/{robot}/slam", message=f"this is {robot}", hardware_id="hmt_slam_ros")
        mouth.publish(DiagnosticArray(status=[status]))
    missing = "aam, tsbi, tlca and rtl are not running."
    listener.until(lambda: snapshot(port)["verdict"]["text"] == missing, alive=[view])
    known = snapshot(port)
    assert known["about"]["namespace"] == "/left"
    assert next(row for row in known["nodes"] if row["name"] == "slam")["message"] == "this is left"
    assert second.wait(20) == 2
    assert "cannot listen on 127.0.0.1" in second.communicate()[1]
    assert third.wait(20) == 2
    assert "Max: 65535, value: 70000" in third.communicate()[1]


def test_a_page_shows_the_robots_of_the_team_that_are_joined(listener, start):
    port = free_port()
    view = start("view", "-r", "__ns:=/ann", port=port)
    node = listener.node
    health = node.create_publisher(DiagnosticArray, "/ann/diagnostics", topics.STREAM)
    placements = node.create_publisher(String, DOCUMENTS[TeamPlacement], topics.TEAM_HISTORY)
    poses = node.create_publisher(PoseWithCovarianceStamped, "/bob/pose", topics.STREAM)
    grids = node.create_publisher(OccupancyGrid, "/bob/map", topics.LATCHED)
    listener.until(lambda: is_served(port) and placements.get_subscription_count() > 0, alive=[view])
    team = DiagnosticStatus(name="/ann/team", hardware_id="hmt_slam_ros", values=[KeyValue(key="robot", value="ann")])
    place = np.array([4.0, 0.0, 0.5 * np.pi])
    for name in ("bob", "c-3po"):
        verdict = Verdict.JOINED if name == "bob" else Verdict.APART
        placements.publish(String(data=encode(TeamPlacement("ann", "ann", name, verdict, 0.999, 0.001, place))))
    grid = OccupancyGrid(data=[0, 100, -1, 0])
    grid.info.width, grid.info.height, grid.info.resolution = 2, 2, 0.5
    grids.publish(grid)
    pose = PoseWithCovarianceStamped()
    pose.pose.pose.position.x, pose.pose.pose.orientation.w = 2.0, 1.0

    def is_shown():
        health.publish(DiagnosticArray(status=[team]))
        poses.publish(pose)
        rows = snapshot(port).get("team", [])
        return len(rows) == 2 and "robot" in rows[0]

    listener.until(is_shown, alive=[view])
    bob, other = snapshot(port)["team"]
    assert bob["robot"][:2] == pytest.approx([4.0, 2.0], abs=0.01)
    assert bob["map"] is None  # nobody looks at the page
    assert (other["joined"], other["verdict"]) == (False, "apart")
    with urlopen(f"http://127.0.0.1:{port}/news", timeout=20):
        listener.until(lambda: snapshot(port)["team"][0]["map"] is not None, alive=[view])
        with urlopen(f"http://127.0.0.1:{port}/map.png?robot=bob", timeout=20) as answer:
            assert answer.read().startswith(b"\x89PNG")
