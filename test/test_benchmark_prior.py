"""What landmarks are worth as a prior: the figures of made-up looks."""

import math

import numpy as np
import pytest

from benchmark.looks import Look
from benchmark.prior import EXPONENTS, best_constant, by_a_constant, by_landmarks, fitted, looks_of, scored_with
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.topological_inference.global_localization import Whereabouts


def look(probabilities, right=(), ratios=None, inside=True):
    count = len(probabilities)
    ratios = np.zeros(count) if ratios is None else np.array(ratios)
    where = Whereabouts((None,) * count, np.array(probabilities, dtype=float))
    return Look(inside, where, np.array([k in right for k in range(count)]), ratios, np.zeros(count), (0.1, 0.01))


def test_the_score_is_of_where_the_robot_is_and_those_outside_weigh_a_fifth():
    own = [look([0.5, 0.3], right=(0,)), look([0.2], inside=False)]
    scored = scored_with(own)
    assert scored.score == pytest.approx(-0.8 * math.log(0.5) - 0.2 * math.log(0.8))
    assert (scored.found, scored.wrong, scored.outside) == (0.0, 0.0, 0.0)
    # The right place is none of those that were found.
    assert scored_with([*own, look([0.01])]).score == scored.score
    sure = [look([0.9], right=(0,)), look([0.85]), look([0.95], inside=False), look([0.1], inside=False)]
    assert scored_with(sure)[1:] == (0.5, 0.5, 0.5)


def test_landmarks_count_against_places_with_their_exponent_and_the_map_less_by_a_constant():
    own = [look([0.4, 0.4], right=(0,), ratios=[6.0, -2.0]), look([0.1], inside=False, ratios=[1.0])]
    inside = -math.log(0.4 / (0.4 + 0.4 * math.exp(-1.0) + 0.2))
    outside = -math.log(0.9)
    assert scored_with(own, by_landmarks(0.5)).score == pytest.approx(0.8 * inside + 0.2 * outside)
    less = math.exp(-1.0)
    inside = -math.log(0.4 * less / (0.8 * less + 0.2))
    outside = -math.log(0.9 / (0.9 + 0.1 * less))
    assert scored_with(own, by_a_constant(1.0)).score == pytest.approx(0.8 * inside + 0.2 * outside)


def test_what_fits_best_follows_what_landmarks_are_worth():
    telling = [look([0.5], right=(0,), ratios=[20.0]), look([0.5], inside=False, ratios=[-10.0])]
    assert fitted(telling) == max(EXPONENTS)
    misleading = [look([0.5], right=(0,), ratios=[-10.0]), look([0.5], inside=False, ratios=[20.0])]
    assert fitted(misleading) == 0.0
    # The robots are elsewhere more often than the prior has it.
    assert best_constant([look([0.9], inside=False), look([0.9], right=(0,))]) > 0.0


def test_robots_look_at_the_map_of_a_part_of_a_building_from_inside_and_outside():
    found = list(looks_of("office", 3, Configuration(), most=5))
    assert len(found) == 10
    inside = [one for one in found if one.inside]
    # Those inside are mostly recognized; none outside is where the map has a place.
    assert np.mean([one.right.any() for one in inside]) >= 0.8
    assert not any(one.right.any() for one in found if not one.inside)
