"""The modes of the pose that the benchmark lists."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from benchmark.modes import Mode, ScanModes, follow_modes, mode_errors, mode_table, modes_of
from hmt_slam_ros.evaluation import StampedPoses


def filter_state(leader):
    """Five particles of two modes, of which the second has 0.8 of the weights."""
    return SimpleNamespace(
        log_weights=np.log([0.1, 0.1, 0.2, 0.5, 0.1]),
        members=np.array([0, 0, 1, 1, 1]),
        modes=(None, None),
        leader=leader,
        poses=np.array([[0.0, 0, 0], [9.0, 9, 9], [9.0, 9, 9], [1.0, 2.0, 0.5], [9.0, 9, 9]]),
    )


def test_each_mode_has_the_share_of_its_particles_and_the_pose_of_its_heaviest_one():
    first, second = modes_of(filter_state(0))
    assert (first.mass, first.pose.tolist()) == (pytest.approx(0.2), [0.0, 0.0, 0.0])
    assert (second.mass, second.pose.tolist()) == (pytest.approx(0.8), [1.0, 2.0, 0.5])


def test_the_mode_of_the_leading_particle_is_first_and_has_its_pose():
    first, second = modes_of(filter_state(4))
    assert (first.mass, first.pose.tolist()) == (pytest.approx(0.8), [9.0, 9.0, 9.0])
    assert second.mass == pytest.approx(0.2)


def scan(stamp, area, *poses):
    modes = tuple(Mode(1.0 / len(poses), np.array(pose)) for pose in poses)
    return ScanModes(stamp, 1e-9 * stamp, area, 1, 12.0, 0.3871, modes)


def test_errors_are_those_of_the_motion_since_the_first_scan_in_its_area():
    quarter = math.pi / 2
    scans = [
        scan(10, 0, (5.0, 5.0, 0.0)),
        scan(20, 0, (6.0, 5.0, quarter), (6.0, 6.0, quarter)),
        scan(30, 1, (0.0, 0.0, 0.0)),
    ]
    # Seen from elsewhere, the robot drives a meter ahead and turns to the left.
    reference = StampedPoses(np.array([10, 20, 30]), np.array([[0, 0, quarter], [0, 1, 2 * quarter], [0, 2, 0.0]]))
    errors = mode_errors(scans, reference)
    np.testing.assert_allclose(errors[0], np.zeros((1, 3)), atol=1e-12)
    np.testing.assert_allclose(errors[1], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], atol=1e-12)
    assert np.isnan(errors[2]).all()


def test_the_table_has_a_line_for_each_scan():
    errors = np.array([[0.0, 0.0, 0.0], [-0.442, -0.022, -0.1222]])
    line = mode_table([scan(69354000000, 0, (0, 0, 0), (1, 1, 1))], [errors]).splitlines()[2]
    assert line == "| 69.35 | 1 | 12.0 | 0.387 | 2 | 0.50: +0.00, +0.00, +0.0; 0.50: -0.44, -0.02, -7.0 |"


def test_scans_of_the_stretch_are_followed():
    scans = follow_modes("sim:office,laps=1,seed=4", ("motion.patience=0",), 1.0, 2.0)
    seconds = [scan.seconds for scan in scans]
    assert len(scans) >= 4
    assert seconds == sorted(set(seconds))
    assert 1.0 <= seconds[0] < seconds[-1] <= 2.0
    for scan in scans:
        assert sum(mode.mass for mode in scan.modes) == pytest.approx(1.0)
        assert 1.0 <= scan.effective_samples <= 12.0
