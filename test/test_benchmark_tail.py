"""Reliability of probabilities above 0.9, on pairs of which the right figures are known."""

import math
from itertools import pairwise

import numpy as np
import pytest

from benchmark.report import Requirement
from benchmark.tail import tail_bins, tail_error, tail_requirement, tail_table


def pairs_of(probability, right, wrong):
    return [(probability, True)] * right + [(probability, False)] * wrong


@pytest.mark.parametrize(
    ("right", "wrong", "low", "high"),
    [(9, 1, 0.5550, 0.9975), (50, 50, 0.3983, 0.6017), (0, 10, 0.0, 0.3085), (10, 0, 0.6915, 1.0)],
    ids=["nine of ten", "half of hundred", "none of ten", "ten of ten"],
)
def test_the_interval_is_that_of_clopper_and_pearson(right, wrong, low, high):
    (found,) = tail_bins(pairs_of(0.95, right, wrong))
    assert found.interval == (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))
    assert (found.count, found.share) == (right + wrong, pytest.approx(right / (right + wrong)))


def test_only_probabilities_above_nine_tenths_count():
    assert tail_bins([(0.9, False), (0.5, True), (0.1, False)]) == []
    (found,) = tail_bins([(0.9, False), (0.91, True), (0.99, True)])
    assert (found.count, found.right, found.least, found.most) == (2, 2, 0.91, 0.99)
    assert found.mean == pytest.approx(0.95)


def test_bins_are_of_equal_count_in_the_order_of_the_probability_and_few_for_few_pairs():
    draw = np.random.default_rng(3)
    pairs = [(float(p), True) for p in 1.0 - 10.0 ** draw.uniform(-9.0, -1.1, 80)]
    found = tail_bins(pairs)
    assert [one.count for one in found] == [20, 20, 20, 20]
    assert all(one.most <= next_one.least for one, next_one in pairwise(found))
    assert [one.count for one in tail_bins(pairs[:25])] == [12, 13]
    assert [one.count for one in tail_bins(pairs[:3])] == [3]


def test_equal_probabilities_are_in_one_bin_whatever_their_order():
    pairs = pairs_of(1.0, 60, 4) + pairs_of(0.95, 16, 0)
    found = tail_bins(pairs)
    assert [(one.count, one.right) for one in found] == [(16, 16), (64, 60)]
    assert tail_bins(pairs[::-1]) == found


def test_right_probabilities_are_inside_and_too_certain_ones_are_not():
    assert tail_bins(pairs_of(0.95, 95, 5))[0].is_inside
    assert not tail_bins(pairs_of(0.9999, 95, 5))[0].is_inside
    assert not tail_bins(pairs_of(1.0, 999, 1))[0].is_inside
    assert tail_bins(pairs_of(1.0, 1000, 0))[0].is_inside


def test_the_error_is_that_of_the_bins_weighted_by_their_counts():
    pairs = pairs_of(0.92, 20, 0) + pairs_of(0.98, 15, 5)
    assert tail_error(pairs) == pytest.approx((20 * 0.08 + 20 * 0.23) / 40)
    assert tail_error(pairs_of(1.0, 50, 0)) == 0.0


def test_without_answers_nothing_is_met_and_the_table_says_so():
    assert math.isnan(tail_error([]))
    assert not tail_requirement("loops", []).is_met
    assert tail_table({"loops": []}).splitlines()[-1] == "| loops | - | 0 | - | - | - | - |"


def test_the_table_and_the_requirement_name_what_is_counted():
    pairs = pairs_of(0.95, 95, 5)
    table = tail_table({"accepted closures": pairs})
    assert table.splitlines()[-1] == (
        "| accepted closures | 0.95000 to 0.95000 | 100 | 0.95000 | 0.9500 | 0.8872 to 0.9836 | yes |"
    )
    required = tail_requirement("accepted closures", pairs)
    assert required == Requirement("accepted closures: expected calibration error above 0.9", required.value, 0.01)
    assert required.is_met
