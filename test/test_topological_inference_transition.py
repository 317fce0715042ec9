"""The transition model: the probability of areas by the arcs alone."""

import math

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import ShortestPaths
from hmt_slam_ros.hybrid_map.surroundings import AreaPlace, containing_area
from hmt_slam_ros.registration.likelihood_grid import GridModel, build_area_grid
from hmt_slam_ros.topological_inference.candidate_gating import (
    entry_prior,
    quick_entry_bounds,
    sampled_entry_bound,
    transition_model,
)

RADIUS = 2.0
# Two corridors side by side, a wall between them.
CORRIDORS = np.concatenate((box(-1.0, -1.0, 21.0, 1.0), box(-1.0, 1.0, 21.0, 3.0)))


def place(first=0.0, last=8.0, border=5.0):
    """Keyframes every meter along the lower corridor; those beyond ``border`` belong to area 7, the others to 3."""
    x = np.arange(first, last + 0.1)
    poses = np.stack((x, np.zeros_like(x), np.zeros_like(x)), axis=1)
    scans = [scan_in(CORRIDORS, pose, field_of_view=2 * np.pi, beams=361) for pose in poses]
    return AreaPlace(3, np.where(x > border, 7, 3), poses[:, :2], build_area_grid(scans, poses, GridModel()))


def keyframes(x, y=0.0, count=4):
    """Keyframes half a meter apart that begin at (x, y)."""
    return np.array([[x + 0.5 * k, y, 0.0] for k in range(count)])


def belief(sigma, degrees=0.2, x=0.0, y=0.0):
    return PoseGaussian(np.array([x, y, 0.0]), np.diag([sigma, sigma, math.radians(degrees)]) ** 2)


@pytest.fixture(scope="module")
def corridor():
    return place()


def test_keyframes_among_those_of_an_area_lie_in_its_place(corridor):
    assert containing_area(corridor, keyframes(1.0, 0.4), RADIUS) == 3


def test_keyframes_nearer_to_the_next_area_lie_in_the_place_of_that(corridor):
    assert containing_area(corridor, keyframes(6.0), RADIUS) == 7


def test_keyframes_far_away_lie_in_no_place(corridor):
    assert containing_area(corridor, keyframes(12.0), RADIUS) is None


def test_a_parallel_corridor_behind_a_wall_is_another_place(corridor):
    assert containing_area(corridor, keyframes(1.0, 1.6), RADIUS) is None


def test_most_keyframes_decide(corridor):
    assert containing_area(corridor, keyframes(9.0, count=5), RADIUS) == 7  # up to 11 m, place up to 10 m
    assert containing_area(corridor, keyframes(9.6, count=5), RADIUS) is None


def test_a_robot_tracked_within_a_place_is_there_for_sure(corridor):
    assert entry_prior(corridor, belief(0.05), keyframes(1.0), RADIUS).probability == 1.0


def test_without_overlap_the_probability_is_exactly_zero(corridor):
    assert entry_prior(corridor, belief(0.3), keyframes(14.0), RADIUS).probability == 0.0


@pytest.mark.parametrize("x", [1.0, 4.0, 5.6, 9.0, 14.0, 18.0])
@pytest.mark.parametrize("sigma", [0.05, 1.0, 4.0])
def test_the_bound_from_positions_alone_is_a_bound_and_zero_where_nothing_is_near(corridor, x, sigma):
    own = corridor.positions[corridor.keyframe_areas == 3]
    bound = sampled_entry_bound(own, belief(sigma), keyframes(x), RADIUS)
    assert entry_prior(corridor, belief(sigma), keyframes(x), RADIUS).probability <= bound
    assert bound == 0.0 or x < 9.0 or sigma > 0.05


@pytest.mark.parametrize("known", [(1.6, 1.2), (1.2, -1.6), (2.4, 2.0), (-0.5, -0.5)])
def test_the_sampled_bound_is_that_of_draws_from_a_correlated_belief(known):
    root = np.array([[1.0, 0.0, 0.0], [0.8, 0.5, 0.0], [0.3, -0.2, 0.25]])
    prior = PoseGaussian(np.array([0.5, -0.2, 0.7]), root @ root.T)
    poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.5, 0.3]])
    drawn = np.random.default_rng(3).standard_normal((40_000, 3)) @ root.T
    references = se2.compose(prior.mean, se2.exp(drawn))
    away = [np.hypot(*(se2.compose(references, pose)[:, :2] - known).T) for pose in poses]
    share = np.mean(np.minimum(*away) <= 1.0)
    assert 0.05 < share < 0.95
    assert sampled_entry_bound(np.array([known]), prior, poses, 1.0) == pytest.approx(share, abs=0.02)


def test_a_loose_prior_spreads_over_the_place_and_what_lies_around(corridor):
    share = entry_prior(corridor, belief(3.0, 10.0), keyframes(1.0), RADIUS).probability
    assert 0.02 < share < 0.6


def test_the_probability_is_that_of_the_gaussian():
    """Lengthwise uncertainty alone: in the place up to 2 m beyond its last keyframe, normal cumulative distribution."""
    prior = PoseGaussian(np.array([9.0, 0.0, 0.0]), np.diag([0.8, 1e-3, 1e-4]) ** 2)
    share = entry_prior(place(border=50.0), prior, np.zeros((1, 3)), RADIUS).probability
    assert share == pytest.approx(0.5 * (1.0 + math.erf((10.0 - 9.0) / 0.8 / math.sqrt(2.0))), abs=0.02)


