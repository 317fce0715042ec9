"""The pilot as a process on a small floor: what it says, and how it has metric SLAM begin at doors."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small_floor import AREAS, CONFIGURATION, keyframes, make_map, seen_at

from hmt_slam_ros.configuration.flat import with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.exploration.exploration_map import ExplorationMap
from hmt_slam_ros.exploration.pilot import PilotProcess
from hmt_slam_ros.exploration.pose_goals import anchor_pose
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.messages import ClosureDecision, PoseReset, RealTimePose
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import (
    PILOT_TASKS,
    GoalPose,
    PlaceEstimate,
    Task,
    TaskError,
    TaskResult,
    VelocityCommand,
    parse_task,
)
from hmt_slam_ros.sensors import Odometry

PERIOD = 0.2
BEGIN = 5_000_000_000
KNOWN = np.diag([0.02, 0.02, 0.005]) ** 2
NEW_AREA = 7
"""Which the map has not: where metric SLAM maps that does not know where it is."""


@pytest.fixture(scope="module")
def saved_map():
    hybrid_map, scans = make_map()
    return Replica(scans, {0: hybrid_map}, {0: 1.0}, {0: 0}).state


class Robot:
    """It follows commands, and RTL gives its pose: always, from the door on, never, or elsewhere.

    RTL that is lost has it in an area that the map has not.

    :ivar slip: what the wheels roll of what the robot goes, in the room.
    """

    def __init__(self, missions, pose, rtl="always"):
        self.missions, self.pose, self.odometry, self.rtl = missions, np.array(pose), np.zeros(3), rtl
        self.rng, self.stamp = np.random.default_rng(0), BEGIN
        self.velocity, self.sent = np.zeros(3), []
        self.slip = 1.0

    def handle_all(self, message):
        messages = self.missions.handle(message)
        self.sent += messages
        for answer in messages:
            if isinstance(answer, VelocityCommand):
                self.velocity = np.array([answer.speed, 0.0, answer.turn_rate])
            if isinstance(answer, PoseReset) and self.rtl == "door":
                self.rtl = "always"
        return messages

    def rtl_pose(self):
        """What RTL says."""
        area = int(self.pose[0] > 8.0)
        pose = se2.between(AREAS[area], self.pose)
        if self.rtl == "elsewhere":
            pose = se2.compose(pose, np.array([-3.0, 0.0, 0.0]))
        exactly = PoseGaussian.from_pose(np.zeros(3))
        return RealTimePose(
            self.stamp,
            NEW_AREA if self.rtl in {"door", "lost"} else area,
            exactly,
            PoseGaussian(pose, KNOWN),
            exactly,
            self.odometry,
            np.zeros((3, 3)),
        )

    def step(self, velocity=None):
        """Odometry, pose and scan, and on; what the pilot says."""
        messages = self.handle_all(replace(seen_at(self.pose, self.rng), stamp=self.stamp))
        messages += self.handle_all(Odometry(self.stamp, self.odometry))
        if self.rtl != "never":
            messages += self.handle_all(self.rtl_pose())
        increment = se2.exp(PERIOD * (self.velocity if velocity is None else np.array(velocity)))
        rolled = increment * (self.slip if self.pose[1] > 1.0 else 1.0)
        self.pose, self.odometry = se2.compose(self.pose, increment), se2.compose(self.odometry, rolled)
        self.stamp += round(1e9 * PERIOD)
        return messages

    def do(self, text, steps=600):
        """How a task of a text ends."""
        return self.run(parse_task(text, PILOT_TASKS), steps)

    def navigate(self, *pose, steps=600):
        """How the drive to a pose of the world ends."""
        return self.run(Task("navigate", "there", goal_of(self.missions, *pose)), steps)

    def run(self, task, steps=600):
        """How a task ends."""
        messages = self.handle_all(task)
        for _ in range(steps):
            for answer in messages:
                if isinstance(answer, TaskResult):
                    return answer
            messages = self.step()
        return None

    def starts(self):
        return [message.initial_pose for message in self.sent if isinstance(message, PoseReset)]

    def estimate(self):
        return next(message for message in reversed(self.sent) if isinstance(message, PlaceEstimate))


def goal_of(missions, *pose):
    """A pose of the world as the goal of a task."""
    frames = {area: PoseGaussian.from_pose(frame) for area, frame in AREAS.items()}
    return anchor_pose(missions.exploration_map.hybrid_map, frames, np.array(pose))


def pose_error(place, pose):
    return se2.between(place.pose.mean, se2.between(AREAS[place.area], pose))


def the_room(missions):
    (room,) = missions.rooms
    return room


def door_of(missions):
    """The name of the place before the room."""
    return f"door {missions.rooms[the_room(missions)].node}"


def test_a_room_has_the_name_that_it_has_for_the_explorer(saved_map):
    places = ExplorationMap(CONFIGURATION, Replica.from_state(saved_map)).named_places()
    assert the_room(PilotProcess(CONFIGURATION, saved_map)) == "room 1"
    assert [name for name in places if name.startswith("room")] == ["room 1"]


def test_metric_slam_that_is_lost_begins_at_the_door_where_the_robot_stands_until_it_does(saved_map):
    missions = PilotProcess(CONFIGURATION, saved_map)
    robot, room = Robot(missions, (12.0, 0.0, math.pi), rtl="door"), the_room(missions)
    outcome = robot.do("go cellar")
    assert (outcome.succeeded, outcome.text) == (False, f"go cellar: there is no such room: choose from {room}")
    stood = []
    robot.handle_all(parse_task(f"go {room}", PILOT_TASKS))
    while not robot.starts():
        stood.append(robot.pose)
        robot.step()
    (place,) = robot.starts()
    assert np.abs(pose_error(place, stood[-1])).max() < 0.05
    np.testing.assert_allclose(stood[-1], stood[-2], atol=0.02)
    outcome = robot.do(f"go {room}")
    assert (outcome.succeeded, outcome.text) == (True, f"go {room}: the robot is there")
    assert math.dist(robot.pose[:2], (5.0, 3.0)) < 0.3
    assert len(robot.starts()) == 1
    messages = robot.estimate()
    assert (messages.place, messages.room, messages.confident) == (door_of(missions), room, True)
    np.testing.assert_array_equal(robot.velocity, 0.0)
    assert robot.do("localize").text == f"localize: the robot is in {room}"
    assert robot.do(f"go {room}").succeeded


def test_metric_slam_that_has_the_robot_at_the_door_gets_no_initial_pose(saved_map):
    missions = PilotProcess(CONFIGURATION, saved_map)
    robot = Robot(missions, (12.0, 0.0, math.pi))
    assert robot.do(f"go {the_room(missions)}").succeeded
    assert not robot.starts()


@pytest.mark.parametrize("rtl", ["never", "lost"])
def test_a_robot_that_metric_slam_does_not_find_behind_the_door_goes_by_the_map_of_the_room(saved_map, rtl):
    missions = PilotProcess(CONFIGURATION, saved_map)
    robot, room = Robot(missions, (12.0, 0.0, math.pi), rtl), the_room(missions)
    robot.slip = 1.2
    assert robot.do(f"go {room}").succeeded
    assert len(robot.starts()) == 1
    (heading,) = {message for message in robot.sent if isinstance(message, GoalPose)}
    place = se2.compose(AREAS[heading.area], heading.pose)
    np.testing.assert_allclose(place, (5.0, 3.0, 0.5 * math.pi), atol=0.1)
    assert math.dist(robot.pose[:2], place[:2]) < 0.2


def test_where_metric_slam_has_the_robot_elsewhere_the_belief_restarts_and_no_door_is_entered(saved_map):
    missions = PilotProcess(CONFIGURATION, saved_map)
    robot, room = Robot(missions, (12.0, 0.0, math.pi), rtl="elsewhere"), the_room(missions)
    robot.handle_all(parse_task(f"go {room}", PILOT_TASKS))
    confident = []
    for _ in range(250):
        robot.step()
        confident.append(robot.estimate().confident)
        assert robot.pose[1] < 0.7
    assert not robot.starts()
    lost = confident.index(True)
    assert not all(confident[lost:])
    robot.rtl = "always"
    assert robot.do(f"go {room}", 900).succeeded
    assert math.dist(robot.pose[:2], (5.0, 3.0)) < 0.3


def test_where_others_drive_it_says_where_the_robot_is_and_what_a_door_tells_once(saved_map):
    configuration = with_changes(CONFIGURATION, {"pilot.drives": False})
    missions = PilotProcess(configuration, saved_map)
    robot, room = Robot(missions, (12.0, 0.0, math.pi), rtl="never"), the_room(missions)
    assert "pilot.drives is false" in robot.do(f"go {room}").text
    robot.sent.clear()
    robot.step()
    assert robot.estimate().place is None
    while robot.pose[0] > 5.0:
        robot.step((0.6, 0.0, 0.0))
    for _ in range(10):
        robot.step((0.0, 0.0, -math.pi / 4.0))
    assert (robot.estimate().place, robot.estimate().confident) == (door_of(missions), True)
    at = []
    while robot.pose[1] < 1.5:
        at.append(robot.pose)
        if any(isinstance(message, PoseReset) for message in robot.step((0.5, 0.0, 0.0))):
            (place,) = robot.starts()
            assert np.abs(pose_error(place, at[-1])).max() < 0.1
    assert len(robot.starts()) == 1
    assert not any(isinstance(message, VelocityCommand) for message in robot.sent)


def test_it_finds_out_where_it_is_and_stops_on_request_or_when_it_takes_too_long(saved_map):
    missions = PilotProcess(with_changes(CONFIGURATION, {"pilot.task_timeout": 2.0}), saved_map)
    robot = Robot(missions, (14.0, 0.0, math.pi), rtl="never")
    assert robot.do("localize").text == "localize: given up after 2 s"
    np.testing.assert_array_equal(robot.velocity, 0.0)
    robot.handle_all(parse_task("localize", PILOT_TASKS))
    robot.step()
    robot.handle_all(parse_task("stop", PILOT_TASKS))
    np.testing.assert_array_equal(robot.velocity, 0.0)
    assert not any(isinstance(message, VelocityCommand) for message in robot.step())
    robot = Robot(PilotProcess(CONFIGURATION, saved_map), (14.0, 0.0, math.pi), rtl="never")
    outcome = robot.do("localize")
    assert outcome.succeeded
    assert outcome.text.startswith("localize: the robot is at door ")


def test_where_time_goes_back_the_robot_may_be_anywhere(saved_map):
    missions = PilotProcess(CONFIGURATION, saved_map)
    robot = Robot(missions, (12.0, 0.0, math.pi), rtl="never")
    assert robot.do("localize").succeeded
    robot.handle_all(parse_task("localize", PILOT_TASKS))
    robot.stamp -= 3_000_000_000
    assert [answer.text for answer in robot.step() if isinstance(answer, TaskResult)] == [
        "localize: given up: time went back"
    ]
    robot.step()
    assert robot.estimate().place is None


def test_one_who_drives_the_robot_out_of_a_room_brings_it_before_the_door(saved_map):
    missions = PilotProcess(CONFIGURATION, saved_map)
    robot, room = Robot(missions, (12.0, 0.0, math.pi)), the_room(missions)
    assert robot.do(f"go {room}").succeeded
    for _ in range(20):
        robot.step((0.0, 0.0, math.pi / 4.0))
    while robot.pose[1] > 0.2:
        turn = se2.wrap(math.atan2(-robot.pose[1] - 1.0, 5.0 - robot.pose[0]) - robot.pose[2])
        robot.step((0.5, 0.0, turn))
    for _ in range(2):
        robot.step((0.0, 0.0, 0.0))
    messages = robot.estimate()
    assert (messages.place, messages.room, messages.confident) == (door_of(missions), None, True)


def test_it_drives_to_a_pose_of_the_map_and_turns_there(saved_map):
    missions = PilotProcess(CONFIGURATION, saved_map)
    robot = Robot(missions, (12.0, 0.0, math.pi))
    begun = robot.handle_all(Task("navigate", "there", goal_of(missions, 4.6, 2.4, -1.0)))
    remaining = []
    while not any(isinstance(answer, TaskResult) for answer in begun):
        begun = robot.step()
        remaining.append(missions.progress.remaining)
    assert [answer.succeeded for answer in begun if isinstance(answer, TaskResult)] == [True]
    assert missions.task is None
    assert missions.progress == (None, 0)
    known = [each for each in remaining if each is not None]
    assert 8.0 < known[0] < 16.0
    assert known[-1] < 0.2
    off = se2.between(np.array((4.6, 2.4, -1.0)), robot.pose)
    assert np.hypot(*off[:2]) < 0.2
    assert abs(off[2]) < 0.12
    np.testing.assert_array_equal(robot.velocity, 0.0)
    (goal,) = [answer for answer in robot.sent if isinstance(answer, GoalPose)]
    np.testing.assert_allclose(se2.compose(AREAS[goal.area], goal.pose), (4.6, 2.4, -1.0), atol=1e-9)


def test_a_lost_robot_finds_its_place_before_it_drives_to_a_pose(saved_map):
    robot = Robot(PilotProcess(CONFIGURATION, saved_map), (12.0, 0.0, math.pi), rtl="door")
    assert robot.navigate(3.0, 0.0, 0.0).text == "navigate there: the robot is there"
    assert len(robot.starts()) == 1
    assert math.dist(robot.pose[:2], (3.0, 0.0)) < 0.2


def test_a_goal_moves_with_its_area_when_a_loop_is_closed(saved_map):
    """The second area moves against the first, while the robot is on its way there."""
    missions = PilotProcess(CONFIGURATION, saved_map)
    robot = Robot(missions, (3.0, 0.0, 0.0))
    robot.handle_all(Task("navigate", "there", goal_of(missions, 12.0, 0.0, math.pi)))
    for _ in range(5):
        robot.step()
    moved = PoseGaussian(se2.compose(AREAS[1], np.array([0.2, 0.1, 0.01])), KNOWN)
    missions.handle(ClosureDecision(0, 0, arcs=(Arc(0, 1, moved),)))
    for _ in range(300):
        if any(isinstance(answer, TaskResult) for answer in robot.step()):
            break
    assert missions.task is None
    # In the area, whose walls did not move, it is where it was given.
    assert math.dist(robot.pose[:2], (12.0, 0.0)) < 0.2
    assert abs(se2.wrap(robot.pose[2] - math.pi)) < 0.12


def test_a_pose_in_a_wall_is_refused(saved_map):
    outcome = Robot(PilotProcess(CONFIGURATION, saved_map), (12.0, 0.0, math.pi)).navigate(3.0, 0.95, 0.0)
    assert not outcome.succeeded
    assert outcome.reason == "the robot cannot stand there: give a pose on free ground"
    assert outcome.error is TaskError.GOAL_OCCUPIED


def test_a_pose_to_which_no_way_is_known_is_refused():
    """Nobody has been in the hallway between 5 and 15 m."""
    hybrid_map, scans = make_map()
    for keyframe, (x, *_) in enumerate(keyframes()):
        if 5.2 < x < 15.2:
            hybrid_map.remove_keyframe(keyframe, int(x > 8.0))
            del scans[keyframe]
    saved = Replica(scans, {0: hybrid_map}, {0: 1.0}, {0: 0}).state
    outcome = Robot(PilotProcess(CONFIGURATION, saved), (18.0, 0.0, 0.0)).navigate(3.0, 0.0, 0.0)
    assert (outcome.succeeded, outcome.reason) == (False, "no way is known that leads there")
    assert outcome.error is TaskError.NO_VALID_PATH


def test_a_map_without_places_is_refused():
    with pytest.raises(HmtSlamError, match="no door or crossing along a hallway"):
        PilotProcess(CONFIGURATION, Replica({}, {0: HybridMap()}, {0: 1.0}, {0: 0}).state)
