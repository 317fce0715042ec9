"""The common map of hypotheses: queries, and its arcs as arrays."""

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, fuse
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, CommonMap, GraphState, HybridMap


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


def test_the_neighbors_of_an_area_are_those_that_arcs_join_to_it(star):
    assert sorted(star.neighbors(40)) == list(range(40))
    assert sorted(star.neighbors(3)) == [4, 40]
    assert star.neighbors(0) == [40]
    assert star.neighbors(41) == []


def test_the_arrays_hold_what_the_arcs_hold_also_after_one_was_replaced(star):
    star.set_arc((7, 40), arc(99.0))
    table = star.table
    for (a, b), value in star.arcs.items():
        sides = [
            side
            for side in range(2 * len(star.arcs))
            if {table.opposite_area[side], table.opposite_area[side ^ 1]} == {a, b}
        ]
        (lower, upper) = sides
        assert (table.opposite_area[lower], table.opposite_area[upper]) == (b, a)
        assert np.array_equal(table.means[lower // 2], value.pose.mean)
        assert np.array_equal(table.covariances[lower // 2], value.pose.covariance)


def test_the_largest_area_and_the_extents_are_known():
    hybrid_map = HybridMap()
    assert hybrid_map.max_area_id == -1
    hybrid_map.set_keyframe(0, 5, np.array([3.0, 4.0, 0.0]))
    hybrid_map.commit()
    hybrid_map.set_keyframe(1, 30, np.array([0.0, -2.0, 0.0]))
    hybrid_map.set_keyframe(2, 30, np.array([1.0, 0.0, 0.0]))
    assert hybrid_map.max_area_id == 30
    assert hybrid_map.extents(np.array([30, 5, 1000])).tolist() == [2.0, 5.0, 0.0]
    hybrid_map.set_keyframe(3, 5, np.array([0.0, 6.0, 0.0]))
    assert hybrid_map.extents(np.array([5])).tolist() == [6.0]
    assert HybridMap(hybrid_map.common).extents(np.array([5])).tolist() == [5.0]


def test_a_hypothesis_knows_its_own_areas_and_the_common_ones():
    hybrid_map = HybridMap()
    hybrid_map.set_keyframe(0, 2, np.zeros(3))
    hybrid_map.commit()
    child = hybrid_map.branch()
    child.set_keyframe(1, 3, np.zeros(3))
    assert [child.has_area(area) for area in (1, 2, 3)] == [False, True, True]
    assert not hybrid_map.has_area(3)


def test_a_removed_arc_leaves_the_others_unchanged(star):
    for area in (39, 0, 17):
        star.remove_arc((area, 40))
    star.remove_arc((0, 40))
    assert sorted(star.neighbors(40)) == [area for area in range(40) if area not in (0, 17, 39)]
    assert star.neighbors(0) == []
    assert sorted(star.neighbors(3)) == [4, 40]
    star.set_arc((17, 40), arc(5.0))
    star.set_arc((0, 1), arc(6.0))
    assert star.neighbors(17) == [40]
    assert sorted(star.neighbors(1)) == [0, 40]


def test_a_hypothesis_may_lack_a_common_arc_until_all_do(star):
    whole = HybridMap(star)
    hybrid_map = whole.branch()
    hybrid_map.remove_arc(40, 7)
    assert hybrid_map.arc(7, 40) is None
    assert 7 not in hybrid_map.neighbors(40)
    assert (7, 40) not in [(a, b) for a, b, _ in hybrid_map.all_arcs()]
    assert 7 in whole.neighbors(40)
    hybrid_map.commit()
    assert 7 not in whole.neighbors(40)
    hybrid_map.set_arc(40, 7, arc(2.0).pose, closure=True)
    assert 7 in hybrid_map.neighbors(40)


SPREAD = np.diag([0.1, 0.2, 0.05]) ** 2
ZERO_T_TWO = np.array([3.0, 1.0, 0.5])


def joined_twice():
    """Area 1 was left for area 2, which a closure joins to area 0; area 2 was left for area 3."""
    hybrid_map = HybridMap()
    for area in range(4):
        hybrid_map.set_keyframe(10 * area, area, np.zeros(3))
        hybrid_map.set_keyframe(10 * area + 1, area, np.array([1.0, 0.0, 0.2]))
    hybrid_map.set_arc(0, 1, PoseGaussian(np.array([0.0, 5.0, 0.0]), SPREAD), closure=False)
    hybrid_map.set_arc(1, 2, PoseGaussian(np.array([4.0, -4.0, 0.5]), SPREAD), closure=False)
    hybrid_map.set_arc(2, 3, PoseGaussian(np.array([0.0, 2.0, 0.1]), SPREAD), closure=False)
    hybrid_map.set_arc(0, 2, PoseGaussian(ZERO_T_TWO, 0.1 * SPREAD), closure=True)
    hybrid_map.commit()
    return hybrid_map


def test_an_area_that_becomes_part_of_another_is_seen_from_there():
    before, merged = joined_twice(), joined_twice()
    merged.remove_arc(0, 1)
    merged.merge(2, 0, merged.arc(0, 2))
    assert merged.area_ids() == [0, 1, 3]
    assert not merged.has_area(2)
    assert merged.neighbors(2) == []
    assert list(merged.keyframes(0)) == [0, 1, 20, 21]
    np.testing.assert_allclose(merged.keyframes(0)[21], se2.compose(ZERO_T_TWO, [1.0, 0.0, 0.2]), atol=1e-12)
    zero_T_two = before.arc(0, 2)
    for other in (1, 3):
        expected = zero_T_two.compose(before.arc(2, other))
        np.testing.assert_allclose(merged.arc(0, other).mean, expected.mean, atol=1e-12)
        np.testing.assert_allclose(merged.arc(0, other).covariance, expected.covariance, atol=1e-12)
    # The loop is as closed as it was, and what closed it is where the area was entered from.
    assert [(a, b, arc.closure) for a, b, arc in merged.all_arcs()] == [(0, 1, True), (0, 3, False)]
    assert merged.extents(np.array([0, 2])) == pytest.approx([np.hypot(3.0 + np.cos(0.5), 1.0 + np.sin(0.5)), 0.0])
    assert merged.max_area_id == 3


def test_two_arcs_to_the_same_third_area_are_fused():
    before, merged = joined_twice(), joined_twice()
    merged.merge(2, 0, merged.arc(0, 2))
    found = [before.arc(0, 1), before.arc(0, 2).compose(before.arc(2, 1))]
    both = fuse([PoseGaussian(belief.mean, 2.0 * belief.covariance) for belief in found])
    arc = merged.arc(0, 1)
    assert not merged.arc_value(0, 1).closure
    np.testing.assert_allclose(arc.mean[:2], both.mean[:2], atol=0.2)
    # They disagree by more than they admit: no more certain than if they did not, and not less than either by much.
    assert np.trace(both.covariance) - 1e-12 <= np.trace(arc.covariance)


def test_the_number_of_an_area_that_is_no_more_is_not_used_again():
    hybrid_map = joined_twice()
    hybrid_map.set_arc(3, 0, PoseGaussian(np.zeros(3), SPREAD), closure=True)
    hybrid_map.merge(3, 0, hybrid_map.arc(0, 3))
    assert hybrid_map.area_ids() == [0, 1, 2]
    assert hybrid_map.max_area_id == 3


def test_a_removed_arc_is_a_row_of_zeros_that_says_so():
    pose, covariance = np.array([1.0, 2.0, 0.3]), np.diag([0.1, 0.2, 0.3])
    arcs = {(1, 4): ArcValue(PoseGaussian(pose, covariance), closure=True), (2, 3): None}
    state = GraphState.from_areas_and_arcs({}, arcs)
    assert (state.closures.tolist(), state.removed.tolist()) == ([True, False], [False, True])
    np.testing.assert_array_equal(state.means, [pose, np.zeros(3)])
    np.testing.assert_array_equal(state.covariances, [covariance, np.zeros((3, 3))])
    assert state.arcs.tolist() == [[1, 4], [2, 3]]
