"""The overlap graph of an area: what is measured once, and which keyframes separate."""

import numpy as np
import pytest

from hmt_slam_ros.area_abstraction.overlap_graph import OverlapGraph, find_separation, synchronize_graph


def graph_of(similarity, first=0):
    np.fill_diagonal(similarity, 0.0)
    return OverlapGraph(tuple(range(first, first + len(similarity))), similarity)


def rooms(*sizes, between=0.02):
    label = np.repeat(np.arange(len(sizes)), sizes)
    return graph_of(np.where(label[:, None] == label, 0.8, between))


class Meter:
    """Measures |i - j| / 100 and remembers its calls."""

    def __init__(self):
        self.asked = []

    def __call__(self, keyframe, others):
        self.asked += [(keyframe, other) for other in others]
        return np.array([abs(keyframe - other) / 100.0 for other in others])


def assert_measured(graph):
    expected = np.abs(np.subtract.outer(graph.keyframes, graph.keyframes)) / 100.0
    np.testing.assert_allclose(graph.similarity, expected)


def test_a_keyframe_is_inserted_in_order_of_time_with_its_overlaps():
    known = OverlapGraph((1, 5), np.array([[0.0, 0.3], [0.3, 0.0]]))
    graph = synchronize_graph(known, (1, 3, 5), lambda *_: np.array([0.6, 0.7]))
    assert graph.keyframes == (1, 3, 5)
    np.testing.assert_array_equal(graph.similarity, [[0.0, 0.6, 0.3], [0.6, 0.0, 0.7], [0.3, 0.7, 0.0]])


def test_the_rest_of_a_graph_keeps_its_overlaps():
    graph = synchronize_graph(OverlapGraph(), range(6), Meter()).subgraph({1, 4, 5, 9})
    assert graph.keyframes == (1, 4, 5)
    assert_measured(graph)


def test_every_overlap_is_measured_once():
    meter = Meter()
    graph = OverlapGraph()
    for count in range(1, 7):
        graph = synchronize_graph(graph, range(count), meter)
    assert len(meter.asked) == len({frozenset(pair) for pair in meter.asked}) == 15
    assert_measured(graph)


def test_keyframes_that_come_over_bring_their_overlaps_along():
    left = synchronize_graph(OverlapGraph(), range(10, 16), Meter())
    entered = synchronize_graph(OverlapGraph(), range(3), Meter())
    meter = Meter()
    both = synchronize_graph(entered, [0, 1, 2, 13, 14, 15], meter, left)
    assert sorted(meter.asked) == [(k, other) for k in (13, 14, 15) for other in (0, 1, 2)]
    assert_measured(both)


def test_the_newest_room_separates():
    found = find_separation(rooms(6, 7), range(13), 12, 0.35, 5)
    assert found.keyframes == tuple(range(6, 13))
    # cut = 42 x 0.02; assoc = 30 x 0.8 + cut and 42 x 0.8 + cut
    assert found.ncut == pytest.approx(0.84 / 24.84 + 0.84 / 34.44)


def test_nothing_separates_above_the_threshold_or_below_the_smallest_size():
    assert find_separation(rooms(6, 7), range(13), 12, 0.05, 5) is None
    assert find_separation(rooms(6, 4), range(10), 9, 0.35, 5) is None
    assert find_separation(rooms(9), range(9), 8, 0.35, 3) is None


def test_of_three_rooms_only_the_newest_separates_and_the_middle_one_stays():
    assert find_separation(rooms(6, 5, 7), range(18), 17, 0.35, 5).keyframes == tuple(range(11, 18))


def test_known_ground_is_never_split():
    graph = rooms(6, 6, 6)
    # Two known rooms in one area: only the robot's own keyframes, the third room, may leave.
    assert find_separation(graph, range(12, 18), 17, 0.35, 5).keyframes == tuple(range(12, 18))
    # Its own keyframes lie in the second room together with known ones: nothing separates from known ground.
    assert find_separation(rooms(6, 9), range(12, 15), 14, 0.35, 3) is None


def test_known_ground_counts_as_many_keyframes_as_it_holds():
    graph = rooms(6, 6)
    assert find_separation(graph, range(6, 12), 11, 0.35, 6).keyframes == tuple(range(6, 12))


def test_a_robot_back_on_known_ground_does_not_separate():
    # The newest keyframe looks like the first room again; the room between was the robot's own.
    label = np.array([0] * 6 + [1] * 6 + [0])
    graph = graph_of(np.where(label[:, None] == label, 0.8, 0.02))
    assert find_separation(graph, range(13), 12, 0.35, 5) is None
    assert find_separation(graph, range(6, 13), 12, 0.35, 5) is None


def test_without_overlap_to_the_old_ground_the_value_is_nought():
    found = find_separation(rooms(5, 5, between=0.0), range(5, 10), 9, 0.35, 5)
    assert found == (tuple(range(5, 10)), 0.0)


def test_overlaps_between_chambers_are_weakened_and_no_others():
    graph = graph_of(np.full((4, 4), 0.8), first=3)
    weak = graph.weaken_across_doors({3: 0, 4: 1, 5: 1}, 0.25)
    assert weak.keyframes == graph.keyframes
    apart = np.array([[0, 1, 1, 0], [1, 0, 0, 1], [1, 0, 0, 1], [0, 1, 1, 0]], dtype=bool)
    np.testing.assert_allclose(weak.similarity, np.where(apart, 0.25, 1.0) * graph.similarity)
