"""The node of the live page receives what it cannot show: it refuses each message in a sentence and counts it."""

import json
import math
import socket
from array import array
from urllib.request import urlopen

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, Quaternion
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Float64, String
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.view_conversions import area_section, finite, graph_section, map_cells, map_section, robot_section

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


def graph(x=1.0, angle=0.0, scale=1.0, points=2, end=2.0):
    disc, line = Marker(ns="areas", id=1), Marker(ns="arcs", id=2, points=[Point(x=end)] * points)
    ellipse = Marker(ns="arc_uncertainty", id=2, text="t" * 10_000)
    disc.pose.position.x, ellipse.scale.x = x, scale
    ellipse.pose.orientation = Quaternion(z=math.sin(0.5 * angle), w=math.cos(0.5 * angle))
    return MarkerArray(markers=[disc, line, ellipse])


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
BAD_GRAPHS = [graph(NAN), graph(1e308), graph(angle=NAN), graph(scale=INFINITY), graph(points=17), graph(end=NAN)]


@pytest.mark.parametrize("message", BAD_POSES)
def test_a_pose_that_is_none_is_refused(message):
    with pytest.raises(HmtSlamError, match=r"(position|covariance|orientation) = "):
        robot_section(message)


@pytest.mark.parametrize("message", BAD_GRIDS)
def test_a_map_that_is_none_is_refused(message):
    with pytest.raises(HmtSlamError, match=": "):
        map_section(message) and map_cells(message)


@pytest.mark.parametrize("message", BAD_GRAPHS)
def test_a_graph_that_is_none_is_refused(message):
    with pytest.raises(HmtSlamError, match=": "):
        graph_section(message)


def test_too_many_markers_and_long_frames_are_refused():
    with pytest.raises(HmtSlamError, match="a graph has 20001 markers, more than 20000"):
        graph_section(MarkerArray(markers=[Marker()] * 20_001))
    for frame in ("area_" + "9" * 5000, "area_\N{ARABIC-INDIC DIGIT FOUR}", "map", ""):
        with pytest.raises(HmtSlamError, match="run the same version everywhere"):
            area_section(pose(frame=frame))


def test_a_map_beyond_what_is_shown_is_refused():
    with pytest.raises(HmtSlamError, match="a map of 64000001 x 1 cells is empty or too large"):
        map_cells(grid(64_000_001, 1, 64_000_001))


def test_what_is_well_passes():
    assert robot_section(pose())["pose"] == [1.0, 0.0, 0.0]
    assert area_section(pose(frame="area_12")) == "12"
    assert graph_section(graph())["arcs"][0]["ends"] == [[2.0, 0.0]] * 2
    assert len(graph_section(graph())["arcs"][0]["text"]) == 500
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
    graphs = node.create_publisher(MarkerArray, topics.GRAPH, topics.LATCHED)
    entropies = node.create_publisher(Float64, topics.ENTROPY, topics.LATCHED)
    statuses = node.create_publisher(String, topics.ROBOT_STATUS, topics.LATCHED)
    health = node.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, topics.STREAM)
    # Latched: the node receives these when it starts.
    maps.publish(grid(0, 0, 0))
    graphs.publish(graph(angle=NAN))
    entropies.publish(Float64(data=NAN))
    statuses.publish(String(data="hello"))
    port = free_port()
    view = start("view", port=port)
    reports = listener.subscribe(DiagnosticArray, topics.DIAGNOSTICS, topics.STREAM)

    def counts():
        newest = next((s for a in reversed(reports) for s in a.status if s.name == "/view"), None)
        return {} if newest is None else {v.key: int(v.value) for v in newest.values if v.key.startswith("refused on")}

    latched = {f"refused on {topic}" for topic in (topics.GRAPH, topics.ENTROPY, topics.ROBOT_STATUS)}
    listener.until(lambda: latched <= counts().keys(), alive=[view])
    with urlopen(f"http://127.0.0.1:{port}/news", timeout=20):  # a browser is there, so it subscribes to the map
        listener.until(lambda: f"refused on {topics.MAP}" in counts(), alive=[view])
        for message in BAD_GRIDS:
            maps.publish(message)
            listener.spin(0.25)
        for message in BAD_GRAPHS:
            graphs.publish(message)
            listener.spin(0.25)
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
        assert not snapshot(port).keys() & {"robot", "map", "graph", "entropy", "replay"}
        poses.publish(pose(4.0))
        maps.publish(grid())
        graphs.publish(graph())
        entropies.publish(Float64(data=0.25))
        listener.until(lambda: {"robot", "map", "graph", "entropy"} <= snapshot(port).keys(), alive=[view])
    assert snapshot(port)["robot"]["pose"] == [4.0, 0.0, 0.0]
    assert snapshot(port)["entropy"] == 0.25
