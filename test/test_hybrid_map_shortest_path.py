"""Areas seen from one area, along the least uncertain path."""

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import (
    connected_areas,
    map_pieces,
    shortest_path_beliefs,
    uninformative_belief,
)


def arc(x, y, theta, sigma_xy=0.1, sigma_theta=0.0):
    return PoseGaussian(np.array([x, y, theta]), np.diag([sigma_xy**2, sigma_xy**2, sigma_theta**2 + 1e-12]))


def chain(*beliefs):
    hybrid_map = HybridMap()
    for a, belief in enumerate(beliefs):
        hybrid_map.set_arc(a, a + 1, belief, closure=False)
    return hybrid_map


def test_the_start_comes_first_at_the_origin_with_no_uncertainty():
    found = shortest_path_beliefs(chain(arc(1.0, 0.0, 0.0)), 1)
    assert next(iter(found)) == 1
    np.testing.assert_array_equal(found[1].mean, np.zeros(3))
    np.testing.assert_array_equal(found[1].covariance, np.zeros((3, 3)))


def test_an_area_that_the_map_does_not_hold_reaches_only_itself():
    assert list(shortest_path_beliefs(HybridMap(), 7)) == [7]


def test_poses_are_composed_along_a_chain():
    quarter = np.pi / 2.0
    found = shortest_path_beliefs(chain(arc(2.0, 0.0, quarter), arc(3.0, 0.0, quarter), arc(2.0, 0.0, 0.0)), 0)
    np.testing.assert_allclose(found[2].mean, [2.0, 3.0, -np.pi], atol=1e-12)
    np.testing.assert_allclose(found[3].mean, [0.0, 3.0, -np.pi], atol=1e-12)


def test_an_arc_is_followed_against_its_direction():
    found = shortest_path_beliefs(chain(arc(2.0, 0.0, np.pi / 2.0)), 1)
    np.testing.assert_allclose(found[0].mean, [0.0, 2.0, -np.pi / 2.0], atol=1e-12)


def test_variances_of_pure_translations_add():
    found = shortest_path_beliefs(chain(arc(2.0, 0.0, 0.0, 0.3), arc(0.0, 1.0, 0.0, 0.4)), 0)
    np.testing.assert_allclose(found[2].covariance[:2, :2], np.eye(2) * 0.25, atol=1e-10)


def test_heading_error_moves_a_distant_area_by_its_lever_arm():
    found = shortest_path_beliefs(chain(arc(0.0, 0.0, 0.0, 0.0, 0.02), arc(10.0, 0.0, 0.0, 0.0)), 0)
    # 10 m ahead, a heading deviation of 0.02 rad is 0.2 m sideways.
    np.testing.assert_allclose(found[2].covariance[1, 1], 0.2**2, rtol=1e-6)


def test_the_less_uncertain_of_two_paths_is_taken_though_it_has_more_arcs():
    hybrid_map = chain(arc(1.0, 0.0, 0.0, 0.1), arc(1.0, 0.0, 0.0, 0.1), arc(1.0, 0.0, 0.0, 0.1))
    hybrid_map.set_arc(0, 3, arc(9.0, 0.0, 0.0, 0.2), closure=True)
    assert shortest_path_beliefs(hybrid_map, 0)[3].mean[0] == pytest.approx(3.0)
    hybrid_map.set_arc(0, 3, arc(9.0, 0.0, 0.0, 0.15), closure=True)
    assert shortest_path_beliefs(hybrid_map, 0)[3].mean[0] == pytest.approx(9.0)


def test_areas_come_in_order_of_their_uncertainty():
    hybrid_map = HybridMap()
    for area, sigma in ((1, 0.5), (2, 0.1), (3, 0.3)):
        hybrid_map.set_arc(0, area, arc(1.0, 0.0, 0.0, sigma), closure=False)
    assert list(shortest_path_beliefs(hybrid_map, 0)) == [0, 2, 3, 1]


def test_areas_beyond_the_cost_limit_are_left_out():
    hybrid_map = chain(*[arc(1.0, 0.0, 0.0, 0.1)] * 5)
    assert list(shortest_path_beliefs(hybrid_map, 0, cost_limit=3 * 2 * 0.1**2 + 1e-6)) == [0, 1, 2, 3]


def test_at_most_max_areas_are_returned():
    found = shortest_path_beliefs(chain(*[arc(1.0, 0.0, 0.0, sigma) for sigma in (0.1, 0.2, 0.3, 0.4)]), 2, max_areas=3)
    assert list(found) == [2, 1, 0]


def test_costs_never_fall_where_the_path_turns_back_to_its_start():
    # A heading error is a large lever arm out there and none back at the start.
    hybrid_map = chain(arc(0.0, 0.0, 0.0, 0.0, 0.05), arc(10.0, 0.0, 0.0, 0.0), arc(-10.0, 0.0, 0.0, 0.0))
    assert list(shortest_path_beliefs(hybrid_map, 0, cost_limit=0.1)) == [0, 1]


