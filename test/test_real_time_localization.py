"""Real-time localization: dead reckoning since the last estimate, in the area and in the map."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import ClosureDecision, EarlyEstimate, LocalEstimate, Notice, TrackingReset
from hmt_slam_ros.real_time_localization.rtl import CorrectionSmoother, Rtl
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.sensors.relative_motion import path_covariance

SECOND = 1_000_000_000


def odometry(seconds, x, y, theta):
    return Odometry(round(seconds * SECOND), np.array([x, y, theta], dtype=np.float64))


def estimate(seconds, pose, odom, area=0, variance=1e-4):
    belief = PoseGaussian(np.array(pose, dtype=np.float64), np.eye(3) * variance)
    return LocalEstimate(round(seconds * SECOND), 0, area, belief, np.array(odom, dtype=np.float64), 0)


def early_estimate(seconds, pose, odom, area=0, event=0):
    final = estimate(seconds, pose, odom, area)
    return EarlyEstimate(final.stamp, 0, event, area, final.pose, final.odometry)


def make_decision(**areas):
    poses = tuple(
        AreaPose(int(name[1:]), PoseGaussian(np.array(pose, dtype=np.float64), np.eye(3) * 0.01))
        for name, pose in areas.items()
    )
    return ClosureDecision(0, global_poses=poses)


@pytest.fixture
def rtl():
    return Rtl(Configuration())


def test_nothing_is_sent_before_the_first_estimate(rtl):
    assert rtl.handle(odometry(0.0, 0, 0, 0)) == []


def test_each_odometry_reading_is_answered_with_the_estimate_extrapolated(rtl):
    rtl.handle(odometry(0.0, 5, 5, math.pi / 2))
    assert rtl.handle(estimate(0.0, (1, 2, 0), (5, 5, math.pi / 2))) == []
    (answer,) = rtl.handle(odometry(0.1, 5, 5.3, math.pi / 2))
    assert answer.stamp == SECOND // 10
    assert answer.area == 0
    assert np.allclose(answer.pose_in_area.mean, (1.3, 2, 0))


def test_the_odometry_that_came_while_metric_slam_was_busy_counts(rtl):
    for k in range(11):
        rtl.handle(odometry(0.1 * k, 0.1 * k, 0, 0))
    rtl.handle(estimate(0.2, (7, 0, math.pi / 2), (0.2, 0, 0)))
    (answer,) = rtl.handle(odometry(1.1, 1.1, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (7, 0.9, math.pi / 2))


def test_an_estimate_between_two_readings_starts_at_its_own_odometry(rtl):
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(odometry(1.0, 1, 0, 0))
    rtl.handle(estimate(0.5, (0, 0, 0), (0.5, 0, 0)))
    (answer,) = rtl.handle(odometry(2.0, 2, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (1.5, 0, 0))


def test_the_map_pose_is_the_areas_pose_and_the_pose_in_the_area(rtl):
    rtl.handle(make_decision(a0=(0, 0, 0), a3=(10, 0, math.pi / 2)))
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (1, 0, 0), (0, 0, 0), area=3))
    (answer,) = rtl.handle(odometry(0.1, 0.5, 0, 0))
    assert answer.area == 3
    assert np.allclose(answer.map_pose.mean, (10, 1.5, math.pi / 2))
    assert np.allclose(se2.compose(answer.map_T_odom, (0.5, 0, 0)), answer.map_pose.mean)
    assert np.linalg.eigvalsh(answer.map_pose.covariance - answer.pose_in_area.covariance).min() > 0


def test_before_the_first_answer_the_map_frame_is_that_of_the_first_area(rtl):
    for pose in (rtl.state.base_area_pose, *(each.pose for each in rtl.state.area_poses)):
        np.testing.assert_array_equal(pose.mean, np.zeros(3))
        np.testing.assert_array_equal(pose.covariance, np.zeros((3, 3)))
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (1, 2, 0.5), (0, 0, 0)))
    (answer,) = rtl.handle(odometry(0.1, 0, 0, 0))
    np.testing.assert_allclose(answer.map_pose.mean, answer.pose_in_area.mean, atol=1e-12)


def test_a_new_area_waits_for_its_place_in_the_map(rtl):
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (0, 0, 0), (0, 0, 0)))
    rtl.handle(estimate(0.1, (0, 0, 0), (0.1, 0, 0), area=1))
    (before,) = rtl.handle(odometry(0.2, 0.2, 0, 0))
    assert before.area == 0
    assert np.allclose(before.map_pose.mean, (0.2, 0, 0))
    rtl.handle(make_decision(a0=(0, 0, 0), a1=(0.1, 0, 0)))
    (after,) = rtl.handle(odometry(0.3, 0.3, 0, 0))
    assert after.area == 1
    assert np.allclose(after.map_pose.mean, (0.3, 0, 0))


def test_the_robots_area_keeps_its_place_when_a_hypothesis_without_it_takes_the_lead(rtl):
    rtl.handle(make_decision(a0=(0, 0, 0), a3=(10, 0, 0)))
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (1, 0, 0), (0, 0, 0), area=3))
    rtl.handle(make_decision(a0=(0, 5, 0), a1=(4, 0, 0)))
    (answer,) = rtl.handle(odometry(0.1, 0.1, 0, 0))
    assert np.allclose(answer.map_pose.mean, (11.1, 0, 0))
    rtl.handle(estimate(0.2, (2, 0, 0), (0.2, 0, 0), area=1))
    (answer,) = rtl.handle(odometry(0.3, 0.3, 0, 0))
    assert np.allclose(answer.map_pose.mean, (6.1, 0, 0))


def test_the_uncertainty_grows_with_the_path_and_shrinks_with_the_next_estimate(rtl):
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (0, 0, 0), (0, 0, 0)))
    spread = [np.linalg.det(rtl.handle(odometry(k, k, 0, 0))[0].pose_in_area.covariance) for k in (1, 2, 3)]
    assert spread[0] < spread[1] < spread[2]
    rtl.handle(estimate(3, (3, 0, 0), (3, 0, 0)))
    assert np.linalg.det(rtl.handle(odometry(4, 4, 0, 0))[0].pose_in_area.covariance) < spread[1]


def test_the_map_pose_has_the_ambiguity_of_the_newest_decision(rtl):
    def answer(seconds):
        return rtl.handle(odometry(seconds, 0, 0, 0))[0].map_pose.covariance

    rtl.handle(make_decision(a0=(0, 0, 0)))
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (0, 0, 0), (0, 0, 0)))
    alone = answer(0.1)
    for seconds, factor in ((0.2, 1.0), (0.3, 0.25)):
        ambiguity = factor * np.array([[4.0, 1.0, 0.2], [1.0, 3.0, 0.1], [0.2, 0.1, 0.5]])
        rtl.handle(ClosureDecision(0, ambiguity=ambiguity))
        np.testing.assert_allclose(answer(seconds) - alone, ambiguity, atol=1e-12)


def test_the_uncertainty_is_that_of_the_path_and_the_turns_since_the_estimate(rtl):
    path = [(0.0, 0.0, 0.0), (0.4, 0.1, 0.3), (0.7, 0.3, 0.1), (1.1, 0.2, -0.2), (1.3, 0.5, 0.1), (1.6, 0.6, 0.25)]
    for k, pose in enumerate(path[:4]):
        rtl.handle(odometry(float(k), *pose))
    rtl.handle(estimate(2.0, (3.0, 2.0, 1.0), path[2]))
    steps = se2.between(np.array(path[:-1]), np.array(path[1:]))
    for k in (4, 5):
        (answer,) = rtl.handle(odometry(float(k), *path[k]))
        distance, angle = np.hypot(*steps[2:k, :2].T).sum(), np.abs(steps[2:k, 2]).sum()
        since = PoseGaussian(se2.between(path[2], path[k]), path_covariance(distance, angle, Configuration().motion))
        expected = PoseGaussian(np.array([3.0, 2.0, 1.0]), 1e-4 * np.eye(3)).compose(since)
        np.testing.assert_allclose(answer.pose_in_area.mean, expected.mean)
        np.testing.assert_allclose(answer.pose_in_area.covariance, expected.covariance)


def test_driving_to_and_fro_does_not_make_the_robot_sure_again(rtl):
    rtl.handle(odometry(0, 0, 0, 0))
    rtl.handle(estimate(0, (0, 0, 0), (0, 0, 0)))
    (there,) = rtl.handle(odometry(1, 3, 0, 0))
    (back,) = rtl.handle(odometry(2, 0, 0, 0))
    assert np.allclose(back.pose_in_area.mean, 0)
    assert back.pose_in_area.covariance[0, 0] > there.pose_in_area.covariance[0, 0]


def test_an_odometry_reset_is_reported_once_and_the_robot_stays_where_it_was(rtl):
    rtl.handle(odometry(0.0, 40, 10, 1.0))
    rtl.handle(estimate(0.0, (2, 0, 0), (40, 10, 1.0)))
    rtl.handle(odometry(0.1, 40, 10, 1.0))
    notice, answer = rtl.handle(odometry(0.2, 0, 0, 0))
    (later,) = rtl.handle(odometry(0.3, 0.2, 0, 0))
    assert isinstance(notice, Notice)
    assert "41.23 m" in notice.text
    assert np.allclose(answer.pose_in_area.mean, (2, 0, 0))
    assert np.allclose(later.pose_in_area.mean, (2.2, 0, 0))


def test_a_reset_is_no_path(rtl):
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (2, 0, 0), (0, 0, 0)))
    (before,) = rtl.handle(odometry(1.0, 1.5, 0, 0.2))
    _, after = rtl.handle(odometry(1.1, 60, 0, 0))
    np.testing.assert_array_equal(after.pose_in_area.covariance, before.pose_in_area.covariance)


def test_a_correction_decays_exponentially():
    smoother, here = CorrectionSmoother(), np.array([4.0, 1.0, 0.3])
    before, after = np.zeros(3), np.array([0.3, -0.1, 0.0])
    np.testing.assert_array_equal(smoother.smooth(0, before, here, 2.0), before)
    for seconds in (0.5, 1.0, 3.0):
        found = smoother.smooth(round(seconds * SECOND), after, here, 2.0)
        np.testing.assert_allclose(found, (1.0 - math.exp(-seconds / 2.0)) * after, atol=1e-9)
    np.testing.assert_allclose(smoother.smooth(4 * SECOND, before, here, 0.0), before)


@pytest.mark.parametrize(
    ("correction", "is_shown_at_once"),
    [
        ((2.0, 0.0, 0.0), False),
        ((0.0, -2.0, 0.0), False),
        ((0.0, 2.0001, 0.0), True),
        ((1.5, -1.5, 0.0), True),
        ((0.0, 0.0, math.radians(45.0)), False),
        ((0.0, 0.0, math.radians(45.001)), True),
        ((0.0, 0.0, -math.radians(45.001)), True),
        ((0.7, -0.5, -math.radians(44.0)), False),
    ],
)
def test_a_correction_beyond_two_meters_or_an_eighth_of_a_turn_is_shown_at_once(correction, is_shown_at_once):
    """At the origin, so that the remaining correction is exact; of a turn it is the twist."""
    smoother, target = CorrectionSmoother(), np.zeros(3)
    before = se2.exp(np.array(correction))
    smoother.smooth(0, before, np.zeros(3), 2.0)
    found = smoother.smooth(SECOND, target, np.zeros(3), 2.0)
    expected = np.zeros(3) if is_shown_at_once else se2.exp(math.exp(-0.5) * np.array(correction))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_correction_is_smoothed_where_the_robot_is_and_not_at_the_origin_of_odometry():
    smoother, here = CorrectionSmoother(), np.array([40.0, -30.0, 2.0])
    before, after = np.array([1.0, 2.0, 0.3]), np.array([1.5, 1.8, 0.31])
    smoother.smooth(3 * SECOND, before, here, 4.0)
    found = smoother.smooth(5 * SECOND, after, here, 4.0)
    at, target = se2.compose(before, here), se2.compose(after, here)
    expected = se2.compose(target, se2.exp(math.exp(-0.5) * se2.log(se2.between(target, at))))
    np.testing.assert_allclose(se2.compose(found, here), expected, atol=1e-9)
    # A log that begins again has no correction that remains.
    np.testing.assert_array_equal(smoother.smooth(4 * SECOND, before, here, 4.0), before)


def test_an_estimate_from_before_a_reset_still_serves(rtl):
    rtl.handle(odometry(0.0, 40, 0, 0))
    rtl.handle(odometry(0.1, 40.1, 0, 0))
    rtl.handle(odometry(0.2, 0, 0, 0))
    rtl.handle(estimate(0.0, (0, 0, 0), (40, 0, 0)))
    (answer,) = rtl.handle(odometry(0.3, 0.1, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (0.2, 0, 0))


def test_a_reading_that_is_not_newer_is_passed_over(rtl):
    rtl.handle(odometry(1.0, 0, 0, 0))
    rtl.handle(estimate(1.0, (0, 0, 0), (0, 0, 0)))
    assert rtl.handle(odometry(1.0, 3, 0, 0)) == []
    assert rtl.handle(odometry(0.5, 3, 0, 0)) == []
    (answer,) = rtl.handle(odometry(1.1, 0.1, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (0.1, 0, 0))


def test_an_older_estimate_does_not_replace_a_newer_one(rtl):
    rtl.handle(odometry(1.0, 1, 0, 0))
    rtl.handle(estimate(1.0, (1, 0, 0), (1, 0, 0)))
    rtl.handle(estimate(0.5, (9, 9, 0), (0.5, 0, 0)))
    (answer,) = rtl.handle(odometry(1.1, 1.1, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (1.1, 0, 0))


STEPS = st.lists(st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)), min_size=2, max_size=12)


@settings(max_examples=60)
@given(STEPS, st.integers(0, 11))
def test_when_an_estimate_arrives_does_not_matter_only_which_scan_it_is_of(steps, late):
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    late = min(late, len(steps) - 1)
    at_once, delayed = Rtl(Configuration()), Rtl(Configuration())
    belief = estimate(0.0, (1, 2, 3), poses[0])
    at_once.handle(belief)
    for k, pose in enumerate(poses):
        answer = [rtl.handle(Odometry(k * SECOND, pose)) for rtl in (at_once, delayed)]
        if k == late:
            delayed.handle(belief)
    assert np.allclose(answer[0][0].pose_in_area.mean, answer[1][0].pose_in_area.mean)
    assert np.allclose(answer[0][0].pose_in_area.covariance, answer[1][0].pose_in_area.covariance)
    assert np.allclose(answer[0][0].pose_in_area.mean, se2.compose((1, 2, 3), se2.between(poses[0], poses[-1])))


def drive_to(rtl, seconds):
    """The last pose of a drive of 1 m/s, with a reading every tenth of a second after the first second."""
    answers = [rtl.handle(odometry(0.1 * k, 0.1 * k, 0, 0)) for k in range(1, round(10 * seconds) + 1)]
    return answers[-1][0]


def test_an_early_estimate_counts_until_there_is_one_that_is_as_new(rtl):
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (0, 0, 0), (0, 0, 0)))
    assert np.allclose(drive_to(rtl, 1.0).pose_in_area.mean, (1, 0, 0))
    before = rtl.state
    rtl.handle(early_estimate(0.45, (5.45, 0, 0), (0.45, 0, 0)))
    (answer,) = rtl.handle(odometry(1.1, 1.1, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (6.1, 0, 0))
    # An older one of either kind changes nothing.
    rtl.handle(early_estimate(0.4, (0, 9, 0), (0.4, 0, 0)))
    rtl.handle(estimate(0.3, (0.3, 1, 0), (0.3, 0, 0)))
    (answer,) = rtl.handle(odometry(1.2, 1.2, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (6.2, 0, 0))
    rtl.handle(estimate(0.45, (0.45, 2, 0), (0.45, 0, 0)))
    (answer,) = rtl.handle(odometry(1.3, 1.3, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (1.3, 2, 0))
    assert before.base_estimate is not rtl.state.base_estimate


def test_the_state_is_that_without_early_estimates(rtl):
    plain = Rtl(Configuration())
    for own in (rtl, plain):
        own.handle(odometry(0.0, 0, 0, 0))
        own.handle(estimate(0.0, (0, 0, 0), (0, 0, 0)))
        drive_to(own, 1.0)
        if own is rtl:
            own.handle(early_estimate(0.5, (5, 0, 0), (0.5, 0, 0)))
        own.handle(odometry(1.1, 1.1, 0, 0))
    one, two = rtl.state, plain.state
    assert [reading.stamp for reading in one.readings] == [reading.stamp for reading in two.readings]
    assert (one.base_estimate.stamp, one.base_reading.stamp) == (two.base_estimate.stamp, two.base_reading.stamp)


def test_an_early_estimate_in_an_area_without_a_pose_in_the_map_waits_for_it(rtl):
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(estimate(0.0, (0, 0, 0), (0, 0, 0)))
    rtl.handle(early_estimate(0.0, (0, 0, 0), (0, 0, 0), area=3))
    drive_to(rtl, 0.5)
    rtl.handle(early_estimate(0.5, (2, 0, 0), (0.5, 0, 0), area=3))
    (answer,) = rtl.handle(odometry(0.6, 0.6, 0, 0))
    assert answer.area == 0
    rtl.handle(make_decision(a0=(0, 0, 0), a3=(10, 0, 0)))
    (answer,) = rtl.handle(odometry(0.7, 0.7, 0, 0))
    assert answer.area == 3
    assert np.allclose(answer.map_pose.mean, (12.2, 0, 0))


def test_early_estimates_of_before_a_reset_are_dropped(rtl):
    rtl.handle(odometry(0.0, 0, 0, 0))
    rtl.handle(early_estimate(0.0, (1, 0, 0), (0, 0, 0), event=4))
    rtl.handle(TrackingReset(5, 7))
    rtl.handle(odometry(0.1, 0.1, 0, 0))
    rtl.handle(early_estimate(0.1, (1, 0, 0), (0.1, 0, 0), event=4))
    assert rtl.handle(odometry(0.2, 0.2, 0, 0)) == []
    rtl.handle(early_estimate(0.2, (1, 0, 0), (0.2, 0, 0), event=5))
    (answer,) = rtl.handle(odometry(0.3, 0.3, 0, 0))
    assert np.allclose(answer.pose_in_area.mean, (1.1, 0, 0))
