"""The pilot as an OS process over DDS, with the five processes and a simulated robot that it drives in a saved map."""

import math
import os
import signal

import numpy as np
import pytest
from door_floor import ROOM, in_hallway, scripted_drive, write_world
from preloaded import hmt_slam

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from std_msgs.msg import Bool, String

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.documents import decode
from hmt_slam_ros.messages.tasks import PlaceEstimate
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import pose_from_message
from hmt_slam_ros.ros.topics import DIAGNOSTICS, GOAL_POSE, INITIAL_POSE, IS_LOCALIZED, PLACE

PROCESSES = process_names()


@pytest.fixture(scope="module")
def mapped_world(tmp_path_factory):
    """The world, and the folder of its map."""
    folder = tmp_path_factory.mktemp("floor")
    world, out = write_world(folder), folder / "out"
    hmt_slam("map", world, "--out", out, check=True)
    return world, out


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
        self._reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
        self._tasks = listener.node.create_publisher(String, "pilot/task", topics.STREAM)
        self._alive = [start(name, **self._shared) for name in PROCESSES]
        self.pilot = start("pilot", **self._shared)
        self.until(lambda: self._tasks.get_subscription_count() == 1)

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
    assert math.dist(run.truth()[:2], there[:2]) < 0.2
    assert_start(run, origin)
    run.until(lambda: run.is_localized)

    # Killed, it restarts: the robot may be anywhere, and stands.
    run.restart_pilot()
    run.until(lambda: run.place.place is None)
    before = run.truth()
    run.wait_for_truths(20)
    place = run.place
    assert (place.place, place.room, place.confident) == (None, None, False)
    assert np.abs(run.truth() - before).max() < 1e-9


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
