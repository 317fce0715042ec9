"""How far evidence is to be believed, on made-up comparisons of which the right weights are known."""

import numpy as np
import pytest

from benchmark.evidence import Comparison, contradictions, fitted
from hmt_slam_ros.registration.consistency import MAPS, MAPS_USUAL, Agreement


@pytest.mark.parametrize("overstated", [1.0, 4.0])
def test_evidence_has_the_weight_that_it_deserves(overstated):
    generator = np.random.default_rng(1)
    evidence = generator.normal(0.0, 2.0, (20_000, 2))
    right = generator.random(20_000) < 1.0 / (1.0 + np.exp(-evidence @ [1.0, 0.5] + 0.3))
    weights, surprise = fitted(overstated * evidence, right)
    np.testing.assert_allclose(weights, [-0.3, 1.0 / overstated, 0.5 / overstated], atol=0.05)
    assert 0.3 < surprise < np.log(2.0)


def test_what_contradicts_is_that_of_the_inference():
    found = Agreement(100, 90, 5)
    (against,) = contradictions([Comparison("sim:ring,seed=0", False, found, 0.0, 0.0, 0.0)], MAPS)
    assert against == MAPS.log_ratio(found, MAPS_USUAL)
    assert against < -1.0
