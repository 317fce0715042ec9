"""Motion between scans: odometry interpolated, its noise learnt, and the velocity that stands in for it."""

import numpy as np
import pytest

from hmt_slam_ros.configuration.metric_slam import FilterParameters, MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import rotate_covariance
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.sensors.motion_model import Inertia, MotionModel, OdometryNoise
from hmt_slam_ros.sensors.odometry import OdometryBuffer
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, has_wide_heading, increment_covariance, is_wide

SECOND = 10**9
SHARP = np.diag([1e4, 1e4, 1e6])
TURNING = np.array([0.5, 0.0, 0.3])


def test_odometry_is_interpolated_along_the_arc():
    buffer = OdometryBuffer()
    buffer.add(Odometry(0, np.zeros(3)))
    buffer.add(Odometry(SECOND, np.array([1.0, 1.0, np.pi / 2])))
    pose, gap = buffer.pose_at(SECOND // 2)
    np.testing.assert_allclose(pose, [np.sin(np.pi / 4), 1 - np.cos(np.pi / 4), np.pi / 4], atol=1e-12)
    # Speeding up and braking with 1 m/s^2 for half a second each, the robot would be off by this much half way.
    assert gap == pytest.approx(0.125)


def test_odometry_is_unknown_before_the_first_reading_and_after_the_last():
    buffer = OdometryBuffer()
    assert buffer.pose_at(5) is None
    assert not buffer.covers(5)
    buffer.add(Odometry(10, np.array([1.0, 0.0, 0.0])))
    assert buffer.pose_at(5) is None
    assert buffer.pose_at(15) is None
    pose, gap = buffer.pose_at(10)
    np.testing.assert_array_equal(pose, [1.0, 0.0, 0.0])
    assert gap == 0.0
    assert buffer.covers(10)
    assert not buffer.covers(11)


def test_odometry_whose_stamps_jump_back_restarts():
    buffer = OdometryBuffer()
    buffer.add(Odometry(1000, np.array([5.0, 0.0, 0.0])))
    buffer.add(Odometry(10, np.zeros(3)))
    buffer.add(Odometry(20, np.array([1.0, 0.0, 0.0])))
    np.testing.assert_allclose(buffer.pose_at(15)[0], [0.5, 0.0, 0.0])


def drive_steadily(inertia, velocity, times):
    """Let the robot go on at a steady velocity, scans at these times; the last prediction and the truth."""
    prediction = truth = None
    for seconds, step in zip(np.diff(times), np.full(len(times) - 1, times[-1] / (len(times) - 1)), strict=True):
        prediction, truth = inertia.predict(seconds), se2.exp(velocity * step)
        inertia.observe(truth, SHARP)
    return prediction, truth


def deviations(step, truth):
    """How many deviations a prediction is off."""
    difference = se2.log(se2.between(step.increment, truth))
    return np.sqrt(difference @ np.linalg.solve(step.covariance, difference))


def test_of_readings_that_wait_for_hours_fewer_are_kept_and_no_motion_is_lost():
    buffer, period = OdometryBuffer(), 10_000_000
    for k in range(1_000_000):
        buffer.add(Odometry(k * period, np.array([0.01 * k, 0.0, 0.0])))
    readings = buffer.readings
    assert 5_000 <= len(readings) <= 10_000
    assert (readings[0].stamp, readings[-1].stamp) == (0, 999_999 * period)
    pose, _ = buffer.pose_at(654_321 * period)
    assert pose == pytest.approx([6543.21, 0.0, 0.0])


def test_a_steady_velocity_is_learnt():
    prediction, truth = drive_steadily(Inertia(MotionParameters()), TURNING, 0.2 * np.arange(20))
    np.testing.assert_allclose(prediction.increment, truth, atol=0.01)
    assert deviations(prediction, truth) < 0.3
    assert np.sqrt(np.diag(prediction.covariance))[0] < 0.05


def test_scans_whose_stamps_come_in_bursts_are_predicted_as_evenly_taken_within_the_deviation():
    times = 0.2 * np.arange(60)
    bursts = 0.8 * np.ceil(times / 0.8) + 1e-5 * np.arange(60)
    inertia = Inertia(MotionParameters(acceleration=0.5))
    for k in range(1, 60):
        step = inertia.predict(bursts[k] - bursts[k - 1])
        truth = se2.exp(0.2 * TURNING)
        if k > 20:
            assert deviations(step, truth) < 3.0
            assert np.sqrt(step.covariance[0, 0]) < 0.3
        inertia.observe(truth, SHARP)


def test_where_scans_do_not_show_the_motion_the_velocity_becomes_uncertain():
    inertia = Inertia(MotionParameters())
    drive_steadily(inertia, np.array([0.5, 0.0, 0.0]), 0.2 * np.arange(20))
    spreads = []
    for _ in range(10):
        step = inertia.predict(0.2)
        spreads.append(np.sqrt(np.diag(step.covariance)))
        inertia.observe(step.increment, np.diag([0.0, 1e4, 1e6]))
    along, across, _ = np.transpose(spreads)
    assert (np.diff(along) > 0).all()
    assert along[-1] > 2.0 * across[-1]
    assert across[-1] < 1.2 * across[0]


def test_a_jump_has_no_information_on_the_velocity_and_a_velocity_that_lasts_is_learnt_at_once():
    inertia = Inertia(MotionParameters())
    drive_steadily(inertia, np.array([0.3, 0.0, 0.0]), 0.2 * np.arange(20))
    inertia.predict(0.2)
    inertia.observe(se2.exp([0.3, -0.9, -1.0]), SHARP)
    after = inertia.predict(0.2)
    np.testing.assert_allclose(after.increment, np.zeros(3), atol=1e-12)
    assert np.sqrt(after.covariance[0, 0]) > 0.2
    fast = se2.exp(0.2 * np.array([1.5, 0.0, 0.5]))
    inertia.observe(fast, SHARP)
    np.testing.assert_allclose(inertia.predict(0.2).increment, fast, atol=0.03)


def test_after_a_long_pause_the_robot_is_not_believed_to_have_turned_on_and_on():
    inertia = Inertia(MotionParameters())
    drive_steadily(inertia, np.array([0.0, 0.0, np.radians(-60.0)]), 0.2 * np.arange(20))
    step = inertia.predict(6.0)
    assert np.degrees(step.increment[2]) > -65.0
    assert np.degrees(np.sqrt(step.covariance[2, 2])) > 60.0


def learn_noise(factor, steps=400, slips=()):
    """The noise learnt from odometry with ``factor`` times the model's noise; at ``slips`` 20 degrees on top."""
    random = np.random.default_rng(0)
    noise, motion = OdometryNoise(), MotionParameters()
    increment = np.array([0.5, 0.0, 0.1])
    covariance = increment_covariance(increment, motion)
    for k in range(steps):
        error = factor * np.sqrt(np.diag(covariance)) * random.standard_normal(3)
        error[2] += np.radians(20.0) * (k in slips)
        noise.learn(RelativeMotion(se2.compose(increment, se2.exp(error)), covariance), increment, SHARP)
    return noise


@pytest.mark.parametrize("factor", [1.0, 2.0, 4.0])
def test_the_noise_of_odometry_is_learnt(factor):
    np.testing.assert_allclose(learn_noise(factor).factors, factor, rtol=0.25)


def test_odometry_better_than_its_model_is_taken_as_the_model_says():
    np.testing.assert_array_equal(learn_noise(0.3).factors, 1.0)
    step, inertia = RelativeMotion(TURNING, np.diag([1.0, 2.0, 3.0])), RelativeMotion(np.zeros(3), 1e-6 * np.eye(3))
    for scaled in (learn_noise(0.3).scale(step), learn_noise(0.3).fuse(step, np.zeros((3, 3)), inertia)):
        np.testing.assert_array_equal(scaled.increment, step.increment)
        np.testing.assert_array_equal(scaled.covariance, step.covariance)


def test_inertia_reduces_noise_beyond_twice_the_models_and_no_more():
    step, inertia = (
        RelativeMotion(np.array([0.1, 0.0, 0.0]), 1e-4 * np.eye(3)),
        RelativeMotion(np.zeros(3), 1e-12 * np.eye(3)),
    )
    both = learn_noise(4.0).fuse(step, np.zeros((3, 3)), inertia)
    np.testing.assert_allclose(both.increment, 0.0, atol=1e-3)
    np.testing.assert_allclose(both.covariance, 4.0 * step.covariance, rtol=1e-3, atol=1e-9)


def test_inertia_reduces_all_of_the_error_of_interpolation():
    step = RelativeMotion(np.array([0.1, 0.0, 0.0]), 1e-8 * np.eye(3))
    inertia = RelativeMotion(np.zeros(3), 1e-4 * np.eye(3))
    both = OdometryNoise().fuse(step, 0.01 * np.eye(3), inertia)
    np.testing.assert_allclose(both.increment, [0.1 / 101.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(both.covariance, 1e-4 / 1.01 * np.eye(3), rtol=1e-3, atol=1e-8)


def test_within_a_long_gap_of_odometry_a_step_is_off_by_the_error_of_its_velocity():
    """Of poses 0.1 s apart, each is off by up to 25 degrees at 200 deg/s^2, but both alike: the step by 10 degrees."""
    model = MotionModel(MotionParameters(turn_acceleration=200.0))
    for stamp in (0, SECOND):
        model.odometry.add(Odometry(stamp, np.array([0.0, 0.0, 1.0]) * (stamp / SECOND)))
    spreads, fused = [], []
    for k in range(11):
        prediction = model.predict(k * SECOND // 10)
        if prediction.odometry is not None:
            spreads.append(np.degrees(np.sqrt(prediction.odometry.covariance[2, 2])))
            fused.append(np.degrees(np.sqrt(prediction.fused.covariance[2, 2])))
            model.observe(np.array([0.0, 0.0, 0.1]), SHARP)
    assert 9.0 < max(spreads) < 11.5
    assert max(fused[3:]) < 3.0


def test_a_slip_is_not_taken_for_noise():
    assert learn_noise(1.0, slips=(399,)).factors[1] < 1.6
    assert learn_noise(1.0, slips=(200,)).factors[1] < 1.3


def test_what_scans_do_not_show_has_no_information_on_the_noise():
    noise = OdometryNoise()
    covariance = np.diag([0.01, 0.01, 0.001])
    for _ in range(100):
        # Matched where odometry predicts, along the corridor; twice the deviation off, across.
        odometry = RelativeMotion(np.array([0.5, 0.0, 0.0]), covariance)
        noise.learn(odometry, np.array([0.5, 0.2, 0.0]), np.diag([0.0, 1e6, 1e6]))
    assert noise.factors[0] == pytest.approx(2.0, rel=0.05)


def test_odometry_predicts_where_readings_enclose_both_scans_and_inertia_elsewhere():
    model = MotionModel(MotionParameters())
    for k in (0, 1, 2, 6, 7):
        model.odometry.add(Odometry(k * SECOND // 10, np.array([0.05 * k, 0.0, 0.0])))
    steps = [model.predict(k * SECOND // 10).odometry for k in range(10)]
    assert [step is None for step in steps] == [True] + 7 * [False] + 2 * [True]
    for step in steps[1:8]:
        np.testing.assert_allclose(step.increment, [0.05, 0.0, 0.0], atol=1e-12)
    # Between readings 0.4 s apart the robot may have sped up and braked.
    assert steps[4].covariance[0, 0] > steps[1].covariance[0, 0]
    assert steps[7].covariance[0, 0] == pytest.approx(steps[1].covariance[0, 0])


def test_where_odometry_is_silent_its_pose_is_extrapolated_by_the_match():
    model = MotionModel(MotionParameters())
    model.odometry.add(Odometry(0, np.array([3.0, 0.0, 0.0])))
    for k in range(4):
        model.predict(k * SECOND // 10)
        model.observe(np.zeros(3) if k == 0 else np.array([0.1, 0.0, 0.0]), SHARP)
    np.testing.assert_allclose(model.odometry_pose, [3.3, 0.0, 0.0], atol=1e-9)


def test_noisy_odometry_and_inertia_together_tell_the_motion_better_where_no_scan_does():
    random = np.random.default_rng(0)
    model, truth, noise = MotionModel(MotionParameters()), se2.exp(0.1 * TURNING), np.array([0.06, 0.06, 0.06])
    readings = [np.zeros(3)]
    for _ in range(400):
        readings.append(se2.compose(readings[-1], se2.compose(truth, se2.exp(noise * random.standard_normal(3)))))
    off = []
    for k, reading in enumerate(readings):
        model.odometry.add(Odometry(k * SECOND // 10, reading))
        step = model.predict(k * SECOND // 10).fused
        model.observe(step.increment, np.zeros((3, 3)))
        # Scans show as much at keyframes, so that the noise is known.
        model.observe_keyframe(truth, SHARP)
        off.append(se2.log(se2.between(truth, step.increment)))
    late = np.array(off[200:])
    assert (np.sqrt((late**2).mean(axis=0)) < 0.6 * noise).all()


def test_odometry_that_the_scans_contradict_has_no_information_on_the_velocity():
    models = [MotionModel(MotionParameters()), MotionModel(MotionParameters())]
    for k in range(20):
        for model in models:
            model.odometry.add(Odometry(k * SECOND // 10, np.array([0.1 * k, 0.0, 0.0])))
            model.predict(k * SECOND // 10)
            model.observe(np.zeros(3), np.zeros((3, 3)), contradicted=model is models[0])
    contradicted, believed = (model.predict(2 * SECOND).inertia.increment[0] for model in models)
    assert contradicted == pytest.approx(0.0, abs=1e-9)
    assert believed > 0.05


def test_two_sources_tell_of_one_motion():
    narrow, wide = (
        RelativeMotion(np.array([0.1, 0.0, 0.1]), 1e-4 * np.eye(3)),
        RelativeMotion(np.zeros(3), 3e-4 * np.eye(3)),
    )
    for both in (narrow.fuse(wide), wide.fuse(narrow)):
        np.testing.assert_allclose(both.increment, [0.075, 0.0, 0.075], atol=2e-3)
        np.testing.assert_allclose(both.covariance, 0.75e-4 * np.eye(3), atol=1e-12)


def test_a_heading_is_no_less_certain_than_one_of_which_nothing_is_known():
    covariance = np.array([[4.0, 0.0, 6.0], [0.0, 1.0, 0.0], [6.0, 0.0, 36.0]])
    bounded = RelativeMotion(np.ones(3), covariance).bound_heading()
    assert bounded.covariance[2, 2] == pytest.approx(np.pi**2 / 3.0)
    np.testing.assert_array_equal(bounded.covariance[:2, :2], covariance[:2, :2])
    # The correlation stays.
    assert bounded.covariance[0, 2] / np.sqrt(4.0 * bounded.covariance[2, 2]) == pytest.approx(0.5)
    certain = RelativeMotion(np.ones(3), 1e-4 * np.eye(3))
    np.testing.assert_array_equal(certain.bound_heading().covariance, certain.covariance)


def test_a_pose_is_wide_where_its_heading_is_or_its_position_in_all_directions():
    settings = FilterParameters(keyframe_distance=0.5, keyframe_angle=20.0)

    def is_wide_in(along, across, heading, theta):
        covariance = rotate_covariance(np.diag([along, across, np.radians(heading)]) ** 2, theta)
        return is_wide(covariance, settings)

    for theta in (0.0, 0.7, 2.0):
        assert is_wide_in(0.01, 0.01, 20.1, theta)
        assert not is_wide_in(0.01, 0.01, 19.9, theta)
        assert is_wide_in(2.0, 0.51, 1.0, theta)
        for degrees, is_heading_wide in ((20.1, True), (19.9, False)):
            covariance = np.diag([2.0, 0.51, np.radians(degrees)]) ** 2
            assert has_wide_heading(covariance, settings) == is_heading_wide
        # A corridor shows where its walls are, and not where along them the robot is.
        assert not is_wide_in(9.0, 0.49, 1.0, theta)
        assert not is_wide_in(0.49, 9.0, 1.0, theta)
