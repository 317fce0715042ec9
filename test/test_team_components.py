"""Two maps as one hybrid map, and the windows of a component."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import blank_scan

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative, map_pieces
from hmt_slam_ros.registration.consistency import MAPS_OUTLIER_RATE, Clutter
from hmt_slam_ros.team.components import Component, combine, renumber
from hmt_slam_ros.team.team_map import split_component
from hmt_slam_ros.team.windows import find_windows

ARC = PoseGaussian(np.array([10.0, 0.0, 0.0]), np.diag([0.02, 0.02, 0.01]) ** 2)


def corridor(keyframes=40, step=0.5, first=0):
    """Keyframes along x in two areas of 10 m each, whose numbers begin with ``first``."""
    hybrid_map = HybridMap()
    for k in range(keyframes):
        x = step * k
        area = int(x >= 10.0)
        hybrid_map.set_keyframe(first + k, first + area, np.array([x - 10.0 * area, 0.0, 0.0]))
    if keyframes * step > 10.0:
        hybrid_map.set_arc(first, first + 1, ARC, closure=False)
    hybrid_map.commit()
    return Component(hybrid_map, {first + k: blank_scan() for k in range(keyframes)})


def test_the_second_component_has_the_larger_numbers():
    pair = combine(corridor(first=3), corridor())
    assert pair.known == (3, 4) and pair.other == (5, 6)
    assert pair.first_keyframe == 43 and pair.area_shift == 5
    assert max(pair.hybrid_map.keyframes(4)) < pair.first_keyframe <= min(pair.hybrid_map.keyframes(5))
    assert pair.scans.keys() == set(range(3, 83))
    np.testing.assert_array_equal(pair.hybrid_map.arc(5, 6).mean, ARC.mean)


def test_nothing_is_known_of_the_arc_between_two_components():
    pair = combine(corridor(), corridor())
    assert is_uninformative(pair.hybrid_map.arc(*pair.joint))
    assert map_pieces(pair.hybrid_map) == [[0, 1], [2, 3]]
    # Beside, as long as the place is unknown.
    assert pair.hybrid_map.arc(*pair.joint).mean[0] > 20.0


def test_people_who_walked_past_either_robot_contradict_between_the_maps():
    busy, calm = Clutter(0.03, 0.004), Clutter(0.0005, 0.001)
    pair = combine(replace(corridor(), clutter=busy), replace(corridor(), clutter=calm))
    assert pair.clutter == pytest.approx((0.03, 0.0025))
    both = combine(replace(corridor(), clutter=busy), replace(corridor(), clutter=busy))
    assert both.clutter.beam_outlier_rate == pytest.approx(2 * 0.03 - MAPS_OUTLIER_RATE)
    # Maps without people contradict as maps do.
    assert combine(corridor(), corridor()).clutter == pytest.approx((MAPS_OUTLIER_RATE, 0.0))
    assert pair.as_one(pair.hybrid_map).clutter == busy


def test_the_components_stay_as_they_are():
    first, second = corridor(), corridor()
    combine(first, second).hybrid_map.set_keyframe(99, 0, np.zeros(3))
    assert 99 not in first.hybrid_map.keyframes(0) and second.hybrid_map.area_ids() == [0, 1]


def test_renumbering_keeps_poses_and_arcs():
    hybrid_map = renumber(corridor().hybrid_map, 7, 100)
    assert hybrid_map.area_ids() == [7, 8]
    assert list(hybrid_map.keyframes(7)) == list(range(100, 120))
    assert [(a, b) for a, b, _ in hybrid_map.all_arcs()] == [(7, 8)]


def test_a_map_in_pieces_has_a_component_of_each():
    pair = combine(corridor(), corridor())
    parts = split_component("one", Component(pair.hybrid_map, pair.scans))
    assert list(parts) == ["one", "one, piece 2"]
    assert parts["one, piece 2"].hybrid_map.area_ids() == [2, 3]
    assert parts["one, piece 2"].scans.keys() == set(range(40, 80))


def test_windows_are_stretches_of_the_path_that_do_not_overlap():
    hybrid_map = corridor().hybrid_map
    windows = find_windows(hybrid_map, hybrid_map.area_ids())
    assert [list(window.poses) for window in windows] == [[*range(17)], [*range(17, 34)], [*range(34, 40)]]
    # The second one goes on into the second area, in the frame of its first keyframe.
    assert windows[1].area == 0
    np.testing.assert_allclose(windows[1].poses[33], [8.0, 0.0, 0.0], atol=1e-12)


def test_a_window_ends_where_the_path_has_a_gap():
    hybrid_map = corridor(12, step=0.5).hybrid_map
    for k in range(6, 12):
        hybrid_map.set_keyframe(k, 0, hybrid_map.keyframes(0)[k] + [5.0, 0.0, 0.0])
    assert [list(window.poses) for window in find_windows(hybrid_map, [0])] == [[*range(6)], [*range(6, 12)]]


def test_few_keyframes_are_no_window():
    assert find_windows(corridor(4).hybrid_map, [0]) == []
