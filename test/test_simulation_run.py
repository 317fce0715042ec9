"""A simulated drive through the whole system, against the truth."""

import numpy as np
import pytest
from preloaded import hmt_slam

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.evaluation import evaluate_relations, read_true_poses, read_tum, true_relations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import MotionModel

LOG = "sim:ring,seed=2,size=0.8"


@pytest.fixture(scope="module")
def mapped_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "out"
    messages = hmt_slam("map", LOG, "--out", folder, check=True).stdout
    return folder, messages


def test_a_small_loop_is_closed_and_mapped_to_two_centimeters(mapped_folder):
    """Two laps of 45 m: the mean error of relations to the next meters, and to where the robot was a lap before."""
    folder, messages = mapped_folder
    assert "0 dropped" in messages
    assert "loop closures: 0" not in messages
    errors = evaluate_relations(read_tum(folder / "trajectory.tum"), true_relations(read_true_poses(open_log(LOG))))
    assert errors.overall.missed == 0
    assert errors.over_60_s.count > 30
    for score in (errors.overall, errors.over_60_s):
        assert score.translation.mean < 0.02
        assert score.rotation.mean < 0.2


def test_its_bag_makes_the_same_map_as_far_as_quaternions_are_exact(mapped_folder, tmp_path):
    folder, _ = mapped_folder
    hmt_slam("simulate", "sim:ring", "--seed", "2", "--set", "size=0.8", "--out", tmp_path / "bag", check=True)
    hmt_slam("map", tmp_path / "bag", "--out", tmp_path / "out", check=True)
    found, expected = (np.loadtxt(out / "trajectory.tum") for out in (tmp_path / "out", folder))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


def test_a_motion_model_that_has_the_true_parameters_finds_nothing_wrong_with_the_odometry():
    model, last, factors = MotionModel(MotionParameters()), None, []
    certain = 1e8 * np.eye(3)
    for record in open_log("sim:nested,seed=1", duration=600.0).records():
        if isinstance(record.measurement, Odometry):
            model.odometry.add(record.measurement)
            continue
        assert isinstance(record.measurement, Scan)
        model.predict(record.measurement.stamp)
        moved = np.zeros(3) if last is None else se2.between(last, record.true_pose)
        if last is None or np.hypot(*moved[:2]) > 0.5:
            model.observe_keyframe(moved, certain)
            last = record.true_pose
            factors.append(model.noise.factors)
    # The factors are 1 at least, and their memory is of 20 keyframes.
    assert np.mean(factors, axis=0).max() < 1.15
