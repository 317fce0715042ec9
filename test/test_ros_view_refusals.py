"""The node of the live page receives what it cannot show: it refuses each message in a sentence and counts it."""

import json
import math
import re
import socket
from array import array
from urllib.request import Request, urlopen

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Float64, String
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import ScanGeometry, encode
from hmt_slam_ros.messages.topology import Topology, TopologyArea, TopologyHypothesis
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.map_layers import beams_of
from hmt_slam_ros.ros.view_conversions import area_section, finite, map_cells, map_section, robot_section
from hmt_slam_ros.view.commands import TOKEN_HEADER
from hmt_slam_ros.view.topology_section import topology_section

NAN, INFINITY = math.nan, math.inf


def pose(x=1.0, w=1.0, frame="map", variance=0.01):
    message = PoseWithCovarianceStamped()
    message.header.frame_id = frame
    message.pose.pose.position.x, message.pose.pose.orientation.w = x, w
    message.pose.covariance[0] = message.pose.covariance[7] = message.pose.covariance[35] = variance
    return message


def grid(width=3, height=2, count=6, resolution=0.05, x=0.0, w=1.0):
    message = OccupancyGrid(data=array("b", [0]) * count)
    message.info.width, message.info.height, message.info.resolution = width, height, resolution
    message.info.origin.position.x, message.info.origin.orientation.w = x, w
    return message


def topology(stamp=5, keyframes=1):
    """The document of a map of one area."""
    known = PoseGaussian(np.array([1.0, 2.0, 0.5]), 0.01 * np.eye(3))
    poses, numbers = (np.zeros(3),) * keyframes, tuple(range(keyframes))
    area = TopologyArea(0, known, numbers, (5,) * keyframes, poses)
    return Topology(1, stamp, "map", (TopologyHypothesis(0, 1.0, 0),), 0.0, 0, np.zeros(3), (area,), (), ())


def laser(angle=0.1, range_max=30.0, beams=3):
    return LaserScan(angle_min=-0.1, angle_increment=angle, range_max=range_max, ranges=[1.0] * beams)


def marker_publishers(node):
    """A function that publishes a landmark and a room at an x."""
    landmarks, rooms = (
        node.create_publisher(MarkerArray, topic, topics.LATCHED)
        for topic in (topics.LANDMARKS, topics.ROOMS["explorer"])
    )

    def publish(x):
        corner = Marker(ns="corners", type=Marker.LINE_LIST, points=[Point(x=x)] * 4)
        room = Marker(type=Marker.TEXT_VIEW_FACING, text="room 1")
        room.pose.position.x = x
        landmarks.publish(MarkerArray(markers=[corner]))
        rooms.publish(MarkerArray(markers=[room]))

    return publish


@pytest.fixture(autouse=True)
def unchecked_fields(monkeypatch):
    """Senders elsewhere do not check their fields either."""
    monkeypatch.setenv("ROS_PYTHON_CHECK_FIELDS", "0")


BAD_POSES = [
    pose(NAN), pose(INFINITY), pose(1e308), pose(w=NAN), pose(w=0.0), pose(w=2.0), pose(variance=NAN),
    pose(variance=1e308),
]  # fmt: skip
BAD_GRIDS = [
    grid(0, 0, 0), grid(0, 5, 0), grid(3, 2, 5), grid(2**32 - 1, 2**32 - 1, 6), grid(resolution=NAN),
    grid(resolution=INFINITY), grid(resolution=0.0), grid(resolution=-0.05), grid(x=NAN), grid(w=NAN), grid(w=0.0),
]  # fmt: skip
BAD_GRAPHS = [
    *("hello", encode(topology(stamp=10**400)), encode(topology()).replace("2.0,0.5", "2e9,0.5")),
    *(encode(topology()).replace('"probability":1.0', word) for word in ('"probability":NaN', '"probability":1e999')),
]
BAD_SCANS = [laser(NAN), laser(1e9), laser(range_max=NAN), laser(beams=20_001)]


