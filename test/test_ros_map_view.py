"""What tlca makes of the map for other programs: path and topology, in a bounded share of a core."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from three_areas import SECOND, START, STEP, belief, chain, keyframe

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, GraphState
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.map_changes import AreaPose, ForeignGround, ForeignKeyframe
from hmt_slam_ros.messages.messages import ClosureDecision
from hmt_slam_ros.messages.replica import ReplicaState
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import pose_from_message, stamp_from_time
from hmt_slam_ros.ros.keyframe_path import serialized_path
from hmt_slam_ros.ros.map_publisher import MapPublisher
from hmt_slam_ros.ros.map_view import MapRenderer, MapRendererState

AREA_POSES = {0: belief(np.zeros(3)), 1: belief(STEP), 2: belief(se2.compose(STEP, STEP))}
KEYFRAMES, PER_AREA = 10_000, 50


def make_renderer(area_poses=None, frame="map", foreign_ground=None):
    renderer = MapRenderer(Configuration(), frame, MapRendererState())
    for message in chain():
        renderer.update(message)
    poses = tuple(AreaPose(area, pose) for area, pose in (area_poses or AREA_POSES).items())
    renderer.update(ClosureDecision(2, 1, global_poses=poses, foreign_ground=foreign_ground))
    return renderer


@pytest.mark.parametrize("frame", ["map", "m", "odom_frame", "ann/map", "four", "seven__"])
def test_ros_reads_the_path_whatever_its_alignment(frame):
    data = make_renderer(frame=frame).path()
    path = deserialize_message(data, PathMessage)
    assert len(serialize_message(path)) == len(data)  # the bytes between fields are any
    assert {pose.header.frame_id for pose in path.poses} == {path.header.frame_id} == {frame}
    assert [stamp_from_time(pose.header.stamp) for pose in path.poses] == [START + k * SECOND for k in range(3)]
    assert stamp_from_time(path.header.stamp) == START + 2 * SECOND
    for pose, belief_ in zip(path.poses, AREA_POSES.values(), strict=True):
        assert pose_from_message(pose.pose) == pytest.approx(belief_.mean)


def test_a_path_without_keyframes_is_empty():
    data = MapRenderer(Configuration(), "map", MapRendererState()).path()
    assert deserialize_message(data, PathMessage).poses == []
    assert data == serialized_path(0, "map", np.zeros(0, dtype=np.int64), np.zeros((0, 3)))


def test_the_path_is_without_areas_of_a_lost_robot_and_ground_of_others():
    ground = ForeignGround("bob", (ForeignKeyframe(-2, 0, STEP, keyframe(9, 0, STEP).scan),))
    renderer = make_renderer({**AREA_POSES, 2: uninformative_belief(np.zeros(3))}, foreign_ground=ground)
    path = deserialize_message(renderer.path(), PathMessage)
    assert [stamp_from_time(pose.header.stamp) for pose in path.poses] == [START, START + SECOND]
    assert renderer.topology({1: STEP}).areas[0].keyframes == (0, -2)


def large_renderer():
    """A renderer of a map of 10,000 keyframes."""
    rng, scan = np.random.default_rng(0), keyframe(0, 0, STEP).scan
    areas = {a: {PER_AREA * a + k: rng.normal(size=3) for k in range(PER_AREA)} for a in range(KEYFRAMES // PER_AREA)}
    arcs = {(a, a + 1): ArcValue(belief(STEP), closure=False) for a in range(len(areas) - 1)}
    replica = ReplicaState(
        dict.fromkeys(range(KEYFRAMES), scan), GraphState.from_areas_and_arcs(areas, arcs), len(areas)
    )
    poses = tuple(AreaPose(area, belief(rng.normal(size=3))) for area in areas)
    return MapRenderer(Configuration(), "map", MapRendererState(START, replica, poses))


def least_seconds(work):
    """The CPU time of some work, the least of three repetitions."""
    seconds = []
    for _ in range(3):
        begin = time.thread_time()
        work()
        seconds.append(time.thread_time() - begin)
    return min(seconds)


def test_path_and_topology_of_10000_keyframes_take_a_few_percent_of_a_second():
    renderer = large_renderer()
    path = least_seconds(renderer.path)
    document = least_seconds(lambda: encode(renderer.topology({0: STEP})))
    print(f"path {1e3 * path:.1f} ms, topology {1e3 * document:.1f} ms")
    assert len(deserialize_message(renderer.path(), PathMessage).poses) == KEYFRAMES
    assert path < 0.05
    assert document < 0.1


def test_what_is_large_is_published_less_often(listener):
    made = []

    def make(renderer):
        made.append(time.monotonic())
        begin = time.thread_time()
        while time.thread_time() - begin < 0.04:
            pass
        return String(data=str(renderer.version))

    renderer = SimpleNamespace(version=1)
    publisher = MapPublisher(listener.node, String, "large", make, period=0.01)
    publisher.publish_if_due(renderer)
    assert made == []  # as there are no subscribers
    received = listener.subscribe(String, "large", topics.LATCHED)

    def is_made_twice():
        publisher.publish_if_due(renderer)
        renderer.version = 1 + len(made)
        return len(made) == 2

    listener.until(is_made_twice)
    assert made[1] - made[0] > 0.04 / 0.05
    listener.until(lambda: [message.data for message in received] == ["1", "2"])
    publisher.publish_if_due(SimpleNamespace(version=2))
    assert len(made) == 2
