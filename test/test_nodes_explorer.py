"""The explorer as an OS process over DDS, with the five processes and a simulated robot that it drives."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import String

from hmt_slam_ros.nodes import qos
from hmt_slam_ros.nodes.conversions import planar_pose

WORLD = """
walls: [[0, -1, 5, -1], [5, -1, 5, 1], [5, 1, 3, 1], [3, 1, 3, 4],
  [3, 4, 1, 4], [1, 4, 1, 1], [1, 1, 0, 1], [0, 1, 0, -1]]
route: [[1, 0], [4, 0]]
settings: {field_of_view: 360.0, beams: 360, laps: 1, people: 0}
"""
"""A short hallway with an arm to the left."""

PROCESSES = ("slam", "aam", "tsbi", "tlca", "rtl")


@pytest.fixture
def system(tmp_path, start):
    """Starts all nodes."""
    world = tmp_path / "world.yaml"
    world.write_text(WORLD)

    def start_all(**parameters):
        nodes = [start(name) for name in PROCESSES]
        explorer = start("explorer", laser_pose="[0.0,0.0,0.0]", **parameters)
        robot = start(
            "robot", log=f"sim:{world}", robot__drive="commands", robot__rate=3.0, robot__scan_listeners=2,
            robot__patience=60.0,
        )  # fmt: skip
        return [*nodes, explorer, robot]

    return start_all


def test_it_explores_and_goes_where_it_is_sent(listener, system):
    outcomes = listener.hear(String, "explorer/outcome", qos.LATCHED)
    goals = listener.hear(PoseStamped, "goal_pose", qos.STREAM)
    truths = listener.hear(PoseStamped, "ground_truth", qos.STREAM)
    nodes = system()
    listener.until(lambda: outcomes, alive=nodes)
    assert outcomes[0].data == "explore: all is known that can be reached; 0 places were given up"
    path = np.array([planar_pose(message.pose)[:2] for message in truths])
    assert np.hypot(*(path - (2.0, 3.0)).T).min() < 2.0
    assert goals
    assert goals[0].header.frame_id == "map"
    errands = listener.node.create_publisher(String, "explorer/errand", 10)
    listener.until(lambda: errands.get_subscription_count() > 0)
    errands.publish(String(data="go cellar"))
    listener.until(lambda: len(outcomes) > 1, alive=nodes)
    assert outcomes[1].data.startswith("go cellar: there is no such place: choose from")
    errands.publish(String(data="go area 0"))
    listener.until(lambda: len(outcomes) > 2, alive=nodes)
    assert outcomes[2].data == "go area 0: the robot is there"


def test_others_drive_to_its_goals(listener, system):
    goals = listener.hear(PoseStamped, "goal_pose", qos.STREAM)
    truths = listener.hear(PoseStamped, "ground_truth", qos.STREAM)
    nodes = system(explorer__drive="goals")
    listener.until(lambda: goals and len(truths) > 30, alive=nodes)
    assert np.ptp([planar_pose(message.pose) for message in truths], axis=0).max() < 1e-9
