"""Distributions over the pose of a lost robot, by Bayes' rule."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import NO_CLUTTER, WALLS_OF_MAP, WALLS_OUTLIER_RATE, Agreement
from hmt_slam_ros.topological_inference.global_localization import (
    UNMAPPED_PRIOR,
    PoseDistribution,
    PoseHint,
    localize_globally,
    summarize_localization,
)
from hmt_slam_ros.topological_inference.global_scan_matching import GlobalScanMatcher, PoseCandidate

shares = st.lists(st.floats(0.001, 1.0), min_size=1, max_size=5)


def make_candidate(area):
    belief = PoseGaussian(np.zeros(3), np.eye(3))
    return PoseCandidate(area, MatchMode(belief, belief, 0.0), Agreement(0, 0, 0))


def distribution(likelihoods, prior=UNMAPPED_PRIOR):
    """Candidates by their likelihood relative to unmapped ground, with a flat prior in the map."""
    weights = (1.0 - prior) / len(likelihoods) * np.array(likelihoods)
    return PoseDistribution(tuple(map(make_candidate, range(len(likelihoods)))), weights / (weights.sum() + prior))


@given(shares, st.floats(0.01, 0.99))
def test_another_prior_of_unmapped_ground_is_as_if_it_had_been_the_prior_at_first(likelihoods, prior):
    found = distribution(likelihoods).with_unmapped_prior(prior)
    np.testing.assert_allclose(found.probabilities, distribution(likelihoods, prior).probabilities, rtol=1e-9)


def test_one_fifth_of_poses_are_unmapped_before_any_evidence():
    assert summarize_localization({}, 1.0, 0.0, 4, None, 0.5).entropy == pytest.approx(
        -(0.2 * math.log(0.2) + 0.8 * math.log(0.2))
    )
    assert summarize_localization({}, 1.0, 0.0, 0, None, 0.5).entropy == 0.0


@given(shares, shares, st.floats(0.05, 0.95))
def test_the_entropy_is_that_of_the_areas_of_tracked_and_lost_robots(tracked, likelihoods, lost):
    total = sum(tracked)
    areas = {area: (1.0 - lost) * share / total for area, share in enumerate(tracked)}
    where = distribution(likelihoods)
    # Two candidates in one area count as one.
    where = where._replace(candidates=(make_candidate(0), *where.candidates[:-1]))
    joined = {}
    for candidate, probability in zip(where.candidates, where.probabilities, strict=True):
        joined[candidate.area] = joined.get(candidate.area, 0.0) + lost * probability
    unmapped = lost * (1.0 - where.probabilities.sum())
    expected = -sum(p * math.log(p) for p in (*areas.values(), *joined.values(), unmapped))
    found = summarize_localization(areas, lost, 0.0, 7, where, 0.5)
    assert found.entropy == pytest.approx(expected)
    assert found.localized == (lost <= 0.5)


def test_a_robot_in_one_area_for_certain_is_localized_without_entropy():
    assert summarize_localization({3: 1.0}, 0.0, 0.0, 5, None, 0.1) == (True, 0.0)
    half = summarize_localization({3: 0.5}, 0.0, 0.5, 5, None, 0.1)
    assert half.entropy == pytest.approx(math.log(2.0))


@given(shares, st.floats(0.05, 0.95), st.integers(0, 4))
def test_a_false_alarm_leaves_the_robot_at_its_tracked_pose(likelihoods, probability, tracked):
    """Moved: a flat prior over the areas; not moved: at the tracked pose, where scans are as likely as elsewhere."""
    count = len(likelihoods)
    at_tracked_pose = np.arange(count) == tracked
    found = distribution(likelihoods).with_false_alarm(at_tracked_pose, probability, count)
    moved = (1.0 - UNMAPPED_PRIOR) / count * np.array(likelihoods)
    stayed = np.where(at_tracked_pose, likelihoods, 0.0)
    weights = (1.0 - probability) * moved + probability * stayed
    rest = (1.0 - probability) * UNMAPPED_PRIOR + probability * max(0.0, 1.0 - stayed.sum())
    np.testing.assert_allclose(found.probabilities, weights / (weights.sum() + rest), rtol=1e-9)


@given(st.lists(st.tuples(st.floats(0.01, 1.0), st.floats(-5.0, 5.0)), min_size=1, max_size=5))
def test_evidence_multiplies_odds_against_unmapped_ground(pairs):
    likelihoods, logs = zip(*pairs, strict=True)
    expected = distribution(np.array(likelihoods) * np.exp(logs))
    found = distribution(likelihoods).reweight(logs)
    np.testing.assert_allclose(found.probabilities, expected.probabilities, rtol=1e-6)
    best, probability = found.best
    assert probability == max(found.probabilities)
    assert found.candidates.index(best) == found.probabilities.argmax()


class GivenWalls(GlobalScanMatcher):
    """Finds one candidate in every area that is searched, each with given walls."""

    def __init__(self, walls):
        self.walls, self.searched = walls, []

    def match_regions(self, _hybrid_map, _poses, _before, area_probabilities):
        self.searched = list(area_probabilities)
        return list(map(make_candidate, area_probabilities))

    def check_walls(self, _hybrid_map, candidate, _poses, _before):
        return self.walls[candidate.area]


def test_walls_that_beams_pass_count_against_a_candidate_and_others_count_for_none():
    passed = Agreement(400, 360, 40)
    matcher = GivenWalls({0: Agreement(400, 400, 0), 1: passed, 2: Agreement(0, 0, 0)})
    found = localize_globally(matcher, dict.fromkeys(range(3), 1.0 / 3.0), 0.01, HybridMap(), {}, 9, NO_CLUTTER)
    log_ratio = WALLS_OF_MAP.log_likelihood_ratio(passed, WALLS_OUTLIER_RATE)
    assert log_ratio < -1.0
    first, second, third = found.probabilities
    assert second / first == pytest.approx(math.exp(log_ratio))
    assert third == pytest.approx(first)


@pytest.mark.parametrize("reach", [-0.01, 0.01])
@pytest.mark.parametrize("turn", [0.3, 2.0])
def test_an_initial_pose_reaches_four_deviations_of_its_least_certain_direction(turn, reach):
    """From a keyframe amid area 1, whose other keyframe is farther away, in whatever direction it lies."""
    hybrid_map, rotation = HybridMap(), se2.adjoint([0.0, 0.0, turn])
    hybrid_map.set_keyframe(0, 0, np.array([50.0, 0.0, 0.0]))
    hybrid_map.set_keyframe(1, 1, np.array([20.0, 1.0, 0.0]))
    hybrid_map.set_keyframe(2, 1, np.array([1.0, -0.5, 0.3]))
    hybrid_map.set_keyframe(8, 2, np.zeros(3))
    arc = np.array([3.0, 7.0, 1.2])
    for area in (1, 2):
        hybrid_map.set_arc(0, area, PoseGaussian(arc, 1e-4 * np.eye(3)), closure=False)
    covariance = rotation @ np.diag([0.1, 0.6, 0.2]) ** 2 @ rotation.T
    at = se2.transform(arc, [1.0, -0.5]) + (1.5 + 4.0 * 0.6 - reach) * np.array([0.6, -0.8])
    pose_hint = PoseHint(9, 0, PoseGaussian(np.array([*at, 0.4]), covariance))
    matcher = GivenWalls(dict.fromkeys(range(3), Agreement(0, 0, 0)))
    # The keyframe of area 2 came when the robot was lost already.
    areas = dict.fromkeys(range(3), 1.0 / 3.0)
    localize_globally(matcher, areas, 0.01, hybrid_map, {9: np.zeros(3)}, 8, NO_CLUTTER, pose_hint, 1.5)
    assert matcher.searched == ([1] if reach > 0.0 else [])


def test_an_initial_pose_weighs_candidates_by_their_distance_in_both_covariances():
    hybrid_map = HybridMap()
    for area in (0, 1):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    arc = PoseGaussian(np.array([1.0, 0.5, 0.9]), np.diag([0.02, 0.01, 0.004]))
    hybrid_map.set_arc(0, 1, arc, closure=False)
    hint = PoseGaussian(np.array([0.4, 0.9, 0.5]), np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.02], [0.0, 0.02, 0.1]]))
    matcher = GivenWalls(dict.fromkeys(range(2), Agreement(0, 0, 0)))
    areas = dict.fromkeys(range(2), 0.5)
    search = (matcher, areas, 0.01, hybrid_map, {9: np.zeros(3)}, 9, NO_CLUTTER)
    flat, found = (
        localize_globally(*search, pose_hint, 2.0).probabilities for pose_hint in (None, PoseHint(9, 0, hint))
    )
    measured = make_candidate(0).mode.measured
    odds = []
    for belief in (PoseGaussian(np.zeros(3), np.zeros((3, 3))), arc):
        ad = se2.adjoint(se2.inverse(measured.mean))
        pose, covariance = se2.compose(belief.mean, measured.mean), ad @ belief.covariance @ ad.T + measured.covariance
        off = se2.log(se2.between(hint.mean, pose))
        odds.append(math.exp(-0.5 * off @ np.linalg.inv(covariance + hint.covariance) @ off))
    # The flat prior gives each of the two areas a half.
    np.testing.assert_allclose(found / (1.0 - found.sum()), 2.0 * np.array(odds) * flat / (1.0 - flat.sum()))


@pytest.mark.parametrize(("x", "y", "near"), [(0.0, 8.0, [1]), (8.0, 0.0, [2]), (0.5, 0.5, [0]), (4.5, 4.5, [])])
def test_only_areas_near_an_initial_pose_are_searched(x, y, near):
    """One keyframe in each of three areas; the search reaches 2 m beyond four deviations of 0.5 m."""
    hybrid_map = HybridMap()
    for area, position in enumerate(((0.0, 0.0), (0.0, 8.0), (8.0, 0.0))):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
        if area:
            hybrid_map.set_arc(0, area, PoseGaussian(np.array([*position, 0.0]), 1e-4 * np.eye(3)), closure=False)
    pose_hint = PoseHint(9, 0, PoseGaussian(np.array([x, y, 0.0]), np.diag([0.25, 0.25, 0.1])))
    matcher = GivenWalls(dict.fromkeys(range(3), Agreement(0, 0, 0)))
    areas = dict.fromkeys(range(3), 1.0 / 3.0)
    localize_globally(matcher, areas, 0.01, hybrid_map, {9: np.zeros(3)}, 9, NO_CLUTTER, pose_hint, 2.0)
    assert matcher.searched == near