@pytest.mark.parametrize("message", BAD_POSES)
def test_a_pose_that_is_none_is_refused(message):
    with pytest.raises(HmtSlamError, match=r"(position|covariance|orientation) = "):
        robot_section(message)


@pytest.mark.parametrize("message", BAD_GRIDS)
def test_a_map_that_is_none_is_refused(message):
    with pytest.raises(HmtSlamError, match=": "):
        map_section(message) and map_cells(message)


@pytest.mark.parametrize("message", BAD_SCANS)
def test_a_scan_that_is_none_is_refused(message):
    with pytest.raises(HmtSlamError, match=r"look who publishes it|is NaN"):
        beams_of(message)


def test_too_many_keyframes_and_long_frames_are_refused():
    with pytest.raises(HmtSlamError, match="a map of 0 arcs and 50001 keyframes is too large to be shown"):
        topology_section(topology(keyframes=50_001))
    for frame in ("area_" + "9" * 5000, "area_\N{ARABIC-INDIC DIGIT FOUR}", "map", ""):
        with pytest.raises(HmtSlamError, match="run the same version everywhere"):
            area_section(pose(frame=frame))


def test_a_map_beyond_what_is_shown_is_refused():
    with pytest.raises(HmtSlamError, match="a map of 64000001 x 1 cells is empty or too large"):
        map_cells(grid(64_000_001, 1, 64_000_001))


def test_what_is_well_passes():
    assert robot_section(pose())["pose"] == [1.0, 0.0, 0.0]
    assert area_section(pose(frame="area_12")) == "12"
    assert topology_section(topology())["areas"][0]["pose"] == [1.0, 2.0, 0.5]
    assert beams_of(laser()).points(ScanGeometry(0, 0.0, 0.1, 0.0, 30.0, np.zeros(3), 0.0, np.zeros(3))).shape == (3, 2)
    assert map_section(grid()) == {"origin": [0.0, 0.0], "size": [0.15, 0.1]}
    assert map_cells(grid()).shape == (2, 3)
    assert finite(0.5, "entropy") == 0.5


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def snapshot(port):
    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    with urlopen(f"http://127.0.0.1:{port}/snapshot.json", timeout=20) as answer:
        return json.load(answer, parse_constant=refuse)


