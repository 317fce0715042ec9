"""The existence of landmarks by Bayes' rule, and their pose by the scatter of its observations."""

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark

CHANCES = {"landmark_detected": 0.7, "landmark_by_chance": 0.12, "landmark_lasting": 0.9, "landmark_lasting_away": 0.6}
FEATURES = with_changes(Configuration(), {f"features.{name}": value for name, value in CHANCES.items()}).features


@pytest.mark.parametrize("was_away", [False, True])
@pytest.mark.parametrize("is_seen", [False, True])
def test_presence_follows_bayes_rule_in_a_world_that_changes(is_seen, was_away):
    before = Existence(0.8, 0.75, 3, 2)
    before = before.mark_absence() if was_away else before
    assert before.robot_was_away == was_away
    found = before.update_on_detection(0.5, FEATURES) if is_seen else before.update_on_miss(FEATURES)
    there = 0.75 * 0.9 * (0.6 if was_away else 1.0)
    yes, no = (0.7, 0.12) if is_seen else (0.3, 0.88)
    assert found.presence == pytest.approx(yes * there / (yes * there + no * (1.0 - there)))
    assert (found.detections, found.misses) == ((4, 2) if is_seen else (3, 3))
    assert found.confidence == pytest.approx((3.0 * 0.8 + 0.5) / 4.0 if is_seen else 0.8)
    assert found.probability == found.confidence * found.presence
    assert not found.robot_was_away


@pytest.mark.parametrize("detections", [1, 2, 7])
def test_errors_of_scans_average_out_and_those_of_the_robot_do_not(detections):
    rng = np.random.default_rng(detections)
    covariance, scatter, ratio = (root @ root.T + 0.1 * np.eye(3) for root in rng.normal(size=(3, 3, 3)))
    share = np.diag([0.2, 0.5, 0.9])
    pose = PoseGaussian(np.array([1.0, -2.0, 0.4]), covariance)
    existence = Existence(0.9, detections=detections)
    landmark = Landmark(1, pose, 0.0, 0.1, existence, scatter, share)
    found = landmark.pose_from_scatter(ratio)
    # In deviations: errors that are common to all observations, and the part of each that is the scan's own.
    inner, outer = np.linalg.cholesky((ratio + scatter) / detections), np.linalg.cholesky(covariance)
    common, own = np.eye(3) - share, share / detections
    np.testing.assert_allclose(found.covariance, outer @ inner @ (common + own) @ inner.T @ outer.T)
    np.testing.assert_array_equal(found.mean, pose.mean)
    plain = Landmark(1, pose, 0.0, 0.1, existence)
    np.testing.assert_allclose(plain.pose_from_scatter(detections * np.eye(3)).covariance, covariance)
