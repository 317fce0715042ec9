"""Maps that are searched in themselves."""

import math
from dataclasses import replace

import pytest
from laps import CONFIGURATION, map_lap
from test_team_join import rooms

from hmt_slam_ros.messages.team import Repetition
from hmt_slam_ros.team.components import Shift, combine
from hmt_slam_ros.team.repetition import RepetitionTest, add_repetition

OFFICE, RING = "sim:office,size=0.7,seed=51", "sim:ring,seed=50"


def repetition(component):
    return add_repetition(component, CONFIGURATION).repetition


def log_repetition(component):
    return repetition(component).log_ratio


def test_an_office_does_not_repeat_itself():
    # Most of its windows are searched in few areas: the others are too near. A twin may lie beyond the map.
    assert math.log(0.5) < log_repetition(map_lap(OFFICE, 0)) < -0.1


def test_a_ring_with_equal_sides_repeats_itself():
    found = repetition(map_lap(RING, 0))
    assert found.log_ratio > 5.0
    # Nowhere it was seen to end.
    assert found.persistence == 1.0


def test_where_what_is_alike_ends_it_is_less_persistent():
    """Three rooms, of which the third has another shape: the shift by one room ends there."""
    assert repetition(rooms((0.0, 30.0, 60.0), 0)).persistence == 1.0
    assert 0.5 < repetition(rooms((0.0, 30.0, 60.0), 0, cupboards=(5.0, 5.0, 1.0))).persistence < 0.95


def test_of_two_equal_rooms_one_is_the_twin_of_the_other():
    assert log_repetition(rooms((0.0, 30.0), 0)) > 0.3


def test_a_map_of_one_place_is_no_evidence():
    assert log_repetition(rooms((0.0,), 0)) == 0.0


def test_a_place_beside_itself_is_no_twin():
    """Areas so near that a window overlaps its copy are not searched."""
    assert log_repetition(rooms((0.0, 1.0), 0)) == 0.0


def test_a_map_that_grows_ends_as_if_it_had_been_tested_whole():
    test, component = RepetitionTest(CONFIGURATION), rooms((0.0, 30.0, 60.0), 0)
    for part in (rooms((0.0,), 0), rooms((0.0, 30.0), 0), component):
        test.update(part, Shift(1000, 10_000))
        while not test.is_done:
            test.step()
    assert test.repetition == pytest.approx(repetition(component), abs=0.011)


def test_a_pair_has_the_evidence_of_both_maps():
    own = Repetition(1.5, 0.8), Repetition(-0.5, 1.0)
    one, other = (replace(rooms((0.0,), 5 * n), repetition=own[n]) for n in range(2))
    assert combine(one, other).repetitions == own
