"""Normalized cut on graphs whose best bipartition is known, and against all bipartitions of small random graphs."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_slam_ros.area_abstraction.overlap_graph import ncut, normalized_cut, recursive_cut


def blocks(*sizes, within=1.0, between=0.0):
    label = np.repeat(np.arange(len(sizes)), sizes)
    similarity = np.where(label[:, None] == label, within, between)
    np.fill_diagonal(similarity, 0.0)
    return similarity


def corridor(n, reach):
    """Similarity that falls linearly to nought over ``reach`` steps, as in a uniform corridor."""
    step = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    similarity = np.clip(1.0 - step / reach, 0.0, None)
    np.fill_diagonal(similarity, 0.0)
    return similarity


def random_graph(rng, n, density=0.7):
    upper = np.triu(rng.random((n, n)) * (rng.random((n, n)) < density), 1)
    return upper + upper.T


def best_by_force(similarity, min_size=1):
    n = len(similarity)
    values = []
    for chosen in itertools.product((False, True), repeat=n - 1):
        side = np.array((False, *chosen))
        if min_size <= side.sum() <= n - min_size:
            values.append(ncut(similarity, side))
    return min(values)


def test_the_value_of_two_triangles_joined_by_one_edge_is_computed_by_hand():
    similarity = blocks(3, 3)
    similarity[2, 3] = similarity[3, 2] = 0.5
    # Each triangle has three edges counted twice and the half edge: assoc 6.5, cut 0.5.
    assert ncut(similarity, np.repeat([False, True], 3)) == pytest.approx(2 * 0.5 / 6.5)


def test_the_value_does_not_depend_on_which_part_is_named_first():
    similarity = random_graph(np.random.default_rng(0), 8)
    side = np.arange(8) % 3 == 0
    assert ncut(similarity, side) == pytest.approx(ncut(similarity, ~side))


def test_equal_parts_joined_as_strongly_as_within_have_the_value_of_shi_and_malik():
    # c = W between parts that each hold W (edges counted once): 2 c / (2 W + c) = 2/3, where other definitions give 1.
    similarity = np.array([[0, 1, 0.5, 0], [1, 0, 0, 0.5], [0.5, 0, 0, 1], [0, 0.5, 1, 0]])
    assert ncut(similarity, np.array([False, False, True, True])) == pytest.approx(2.0 / 3.0)


def test_two_cliques_with_weak_ties_are_separated():
    cut = normalized_cut(blocks(6, 9, between=0.01))
    np.testing.assert_array_equal(cut.side, np.arange(15) >= 6)
    assert cut.value == pytest.approx(54 * 0.01 / (30 + 0.54) + 54 * 0.01 / (72 + 0.54))


def test_a_uniform_corridor_is_cut_in_the_middle():
    cut = normalized_cut(corridor(20, 5))
    np.testing.assert_array_equal(cut.side, np.arange(20) >= 10)


def test_the_cut_follows_a_permutation_of_the_nodes():
    similarity = blocks(5, 7, between=0.05)
    order = np.random.default_rng(1).permutation(12)
    side = normalized_cut(similarity[np.ix_(order, order)]).side
    expected = order >= 5
    np.testing.assert_array_equal(side, expected ^ expected[0])


@pytest.mark.parametrize("min_size", [1, 2, 4])
def test_small_random_graphs_are_cut_as_well_as_by_trying_everything(min_size):
    rng = np.random.default_rng(7)
    excess = []
    for _ in range(30):
        similarity = random_graph(rng, 9)
        excess.append(normalized_cut(similarity, min_size).value - best_by_force(similarity, min_size))
    # The relaxation is no guarantee: it finds the optimum mostly and comes close otherwise.
    assert np.min(excess) > -1e-9
    assert np.median(excess) < 1e-9
    assert np.max(excess) < 0.1


def test_parts_are_at_least_as_large_as_requested():
    similarity = blocks(2, 10, between=0.001)
    assert normalized_cut(similarity).side.sum() == 10
    larger = normalized_cut(similarity, min_size=4)
    assert 4 <= larger.side.sum() <= 8


def test_a_graph_too_small_for_two_parts_is_not_cut():
    assert normalized_cut(blocks(9), min_size=5) is None
    assert normalized_cut(np.zeros((1, 1))) is None


def test_a_node_counts_as_many_as_it_stands_for():
    similarity = np.array([[20.0, 0.1, 0.0], [0.1, 0.0, 1.0], [0.0, 1.0, 0.0]])
    assert normalized_cut(similarity, min_size=2) is None
    np.testing.assert_array_equal(
        normalized_cut(similarity, min_size=2, sizes=np.array([6, 1, 1])).side, [False, True, True]
    )


def test_contracting_nodes_keeps_the_value_of_a_cut_that_does_not_split_them():
    similarity = random_graph(np.random.default_rng(5), 10)
    membership = np.eye(5)[[0, 0, 0, 0, 0, 0, 1, 2, 3, 4]]
    contracted = membership.T @ similarity @ membership
    assert ncut(contracted, np.array([False, False, True, False, True])) == pytest.approx(
        ncut(similarity, np.array([False] * 7 + [True, False, True]))
    )


def test_separate_components_are_separated_at_no_cost():
    cut = normalized_cut(blocks(4, 6, 5), min_size=3)
    assert cut.value == 0.0
    assert {tuple(cut.side[:4]), tuple(cut.side[4:10]), tuple(cut.side[10:])} <= {
        (value,) * size for value in (False, True) for size in (4, 5, 6)
    }


def test_nodes_without_any_similarity_do_not_hide_the_cut_between_two_rooms():
    similarity = np.zeros((14, 14))
    rooms = np.r_[0:6, 7:13]  # nodes 6 and 13 saw nothing
    similarity[np.ix_(rooms, rooms)] = blocks(6, 6, between=0.02)
    cut = normalized_cut(similarity, min_size=4)
    np.testing.assert_array_equal(cut.side[rooms], np.arange(12) >= 6)


def test_a_graph_without_any_similarity_is_cut_in_the_order_of_time():
    cut = normalized_cut(np.zeros((6, 6)), min_size=3)
    np.testing.assert_array_equal(cut.side, np.arange(6) >= 3)
    assert cut.value == 0.0


@given(st.integers(0, 10_000), st.integers(2, 12))
def test_the_value_lies_between_nought_and_two_and_the_first_node_stays(seed, n):
    cut = normalized_cut(random_graph(np.random.default_rng(seed), n, density=0.3))
    assert 0.0 <= cut.value <= 2.0 + 1e-12
    assert not cut.side[0]
    assert cut.side.any()


def test_the_same_graph_is_cut_the_same_way_every_time():
    similarity = random_graph(np.random.default_rng(3), 60)
    first, second = normalized_cut(similarity), normalized_cut(similarity.copy())
    np.testing.assert_array_equal(first.side, second.side)
    assert first.value == second.value


def test_three_rooms_become_three_parts_in_the_order_of_their_first_nodes():
    labels = recursive_cut(blocks(6, 5, 7, between=0.01), threshold=0.35, min_size=3)
    np.testing.assert_array_equal(labels, np.repeat([0, 1, 2], [6, 5, 7]))


def test_one_room_stays_whole():
    np.testing.assert_array_equal(recursive_cut(blocks(12), threshold=0.35, min_size=3), np.zeros(12))


def test_a_lower_threshold_makes_fewer_parts():
    counts = [recursive_cut(corridor(40, 8), threshold, 3).max() + 1 for threshold in (0.05, 0.2, 0.5, 1.0)]
    assert counts == sorted(counts)
    assert counts[0] == 1
    assert counts[-1] > 3
