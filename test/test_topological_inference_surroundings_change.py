import math

import numpy as np
import pytest

from hmt_slam_ros.topological_inference.surroundings_change import Surroundings


def forward(observations, onset=0.002, end=0.5):
    """Likelihood of scans by the matrix form of the forward algorithm, without scaling."""
    transition = np.array([[1.0 - 2.0 * onset, onset, onset], [end, 1.0 - end, 0.0], [end, 0.0, 1.0 - end]])
    belief, likelihoods = np.array([1.0, 0.0, 0.0]), []
    for ends, walls in observations:
        belief = belief @ transition * np.exp([ends + walls, walls, ends])
        likelihoods.append(belief.sum())
    return belief / belief.sum(), np.diff(np.log([1.0, *likelihoods]))


def test_the_belief_and_the_likelihood_are_those_of_the_forward_algorithm():
    observations = [(0.2, 1.5), (-4.0, 0.9), (-6.0, 1.1), (0.3, -2.5), (0.1, 2.0), (-1.0, -3.0)]
    surroundings, log_likelihoods = Surroundings(), []
    for ends, walls in observations:
        surroundings = surroundings.update(ends, walls)
        log_likelihoods.append(surroundings.log_likelihood)
    belief, expected = forward(observations)
    np.testing.assert_allclose((surroundings.known, surroundings.added, surroundings.removed), belief, rtol=1e-9)
    np.testing.assert_allclose(log_likelihoods, expected, rtol=1e-9)


@pytest.mark.parametrize(("ends", "walls", "explained"), [(-30.0, 0.5, "added"), (0.5, -30.0, "removed")])
def test_one_kind_of_contradictions_costs_its_onset_once(ends, walls, explained):
    first = Surroundings().update(ends, walls)
    assert getattr(first, explained) > 0.999
    assert first.log_likelihood == pytest.approx(math.log(0.002) + 0.5)
    assert first.update(ends, walls).log_likelihood == pytest.approx(math.log(0.5) + 0.5)


def test_contradictions_of_both_kinds_have_no_such_explanation():
    assert Surroundings().update(-15.0, -15.0).log_likelihood < -20.0


def test_contradictions_too_strong_for_a_number_leave_a_belief():
    surroundings = Surroundings().update(-4000.0, -5000.0)
    assert surroundings.known + surroundings.added + surroundings.removed == pytest.approx(1.0)
    assert surroundings.log_likelihood == pytest.approx(-4000.0 + math.log(0.002))
