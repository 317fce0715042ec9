"""The cost of the process team in small lattices."""

from benchmark.lattice import Lattice
from benchmark.team_load import TeamLoad, TeamMemory, load_table, measure_load, weigh_ground
from benchmark.team_load import requirements as load_requirements
from benchmark.team_scale import cost_table, measure_cost, requirements
from hmt_slam_ros.configuration import Configuration


def test_a_lattice_has_its_cost():
    cost = measure_cost(Lattice(2, 2), Configuration(), steps=3)
    assert (cost.areas, cost.windows) == (4, 8)
    assert cost.step > 0.0 and cost.comparison > 0.0
    assert requirements([cost])[0].is_met
    assert "| 4 | 8 |" in cost_table([cost])


def test_robots_that_drive_on_have_their_load():
    load = measure_load(Lattice(2, 2), Configuration(), 3)
    assert load.areas == 16
    assert 0.0 < load.share <= load.longest


def test_foreign_ground_takes_no_more_memory_than_own_ground():
    memory = weigh_ground(Configuration(), Lattice(3, 3))
    assert 10.0 < memory.foreign < 1.1 * memory.own < 40.0


def test_a_load_above_a_fifth_of_a_core_and_more_memory_than_for_own_ground_fail():
    memory, loads = TeamMemory(10.0, 12.0), [TeamLoad(100, 0.1, 0.5), TeamLoad(1000, 0.21, 1.0)]
    assert [each.is_met for each in load_requirements(loads, memory)] == [False, False]
    assert not load_requirements(loads[::-1], memory)[0].is_met
    assert [each.is_met for each in load_requirements(loads[:1], TeamMemory(10.0, 10.0))] == [True, True]
    assert "| 1000 | 21.0 % | 1.00 s |" in load_table(loads, memory)
