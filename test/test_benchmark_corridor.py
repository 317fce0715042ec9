"""A corridor that is bare leaves the robot to its odometry, and the covariance says so."""

import numpy as np
import pytest

from benchmark.corridor import CorridorDrive, drive, errors_of, report


@pytest.fixture(scope="module")
def drives():
    return [drive(seed) for seed in range(72)]


@pytest.mark.long
def test_the_covariance_along_a_bare_corridor_covers_the_truth(drives):
    for stride, low, high, covered in ((1, 0.7, 1.3, 0.9), (20, 0.5, 1.7, 0.85)):
        found = errors_of(drives, stride)
        assert low < found.nees[0] < high
        assert found.coverage[0] >= covered
        # Across, what is no drift is within the floor that arcs have.
        assert found.nees[1] < 1.0
        assert found.coverage[1] >= 0.95


def test_a_bare_corridor_neither_shrinks_nor_grows(drives):
    for stride in (1, 20):
        shortening, deviation = errors_of(drives, stride).shortening
        assert abs(shortening) < 2.5 * deviation
        assert deviation < 0.003


def test_along_a_bare_corridor_the_robot_is_as_uncertain_as_its_odometry_and_across_it_is_not(drives):
    steps = errors_of(drives, 1)
    along, across = np.sqrt(steps.variances.mean(axis=0))
    by_odometry = np.sqrt(np.mean(steps.odometry_errors**2))
    assert 0.8 * by_odometry < along < 1.4 * by_odometry
    assert across < 0.3 * along


def make_drive(share, seed):
    """A straight drive whose estimate is too short by a share and as far off as is stated."""
    random = np.random.default_rng(seed)
    slips = 0.1 * random.standard_normal((40, 2))
    moved = np.tile([1.0, 0.0], (40, 1))
    truths, poses = (
        np.column_stack([np.cumsum(np.concatenate((np.zeros((1, 2)), moves)), axis=0), np.zeros(41)])
        for moves in (moved, moved * (1.0 - share) + slips)
    )
    covariances = np.tile(np.diag([0.01, 0.01, 1e-12]), (41, 1, 1))
    return CorridorDrive(truths, poses, covariances, np.concatenate(([0.0], np.cumsum(slips[:, 0]))))


@pytest.mark.parametrize("stride", [1, 4])
def test_figures_of_a_drive_that_is_as_stated(stride):
    found = errors_of([make_drive(0.0, seed) for seed in range(100)], stride)
    assert len(found.errors) == 100 * (40 // stride)
    np.testing.assert_allclose(found.variances, 0.01 * stride, rtol=1e-6)
    np.testing.assert_allclose(found.lengths, stride)
    np.testing.assert_allclose(found.nees, 1.0, atol=0.1)
    np.testing.assert_allclose(found.coverage, 0.95, atol=0.02)
    assert found.shortening[0] == pytest.approx(0.0, abs=1e-9)


def test_figures_of_a_drive_that_shrinks():
    found = errors_of([make_drive(0.05, seed) for seed in range(4)], 4)
    assert found.shortening[0] == pytest.approx(0.05)
    assert found.nees[0] > 1.5 > found.nees[1]
    assert "+5.00 ± 0.00" in report([make_drive(0.05, seed) for seed in range(4)])
