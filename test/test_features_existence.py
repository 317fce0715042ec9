"""Existence of landmarks, Eqs. (4) and (5) of Tomatis, Nourbakhsh and Siegwart."""

import numpy as np
import pytest

from hmt_slam_ros.features.existence import Existence, after_visit

LEAST = 0.6


def visited(times, existence=None, confidence=0.9):
    existence = existence or Existence(confidence)
    for _ in range(times):
        existence = existence.observed(confidence)
    return existence


def test_it_is_the_mean_of_what_all_visits_said():
    """Eq. (4) over the whole history, with Eq. (5) for the visits at which nothing was seen."""
    draw = np.random.default_rng(3)
    existence, said = Existence(0.8), [0.8]
    for _ in range(50):
        if draw.random() < 0.6:
            confidence = float(draw.random())
            existence = existence.observed(confidence)
            said.append(confidence)
        else:
            said.append(1.0 - float(np.mean(said)))
            existence = existence.missed()
        assert existence.probability == pytest.approx(np.mean(said))
        assert existence.visits == len(said)
        assert 0.0 <= existence.probability <= 1.0


def test_what_is_missed_for_ever_comes_near_to_one_half_from_above():
    existence = visited(10)
    before = existence.probability
    for _ in range(1000):
        existence = existence.missed()
        assert 0.5 <= existence.probability < before
        before = existence.probability
    assert existence.probability == pytest.approx(0.5, abs=0.01)


def test_what_is_gone_is_deleted_and_what_is_there_stays():
    """A thing that was seen at 20 visits is taken away; another, which is missed once in four visits, is not."""
    known = {0: visited(20), 1: visited(20)}
    visits = 0
    while 0 in known:
        visits += 1
        seen = {} if visits % 4 == 0 else {1: 0.9}
        known = after_visit(known, [0, 1], seen, LEAST)
        assert visits < 40
    assert visits > 10
    assert known[1].probability > 0.75


def test_what_was_seen_once_is_deleted_at_the_first_miss():
    assert after_visit({7: Existence(0.95)}, [7], {}, LEAST) == {}


def test_what_was_not_expected_stays_as_it_is_but_counts_where_it_is_seen():
    known = {1: Existence(0.7, 3), 2: Existence(0.7, 3)}
    after = after_visit(known, [], {2: 1.0}, LEAST)
    assert after[1] == known[1]
    assert after[2] == Existence(pytest.approx(0.775), 4)
    assert known[2] == Existence(0.7, 3)


@pytest.mark.parametrize("least", [0.5, 0.2, 1.0])
def test_a_minimum_that_deletes_nothing_is_refused(least):
    with pytest.raises(ValueError, match=f"{least:g}.*above 0.5"):
        after_visit({}, [], {}, least)
