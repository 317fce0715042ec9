"""What counts as told apart, and as found among the areas that look most alike, on made-up likenesses."""

import numpy as np
import pytest

from benchmark.appearance import MOST, Question, questions
from benchmark.simulated.worlds import World


def asked(likeness, right):
    right = np.array(right, dtype=bool)
    return Question(np.array(likeness, dtype=float), right, ~right)


def test_the_right_area_is_told_apart_as_often_as_it_looks_more_alike():
    assert asked([3.0, 1.0, 2.0, 3.0], [1, 0, 0, 0]).told_apart == pytest.approx(2.5 / 3.0)


def test_among_those_most_alike_and_by_chance():
    question = asked(np.arange(10.0), [0] * 5 + [1] + [0] * 4)
    assert not question.among_most
    assert question.by_chance == pytest.approx(MOST / 10.0)
    assert asked(np.arange(10.0), [0] * 9 + [1]).among_most


def test_a_drive_asks_where_it_was_before():
    found = list(questions(World("twins", 0)))
    assert found
    for question in found:
        assert question.right.any()
        assert not (question.right & question.wrong).any()
    assert np.mean([question.told_apart for question in found]) > 0.6
