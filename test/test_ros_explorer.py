"""The explorer as an OS process over DDS, with the five processes and a simulated robot that it drives."""

import json

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.documents import decode, encode
from hmt_slam_ros.messages.tasks import TaskFeedback
from hmt_slam_ros.messages.team import TeamGoal, TeamPlace
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import keyframe_frame, pose_from_message, pose_message
from hmt_slam_ros.ros.topics import DIAGNOSTICS, KEYFRAME_SCANS, KEYFRAMES, ROOMS, TASK_FEEDBACK

WORLD = """
walls: [[0, -1, 5, -1], [5, -1, 5, 1], [5, 1, 3, 1], [3, 1, 3, 4],
  [3, 4, 1, 4], [1, 4, 1, 1], [1, 1, 0, 1], [0, 1, 0, -1]]
route: [[1, 0], [4, 0]]
settings: {field_of_view: 360.0, beams: 360, laps: 1, people: 0}
"""
"""A short hallway with an arm to the left."""

PROCESSES = process_names()

REAR_ANGLE = 0.5
"""Heading of the second laser, rad, which sees what the first one sees."""


class SecondLaser:
    """Sends each scan again as that of a second laser, as soon as it is switched on."""

    def __init__(self, listener):
        self.is_on = False
        self._scans = listener.node.create_publisher(LaserScan, "scan_rear", 10)
        listener.node.create_subscription(LaserScan, "scan", self._on_scan, 10)

    def _on_scan(self, scan):
        if self.is_on:
            scan.angle_min -= REAR_ANGLE
            scan.angle_max -= REAR_ANGLE
            self._scans.publish(scan)


class Bob:
    """Another robot of the team, which sends two goals, of which the second is none."""

    def __init__(self, listener):
        self._listener, self._goals = listener, listener.subscribe(String, "/team/goals", topics.TEAM_HISTORY)
        self._publisher = listener.node.create_publisher(String, "/team/goals", topics.TEAM_HISTORY)
        for goal in (
            TeamGoal("bob", 9, False, False, TeamPlace("bob", 7, np.zeros(3)), False, 5.0),
            TeamGoal("bob", 9, False, False, None, False, -1.0),
        ):
            self._publisher.publish(String(data=encode(goal)))

    def assert_goals_were_exchanged(self, reports):
        """Ann has sent where she drives to, and at last that it is nowhere; she has refused what makes no sense."""
        self._listener.until(lambda: decode(self._goals[-1].data, TeamGoal).place is None)
        goals = [decode(message.data, TeamGoal) for message in self._goals]
        places = [goal.place for goal in goals[:-1] if goal.robot == "ann"]
        assert places and {place.owner for place in places} == {"ann"}
        values = [value for report in reports for value in report.status[0].values if value.key.endswith("/team/goals")]
        assert {(value.key, value.value) for value in values} == {("refused on /team/goals", "1")}


@pytest.fixture
def system(tmp_path, start, listener):
    """Starts all nodes, the robot once the test's node knows the explorer, whose first goal may be its only one."""
    world = tmp_path / "world.yaml"
    world.write_text(WORLD)

    def start_all(**parameters):
        nodes = [start(name) for name in PROCESSES]
        explorer = start("explorer", **{"laser_pose": "[0.0,0.0,0.0]", **parameters})
        listener.until(lambda: listener.node.count_publishers("goal_pose"))
        robot = start(
            "robot",
            log=f"sim:{world}",
            robot__drive="commands",
            robot__rate=3.0,
            robot__scan_listeners=2,
            robot__discovery_timeout=60.0,
        )
        return [*nodes, explorer, robot]

    return start_all


