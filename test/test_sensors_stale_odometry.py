"""Readings that fall behind the robot and catch up at once, against readings of a robot that really moves so."""

import numpy as np
import pytest

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.sensors.motion_model import MotionModel
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, increment_covariance
from hmt_slam_ros.sensors.stale_odometry import MAX_STEPS, SteadyMotionSearch

PERIOD = 200_000_000
"""Time between two scans, ns."""
MOTION = MotionParameters(patience=2.0)
SHARP = np.diag([1e6, 1e6, 1e8])
TURNING = np.array([0.8, 0.0, np.radians(45.0)])


def path_of(velocities):
    """Poses after steps of 0.2 s at these velocities, the start included."""
    poses = [np.array([3.0, -2.0, 0.7])]
    for velocity in velocities:
        poses.append(se2.compose(poses[-1], se2.exp(0.2 * np.asarray(velocity))))
    return poses


def with_repeats(poses, first, last):
    """The poses, from ``first`` on repeated up to ``last``."""
    return [poses[first] if first <= k <= last else pose for k, pose in enumerate(poses)]


def decide_all(readings, scans, motion=MOTION):
    """What the model decides at each scan, and the motions that it predicts by odometry; readings come one by one."""
    model, decisions, motions, waiting = MotionModel(motion), [], [], list(scans)
    truth = dict(scans)
    last = None
    for stamp, pose in readings:
        model.odometry.add(Odometry(stamp, pose))
        while waiting and model.odometry.covers(waiting[0][0]):
            scan = waiting[0][0]
            decision = model.settle_odometry(scan)
            if decision is None:
                break
            waiting.pop(0)
            prediction = model.predict(scan)
            decisions.append(decision)
            if last is not None:
                motions.append(prediction.odometry)
                model.observe(se2.between(truth[last], truth[scan]), SHARP)
            last = scan
    return decisions, motions


def with_stamps(poses, period=PERIOD):
    return [(k * period, pose) for k, pose in enumerate(poses)]


@pytest.mark.parametrize("velocity", [TURNING, np.array([1.2, 0.0, 0.0])])
def test_repeated_readings_of_a_robot_that_goes_on_become_one_steady_motion(velocity):
    truth = path_of([velocity] * 40)
    decisions, motions = decide_all(with_stamps(with_repeats(truth, 20, 24)), with_stamps(truth))
    assert [round(decision, 6) for decision in decisions if decision] == [0.8]
    step = se2.exp(0.2 * velocity)
    for motion in motions[20:25]:
        np.testing.assert_allclose(motion.increment, step, atol=1e-9)
    # What happened in between is less certain than a reading.
    assert motions[22].covariance[0, 0] > 4.0 * increment_covariance(step, MOTION)[0, 0]
    np.testing.assert_allclose(motions[30].covariance, increment_covariance(step, MOTION))


def test_only_the_position_may_be_stale():
    truth = path_of([TURNING] * 40)
    late = [np.array([*shown[:2], pose[2]]) for shown, pose in zip(with_repeats(truth, 20, 23), truth, strict=True)]
    decisions, motions = decide_all(with_stamps(late), with_stamps(truth))
    assert sum(decisions) == pytest.approx(0.6)
    for motion in motions[20:24]:
        np.testing.assert_allclose(motion.increment, se2.exp(0.2 * TURNING), atol=1e-9)


