"""Landmarks and names of rooms as markers: made for subscribers alone, some at a time, and sent when they change."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from small_floor import AREAS, CONFIGURATION, make_map

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from geometry_msgs.msg import Point
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.exploration.exploration_map import ExplorationMap
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import GraphState
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.landmarks.landmarks import CONCAVE_CORNER, CONVEX_CORNER, OPENING
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.kernel_thread import KernelThread
from hmt_slam_ros.ros.landmark_markers import MAX_LANDMARKS, landmark_lines, landmark_markers
from hmt_slam_ros.ros.landmark_publisher import LandmarkExtraction, LandmarkPublisher
from hmt_slam_ros.ros.map_view import MapRenderer, MapRendererState
from hmt_slam_ros.ros.room_markers import RoomMarkers
from hmt_slam_ros.ros.view_conversions import landmarks_section, rooms_section

CERTAIN = {area: PoseGaussian.from_pose(pose) for area, pose in AREAS.items()}


def floor_state():
    """The map of the small floor as a replica."""
    hybrid_map, scans = make_map()
    areas = {area: dict(hybrid_map.keyframes(area)) for area in AREAS}
    return ReplicaState(scans, GraphState.from_areas_and_arcs(areas, {(0, 1): hybrid_map.arc_value(0, 1)}), 1)


def renderer_of(state, poses=CERTAIN):
    areas = tuple(AreaPose(area, pose) for area, pose in poses.items())
    return MapRenderer(CONFIGURATION, "map", MapRendererState(5, state, areas), events=1)


def landmark(kind, pose, width=0.0, probability=1.0):
    return Landmark(kind, PoseGaussian.from_pose(np.array(pose)), width, 0.0, Existence(probability))


def test_lines_are_the_walls_of_corners_and_the_gaps_of_openings():
    frame = np.array([10.0, 0.0, 0.5 * math.pi])
    known = [
        landmark(CONCAVE_CORNER, (1.0, 0.0, 0.25 * math.pi)),
        landmark(CONVEX_CORNER, (2.0, 0.0, 0.25 * math.pi)),
        landmark(OPENING, (3.0, 0.0, 0.0), 0.8),
        landmark(OPENING, (4.0, 0.0, 0.0), 0.8, probability=0.4),
    ]
    lines = landmark_lines([(frame, known)])
    np.testing.assert_allclose(lines["corners"], [(10, 1), (9.6, 1), (10, 1), (10, 1.4)], atol=1e-9)
    np.testing.assert_allclose(lines["convex_corners"], [(10, 2), (10, 1.6), (10, 2), (10.4, 2)], atol=1e-9)
    np.testing.assert_allclose(lines["openings"], [(10.4, 3), (9.6, 3)], atol=1e-9)
    shown = landmarks_section(landmark_markers(lines, 5, "map"))
    assert shown["corners"] == [1000, 100, 960, 100, 1000, 100, 1000, 140]
    assert shown["openings"] == [1040, 300, 960, 300]
    many = landmark_lines([(frame, known * MAX_LANDMARKS)])
    assert len(many["corners"]) // 4 + len(many["convex_corners"]) // 4 + len(many["openings"]) // 2 == MAX_LANDMARKS


def middles(message):
    """The middles of openings, shape (n, 2), m."""
    flat = np.array(landmarks_section(message)["openings"]).reshape(-1, 2, 2)
    return 0.01 * flat.mean(axis=1)


def test_landmarks_are_extracted_for_subscribers_and_sent_again_where_the_map_changed(listener):
    state = floor_state()
    renderer = renderer_of(state)
    publisher = LandmarkPublisher(listener.node, KernelThread("listener"), CONFIGURATION)
    publisher.publish_if_due(renderer)
    assert publisher._extraction is None
    received = listener.subscribe(MarkerArray, topics.LANDMARKS, topics.LATCHED)

    def has_doors():
        publisher._next_extraction = publisher._next_message = 0.0  # the test waits for no share of a core
        publisher.publish_if_due(renderer)
        found = middles(received[-1]) if received else np.empty((0, 2))
        doors = np.array([(5.0, 1.0), (10.1, 1.0), (9.9, -1.0)])
        return all((np.hypot(*(found - door).T) < 0.2).any() for door in doors)

    listener.until(has_doors)
    count = len(received)
    for _ in range(10):
        publisher._next_extraction = publisher._next_message = 0.0
        publisher.publish_if_due(renderer)
        listener.spin(0.05)
    assert len(received) == count
    moved = renderer_of(state, {0: CERTAIN[0], 1: uninformative_belief(np.zeros(3))})
    publisher.invalidate()
    listener.until(lambda: publisher.publish_if_due(moved) or len(received) > count)
    assert (middles(received[-1])[:, 0] < 8.0).all()  # where the other area is, is not known
    publisher.invalidate()  # as after a reset
    empty = MapRenderer(CONFIGURATION, "map", MapRendererState())
    listener.until(lambda: publisher.publish_if_due(empty) or len(middles(received[-1])) == 0)


def test_extraction_takes_some_milliseconds_for_each_keyframe():
    """Of a laser that sees only what is ahead, whose landmarks are those of the map around."""
    state = floor_state()
    ahead = {
        k: replace(scan, ranges=scan.ranges[180:540], angle_min=scan.angle_min + 180 * scan.angle_increment)
        for k, scan in state.scans.items()
    }
    renderer, seconds = renderer_of(replace(state, scans=ahead)), []
    for _ in range(2):  # kernels are loaded the first time
        extraction = LandmarkExtraction(CONFIGURATION, renderer.scans)
        begin = time.thread_time()
        while len(extraction.landmarks) < len(AREAS):
            extraction.advance(renderer.area_keyframes())
        seconds.append(time.thread_time() - begin)
    count = sum(map(len, renderer.area_keyframes().values()))
    print(f"{1e3 * seconds[1] / count:.1f} ms for each of {count} keyframes")
    assert seconds[1] / count < 0.05


def test_rooms_are_named_where_they_are_and_sent_again_where_they_moved():
    explored = ExplorationMap(CONFIGURATION, Replica.from_state(floor_state()))
    assert explored.version > 0
    rooms = explored.named_rooms()
    assert list(rooms) == ["room 1"]
    markers, places = RoomMarkers("map"), explored.positions_in_map(CERTAIN, rooms)
    ((name, x, y),) = rooms_section(markers.make(places))
    assert (name, math.dist((x, y), (5.0, 2.5)) < 1.0) == ("room 1", True)
    assert markers.make({"room 1": places["room 1"] + 0.03}) is None
    assert rooms_section(markers.make({"room 1": places["room 1"] + 0.1})) == [["room 1", x + 0.1, y + 0.1]]
    assert explored.positions_in_map({1: CERTAIN[1]}, rooms) == {}
    assert rooms_section(markers.make({})) == []
    markers.forget()
    assert rooms_section(markers.make({})) == []


def lines_of(count, kind="corners", x=0.0):
    return Marker(ns=kind, type=Marker.LINE_LIST, points=[Point(x=x)] * count)


def text_of(x=0.0, text="room 1"):
    marker = Marker(type=Marker.TEXT_VIEW_FACING, text=text)
    marker.pose.position.x = x
    return marker


@pytest.mark.parametrize(
    "markers",
    [[lines_of(3)], [lines_of(4, x=math.nan)], [lines_of(2, "openings", 1e12)], [lines_of(4)] * 1001,
     [lines_of(4 * MAX_LANDMARKS + 4)]],
)  # fmt: skip
def test_landmarks_that_are_none_are_refused(markers):
    with pytest.raises(HmtSlamError, match="look who publishes"):
        landmarks_section(MarkerArray(markers=markers))


@pytest.mark.parametrize("markers", [[text_of(math.inf)], [text_of()] * 501, [text_of()] * 1001])
def test_rooms_that_are_none_are_refused(markers):
    with pytest.raises(HmtSlamError, match="look who publishes"):
        rooms_section(MarkerArray(markers=markers))


def test_of_markers_of_others_only_lines_and_texts_are_taken():
    others = [lines_of(4, "walls"), Marker(ns="corners", type=Marker.CUBE), text_of(text="")]
    assert landmarks_section(MarkerArray(markers=others)) == {"corners": [], "convex_corners": [], "openings": []}
    (row,) = rooms_section(MarkerArray(markers=[*others, text_of(text="r" * 10_000)]))
    assert len(row[0]) < 300