def test_neighboring_areas_share_the_probability(corridor):
    other = AreaPlace(7, corridor.keyframe_areas, corridor.positions, corridor.grid)
    prior = PoseGaussian(np.array([4.0, 0.0, 0.0]), np.diag([0.5, 0.1, 0.003]) ** 2)
    shares = [entry_prior(p, prior, keyframes(0.5), RADIUS).probability for p in (corridor, other)]
    assert min(shares) > 0.1
    assert sum(shares) <= 1.0
    assert sum(shares) == pytest.approx(1.0, abs=0.02)


def test_known_and_new_sum_to_one():
    for shares in ({1: 0.2, 4: 0.3}, {1: 0.7, 2: 0.6}, {1: 1.0}, {}):
        model = transition_model(shares, 0.05)
        assert sum(model.known.values()) + model.new == pytest.approx(1.0)


def test_new_ground_has_the_remaining_probability():
    model = transition_model({1: 0.2, 4: 0.3}, 0.05)
    assert model.new == pytest.approx(0.5)
    assert model.known == pytest.approx({1: 0.2, 4: 0.3})


def test_new_ground_keeps_its_floor():
    assert transition_model({1: 0.9, 2: 0.9}, 0.05).new == 0.05


def test_without_a_candidate_all_is_new():
    assert transition_model({}, 0.05) == ({}, 1.0)


def test_a_place_that_the_belief_is_all_in_is_made_of_poses_as_near_as_the_belief_is_wide(corridor):
    found = entry_prior(corridor, belief(0.05), keyframes(1.0), RADIUS)
    assert found.median_mahalanobis2 == pytest.approx(
        2.37, abs=0.1
    )  # the median of chi-square with 3 degrees of freedom


def test_a_place_at_the_edge_of_the_belief_is_made_of_poses_that_are_far_off(corridor):
    near, far = (entry_prior(corridor, belief(1.0), keyframes(x), RADIUS) for x in (1.0, -3.5))
    assert near.probability > 5.0 * far.probability > 0.0
    assert far.median_mahalanobis2 > near.median_mahalanobis2 + 1.0


@pytest.mark.parametrize(("query_position", "keyframe"), [((0.0, 0.0), (0.0, 0.0)), ((2.0, 0.5), (1.5, 0.0))])
def test_the_quick_bound_lets_all_pass_that_are_near_and_few_others(query_position, keyframe):
    rng = np.random.default_rng(2)
    square = rng.normal(size=(200, 3, 3)) * np.array([0.3, 0.3, 0.05])[:, None]
    found = ShortestPaths(np.arange(200), rng.uniform(-9.0, 9.0, size=(200, 3)), square @ square.transpose(0, 2, 1))
    query = PoseGaussian(np.array([1.0, 2.0, 0.3]), np.diag([0.1, 0.2, 0.05]) ** 2)
    lever, extent = np.hypot(*query_position), np.hypot(*keyframe)
    bounds = quick_entry_bounds(found, query, lever, np.full(200, extent + lever + 2.0), 2.0, 2.0)
    passed = bounds > 0.0
    near = []
    for mean, covariance in zip(found.means, found.covariances, strict=True):
        prior = PoseGaussian(mean, covariance).inverse().compose(query)
        spread = np.sqrt(np.linalg.eigvalsh(prior.covariance[:2, :2])[-1]) + lever * np.sqrt(prior.covariance[2, 2])
        near.append(np.hypot(*(se2.transform(prior.mean, np.array(query_position)) - keyframe)) <= 2.0 + 4.0 * spread)
    assert passed[near].all()
    assert 20 < sum(near) < 180
    # Where the query and the area are points, the bound is the distance itself.
    assert passed.sum() == sum(near) if lever == 0.0 else sum(near) < passed.sum() < 200


@pytest.mark.parametrize("away", [0.0, 6.0, 15.0, 30.0])
def test_the_quick_bound_is_one_on_the_probability_of_an_area_far_from_certain(away):
    spread = np.diag([6.0, 4.0, 0.1]) ** 2
    found = ShortestPaths(np.array([3]), np.array([[away, 1.0, 0.5]]), spread[None])
    query = PoseGaussian(np.array([0.0, 0.0, 1.0]), 0.01 * np.eye(3))
    (bound,) = quick_entry_bounds(found, query, 1.0, np.array([3.0]), 1.5, 4.0)
    prior = PoseGaussian(found.means[0], spread).inverse().compose(query)
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    exact = sampled_entry_bound(np.zeros((1, 2)), PoseGaussian(prior.mean, 1.5**2 * prior.covariance), poses, 2.0)
    assert exact <= bound <= max(10.0 * exact, 0.01)


@pytest.mark.parametrize("direction", [0.0, 0.5 * math.pi, 2.0])
def test_the_quick_bound_passes_an_area_whose_origin_is_uncertain_in_the_direction_of_the_query_alone(direction):
    """At 10 m, with a deviation of 6 m in that direction and 1 cm across it."""
    axes = np.array([[math.cos(direction), -math.sin(direction)], [math.sin(direction), math.cos(direction)]])
    spread = np.zeros((3, 3))
    spread[:2, :2] = axes @ np.diag([6.0, 0.01]) ** 2 @ axes.T
    spread[2, 2] = 1e-6
    found = ShortestPaths(np.array([3]), np.array([[*(10.0 * axes[:, 0]), 0.0]]), spread[None])
    query = PoseGaussian(np.zeros(3), 1e-6 * np.eye(3))
    assert quick_entry_bounds(found, query, 0.0, np.array([2.0]), 1.0, 4.0)[0] > 0.0
    assert quick_entry_bounds(found, query, 0.0, np.array([2.0]), 1.0, 1.0)[0] == 0.0
