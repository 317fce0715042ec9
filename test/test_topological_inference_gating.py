"""The gate of areas in which keyframes may lie, against brute force."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.topological_inference import candidate_gating
from hmt_slam_ros.topological_inference.candidate_gating import CandidateGating, Query, transition_model

OPTIONS = replace(Configuration().tsbi, place_radius=1.5, prior_scale=1.3, gate_probability=0.99)
POSES = {7: np.zeros(3), 8: np.array([0.7, 0.3, 0.4]), 9: np.array([1.1, 0.9, 0.9])}
SPREAD = np.array([[0.09, 0.02, 0.01], [0.02, 0.05, -0.01], [0.01, -0.01, 0.02]])


def make_map(areas, seed=1):
    """A random tree of areas, each with two keyframes."""
    rng, hybrid_map = np.random.default_rng(seed), HybridMap()
    for area in range(areas):
        for k in range(2):
            pose = np.zeros(3) if k == 0 else rng.uniform([0.2, -1.5, -1.0], [1.5, 1.5, 1.0])
            hybrid_map.set_keyframe(1000 + 2 * area + k, area, pose)
        if area:
            step = rng.uniform([-3.0, -3.0, -2.0], [3.0, 3.0, 2.0])
            sigma = rng.uniform(0.02, 0.3)
            belief = PoseGaussian(step, np.diag([sigma, 0.6 * sigma, 0.2 * sigma]) ** 2)
            hybrid_map.set_arc(int(rng.integers(area)), area, belief, closure=False)
    return hybrid_map


def plain_prior(belief, query):
    """Of the area seen from the query's: the inverse, then the query, scaled."""
    inverse = belief.inverse()
    ad = se2.adjoint(se2.inverse(query.belief.mean))
    covariance = ad @ inverse.covariance @ ad.T + query.belief.covariance
    return PoseGaussian(se2.compose(inverse.mean, query.belief.mean), 1.3**2 * covariance)


def plain_reach(hybrid_map, area, prior, poses):
    """How far the query may be at most, less how far its keyframes are; at least 0 within reach."""
    at = se2.compose(prior.mean, np.array(list(poses.values())))[:, :2]
    known = np.array(list(hybrid_map.keyframes(area).values()))[:, :2]
    lever = max(math.dist(prior.mean[:2], each) for each in at)
    widest = math.sqrt(np.linalg.norm(prior.covariance[:2, :2], 2)) + lever * math.sqrt(prior.covariance[2, 2])
    return 1.5 + math.sqrt(chi2.ppf(0.99, 3)) * widest - min(math.dist(a, b) for a in at for b in known)


@pytest.mark.parametrize("seed", range(4))
def test_the_areas_within_reach_are_those_near_enough_somewhere_within_the_gate(seed):
    hybrid_map = make_map(40, seed)
    gating = CandidateGating(OPTIONS)
    query = Query(PoseGaussian(np.array([1.5, -0.5, 2.0]), 0.1 * SPREAD), POSES)
    within, unexamined, elsewhere = gating.classify_areas(hybrid_map, 3, query, {4, 6})
    beliefs = shortest_path_beliefs(hybrid_map, 3, OPTIONS.prior_limit**2)
    priors = {area: plain_prior(belief, query) for area, belief in beliefs.items() if area not in (4, 6)}
    near = {area for area, prior in priors.items() if plain_reach(hybrid_map, area, prior, POSES) >= 0.0}
    assert within.keys() == near
    assert 3 in near
    assert 5 < len(near) < len(priors)
    for area in near:
        np.testing.assert_allclose(within[area].mean, priors[area].mean, atol=1e-9)
        np.testing.assert_allclose(within[area].covariance, priors[area].covariance, rtol=1e-6, atol=1e-12)
    assert unexamined == {}
    assert set(elsewhere) <= beliefs.keys() - near - {4, 6}
    assert len(elsewhere) == min(6, len(beliefs.keys() - near - {4, 6}))
    np.testing.assert_allclose(query.poses_in_area[2], se2.compose(query.belief.mean, POSES[9]))


def test_of_very_many_areas_those_with_the_largest_bounds_are_examined():
    hybrid_map = HybridMap()
    for area in range(90):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
        if area:
            arc = PoseGaussian(np.array([0.02 * area, 0.0, 0.1]), np.diag([0.5, 0.5, 0.1]) ** 2)
            hybrid_map.set_arc(0, area, arc, closure=False)
    query = Query(PoseGaussian(np.array([0.3, 0.1, 0.2]), SPREAD), {100: np.zeros(3)})
    within, unexamined, elsewhere = CandidateGating(OPTIONS).classify_areas(hybrid_map, 0, query, {5})
    assert len(within) == 64
    assert len(unexamined) == 25
    assert within.keys() | unexamined.keys() == set(range(90)) - {5}
    assert max(unexamined.values()) <= 1.0
    assert min(unexamined.values()) > 0.0
    assert elsewhere == []
    # The robot's own area, which is certain, has the largest bound.
    assert next(iter(within)) == 0


