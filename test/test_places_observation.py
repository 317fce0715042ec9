"""Observation graphs, and the observation function against enumeration and as a density."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from worlds import scan_at

from benchmark.belief_world import draw_clutter, draw_observation
from hmt_slam_ros.configuration.landmarks import FeatureParameters, PlaceParameters
from hmt_slam_ros.landmarks.beam_labels import rays_from_scan
from hmt_slam_ros.landmarks.corners import Corners, extract_corners
from hmt_slam_ros.landmarks.line_extraction import extract_lines
from hmt_slam_ros.landmarks.openings import Openings, extract_openings
from hmt_slam_ros.places.observation import (
    ExpectedLandmarks,
    estimate_distance_past_node,
    log_observation_ratios,
    log_unknown_ground_ratio,
    observation_model,
)
from hmt_slam_ros.places.observation_graph import (
    OPENINGS,
    TRACKS,
    LandmarkSequence,
    empty_sequence,
    merge_sequences,
    observation_graph,
    reverse_direction,
    shift_ahead,
)

FEATURES = FeatureParameters(range_deviation=0.01)
PLACES = PlaceParameters()
MODEL = observation_model(PLACES, FEATURES)
WHOLE = dataclasses.replace(PLACES, reach=6.0, aside=4.0)
# A hallway of 2 m with a door of 1 m to a room on the left, and at its end another hallway to the right.
HALLWAY = np.array(
    [
        [-6, -1, 4, -1],
        [4, -1, 4, -6],
        [6, -6, 6, 1],
        [6, 1, 2.5, 1],
        [2.5, 1, 2.5, 1.2],
        [2.5, 1.2, 4, 1.2],
        [4, 1.2, 4, 5],
        [4, 5, -1, 5],
        [-1, 5, -1, 1.2],
        [-1, 1.2, 1.5, 1.2],
        [1.5, 1.2, 1.5, 1],
        [1.5, 1, -6, 1],
        [-6, 1, -6, -1],
    ],
    dtype=float,
)


def graph_at(pose, axis):
    scan = scan_at(HALLWAY, pose, 0.01, np.random.default_rng(0), 720)
    lines = extract_lines(scan, FEATURES)
    openings = extract_openings(lines, rays_from_scan(scan, FEATURES), FEATURES)
    return observation_graph(extract_corners(lines, FEATURES), openings, axis, WHOLE)


def is_in(few, more):
    """Whether the landmarks of one list are in the other."""
    off = np.abs(few.forms[:, None] - more.forms)
    near = (np.abs(few.positions[:, None] - more.positions) < 0.05) & (np.minimum(off, 2 * np.pi - off) < 0.15)
    return len(few.tracks) > 2 and (near & (few.tracks[:, None] == more.tracks)).any(axis=1).all()


def landmarks(*rows):
    """Rows of track, along, form, its two variances and the probability."""
    table = np.array(rows, dtype=float).reshape(-1, 6)
    return merge_sequences(
        (LandmarkSequence(table[:, 0].astype(np.int64), table[:, 1], table[:, 2], table[:, 3:5], table[:, 5]),)
    )


def random_landmarks(random, count, tracks=(0, 2, 5), spread=1.0):
    chosen = random.choice(tracks, count)
    forms = np.where(chosen < OPENINGS, random.uniform(-np.pi, np.pi, count), random.uniform(0.7, 2.5, count))
    variances = random.uniform(0.0, 0.2, (count, 2))
    along = random.uniform(-spread, spread, count)
    return merge_sequences((LandmarkSequence(chosen, along, forms, variances, random.uniform(0.1, 1.0, count)),))


def one_state(found):
    return ExpectedLandmarks(np.array([0, len(found.tracks)]), found)


def test_a_hallway_is_seen_in_order_along_the_axis_whatever_the_robot_heads_for():
    straight = graph_at((-1.0, 0.0, 0.0), 0.0)
    assert list(straight.tracks) == sorted(straight.tracks)
    door = straight.tracks == OPENINGS + 1
    assert door.sum() == 1
    assert straight.positions[door][0] == pytest.approx(3.0, abs=0.05)
    assert straight.forms[door][0] == pytest.approx(1.0, abs=0.15)
    np.testing.assert_allclose(straight.positions[straight.tracks == 0], [-5.0], atol=0.05)
    np.testing.assert_allclose(straight.forms[straight.tracks == 0], [-0.25 * np.pi], atol=0.05)
    turned = graph_at((-1.0, 0.0, 0.7), -0.7)
    assert is_in(straight, turned)


def test_only_landmarks_within_reach_count_and_variances_are_those_along_the_axis():
    poses = np.array([[1.0, 2.0, 0.5 * np.pi], [7.0, 1.0, 0.0], [1.0, 5.0, 0.0]])
    covariances = np.tile(np.diag([1e-4, 4e-4, 9e-4]), (3, 1, 1))
    corners = Corners(poses, covariances, np.array([True, False, False]), np.array([0.9, 0.8, 0.7]))
    none = Openings(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), np.empty(0), np.empty(0))
    seen = observation_graph(corners, none, 0.0, PLACES)
    assert list(seen.tracks) == [2]
    np.testing.assert_allclose(seen.variances, [[4e-4, 9e-4]])
    np.testing.assert_allclose(seen.probabilities, [0.9])


def test_to_turn_back_is_to_see_the_hallway_from_its_other_end():
    there, back = graph_at((-1.0, 0.0, 0.0), 0.0), graph_at((-1.0, 0.0, np.pi), 0.0)
    mirrored = reverse_direction(there)
    assert is_in(back, mirrored) or is_in(mirrored, back)
    for one, other in zip(reverse_direction(mirrored), there, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_what_is_seen_tells_how_far_the_robot_is_beyond_the_node():
    expected = ExpectedLandmarks(
        np.array([0, 0, 2]), landmarks((0, 1.0, 0.5, 0.0, 0.0, 0.9), (5, 2.0, 1.0, 0.0, 0.0, 0.9))
    )
    seen = landmarks((0, 0.8, 0.5, 0.0, 0.0, 0.9), (5, 1.8, 1.0, 0.0, 0.0, 0.9))
    mean, variance = estimate_distance_past_node(seen, expected, 1, 0.0, 0.25, MODEL)
    assert mean == pytest.approx(0.2, abs=0.02)
    assert variance == pytest.approx(1.0 / (2.0 / MODEL.position_variance + 4.0), rel=0.1)
    # Where nothing is seen that is known, nothing is learnt.
    mean, variance = estimate_distance_past_node(empty_sequence(), expected, 0, 0.1, 0.25, MODEL)
    assert (mean, variance) == pytest.approx((0.1, 0.25), rel=0.01)


def brute_force(observed, expected, away, model):
    """The sum over every pairing in which nothing crosses, for one place of the robot."""
    total, n, m = 0.0, len(expected.tracks), len(observed.tracks)
    for count in range(min(n, m) + 1):
        for own in itertools.combinations(range(n), count):
            for other in itertools.combinations(range(m), count):
                total += product(observed, expected, dict(zip(own, other, strict=True)), away, model)
    return total


def product(observed, expected, pairs, away, model):
    value = 1.0
    for i in range(len(expected.tracks)):
        seen = expected.probabilities[i] * model.detection
        place, variance = expected.positions[i] - away, expected.variances[i, 0] + model.position_variance
        scale = math.sqrt(2.0 * variance)
        low, high = -model.reach, model.reach
        if expected.tracks[i] == 2:
            low, high = (low, 0.0) if math.cos(expected.forms[i]) > 0.0 else (0.0, high)
        within = 0.5 * (math.erf((high - place) / scale) - math.erf((low - place) / scale))
        if i not in pairs:
            value *= 1.0 - seen * within
            continue
        j = pairs[i]
        if observed.tracks[j] != expected.tracks[i] or not low <= observed.positions[j] <= high:
            return 0.0
        corner = expected.tracks[i] < OPENINGS
        form_variance = (
            expected.variances[i, 1]
            + observed.variances[j, 1]
            + (model.heading_variance if corner else model.width_variance)
        )
        off = observed.forms[j] - expected.forms[i]
        off = math.remainder(off, 2.0 * math.pi) if corner else off
        p = observed.probabilities[j]
        false, there = model.false_density * (1.0 - p) / (1.0 - model.true_share), p / model.true_share
        extra = (model.corner_form if corner else model.opening_form) * (false + model.new_density * there)
        g = density(observed.positions[j] - place, variance + observed.variances[j, 0]) * density(off, form_variance)
        value *= seen * g * there / extra
    return value


def density(off, variance):
    return math.exp(-0.5 * off**2 / variance) / math.sqrt(2.0 * math.pi * variance)


@pytest.mark.parametrize("seed", range(40))
def test_the_forward_algorithm_is_the_sum_over_all_pairings_that_do_not_cross(seed):
    random = np.random.default_rng(seed)
    model = MODEL._replace(position_variance=0.3, heading_variance=0.5, width_variance=0.5, reach=1.5)
    states = [random_landmarks(random, int(random.integers(0, 6))) for _ in range(3)]
    observed = random_landmarks(random, int(random.integers(0, 6)))
    starts = np.concatenate(([0], np.cumsum([len(state.tracks) for state in states])))
    every = LandmarkSequence(*(np.concatenate(fields) for fields in zip(*states, strict=True)))
    found = log_observation_ratios(observed, ExpectedLandmarks(starts, every), 0.2, 0.0, model)
    np.testing.assert_allclose(found, [math.log(brute_force(observed, s, 0.2, model)) for s in states], rtol=1e-12)


def test_where_the_robot_is_along_the_axis_is_integrated_out():
    random = np.random.default_rng(5)
    expected, observed = random_landmarks(random, 4), random_landmarks(random, 4)
    found = math.exp(log_observation_ratios(observed, one_state(expected), 0.1, 0.09, MODEL)[0])
    points = np.linspace(-1.5, 1.5, 3001)
    weights = np.exp(-0.5 * points**2 / 0.09)
    values = [math.exp(log_observation_ratios(observed, one_state(expected), 0.1 + x, 0.0, MODEL)[0]) for x in points]
    assert found == pytest.approx(float(weights @ values / weights.sum()), rel=1e-3)


def mean_ratio(expected, model, draws=12000, variance=0.0, seed=1):
    """E[OS / OS of a place where nothing is expected] over what is seen in such a place, and its error."""
    random = np.random.default_rng(seed)
    state = one_state(expected)
    ratios = np.exp(
        [
            log_observation_ratios(
                draw_clutter(random, model.new_density, model.false_density, model), state, 0.0, variance, model
            )[0]
            for _ in range(draws)
        ]
    )
    return ratios.mean(), ratios.std() / math.sqrt(draws)


# Much that is extra and little that is certain, so that the mean over what is extra is one of many terms.
DENSE = MODEL._replace(
    reach=3.0,
    position_variance=0.4,
    heading_variance=0.6,
    width_variance=0.06,
    new_density=0.15,
    false_density=0.05,
    detection=0.6,
)
APART = landmarks(
    (0, -2.3, 0.5, 0, 0, 0.7), (0, 2.3, -2.0, 0, 0, 0.6), (5, 0.5, 1.8, 0, 0, 0.8), (1, 2.9, 0.0, 0, 0, 0.7)
)


@pytest.mark.parametrize("variance", [0.0, 0.1])
def test_the_observation_function_is_a_density(variance):
    mean, error = mean_ratio(APART, DENSE, variance=variance)
    assert error < 0.06
    assert mean == pytest.approx(1.0, abs=4.0 * error)


def test_unknown_ground_is_a_density_too():
    random = np.random.default_rng(2)
    model = DENSE._replace(usual_density=0.25)
    ratios = np.exp(
        [
            log_unknown_ground_ratio(draw_clutter(random, model.new_density, model.false_density, model), model)
            for _ in range(8000)
        ]
    )
    error = ratios.std() / math.sqrt(len(ratios))
    assert error < 0.05
    assert ratios.mean() == pytest.approx(1.0, abs=4.0 * error)


def test_of_two_landmarks_in_one_place_what_is_missing_is_the_probability_of_the_wrong_order():
    seen = 0.8 * DENSE.detection
    together = landmarks((0, 0.0, 0.5, 0, 0, 0.8), (0, 0.0, 0.5, 0, 0, 0.8))
    mean, error = mean_ratio(together, DENSE)
    assert error < 0.05
    assert mean == pytest.approx(1.0 - 0.5 * seen**2, abs=4.0 * error)


def test_what_is_seen_of_a_state_speaks_for_it_on_average_as_much_as_information_theory_says():
    random = np.random.default_rng(3)
    right = landmarks((0, 1.0, 0.5, 0, 0, 0.9), (5, -1.0, 1.0, 0, 0, 0.9))
    wrong = shift_ahead(right, 0.6)
    both = ExpectedLandmarks(
        np.array([0, 2, 4]), LandmarkSequence(*(np.concatenate(f) for f in zip(right, wrong, strict=True)))
    )
    ratios = []
    for _ in range(8000):
        seen = log_observation_ratios(draw_observation(random, right, 0.0, 0.0, DENSE), both, 0.0, 0.0, DENSE)
        ratios.append(math.exp(seen[1] - seen[0]))
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * np.std(ratios) / math.sqrt(len(ratios)))


def test_without_landmarks_there_is_no_evidence_and_a_certain_missing_one_excludes():
    assert log_observation_ratios(empty_sequence(), one_state(empty_sequence()), 0.0, 0.0, MODEL)[0] == 0.0
    certain = landmarks((0, 0.0, 0.5, 0, 0, 1.0))
    found = log_observation_ratios(empty_sequence(), one_state(certain), 0.0, 0.0, MODEL._replace(detection=1.0))
    assert found[0] == -np.inf
    less = observation_model(dataclasses.replace(PLACES, detection=0.5), FEATURES)
    assert log_observation_ratios(empty_sequence(), one_state(certain), 0.0, 0.0, less)[0] == pytest.approx(
        math.log(0.5)
    )


def test_every_track_has_a_mirrored_one():
    table = [(track, 0.5, 1.0, 0, 0, 1) for track in range(TRACKS)]
    assert sorted(reverse_direction(landmarks(*table)).tracks) == list(range(TRACKS))
