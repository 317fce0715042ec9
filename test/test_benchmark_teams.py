"""The figures of teams: overlap, path until the join, and wrong joins."""

import math

import numpy as np
import pytest

from benchmark import teams
from benchmark.teams import PairOutcome, requirements, team_table
from hmt_slam_ros.messages.team import TeamPlacement, Verdict


def track(*points, speed=1.0):
    """A robot that drives straight from point to point."""
    corners = np.array(points, dtype=float)
    lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    along = np.arange(0.0, lengths[-1] + 0.1, 0.2)
    positions = np.stack([np.interp(along, lengths, column) for column in corners.T], axis=1)
    return teams._Track(along / speed, positions, along)


def answer(seconds, verdict, probability, is_right):
    placement = TeamPlacement("a", "a", "b", Verdict(verdict), probability, 1.0 - probability, np.zeros(3))
    return seconds, placement, is_right


def outcome(first, second, *answers):
    return teams._outcome("hall", "hall-1", first, second, answers, teams._Cost(0.05, 2000.0, 40.0))


def test_overlap_is_the_path_on_ground_of_the_other():
    found = outcome(track((0, 0), (30, 0)), track((10, 0), (10, 40)))
    # 2 m on both sides of the crossing for the first, and 2 m for the second.
    assert found.overlap == pytest.approx(6.0, abs=0.5)
    assert not found.is_due
    assert outcome(track((0, 0), (30, 0)), track((0, 1), (30, 1))).is_due


def test_the_path_counts_from_the_first_common_ground():
    first, second = track((0, 0), (60, 0)), track((20, 5), (20, 0), (80, 0))
    found = outcome(first, second, answer(40.0, "joined", 0.995, True))
    # The second was there after 3 m; the first comes there after 18 m.
    assert found.path == pytest.approx(22.0, abs=0.5)
    assert found.is_joined and found.false_joins == 0


def test_a_wrong_join_counts_though_it_is_withdrawn():
    first, second = track((0, 0), (60, 0)), track((0, 0), (60, 0))
    found = outcome(
        first,
        second,
        answer(20.0, "joined", 0.99, False),
        answer(30.0, "open", 0.6, False),
        answer(0.0, "apart", 0.0, False),
    )
    assert (found.is_joined, found.false_joins, found.path) == (False, 1, math.inf)
    assert found.answers == ((0.99, False), (0.6, False))


def pair(**changes):
    values = {"family": "hall", "name": "hall-1", "overlap": 50.0, "is_joined": True, "false_joins": 0, "path": 8.0}
    return PairOutcome(
        **values | {"answers": ((0.995, True),), "share": 0.05, "sent": 2000.0, "keyframes": 40.0} | changes
    )


def test_requirements_and_table():
    found = [pair()] * 18 + [pair(is_joined=False, path=math.inf), pair(overlap=0.0, is_joined=False, path=math.inf)]
    bounds = {each.name: each for each in requirements(found)}
    assert bounds["joined wrongly"].is_met
    assert bounds["due and joined, share"].value == pytest.approx(18 / 19)
    assert not bounds["due and joined, share"].is_met
    assert bounds["path until the join, median"].value == 8.0
    assert bounds["sent by a robot, most"].value == 2.0
    assert "| hall | 20 | 48 m | 19 | 18 | 0 | 0 | 8.0 m | 5.0 % | 2.0 kB/m | 40 |" in team_table(found)


@pytest.mark.parametrize("verdict", ["joined", "open"])
def test_answers_of_no_placement_do_not_count(verdict):
    found = outcome(track((0, 0), (9, 0)), track((0, 0), (9, 0)), answer(1.0, verdict, 0.0, False))
    assert found.answers == ()
