"""The cost of the process team in a small lattice."""

from benchmark.lattice import Lattice
from benchmark.team_scale import cost_table, measure_cost, requirements
from hmt_slam_ros.configuration import Configuration


def test_a_lattice_has_its_cost():
    cost = measure_cost(Lattice(2, 2), Configuration(), steps=3)
    assert (cost.areas, cost.windows) == (4, 8)
    assert cost.step > 0.0 and cost.comparison > 0.0
    assert requirements([cost])[0].is_met
    assert "| 4 | 8 |" in cost_table([cost])