def test_the_node_survives_what_a_stranger_says_counts_it_and_shows_what_is_well(listener, start):
    node = listener.node
    poses = node.create_publisher(PoseWithCovarianceStamped, topics.POSE, topics.STREAM)
    areas = node.create_publisher(PoseWithCovarianceStamped, topics.HMT_POSE, topics.STREAM)
    maps = node.create_publisher(OccupancyGrid, topics.MAP, topics.LATCHED)
    graphs = node.create_publisher(String, topics.DOCUMENTS[Topology], topics.LATCHED)
    entropies = node.create_publisher(Float64, topics.ENTROPY, topics.LATCHED)
    statuses = node.create_publisher(String, topics.ROBOT_STATUS, topics.LATCHED)
    health = node.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, topics.STREAM)
    publish_markers = marker_publishers(node)
    # Latched: the node receives these when it starts.
    maps.publish(grid(0, 0, 0))
    graphs.publish(String(data="hello"))
    entropies.publish(Float64(data=NAN))
    statuses.publish(String(data="hello"))
    publish_markers(NAN)
    port = free_port()
    view = start("view", port=port, controls="true")
    reports = listener.subscribe(DiagnosticArray, topics.DIAGNOSTICS, topics.STREAM)

    def counts():
        newest = next((s for a in reversed(reports) for s in a.status if s.name == "/view"), None)
        return {} if newest is None else {v.key: int(v.value) for v in newest.values if v.key.startswith("refused on")}

    latched = {f"refused on {topic}" for topic in (topics.DOCUMENTS[Topology], topics.ENTROPY, topics.ROBOT_STATUS)}
    listener.until(lambda: latched <= counts().keys(), alive=[view])
    with urlopen(f"http://127.0.0.1:{port}/news", timeout=20):  # a browser is there, so it subscribes to the map
        watched = {f"refused on {topic}" for topic in (topics.MAP, topics.LANDMARKS, topics.ROOMS["explorer"])}
        listener.until(lambda: watched <= counts().keys(), alive=[view])
        for message in BAD_GRIDS:
            maps.publish(message)
            listener.spin(0.25)
        for message in BAD_GRAPHS[:2]:
            before = counts()[f"refused on {topics.DOCUMENTS[Topology]}"]
            graphs.publish(String(data=message))
            listener.until(lambda: counts()[f"refused on {topics.DOCUMENTS[Topology]}"] > before, alive=[view])  # noqa: B023
        for message in BAD_POSES:
            poses.publish(message)
            listener.spin(0.25)
        areas.publish(pose(frame="area_" + "9" * 5000))
        strange = DiagnosticStatus(name="/slam", hardware_id="hmt_slam_ros")
        for busy in ("nan s", "inf s"):
            strange.values = [KeyValue(key="busy", value=busy)]
            health.publish(DiagnosticArray(status=[strange]))
            listener.spin(0.25)
        listener.until(lambda: counts().get(f"refused on {topics.HMT_POSE}", 0) > 0, alive=[view])
        assert counts()[f"refused on {topics.POSE}"] > 1
        assert not snapshot(port).keys() & {"robot", "map", "graph", "entropy", "replay", "landmarks", "rooms"}
        poses.publish(pose(4.0))
        maps.publish(grid())
        graphs.publish(String(data=encode(topology())))
        entropies.publish(Float64(data=0.25))
        publish_markers(1.0)
        shown = {"robot", "map", "graph", "entropy", "landmarks", "rooms"}
        listener.until(lambda: shown <= snapshot(port).keys(), alive=[view])
    known = snapshot(port)
    assert (known["robot"]["pose"], known["entropy"]) == ([4.0, 0.0, 0.0], 0.25)
    assert (known["landmarks"]["corners"], known["rooms"]) == ([100, 0] * 4, [["room 1", 1.0, 0.0]])
    assert_commands(listener, view, port)


def assert_commands(listener, view, port):
    """A person who has the token, which is in the log, gives initial poses and goals."""
    token = next(re.search("#token=(.*)$", line.strip())[1] for line in view.stderr if "#token=" in line)
    initial_poses = listener.subscribe(PoseWithCovarianceStamped, topics.INITIAL_POSE, topics.STREAM)
    goals = listener.subscribe(PoseStamped, topics.GOAL_POSE, topics.STREAM)
    statements = listener.subscribe(String, topics.STATEMENT, topics.STREAM)
    for topic in (topics.INITIAL_POSE, topics.GOAL_POSE, topics.STATEMENT):
        listener.until(lambda topic=topic: listener.node.count_publishers(topic), alive=[view])

    def command(**content):
        headers = {"Content-Type": "application/json", "Origin": f"http://127.0.0.1:{port}", TOKEN_HEADER: token}
        request = Request(f"http://127.0.0.1:{port}/command", data=json.dumps(content).encode(), headers=headers)
        with urlopen(request, timeout=20) as answer:
            assert answer.status == 202

    command(kind="initial_pose", pose=[1.0, 2.0, 0.0])
    command(kind="goal", pose=[3.0, 2.0, 0.0])
    command(kind="statement", statement="same 3 5 by ann")
    command(kind="save")
    listener.until(lambda: initial_poses and goals and statements, alive=[view])
    assert statements[0].data == "same 3 5 by ann"
    assert (initial_poses[0].header.frame_id, initial_poses[0].pose.pose.position.x) == ("map", 1.0)
    assert initial_poses[0].pose.covariance[0] == pytest.approx(0.25)
    assert goals[0].pose.position.x == 3.0
    listener.until(lambda: "slam/save does not answer" in snapshot(port)["command"]["text"], alive=[view])
