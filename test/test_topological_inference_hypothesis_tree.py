"""Weights of the hypotheses and what is remembered of them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.topological_inference.hypothesis_tree import (
    HypothesisState,
    Lost,
    Tracking,
    normalize_and_reduce,
    relative_covariance,
)


def weigh(weights, skipped=0.0, unexamined=0.0, most=16, least=1e-6):
    with np.errstate(divide="ignore"):
        logs, log_skipped = np.log(np.array(weights)), float(np.log(skipped))
    return normalize_and_reduce(logs, log_skipped, unexamined, most, least, random_stream(0, Purpose.HYPOTHESES, 0))


def test_weights_are_normalized():
    assert weigh([2.0, 6.0]).probabilities.tolist() == pytest.approx([0.25, 0.75])


def test_hopelessly_small_weights_do_not_underflow():
    found = normalize_and_reduce(
        np.array([-5000.0, -5001.0]), -math.inf, 0.0, 4, 1e-6, random_stream(0, Purpose.HYPOTHESES, 0)
    )
    assert found.probabilities.tolist() == pytest.approx([1.0 / (1.0 + math.exp(-1.0)), 1.0 / (1.0 + math.e)])


def test_what_was_skipped_keeps_its_mass():
    found = weigh([3.0, 6.0], skipped=1.0)
    assert found.unexamined == pytest.approx(0.1)
    assert found.probabilities.sum() == pytest.approx(0.9)


def test_what_was_not_examined_earlier_keeps_its_share():
    found = weigh([1.0, 1.0], unexamined=0.2)
    assert found.probabilities.tolist() == pytest.approx([0.4, 0.4])
    assert found.unexamined == pytest.approx(0.2)


def test_what_is_dropped_is_counted_as_unexamined():
    found = weigh([1.0, 1e-3], least=0.01)
    assert found.indices.tolist() == [0]
    assert found.unexamined == pytest.approx(1e-3, rel=0.01)


def test_the_best_is_never_dropped():
    assert weigh([1.0, 1.0, 1.0], least=0.5).indices.tolist() == [0, 1, 2]


def test_the_reduction_keeps_the_total():
    found = weigh(np.linspace(0.5, 1.5, 40), most=5)
    assert found.indices.size == 5
    assert found.probabilities.sum() == pytest.approx(1.0)


def test_the_drift_beyond_the_reference_is_what_the_chain_added():
    reference = PoseGaussian(np.array([3.0, 1.0, 0.4]), np.diag([0.04, 0.02, 0.01]))
    step = PoseGaussian(np.array([2.0, -0.5, 0.3]), np.diag([0.003, 0.001, 0.0004]))
    whole = reference.compose(step)
    found = relative_covariance(whole.covariance, reference.covariance, step.mean, np.zeros((3, 3)))
    assert np.allclose(found, step.covariance)


def test_a_keyframe_that_is_better_known_than_the_reference_leaves_the_floor():
    floor = np.diag([1e-4, 1e-4, 1e-5])
    found = relative_covariance(np.eye(3) * 1e-3, np.eye(3) * 1e-2, np.zeros(3), floor)
    assert np.allclose(found, floor)


def test_entering_an_area_keeps_the_notes_of_the_keyframes_that_came_along():
    notes = HypothesisState().after_keyframe(4, np.eye(3)).after_keyframe(5, np.eye(3)).after_matching([9], [4, 5])
    entered = notes.after_area_change({5: 2.0 * np.eye(3)})
    assert entered.matched_keyframes == {9: {5}}
    assert entered.covariances.keys() == {5}
    assert entered.unmatched_keyframes == ()


def test_entering_an_area_a_lost_robot_stays_lost_and_a_tracked_one_is_no_more_where_it_was_recognized():
    lost = Lost(7, counted_evidence=2.0)
    assert HypothesisState(localization=lost).after_area_change({}).localization is lost
    entered = HypothesisState(localization=Tracking(3)).after_area_change({})
    assert not entered.is_lost
    assert entered.localization.relocalized_area is None


def test_areas_beside_which_keyframes_fitted_are_remembered_until_the_next_comparison():
    notes = HypothesisState(unmatched_keyframes=(3, 4, 5, 6, 7)).after_matching([1], [3, 4, 5, 6, 7], (2,))
    assert (notes.unmatched_keyframes, notes.pending_candidates) == ((), (2,))
    assert notes.matched_keyframes == {1: {3, 4, 5, 6, 7}}
    soon = replace(notes, unmatched_keyframes=(8, 9)).after_matching([2], [5, 6, 7, 8, 9], all_areas=False)
    assert (soon.unmatched_keyframes, soon.pending_candidates) == ((8, 9), ())


def test_notes_are_values():
    before = HypothesisState().after_keyframe(1, np.eye(3))
    before.after_keyframe(2, np.eye(3))
    before.after_matching([3], [1])
    assert before.unmatched_keyframes == (1,)
    assert not before.matched_keyframes


def test_the_pose_of_the_reference_does_not_enter_the_relative_covariance():
    whole, part = np.diag([0.2, 0.1, 0.05]), np.diag([0.1, 0.05, 0.02])
    pose = np.array([1.0, 2.0, 0.5])
    ad = se2.adjoint(se2.inverse(pose))
    found = relative_covariance(ad @ whole @ ad.T, part, pose, np.zeros((3, 3)))
    assert np.allclose(found, ad @ (whole - part) @ ad.T)
