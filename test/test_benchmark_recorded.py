"""What landmarks and kinds of areas add on recorded logs: the figures of made-up looks."""

import math

import numpy as np
import pytest

from benchmark.looks import Look, same_kind
from benchmark.recorded import BOTH, KINDS, LANDMARKS, NONE, roc_area, scored
from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.topological_inference.global_localization import Whereabouts


def test_the_area_under_the_curve_is_the_share_of_pairs_in_the_right_order():
    right = np.array([True, False, False, True])
    assert roc_area(np.array([3.0, 1.0, 2.0, 4.0]), right) == 1.0
    assert roc_area(np.array([1.0, 3.0, 0.0, 1.0]), right) == 0.5
    assert roc_area(np.zeros(4), right) == 0.5


def test_places_of_one_kind_are_likelier_the_rarer_it_is():
    assert same_kind(1.0, 1.0, 0.25) == pytest.approx(math.log(4.0))
    assert same_kind(0.0, 0.0, 0.25) == pytest.approx(math.log(4.0 / 3.0))
    assert same_kind(0.25, 0.9, 0.25) == pytest.approx(0.0)
    assert same_kind(None, 1.0, 0.25) == same_kind(1.0, None, 0.25) == 0.0


def test_looks_are_scored_by_every_way_to_weigh_them():
    places = Whereabouts((None, None), np.array([0.45, 0.45]))
    look = Look(True, places, np.array([True, False]), np.array([1.0, -4.0]), np.array([1.0, 0.0]), (0.1, 0.01))
    of = scored([look], with_changes(Configuration(), {"places.prior_temper": 0.5}))
    for name, nats in ((NONE, (0.0, 0.0)), (LANDMARKS, (0.0, -2.0)), (KINDS, (1.0, 0.0)), (BOTH, (1.0, -2.0))):
        right, wrong = (0.45 * math.exp(each) for each in nats)
        # None from outside, so that there is no mean of these.
        assert math.isnan(of[name].score)
        assert (of[name].found == 1.0) == (right / (right + wrong + 0.1) >= 0.8), name
