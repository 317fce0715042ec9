"""The measurement of the belief over places."""

import numpy as np
import pytest

from benchmark.belief import FAMILIES, Estimate, calibration_error, recovery, run_of, world_of
from benchmark.belief_corridors import drawn_building, random_corridors
from benchmark.documents import VALIDATION, marks
from hmt_slam_ros.configuration import Configuration

CONFIGURATION = Configuration()


def estimate(arrivals, right=True, confident=True):
    return Estimate(arrivals, 4.0 * arrivals, 0.9, confident, right)


def test_a_recovery_is_confident_and_right_and_right_at_the_three_nodes_behind():
    run = [estimate(0, confident=False), estimate(1), estimate(1), *(estimate(k, confident=False) for k in (2, 3, 4))]
    assert recovery(run) == estimate(1)
    assert recovery(run[:-1]) is None
    spoilt = [*run[:4], estimate(2, right=False), *run[4:]]
    assert recovery(spoilt) is None
    assert recovery([*run[:-1], estimate(4), estimate(4, right=False)]) is None


def test_calibration_is_the_distance_between_probability_and_share():
    assert calibration_error([estimate(0), estimate(1, right=False)]) == pytest.approx(0.4)


def test_a_building_has_what_its_map_has_where_that_is_certain_and_less_where_it_is_not():
    random = np.random.default_rng(0)
    known = random_corridors(random, 2, 2, 0.2)
    there = drawn_building(random, known)
    listed = sum(len(way.landmarks.tracks) for way in known.ways)
    standing = sum(len(way.landmarks.tracks) for way in there.ways)
    expected = sum(float(way.landmarks.probabilities.sum()) for way in known.ways)
    assert standing < listed
    assert abs(standing - expected) < 4.0 * np.sqrt(0.2 * listed)
    ratios = [one.distance[0] / other.distance[0] for one, other in zip(there.ways, known.ways, strict=True)]
    assert 0.01 < np.std(ratios) < 0.06


def test_a_run_is_the_same_each_time_and_a_robot_that_looks_finds_its_place_in_the_model_s_own_world():
    run = run_of(FAMILIES["model"], 3, CONFIGURATION)
    assert run == run_of(FAMILIES["model"], 3, CONFIGURATION)
    assert recovery(run) is not None
    assert run[-1].arrivals == 12
    metres = [each.metres for each in run]
    assert metres == sorted(metres)


def test_only_what_stands_is_drawn_once():
    for name, family in FAMILIES.items():
        world = world_of(np.random.default_rng(1), family, CONFIGURATION)
        alike = np.array_equal(world.truth.expected.starts, world.graph.expected.starts)
        assert alike == (name == "model"), name
        assert world.truth.states == world.graph.states


def test_the_document_has_a_place_for_it():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in marks("belief"))
