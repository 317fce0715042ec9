"""The path until the place is sure: names of drives, truth of hypotheses, figures, and one drive of each way."""

import math

import numpy as np
import pytest

from benchmark.disambiguation import (
    DISAMBIGUATING,
    EXPLORING,
    LIMIT,
    ROUTE,
    DecidingDrive,
    QuestionDrives,
    continued_records,
    find_question_drives,
    log_names,
    quantile,
    requirements,
)
from benchmark.open_question import OpenQuestion, PlaceTruth
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import START


def right(distance):
    return DecidingDrive(distance, "right", distance)


def answer(looks, route):
    return QuestionDrives("twins", 1, 100.0, {DISAMBIGUATING: looks, EXPLORING: looks, ROUTE: route})


NEVER, FALSE = DecidingDrive(math.inf, "open", LIMIT), DecidingDrive(3.0, "wrong", 3.0)


def test_names_of_drives_have_the_kidnapping_or_not():
    name, world = log_names("twins kidnapped", 3)
    assert world == log_names("twins", 3)[0] == "sim:twins,seed=3,size=0.7,laps=2"
    assert name.startswith(f"{world},carried=0.")
    assert open_simulated(name).scenario.settings.to > 0.7


def test_quantiles_count_what_was_never_sure_as_infinite():
    drives = [right(2.0), right(4.0), NEVER, FALSE]
    assert quantile(drives, 0.5) == 4.0
    assert quantile(drives, 0.9) == math.inf
    assert math.isnan(quantile([], 0.5))


def test_driving_to_looks_must_not_take_longer_nor_be_wrong_more_often():
    met = [one.is_met for one in requirements([answer(right(2.0), right(3.0))])]
    assert met == [True, True]
    met = [one.is_met for one in requirements([answer(FALSE, right(3.0))])]
    assert met == [False, False]


def test_a_hypothesis_is_true_by_the_pose_of_the_path_in_old_ground_or_on_new_ground():
    poses = {k: np.array([float(k), 0.0, 0.0]) for k in range(8)}
    truth = PlaceTruth(poses, frozenset(range(4)), (5, 4), frozenset((5,)))

    def holds(pose_of_5):
        hybrid_map = HybridMap()
        for k in range(4):
            hybrid_map.set_keyframe(k, 0, poses[k])
        hybrid_map.set_keyframe(5, 0, np.array(pose_of_5))
        return truth.is_right(hybrid_map), hybrid_map

    assert holds([5.0, 0.0, 0.0])[0]
    assert not holds([4.0, 0.6, 0.0])[0]
    assert not holds([5.0, 0.0, 0.5])[0]
    assert not holds([9.0, 0.0, 0.0])[0]  # new ground, where it is known
    assert not truth.is_right(HybridMap())
    (_, one), (_, other) = holds([5.0, 0.0, 0.0]), holds([9.0, 0.0, 0.0])
    replica = Replica({}, {0: one, 1: other}, {0: 0.55, 1: 0.45}, {0: 0, 1: 0})
    assert truth.shares(replica) == (0.55, 0.45)
    assert truth.verdict(replica) == "open"
    replica.probabilities = {0: 0.02, 1: 0.98}
    assert truth.verdict(replica) == "wrong"


def test_the_measurements_of_the_driven_robot_continue_those_of_the_route():
    scenario = open_simulated("sim:ring,seed=3").scenario
    robot = DrivenRobot(scenario)
    odometry = np.array([1.0, 2.0, 0.5])
    state = LockStepRun(Configuration()).state
    truth = PlaceTruth({}, frozenset(), (), frozenset())
    question = OpenQuestion(7, 10.0, START + 10**11, robot.pose, odometry, state, None, truth)
    records = continued_records(robot, question)
    first, second, third = (next(records) for _ in range(3))
    robot.set_velocity(0.5, 0.0)
    assert question.stamp < first.source_stamp < second.source_stamp == third.source_stamp
    assert first.measurement.stamp == first.source_stamp
    np.testing.assert_allclose(se2.between(odometry, second.measurement.pose), np.zeros(3), atol=0.05)


@pytest.mark.long
def test_from_a_question_in_twin_rooms_the_run_goes_on_in_three_ways():
    found = find_question_drives(("twins", 51))
    assert found is not None
    assert set(found.drives) == {DISAMBIGUATING, EXPLORING, ROUTE}
    assert found.drives[DISAMBIGUATING].verdict == "right"
    # Which way is shorter in one world is the benchmark's question.
    assert all(0.0 < drive.distance <= drive.driven for drive in found.drives.values() if drive.verdict != "open")
    assert found.drives[DISAMBIGUATING].right_distance < LIMIT
