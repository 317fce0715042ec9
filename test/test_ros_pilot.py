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


def test_it_goes_to_a_room_and_has_slam_begin_at_the_door(mapped_world, listener, start):
    world, out = mapped_world
    # Slam alone would not look for the robot before it is there.
    shared = {"start_from": out, "mode": "localization", "tsbi__recheck_keyframes": 100}
    outcomes = listener.subscribe(String, "pilot/task_result", topics.LATCHED)
    places = listener.subscribe(String, PLACE, topics.LATCHED)
    starts = listener.subscribe(PoseWithCovarianceStamped, INITIAL_POSE, topics.STREAM)
    goals = listener.subscribe(PoseStamped, GOAL_POSE, topics.STREAM)
    truths = listener.subscribe(PoseStamped, "ground_truth", topics.STREAM)
    localized = listener.subscribe(Bool, IS_LOCALIZED, topics.LATCHED)
    diagnostics = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    pilot = start("pilot", **shared)
    others = [start(name, **shared) for name in PROCESSES]
    goals_ = listener.node.create_publisher(String, "pilot/task", topics.STREAM)
    listener.until(lambda: goals_.get_subscription_count() == 1, alive=[pilot])
    goals_.publish(String(data="go cellar"))
    goals_.publish(String(data="dance"))
    listener.until(lambda: outcomes, alive=[pilot])
    sentence, _, room = outcomes[0].data.rpartition(" from ")
    assert sentence == "go cellar: there is no such room: choose"
    goals_.publish(String(data=f"go {room}"))
    robot = start(
        "robot",
        log=world,
        robot__drive="commands",
        robot__rate=4.0,
        robot__start=in_hallway(world, 9.0),
        robot__scan_listeners=2,
        robot__odometry_listeners=3,
        robot__discovery_timeout=60.0,
    )
    listener.until(lambda: len(outcomes) == 2, alive=[pilot, robot, *others])
    assert outcomes[1].data == f"go {room}: the robot is there"
    # The map's frame is where the scripted drive began.
    origin = scripted_drive(world)[1][0]
    (goal,) = goals
    assert goal.header.frame_id == "map"
    place = se2.compose(origin, pose_from_message(goal.pose))
    # The last keyframe in the room is up to half a meter before the drive's end.
    np.testing.assert_allclose(place, (ROOM[0], ROOM[1] - 0.25, 0.5 * math.pi), atol=0.25)
    assert math.dist(pose_from_message(truths[-1].pose)[:2], place[:2]) < 0.2
    messages = [value.value for m in diagnostics if m.status[0].name == "/pilot" for value in m.status[0].values]
    refusal = "pilot/task is left out: 'dance' is no task: give one of localize, stop, or go and the name of a place"
    assert refusal in messages
    last = decode(places[-1].data, PlaceEstimate)
    assert (last.place, last.room, last.confident) == (room.replace("room", "door"), room, True)
    (begun,) = starts
    assert begun.header.frame_id == "map"
    true = next(pose_from_message(m.pose) for m in truths if m.header.stamp == begun.header.stamp)
    off = se2.between(se2.between(origin, true), pose_from_message(begun.pose.pose))
    assert np.abs(off).max() < 0.05, off
    listener.until(lambda: localized[-1].data, alive=others)

    # Killed, it restarts: the robot may be anywhere, and stands.
    os.kill(pilot.pid, signal.SIGKILL)
    pilot.wait(10)
    again = start("pilot", **shared)
    listener.until(lambda: decode(places[-1].data, PlaceEstimate).place is None, alive=[again, robot, *others])
    before = len(truths)
    listener.until(lambda: len(truths) > before + 20, alive=[again, robot, *others])
    last = decode(places[-1].data, PlaceEstimate)
    assert (last.place, last.room, last.confident) == (None, None, False)
    assert np.abs(pose_from_message(truths[-1].pose) - pose_from_message(truths[before].pose)).max() < 1e-9


def test_without_a_map_it_ends_with_a_sentence(start):
    node = start("pilot")
    sentence = "the pilot goes by the places of a map, and there is none: set start_from"
    assert sentence in node.communicate(timeout=60)[1]
    assert node.returncode == 2
