"""The pilot as an OS process over DDS, with the five processes and a simulated robot that it drives in a saved map."""

import math
import os
import re
import signal
from typing import NamedTuple

import numpy as np
import pytest
from door_floor import ROOM, in_hallway, scripted_drive, write_world
from preloaded import hmt_slam

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.action import ActionClient
from std_msgs.msg import Bool, Header, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.documents import decode
from hmt_slam_ros.messages.tasks import PlaceEstimate, TaskFeedback
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import pose_from_message, pose_message
from hmt_slam_ros.ros.navigation_action import NavigateToPose
from hmt_slam_ros.ros.topics import DIAGNOSTICS, GOAL_POSE, INITIAL_POSE, IS_LOCALIZED, PLACE, ROOMS, TASK_FEEDBACK

PROCESSES = process_names()


@pytest.fixture(scope="module")
def mapped_world(tmp_path_factory):
    """The world, and the folder of its map."""
    folder = tmp_path_factory.mktemp("floor")
    world, out = write_world(folder), folder / "out"
    hmt_slam("map", world, "--out", out, check=True)
    return world, out


class SentGoal(NamedTuple):
    """A goal of the action, the future of its result, and its feedback."""

    handle: object
    result: object
    feedback: list


class PilotedRobot:
    """The pilot, the five processes and a robot in a mapped world, and what they publish."""

    def __init__(self, mapped_world, listener, start):
        self.world, self._out = mapped_world
        self._listener, self._start = listener, start
        # Slam alone would not look for the robot before it is there.
        self._shared = {"start_from": self._out, "mode": "localization", "tsbi__recheck_keyframes": 100}
        self.outcomes = listener.subscribe(String, "pilot/task_result", topics.LATCHED)
        self.starts = listener.subscribe(PoseWithCovarianceStamped, INITIAL_POSE, topics.STREAM)
        self.goals = listener.subscribe(PoseStamped, GOAL_POSE, topics.STREAM)
        self._places = listener.subscribe(String, PLACE, topics.LATCHED)
        self._truths = listener.subscribe(PoseStamped, "ground_truth", topics.STREAM)
        self._localized = listener.subscribe(Bool, IS_LOCALIZED, topics.LATCHED)
        self.rooms = listener.subscribe(MarkerArray, ROOMS["pilot"], topics.LATCHED)
        self._reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
        self._documents = listener.subscribe(String, TASK_FEEDBACK, topics.STREAM)
        self.goal_poses = listener.node.create_publisher(PoseStamped, "pilot/goal", topics.STREAM)
        self._tasks = listener.node.create_publisher(String, "pilot/task", topics.STREAM)
        self._alive = [start(name, **self._shared) for name in PROCESSES]
        self.pilot = start("pilot", **self._shared)
        self.until(lambda: self._tasks.get_subscription_count() == self.goal_poses.get_subscription_count() == 1)
        if NavigateToPose is not None:
            self._action = ActionClient(listener.node, NavigateToPose, "navigate_to_pose")

    def until(self, condition):
        self._listener.until(condition, alive=[self.pilot, *self._alive])

    def give(self, task):
        self._tasks.publish(String(data=task))

    def start_robot(self):
        robot = self._start(
            "robot",
            log=self.world,
            robot__drive="commands",
            robot__rate=4.0,
            robot__start=in_hallway(self.world, 9.0),
            robot__scan_listeners=2,
            robot__odometry_listeners=3,
            robot__discovery_timeout=60.0,
        )
        self._alive.append(robot)

    def restart_pilot(self):
        os.kill(self.pilot.pid, signal.SIGKILL)
        self.pilot.wait(10)
        self.pilot = self._start("pilot", **self._shared)

    def call(self, kind, name, request):
        return self._listener.call(kind, name, request)

    def wait_for(self, future):
        self.until(future.done)
        return future.result()

    def send_goal(self, goal):
        """A goal of the action that is accepted."""
        self.until(self._action.server_is_ready)
        feedback = []
        request = NavigateToPose.Goal(pose=goal, behavior_tree="ignored")
        handle = self.wait_for(self._action.send_goal_async(request, feedback.append))
        assert handle.accepted
        return SentGoal(handle, handle.get_result_async(), feedback)

    def result_of(self, goal):
        """The status of a goal that ended, and its sentence."""
        answer = self.wait_for(goal.result)
        return answer.status, answer.result.error_msg

    def close(self):
        """End the client, which the listener's node does not."""
        if NavigateToPose is not None:
            self._action.destroy()

    @property
    def feedback(self):
        return [decode(message.data, TaskFeedback) for message in self._documents]

    @property
    def place(self):
        """The last place."""
        return decode(self._places[-1].data, PlaceEstimate)

    @property
    def is_localized(self):
        return self._localized[-1].data

    def messages(self):
        """All messages in the pilot's diagnostics."""
        return [v.value for m in self._reports if m.status[0].name == "/pilot" for v in m.status[0].values]

    def truth(self, stamp=None):
        """The last true pose, or that of a stamp."""
        found = self._truths[-1] if stamp is None else next(m for m in self._truths if m.header.stamp == stamp)
        return pose_from_message(found.pose)

    def wait_for_truths(self, count):
        before = len(self._truths)
        self.until(lambda: len(self._truths) > before + count)


