"""The map that hypotheses share: what is asked of it, and its arcs as arrays."""

import numpy as np
import pytest

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.common_map import ArcValue, CommonMap
from hmt_slam_ros.topology.hybrid_map import HybridMap


def arc(x):
    return ArcValue(PoseGaussian(np.array([x, 0.0, 0.1]), x * np.eye(3)), closure=False)


@pytest.fixture
def star():
    """Area 40 with an arc to each of the 40 areas below it, and area 3 with one to area 4 as well."""
    common = CommonMap()
    for area in range(40):
        common.set_arc((area, 40), arc(1.0 + area))
    common.set_arc((3, 4), arc(0.5))
    return common


def test_the_neighbours_of_an_area_are_those_that_arcs_join_to_it(star):
    assert sorted(star.neighbours(40)) == list(range(40))
    assert sorted(star.neighbours(3)) == [4, 40]
    assert star.neighbours(0) == [40]
    assert star.neighbours(41) == []


def test_the_arrays_hold_what_the_arcs_hold_also_after_one_was_replaced(star):
    star.set_arc((7, 40), arc(99.0))
    table = star.table
    for (a, b), value in star.arcs.items():
        sides = [side for side in range(2 * len(star.arcs)) if {table.beyond[side], table.beyond[side ^ 1]} == {a, b}]
        (lower, upper) = sides
        assert (table.beyond[lower], table.beyond[upper]) == (b, a)
        assert np.array_equal(table.means[lower // 2], value.pose.mean)
        assert np.array_equal(table.covariances[lower // 2], value.pose.covariance)


def test_the_largest_area_and_the_extents_are_known():
    hybrid_map = HybridMap()
    assert hybrid_map.largest_area == -1
    hybrid_map.place(0, 5, np.array([3.0, 4.0, 0.0]))
    hybrid_map.absorb()
    hybrid_map.place(1, 30, np.array([0.0, -2.0, 0.0]))
    hybrid_map.place(2, 30, np.array([1.0, 0.0, 0.0]))
    assert hybrid_map.largest_area == 30
    assert hybrid_map.extents(np.array([30, 5, 1000])).tolist() == [2.0, 5.0, 0.0]
    hybrid_map.place(3, 5, np.array([0.0, 6.0, 0.0]))
    assert hybrid_map.extents(np.array([5])).tolist() == [6.0]
    assert HybridMap(hybrid_map.common).extents(np.array([5])).tolist() == [5.0]


def test_a_hypothesis_knows_its_own_areas_and_the_common_ones():
    hybrid_map = HybridMap()
    hybrid_map.place(0, 2, np.zeros(3))
    hybrid_map.absorb()
    child = hybrid_map.branch()
    child.place(1, 3, np.zeros(3))
    assert [child.has_area(area) for area in (1, 2, 3)] == [False, True, True]
    assert not hybrid_map.has_area(3)


def test_an_arc_that_is_taken_out_leaves_the_others_as_they_are(star):
    for area in (39, 0, 17):
        star.remove_arc((area, 40))
    star.remove_arc((0, 40))
    assert sorted(star.neighbours(40)) == [area for area in range(40) if area not in (0, 17, 39)]
    assert star.neighbours(0) == []
    assert sorted(star.neighbours(3)) == [4, 40]
    star.set_arc((17, 40), arc(5.0))
    star.set_arc((0, 1), arc(6.0))
    assert star.neighbours(17) == [40]
    assert sorted(star.neighbours(1)) == [0, 40]


def test_a_hypothesis_may_lack_a_common_arc_until_all_do(star):
    whole = HybridMap(star)
    hybrid_map = whole.branch()
    hybrid_map.remove_arc(40, 7)
    assert hybrid_map.arc(7, 40) is None
    assert 7 not in hybrid_map.neighbours(40)
    assert (7, 40) not in [(a, b) for a, b, _ in hybrid_map.all_arcs()]
    assert 7 in whole.neighbours(40)
    hybrid_map.absorb()
    assert 7 not in whole.neighbours(40)
    hybrid_map.set_arc(40, 7, arc(2.0).pose, closure=True)
    assert 7 in hybrid_map.neighbours(40)