def test_the_tree_costs_what_the_best_of_all_paths_costs_in_a_random_graph():
    rng = np.random.default_rng(4)
    hybrid_map, edges = HybridMap(), {}
    for a in range(7):
        for b in range(a + 1, 7):
            if rng.random() < 0.6:
                edges[a, b] = rng.uniform(0.05, 1.0)
                hybrid_map.set_arc(a, b, arc(*rng.normal(size=2), 0.0, edges[a, b]), closure=False)
    best = {0: 0.0}
    for _ in range(7):  # Bellman-Ford over the variances
        for (a, b), sigma in edges.items():
            for u, v in ((a, b), (b, a)):
                best[v] = min(best.get(v, np.inf), best.get(u, np.inf) + sigma**2)
    found = shortest_path_beliefs(hybrid_map, 0)
    assert set(found) == set(best)
    for area, variance in best.items():
        assert found[area].covariance[0, 0] == pytest.approx(variance, rel=1e-4)


def test_the_search_ends_when_all_targets_are_found():
    hybrid_map = chain(*[arc(1.0, 0.0, 0.0)] * 6)
    assert set(shortest_path_beliefs(hybrid_map, 1, targets=(0, 3))) == {0, 1, 2, 3}
    assert set(shortest_path_beliefs(hybrid_map, 1, targets=(77,))) == set(range(7))


def test_own_arcs_replace_common_ones_and_beliefs_are_those_of_composition():
    rng = np.random.default_rng(1)
    hybrid_map = HybridMap()
    pairs = [(a, a + step) for a in range(40) for step in (1, 7) if a + step < 40]
    for n, (a, b) in enumerate(pairs):
        loose = 2.0 if n % 5 == 0 else 0.2
        hybrid_map.set_arc(a, b, arc(*rng.normal(size=3), rng.uniform(0.1, loose), 0.05), closure=False)
        if n == len(pairs) // 2:
            hybrid_map.commit()
    for a, b in pairs[: len(pairs) // 4]:
        hybrid_map.set_arc(a, b, arc(*rng.normal(size=3), rng.uniform(0.1, 0.3), 0.05), closure=False)
    found = shortest_path_beliefs(hybrid_map, 20)
    assert len(found) == 40
    for area, belief in list(found.items())[1:]:
        # Every belief is that of a neighbor found before, composed with an arc.
        before = [b for b in hybrid_map.neighbors(area) if list(found).index(b) < list(found).index(area)]
        ways = [found[b].compose(hybrid_map.arc(b, area)) for b in before]
        assert any(
            np.allclose(way.mean, belief.mean) and np.allclose(way.covariance, belief.covariance) for way in ways
        )


def test_a_hypothesis_sees_its_own_arcs_and_the_common_ones():
    hybrid_map = chain(arc(1.0, 0.0, 0.0))
    hybrid_map.commit()
    child = hybrid_map.branch()
    child.set_arc(1, 2, arc(1.0, 0.0, 0.0), closure=True)
    assert list(shortest_path_beliefs(child, 0)) == [0, 1, 2]
    assert list(shortest_path_beliefs(hybrid_map, 0)) == [0, 1]
    np.testing.assert_allclose(shortest_path_beliefs(child, 2)[0].mean, se2.inverse([2.0, 0.0, 0.0]), atol=1e-12)


def test_an_arc_that_a_hypothesis_lacks_is_not_followed():
    hybrid_map = chain(*[arc(1.0, 0.1 * a, 0.3, 0.1 + 0.01 * a) for a in range(6)])
    hybrid_map.set_arc(0, 4, arc(2.0, 1.0, 0.2, 0.01), closure=True)
    hybrid_map.set_arc(4, 6, arc(1.0, -1.0, 0.4, 0.01), closure=True)
    alone = HybridMap()
    for a, b, value in hybrid_map.all_arcs():
        if (a, b) not in ((0, 4), (2, 3)):
            alone.set_arc(a, b, value.pose, closure=value.closure)
    hybrid_map.commit()
    hypothesis = hybrid_map.branch()
    hypothesis.remove_arc(0, 4)
    hypothesis.remove_arc(3, 2)
    for start in range(7):
        found, wanted = shortest_path_beliefs(hypothesis, start), shortest_path_beliefs(alone, start)
        assert list(found) == list(wanted)
        for area, belief in wanted.items():
            np.testing.assert_array_equal(found[area].covariance, belief.covariance)
    hypothesis.commit()
    assert list(shortest_path_beliefs(hypothesis, 0)) == [0, 1, 2]


@pytest.mark.parametrize(("deviations", "last"), [((20.0, 90.0), 2), ((150.0, 149.0), 2), ((150.0, 151.0), 1)])
def test_areas_are_connected_up_to_a_variance_of_300_m_squared(deviations, last):
    hybrid_map = chain(*(arc(4.0, 1.0, 0.2, each) for each in deviations))
    for area in range(3):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    assert list(connected_areas(hybrid_map, 0)) == list(range(last + 1))


def test_pieces_are_what_informative_arcs_hold_together_however_uncertain():
    hybrid_map = chain(*(arc(4.0, 1.0, 0.2, 200.0) for _ in range(3)))
    for area in range(5):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    hybrid_map.set_arc(3, 4, uninformative_belief(np.zeros(3)), closure=False)
    assert map_pieces(hybrid_map) == [[0, 1, 2, 3], [4]]
    hybrid_map.set_arc(1, 2, uninformative_belief(np.zeros(3)), closure=False)
    assert map_pieces(hybrid_map) == [[0, 1], [2, 3], [4]]
    hybrid_map.set_arc(0, 4, arc(1.0, 0.0, 0.0, 1.0), closure=True)
    assert map_pieces(hybrid_map) == [[0, 1, 4], [2, 3]]