def test_readings_between_scans_are_decided_on_alike():
    fine = [se2.exp(0.2 * k / 4 * TURNING) for k in range(160)]
    stale = with_repeats(fine, 81, 97)
    decisions, motions = decide_all(with_stamps(stale, PERIOD // 4), with_stamps(fine[::4]))
    assert max(decisions) > 0.5
    errors = np.array([np.abs(se2.log(motion.increment) - 0.2 * TURNING).max() for motion in motions[2:]])
    # The first scan after the last fresh reading may be too near to it to tell; the motion is spread from there on.
    assert (errors > 0.06).sum() <= 1
    assert errors.max() < 0.16


@pytest.mark.parametrize("braking", [1.0, 2.0])
def test_a_robot_that_stops_and_starts_is_believed_without_waiting(braking):
    speeds = [1.0] * 20 + list(np.arange(1.0, 0.0, -0.2 * braking)) + [0.0] * 10
    speeds += list(np.arange(0.0, 1.0, 0.2 * braking)) + [1.0] * 10
    truth = path_of([(speed, 0.0, 0.0) for speed in speeds])
    decisions, motions = decide_all(with_stamps(truth), with_stamps(truth))
    assert decisions == [0.0] * len(truth)
    for motion, step in zip(motions, map(se2.between, truth[:-1], truth[1:]), strict=True):
        np.testing.assert_allclose(motion.increment, step, atol=1e-9)


def test_a_robot_that_swings_back_and_forth_is_believed():
    swing = [(0.0, 0.0, sign * 2.0) for sign in (1.0, -1.0) for _ in range(3)]
    truth = path_of([(0.0, 0.0, 0.0)] * 20 + swing * 3 + [(0.0, 0.0, 0.0)] * 20)
    decisions, _ = decide_all(with_stamps(truth), with_stamps(truth))
    assert not any(decisions)


def test_a_reset_is_no_motion_over_any_time():
    poses = path_of([TURNING] * 20)
    expected = RelativeMotion(se2.exp(0.2 * TURNING), np.diag([0.04, 0.04, 0.1]))
    reset = [np.array([30.0, 5.0, 2.0])] * 12
    change = np.diag([1e-3, 1e-3, 1e-2])
    assert SteadyMotionSearch(poses[-1], expected, change, lambda _: change, 0.01).extend(reset) is None


def test_a_scan_waits_for_its_patience_and_no_longer():
    truth = path_of([TURNING] * 40)
    stuck = with_repeats(truth, 20, 40)
    decisions, _ = decide_all(with_stamps(stuck), with_stamps(truth))
    # The scan at 20 has its first reading; those after it wait 2 s each, longer than the readings last for the others.
    assert len(decisions) == 31
    assert not any(decisions)
    impatient = MotionParameters(patience=0.0)
    assert len(decide_all(with_stamps(stuck), with_stamps(truth), impatient)[0]) == 41


def test_the_decision_does_not_depend_on_when_readings_arrive():
    truth = path_of([TURNING] * 40)
    readings = with_stamps(with_repeats(truth, 20, 24))
    one_by_one = decide_all(readings, with_stamps(truth))[0]
    model, decisions = MotionModel(MOTION), []
    for stamp, pose in readings:
        model.odometry.add(Odometry(stamp, pose))
    for k, (scan, _) in enumerate(with_stamps(truth)[:31]):
        decisions.append(model.settle_odometry(scan))
        model.predict(scan)
        if k:
            model.observe(se2.between(truth[k - 1], truth[k]), SHARP)
    assert decisions == one_by_one[:31]


def test_scans_that_are_much_closer_than_readings_are_decided_on_in_bounded_steps():
    model, used = MotionModel(MOTION), []
    poses_at = model.odometry.poses_at

    def count_poses(stamps):
        for pose in poses_at(stamps):
            used.append(pose)
            yield pose

    model.odometry.poses_at = count_poses
    # It stands, then leaps, again and again: no steady motion, however long one waits.
    for k in range(80):
        model.odometry.add(Odometry(k * PERIOD // 4, np.array([0.5 * (k // 4), 0.0, 0.0])))
    for stamp in (PERIOD, PERIOD + 600, 2 * PERIOD, 2 * PERIOD + 600):
        decisions = {model.settle_odometry(stamp) for _ in range(5)}
        assert decisions == {0.0}
        model.predict(stamp)
        model.observe(np.zeros(3), SHARP)
    assert len(used) <= 4 * MAX_STEPS