def test_it_goes_to_a_room_and_has_slam_begin_at_the_door(mapped_world, listener, start):
    run = PilotedRobot(mapped_world, listener, start)
    run.give("go cellar")
    run.give("dance")
    run.until(lambda: run.outcomes)
    sentence, _, room = run.outcomes[0].data.rpartition(" from ")
    assert sentence == "go cellar: there is no such room: choose"
    run.give(f"go {room}")
    run.start_robot()
    run.until(lambda: len(run.outcomes) == 2)
    assert run.outcomes[1].data == f"go {room}: the robot is there"
    refusal = "pilot/task is left out: 'dance' is no task: give one of localize, stop, or go and the name of a place"
    assert refusal in run.messages()
    place = run.place
    assert f"{room} behind {place.place}" in run.messages()
    assert (place.place[:5], place.room, place.confident) == ("door ", room, True)
    # The map's frame is where the scripted drive began.
    origin = scripted_drive(run.world)[1][0]
    (goal,) = run.goals
    assert goal.header.frame_id == "map"
    there = se2.compose(origin, pose_from_message(goal.pose))
    # The last keyframe in the room is up to half a meter before the drive's end.
    np.testing.assert_allclose(there, (ROOM[0], ROOM[1] - 0.25, 0.5 * math.pi), atol=0.25)
    (marker,) = [marker for marker in run.rooms[-1].markers if marker.text == room]
    shown = se2.transform(origin, np.array([marker.pose.position.x, marker.pose.position.y]))
    np.testing.assert_allclose(shown, there[:2], atol=0.1)
    assert math.dist(run.truth()[:2], there[:2]) < 0.2
    assert_start(run, origin)
    run.until(lambda: run.is_localized)
    assert_goals_by_topics(run, origin)
    if NavigateToPose is not None:
        assert_goals_by_the_action(run, origin)

    # Killed, it restarts: the robot may be anywhere, and stands.
    run.restart_pilot()
    run.until(lambda: run.place.place is None)
    before = run.truth()
    run.wait_for_truths(20)
    place = run.place
    assert (place.place, place.room, place.confident) == (None, None, False)
    assert np.abs(run.truth() - before).max() < 1e-9


def goal_in_map(origin, x, y, heading=0.0, frame="map"):
    """A goal at a pose of the world."""
    pose = pose_message(se2.between(origin, np.array([x, y, heading])))
    return PoseStamped(header=Header(frame_id=frame), pose=pose)


