"""Where areas end against true doors: what is true of buildings, and the figures of made-up records."""

import math

import numpy as np
import pytest

from benchmark.policies import requirements, share_within
from benchmark.simulated.truth import crossings_of, doors_of
from benchmark.simulated.watch import observe_world
from benchmark.simulated.worlds import INSTITUTE, World
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation import open_simulated

OFFICE = World("office", 2)


@pytest.mark.parametrize("world", [OFFICE, World(INSTITUTE, 3)])
def test_a_robot_that_enters_rooms_passes_their_doors_in_their_middle(world):
    scenario = open_simulated(world.log).scenario
    doors = doors_of(scenario.building)
    path = scenario.poses[:, :2]
    passed = doors.select_passed(path)
    rooms = scenario.building.rooms
    inside = [
        bool((np.abs(se2.transform(se2.inverse(room[:3]), path)) <= 0.5 * room[3:] - 0.5).all(axis=1).any())
        for room in rooms
    ]
    assert len(passed.poses) == sum(inside) > 0
    nearest = np.hypot(*(passed.middles[:, None] - path[None]).transpose(2, 0, 1)).min(axis=1)
    assert nearest.max() < 0.2


def test_an_institute_has_crossings_as_wide_as_their_hallways():
    scenario = open_simulated(World(INSTITUTE, 3).log).scenario
    crossings = crossings_of(scenario.building)
    assert len(crossings.select_passed(scenario.poses[:, :2]).poses) == len(crossings.poses) == 4
    middle, half = crossings.middles[:1], crossings.halves[0]
    assert 0.8 < half < 1.3
    np.testing.assert_allclose(crossings.distances(middle + np.array([0.3, 0.0]))[0], 0.0)
    np.testing.assert_allclose(crossings.distances(middle + np.array([0.0, 3.0]))[0], 3.0 - half)


def record(doors, portals, wrong=0, error=0.1):
    return {
        "doors": {"doors": doors, "portals": portals},
        "accepted": [{"right": k >= wrong} for k in range(3)],
        "loops": [{"can_be_closed": True, "in_time": True}],
        "poses": [{"map": {"translation": error}}],
    }


def test_what_is_near_counts_and_what_is_nowhere_does_not():
    own = [record([0.2, None], [0.1, 0.6]), record([1.5], [])]
    assert share_within(own, "doors", 1.0) == pytest.approx(1 / 3)
    assert share_within(own, "portals", 0.5) == pytest.approx(0.5)
    assert math.isnan(share_within([record([], [])], "doors", 1.0))


def test_a_policy_is_scored_by_doors_closures_and_the_error_by_ncut():
    good, bad = record([0.2], [0.1], error=0.105), record([2.0], [1.0], wrong=1, error=0.2)
    met = {"both": [good], "other": [bad], "ncut": [record([None], [])]}
    assert [one.is_met for one in requirements("both", met)] == [True] * 5
    assert [one.is_met for one in requirements("other", met)] == [False, False, False, True, False]


@pytest.mark.parametrize(("policy", "found"), [("ncut", False), ("both", True)])
def test_areas_end_at_the_doors_that_a_robot_passes_where_they_have_to(policy, found):
    doors = observe_world(OFFICE, (f"aam.area_policy={policy}",))["doors"]
    assert len(doors["doors"]) == 1
    assert [distance <= 1.0 for distance in doors["doors"]] == [found]
    assert [distance <= 0.5 for distance in doors["doors_portals"]] == [found]
