"""What a person or another program sees of a run: map, graph, particles, poses, transforms, probabilities, health."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import HistoryPolicy, QoSProfile
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.nodes import qos
from hmt_slam_ros.nodes.topics import DIAGNOSTICS, FINISHED, GRAPH, HMT_POSE, MAP, PARTICLES, POSE
from hmt_slam_ros.nodes.transforms import TFMessage

BUNDLED = Path(__file__).resolve().parent.parent / "data" / "malaga_one_loop"
PROCESSES = ("slam", "aam", "tsbi", "tlca", "rtl")
ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL)


def test_a_run_of_the_bundled_log_shows_itself_on_the_topics_that_rviz_reads(listener, start):
    maps = listener.hear(OccupancyGrid, MAP, qos.LATCHED)
    graphs = listener.hear(MarkerArray, GRAPH, qos.LATCHED)
    particles = listener.hear(PoseArray, PARTICLES, qos.STREAM)
    poses = listener.hear(PoseWithCovarianceStamped, POSE, ALL)
    local_poses = listener.hear(PoseWithCovarianceStamped, HMT_POSE, ALL)
    health = listener.hear(DiagnosticArray, DIAGNOSTICS, qos.STREAM)
    transforms = listener.hear(TFMessage, "tf", ALL) if TFMessage else None
    finished = listener.hear(String, FINISHED, qos.CHAIN)
    nodes = [start(name) for name in PROCESSES]
    nodes.append(start("robot", log=BUNDLED, robot__rate=0.0))
    listener.until(lambda: bool(finished), seconds=120.0, alive=nodes)
    listener.until(lambda: maps and len(graphs[-1].markers) > 8)

    assert maps[-1].header.frame_id == "map"
    cells = np.asarray(maps[-1].data)
    assert maps[-1].info.width * maps[-1].info.height == cells.size
    assert set(np.unique(cells)) == {-1, 0, 100}
    # The loop is 20 m x 30 m, of which the laser sees most.
    assert (cells == 0).sum() * maps[-1].info.resolution**2 > 600.0
    assert len(graphs[-1].markers) > 8
    assert {len(message.poses) for message in particles} == {12}
    assert {message.header.frame_id for message in poses} == {"map"}
    assert {"area_0", "area_1", "area_2"} <= {message.header.frame_id for message in local_poses}
    assert min(len(poses), len(local_poses)) > 100
    names = {status.name.rpartition("/")[2].partition(":")[0].strip() for array in health for status in array.status}
    assert set(PROCESSES) <= names
    if transforms is not None:
        pairs = {(t.header.frame_id, t.child_frame_id) for message in transforms for t in message.transforms}
        assert ("map", "odom") in pairs
        assert ("odom", "base_link") in pairs