def assert_goals_by_topics(run, origin):
    """Bad goals are refused with a sentence each; one under way is reported, and canceled by a service."""
    refused = {
        "is outside the map: give one within 4 m of where the robot has been": goal_in_map(origin, 30.0, 0.0),
        "the map has no frame 'area_99': give the goal in map": goal_in_map(origin, 4.0, 2.5, frame="area_99"),
        "the map has no frame 'base_link': give the goal in map": goal_in_map(origin, 4.0, 2.5, frame="base_link"),
        "the goal is no pose: ": goal_in_map(origin, math.nan, 2.5),
    }
    for sentence, goal in refused.items():
        before = len(run.outcomes)
        run.goal_poses.publish(goal)
        run.until(lambda before=before: len(run.outcomes) > before)
        assert sentence in run.outcomes[-1].data
    run.goal_poses.publish(goal_in_map(origin, 8.0, 0.0))
    run.until(lambda: run.feedback and run.feedback[-1].distance_remaining is not None)
    feedback = run.feedback[-1]
    assert re.fullmatch(r"navigate to \(-?[\d.]+, -?[\d.]+\)", feedback.task)
    assert 3.0 < feedback.distance_remaining < 10.0
    assert feedback.elapsed >= 0.0
    before = len(run.outcomes)
    answer = run.call(Trigger, "pilot/cancel", Trigger.Request())
    assert (answer.success, answer.message) == (True, f"canceled: {feedback.task}")
    run.until(lambda: len(run.outcomes) > before)
    assert run.outcomes[-1].data == f"{feedback.task}: canceled"
    answer = run.call(Trigger, "pilot/cancel", Trigger.Request())
    assert (answer.success, answer.message) == (False, "there is no task to cancel")


def assert_goals_by_the_action(run, origin):
    """As a client of nav2 has it: refusal, a new goal in place of one, feedback, success and cancellation."""
    answer = run.wait_for(run.send_goal(goal_in_map(origin, math.inf, 0.0)).result)
    assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_ABORTED, 202)
    assert answer.result.error_msg.startswith("the goal is no pose: ")
    first = run.send_goal(goal_in_map(origin, 8.0, 0.0))
    # The pilot stands where it was canceled; the second goal is near.
    there = se2.compose(run.truth(), np.array([0.0, 0.0, 0.5]))
    assert run.result_of(run.send_goal(goal_in_map(origin, *there))) == (GoalStatus.STATUS_SUCCEEDED, "")
    assert abs(se2.between(run.truth(), there)[2]) < 0.2
    assert run.result_of(first) == (GoalStatus.STATUS_ABORTED, "replaced by another task")
    third = run.send_goal(goal_in_map(origin, 8.0, 0.0))
    run.until(lambda: third.feedback and third.feedback[-1].feedback.distance_remaining > 1.0)
    newest = third.feedback[-1].feedback
    shown = se2.compose(origin, pose_from_message(newest.current_pose.pose))
    assert np.abs(se2.between(run.truth(newest.current_pose.header.stamp), shown)).max() < 0.2
    assert newest.current_pose.header.frame_id == "map"
    assert newest.navigation_time.sec >= 0
    run.wait_for(third.handle.cancel_goal_async())
    assert run.result_of(third) == (GoalStatus.STATUS_CANCELED, "canceled")
    run.close()


def assert_start(run, origin):
    """The one initial pose that the pilot gave slam is true."""
    (begun,) = run.starts
    assert begun.header.frame_id == "map"
    true = se2.between(origin, run.truth(begun.header.stamp))
    off = se2.between(true, pose_from_message(begun.pose.pose))
    assert np.abs(off).max() < 0.05, off


def test_without_a_map_it_ends_with_a_sentence(start):
    node = start("pilot")
    sentence = "the pilot goes by the places of a map, and there is none: set start_from"
    assert sentence in node.communicate(timeout=60)[1]
    assert node.returncode == 2
