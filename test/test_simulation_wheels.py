"""Simulated odometry: the motion model is true of it."""

import math

import numpy as np
import pytest

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion, increment_covariance
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.drive import draw_slips, integrate_increments, noisy_increments

RUNS = 100
# 95 % band of the mean over 100 runs of a chi-square with 3 degrees of freedom.
LOW, HIGH = 2.54, 3.50


def nees(step, truth):
    error = se2.log(se2.between(step.increment, truth))
    return error @ np.linalg.solve(step.covariance, error)


def model_of(measured, factor=1.0):
    return RelativeMotion(measured, factor**2 * increment_covariance(measured, MotionParameters()))


@pytest.mark.parametrize(
    "motion", [(0.0, 0.0, 0.0), (0.12, 0.0, 0.0), (0.1, 0.0, 0.2), (0.0, 0.0, -0.3), (2.0, 0.0, 1.0)]
)
@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_error_of_an_increment_is_a_draw_from_the_covariance_that_the_model_states_for_it(motion, factor):
    true = np.tile(motion, (4000, 1))
    measured = noisy_increments(true, factor, np.random.default_rng(3))
    errors = se2.log(se2.between(measured, true))
    whitened = errors / np.sqrt([np.diag(model_of(m, factor).covariance) for m in measured])
    # Deviations of mean and variance of 4000 draws are 0.016 and 0.022.
    assert np.abs(whitened.mean(axis=0)).max() < 0.064
    assert np.abs(whitened.var(axis=0) - 1.0).max() < 0.09
    assert np.abs(np.corrcoef(whitened.T) - np.eye(3)).max() < 0.064


def test_dead_reckoning_over_many_seeds_is_as_wrong_as_the_filters_expect():
    """Over 3 m and a turn; farther, the model's first order is no longer good."""
    true = np.tile([0.1, 0.0, 0.02], (30, 1))
    values = []
    for seed in range(RUNS):
        total = NO_MOTION
        for measured in noisy_increments(true, 1.0, np.random.default_rng(seed)):
            total = total.compose(model_of(measured))
        values.append(nees(total, integrate_increments(true)[-1]))
    assert LOW < np.mean(values) < HIGH


@pytest.mark.parametrize("family", ["office", "ring"])
def test_the_odometry_of_a_log_has_that_noise_from_scan_to_scan_and_less_between(family):
    log = open_simulated(f"sim:{family},seed=4,readings=4")
    scenario = log.scenario
    values = {gap: [] for gap in (4, 1)}
    for gap, own in values.items():
        true = se2.between(scenario.poses[:-gap:4], scenario.poses[gap::4])
        measured = se2.between(scenario.odometry[:-gap:4], scenario.odometry[gap::4])
        own += [nees(model_of(m), t) for m, t in zip(measured, true, strict=True)]
    # The deviation of the mean of n chi-squares with 3 degrees of freedom is sqrt(6 / n).
    assert np.mean(values[4]) == pytest.approx(3.0, abs=4.0 * math.sqrt(6.0 / len(values[4])))
    assert np.mean(values[1]) < 1.0


def test_without_noise_odometry_is_the_truth():
    scenario = open_simulated("sim:ring,odometry=0,slips=0").scenario
    np.testing.assert_allclose(se2.between(scenario.poses[0], scenario.poses), scenario.odometry, atol=1e-9)


def test_slips_come_as_often_and_are_as_large_as_requested():
    distances = np.full(100_000, 0.1)
    errors = draw_slips(distances, 0.2, 2.0, np.random.default_rng(0))
    moving = np.any(errors != 0.0, axis=1)
    # 200 slips of five scans each on 10 km; their number has a deviation of 14.
    assert moving.sum() == pytest.approx(1000, abs=200)
    assert errors[:, 1].max() == 0.0
    assert 5 * errors[moving].std(axis=0)[2] == pytest.approx(math.radians(15.0), rel=0.2)
    assert 5 * errors[moving].std(axis=0)[0] == pytest.approx(0.3, rel=0.2)
    assert not draw_slips(distances, 0.2, 0.0, np.random.default_rng(0)).any()


def test_a_log_with_slips_drifts_by_more_than_the_model_says():
    steady, slipping = (open_simulated(f"sim:ring,odometry=0,slips={n}").scenario for n in (0, 10))
    assert np.array_equal(steady.poses, slipping.poses)
    drift = np.abs(se2.between(steady.odometry[-1], slipping.odometry[-1]))
    assert drift.max() > 0.1
    assert slipping.slips.any()
    assert not steady.slips.any()
