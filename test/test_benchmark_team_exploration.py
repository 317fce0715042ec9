"""Requirements on explorations by a team."""

import math

from benchmark.team_exploration import TeamExploration, requirements

ALONE = TeamExploration(1, 1, False, 700.0, math.inf, 340.0, 9, 9, 0, 0)


def unmet(seconds=400.0, entered=9, in_both=0, contacts=0, with_rendezvous=380.0):
    """The requirements that two explorers do not meet."""
    together = TeamExploration(1, 2, False, seconds, 30.0, 400.0, entered, 9, in_both, contacts)
    met = TeamExploration(1, 2, True, with_rendezvous, 30.0, 400.0, 9, 9, 0, 0)
    return [each.name.split()[0] for each in requirements([ALONE, together, met]) if not each.is_met]


def test_two_take_less_time_enter_all_rooms_once_and_hit_nothing():
    assert unmet() == []
    assert unmet(seconds=500.0) == unmet(seconds=math.inf) == ["time"]
    assert unmet(with_rendezvous=500.0) == ["the"]
    assert unmet(entered=8) == unmet(in_both=1) == ["rooms"]
    assert unmet(contacts=1) == ["contacts"]