@pytest.mark.parametrize(("matched", "count"), [((), 3), ((8,), 2), ((7, 9), 0), ((7, 8, 9), 0)])
def test_a_candidate_has_the_keyframes_that_were_not_compared_if_these_are_half_at_least(matched, count):
    hybrid_map = make_map(5)
    prior = PoseGaussian(np.array([0.4, 0.3, 0.5]), 0.2 * SPREAD)
    query = Query(PoseGaussian(np.zeros(3), SPREAD), POSES)
    found = CandidateGating(OPTIONS).candidates(hybrid_map, query, {2: matched, 3: (7, 8, 9)}, {2: prior})
    assert list(found) == ([2] if count else [])
    if count:
        candidate = found[2]
        assert candidate.prior is prior
        assert candidate.unmatched_poses.keys() == POSES.keys() - set(matched)
        assert candidate.max_probability == pytest.approx(plain_bound(hybrid_map, prior, candidate.unmatched_poses))
        assert 0.5 < candidate.max_probability <= 1.0
    four = POSES | {10: np.array([1.5, 1.2, 1.0])}
    query = replace(query, poses=four)
    assert (2 in CandidateGating(OPTIONS).candidates(hybrid_map, query, {2: (7, 8)}, {2: prior})) is True
    assert CandidateGating(OPTIONS).candidates(hybrid_map, query, {2: (7, 8, 9)}, {2: prior}) == {}
    far = PoseGaussian(np.array([90.0, 0.3, 0.5]), 0.2 * SPREAD)
    assert CandidateGating(OPTIONS).candidates(hybrid_map, query, {}, {2: far}) == {}


def plain_draws():
    """A sequence of low discrepancy by the powers of the root of g^4 = g + 1, through the normal's quantiles."""
    g = np.roots([1.0, 0.0, 0.0, -1.0, -1.0])
    g = g[np.isreal(g) & (g.real > 1.0)].real[0]
    return norm.ppf((0.5 + np.arange(512)[:, None] * g ** -np.arange(1.0, 4.0)) % 1.0)


def plain_positions(belief, poses):
    twists = plain_draws() @ np.linalg.cholesky(belief.covariance).T
    drawn = se2.compose(belief.mean, se2.exp(twists))
    return np.array([se2.compose(pose, np.array(list(poses.values())))[:, :2] for pose in drawn])


def plain_bound(hybrid_map, belief, poses):
    known = np.array(list(hybrid_map.keyframes(2).values()))[:, :2]
    apart = np.hypot(*(plain_positions(belief, poses)[:, :, None] - known).transpose(3, 0, 1, 2))
    return np.mean(apart.min(axis=(1, 2)) <= 1.5)


def test_positions_are_those_of_draws_from_the_belief():
    belief = PoseGaussian(np.array([2.0, -1.0, 2.6]), SPREAD)
    found = candidate_gating._sampled_positions(belief, np.array(list(POSES.values())))
    np.testing.assert_allclose(found, plain_positions(belief, POSES), atol=1e-9)


@pytest.mark.parametrize("radius", [0.5, 1.0, 3.0])
def test_a_draw_is_near_where_one_position_is_within_the_radius_of_one_keyframe(radius):
    rng = np.random.default_rng(4)
    positions, known = rng.uniform(-3.0, 3.0, (200, 2, 2)), rng.uniform(-3.0, 3.0, (3, 2))
    expected = np.hypot(*(positions[:, :, None] - known).transpose(3, 0, 1, 2)).min(axis=(1, 2)) <= radius
    np.testing.assert_array_equal(candidate_gating._any_near(positions, known, radius), expected)
    on_edge = np.array([[[0.6, 0.8]]])
    np.testing.assert_array_equal(candidate_gating._any_near(on_edge, np.zeros((1, 2)), 1.0), [True])


@pytest.mark.parametrize("seed", range(5))
def test_areas_all_over_the_map_are_those_divisible_by_the_largest_powers_of_two(seed):
    rng = np.random.default_rng(seed)
    areas = np.sort(rng.choice(100, int(rng.integers(1, 40)), replace=False))

    # The lowest bit; that of 0 is none.
    expected = sorted(areas.tolist(), key=lambda area: (-(area & -area), area))[:6]
    assert candidate_gating._spread_out(areas, 6).tolist() == expected
    everything = np.arange(0, 100, 7)
    assert candidate_gating._spread_out(everything, 20).tolist()[-1] == 0


@pytest.mark.parametrize(
    ("probabilities", "known", "new"),
    [
        ({1: 0.2, 2: 0.3}, {1: 0.2, 2: 0.3}, 0.5),
        ({1: 0.6, 2: 0.9}, {1: 0.38, 2: 0.57}, 0.05),
        ({1: 0.97}, {1: 0.95}, 0.05),
        ({1: 0.0}, {1: 0.0}, 1.0),
        ({}, {}, 1.0),
    ],
)
def test_new_ground_has_what_places_leave_and_its_floor(probabilities, known, new):
    found = transition_model(probabilities, 0.05)
    assert found.known == pytest.approx(known)
    assert found.new == pytest.approx(new)