def test_it_explores_goes_where_it_is_sent_and_restarts_with_another_map(listener, system, start):
    """It also restarts where it was not there when the map was exchanged. Without a task there is none to cancel.

    It has two lasers, and stands while one of them is silent.
    """
    outcomes = listener.subscribe(String, "explorer/task_result", topics.LATCHED)
    rooms = listener.subscribe(MarkerArray, ROOMS["explorer"], topics.LATCHED)
    goals = listener.subscribe(PoseStamped, "goal_pose", topics.STREAM)
    truths = listener.subscribe(PoseStamped, "ground_truth", topics.STREAM)
    feedback = listener.subscribe(String, TASK_FEEDBACK, topics.STREAM)
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    second, bob = SecondLaser(listener), Bob(listener)
    nodes = system(
        robot_name="ann", sensors__scan_topics="scan,scan_rear", laser_pose=f"[0.0,0.0,0.0,0.0,0.0,{REAR_ANGLE}]"
    )
    assert_stands_beside_a_silent_laser(listener, nodes, reports, truths)
    second.is_on = True
    listener.until(lambda: outcomes, alive=nodes)
    assert_feedback_is_of_exploring(feedback)
    bob.assert_goals_were_exchanged(reports)
    assert_there_is_nothing_to_cancel(listener)
    explored = "explore: all is known that can be reached; 0 places were given up"
    assert outcomes[0].data == explored
    path = np.array([pose_from_message(message.pose)[:2] for message in truths])
    assert np.hypot(*(path - (2.0, 3.0)).T).min() < 2.0
    assert goals and goals[0].header.frame_id == "map"
    goals_ = listener.node.create_publisher(String, "explorer/task", 10)
    poses = listener.node.create_publisher(PoseStamped, "explorer/goal", 10)
    listener.until(lambda: goals_.get_subscription_count() and poses.get_subscription_count())
    goals_.publish(String(data="go cellar"))
    listener.until(lambda: len(outcomes) > 1, alive=nodes)
    assert outcomes[1].data.startswith("go cellar: there is no such place: choose from")
    assert outcomes[1].data.endswith(" room 1, area 0")
    listener.until(lambda: len(rooms[-1].markers) > 1, alive=nodes)  # it is published once a second
    assert_room_is_the_arm(rooms[-1])
    goals_.publish(String(data="go area 0"))
    listener.until(lambda: len(outcomes) > 2, alive=nodes)
    assert outcomes[2].data == "go area 0: the robot is there"
    goals_.publish(String(data="disambiguate"))
    listener.until(lambda: len(outcomes) > 3, alive=nodes)
    assert outcomes[3].data == "disambiguate: the place is sure"
    goal = np.array([2.5, 0.0, 0.3])
    # The first area's frame is where the robot began, the route's first point.
    pose = pose_message(se2.between(np.array([1.0, 0.0, 0.0]), goal))
    poses.publish(PoseStamped(header=Header(frame_id="area_0"), pose=pose))
    listener.until(lambda: len(outcomes) > 4, alive=nodes)
    assert outcomes[4].data == f"navigate to ({pose.position.x:.2f}, {pose.position.y:.2f}): the robot is there"
    np.testing.assert_allclose(pose_from_message(truths[-1].pose), goal, atol=0.25)

    *others, explorer, robot = nodes
    assert listener.call(Trigger, "slam/reset", Trigger.Request()).success
    listener.until(lambda: len(outcomes) > 5, alive=nodes)
    explorer.kill()
    explorer.communicate()
    received = len(outcomes)
    again = start("explorer", laser_pose="[0.0,0.0,0.0]")
    listener.until(lambda: len(outcomes) > received, alive=[*others, robot, again])
    assert {outcome.data for outcome in outcomes[5:]} == {explored}


def assert_feedback_is_of_exploring(messages):
    reported = [decode(message.data, TaskFeedback) for message in messages]
    assert {each.task for each in reported} == {"explore"}
    assert max(each.distance_remaining or 0.0 for each in reported) > 0.5


def assert_there_is_nothing_to_cancel(listener):
    answer = listener.call(Trigger, "explorer/cancel", Trigger.Request())
    assert (answer.success, answer.message) == (False, "there is no task to cancel")


def assert_room_is_the_arm(message):
    (marker,) = [marker for marker in message.markers if marker.text == "room 1"]
    assert 0.0 < marker.pose.position.x < 2.0  # from where the robot began, at (1, 0)
    assert 1.0 < marker.pose.position.y < 4.0
    assert marker.header.frame_id == "map"


def assert_stands_beside_a_silent_laser(listener, nodes, reports, truths):
    silence = "scans come on scan, and none on scan_rear, so that the robot stands"
    listener.until(lambda: any(silence in one.status[0].message for one in reports) and truths, alive=nodes)
    assert np.ptp([pose_from_message(message.pose) for message in truths], axis=0).max() < 1e-9


@pytest.mark.long
def test_where_a_part_of_the_map_never_comes_it_ends_with_a_sentence(listener, system, start):
    """Slam comes back without what it sent before its last checkpoint, and the explorer did not receive that."""
    keyframes = listener.subscribe(String, KEYFRAMES, topics.CHAIN)
    nodes = system()
    listener.until(lambda: len(keyframes) > 2, alive=nodes)
    explorer, slam = nodes[-2], nodes[0]
    for node in (explorer, slam):
        node.kill()
        node.communicate()
    writer = listener.node.create_publisher(String, KEYFRAMES, topics.CHAIN)
    scans = listener.node.create_publisher(LaserScan, KEYFRAME_SCANS, topics.CHAIN)
    ahead = [json.dumps({**json.loads(keyframes[2].data), "sequence": sequence}) for sequence in (2, 3, 4)]
    late = start("explorer", laser_pose="[0.0,0.0,0.0]")
    scan = LaserScan(angle_min=-3.0, angle_max=3.0, angle_increment=0.1, range_max=10.0, ranges=[1.0] * 61)
    listener.until(lambda: writer.get_subscription_count() > 0)
    for sequence, document in enumerate(ahead, 2):
        scan.header.frame_id = keyframe_frame(sequence)
        writer.publish(String(data=document))
        scans.publish(scan)
    error = late.communicate(timeout=60.0)[1]
    assert late.returncode == 2
    assert "Keyframe 0 never came, 2 did" in error


def test_others_drive_to_its_goals(listener, system):
    goals = listener.subscribe(PoseStamped, "goal_pose", topics.STREAM)
    truths = listener.subscribe(PoseStamped, "ground_truth", topics.STREAM)
    nodes = system(explorer__drive="goals")
    listener.until(lambda: goals and len(truths) > 30, alive=nodes)
    assert np.ptp([pose_from_message(message.pose) for message in truths], axis=0).max() < 1e-9
