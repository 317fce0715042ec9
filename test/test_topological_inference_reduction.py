"""Optimal reduction of weighted hypotheses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.topological_inference.hypothesis_tree import reduce_hypotheses, threshold

some_weights = st.lists(st.floats(1e-6, 1.0), min_size=2, max_size=40).map(np.array)


@given(some_weights, st.integers(1, 39))
def test_the_threshold_solves_its_equation(weights, most):
    if most < weights.size:
        assert np.minimum(weights / threshold(weights, most), 1.0).sum() == pytest.approx(most, rel=1e-9)


@given(some_weights, st.integers(1, 40), st.integers(0, 1000))
def test_exactly_the_wanted_number_stays_each_once_and_no_mass_is_lost(weights, most, step):
    reduction = reduce_hypotheses(weights, most, random_stream(1, Purpose.HYPOTHESES, step))
    assert reduction.indices.size == min(most, weights.size)
    assert np.all(np.diff(reduction.indices) > 0)
    assert reduction.weights.sum() == pytest.approx(weights.sum())


@given(some_weights, st.integers(1, 40), st.integers(0, 1000))
def test_the_heavy_stay_with_their_weight(weights, most, step):
    reduction = reduce_hypotheses(weights, most, random_stream(1, Purpose.HYPOTHESES, step))
    c = threshold(weights, most) if most < weights.size else 0.0
    for k in np.flatnonzero(weights >= c):
        assert reduction.weights[reduction.indices == k] == [weights[k]]


def test_the_expected_weight_of_every_hypothesis_is_its_weight():
    weights = np.random.default_rng(5).dirichlet(np.full(20, 0.3))
    runs = 4000
    mean = np.zeros(20)
    for step in range(runs):
        reduction = reduce_hypotheses(weights, 6, random_stream(2, Purpose.HYPOTHESES, step))
        mean[reduction.indices] += reduction.weights / runs
    c = threshold(weights, 6)
    error = np.sqrt(np.maximum(weights * (c - weights), 0.0) / runs)  # of c times a Bernoulli variable
    assert np.all(np.abs(mean - weights) <= 4.0 * error + 1e-12)


def test_hypotheses_without_weight_are_dropped():
    reduction = reduce_hypotheses(np.array([0.0, 0.4, 0.0, 0.6]), 3, random_stream(0, Purpose.HYPOTHESES, 0))
    assert reduction.indices.tolist() == [1, 3]


def test_the_draw_depends_on_seed_and_step_alone():
    weights = np.full(30, 1.0 / 30)
    draws = [
        reduce_hypotheses(weights, 7, random_stream(seed, Purpose.HYPOTHESES, step)).indices.tolist()
        for seed, step in ((1, 1), (1, 1), (1, 2), (2, 1))
    ]
    assert draws[0] == draws[1]
    assert len({tuple(draw) for draw in draws}) > 1
