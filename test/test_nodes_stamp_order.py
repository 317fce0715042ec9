"""The order of a sensor's messages."""

import pytest

from hmt_slam_ros.nodes.stamp_order import BACK, StampOrder


def let_through(stamps, newest=None):
    """The stamps that are let through, and how many are refused."""
    order = StampOrder(newest)
    return [one for stamp in stamps for one in order.arrive(stamp, stamp)], order.refused


@pytest.mark.parametrize(
    ("stamps", "expected", "refused"),
    [
        pytest.param([1, 2, 3], [1, 2, 3], 0, id="in order"),
        pytest.param([1, 3, 2, 4], [1, 3, 4], 1, id="swapped"),
        pytest.param([1, 1, 2, 2, 2, 3], [1, 2, 3], 3, id="repeated"),
        pytest.param([9 * BACK, BACK, 10 * BACK], [9 * BACK, 10 * BACK], 1, id="one very late"),
        pytest.param([9 * BACK, 3, BACK, 10 * BACK], [9 * BACK, 3, BACK, 10 * BACK], 0, id="time goes back"),
        pytest.param([9 * BACK, 3, 3, 4], [9 * BACK, 3, 4], 1, id="time goes back, and the first comes twice"),
        pytest.param([9 * BACK, 5 * BACK, 3, 4], [9 * BACK, 3, 4], 1, id="time goes back twice"),
        pytest.param([-1, 9 * BACK, BACK, 8 * BACK], [-1, 9 * BACK, BACK, 8 * BACK], 0, id="it goes back for long"),
    ],
)
def test_what_comes_late_or_twice_is_refused_and_time_that_goes_back_is_told_from_it(stamps, expected, refused):
    assert let_through(stamps) == (expected, refused)


def test_the_order_goes_on_after_what_was_heard_before_and_what_comes_next_may_be_of_any_time_when_that_is_said():
    assert let_through([4, 5, 6], newest=5) == ([6], 2)
    order = StampOrder(5)
    assert order.arrive(2, "late") == []
    assert order.last_refused == 2
    order.forget()
    assert order.arrive(1, "of another time") == ["of another time"]
