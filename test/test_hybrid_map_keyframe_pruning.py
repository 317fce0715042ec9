"""Which keyframes are more than their places need."""

import math

import numpy as np
import pytest

from hmt_slam_ros.configuration.metric_slam import FilterParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.keyframe_pruning import is_same_viewpoint, nearest_replacement, redundant_keyframes
from hmt_slam_ros.sensors import Scan

AHEAD, BACK = (0.2, 0.0, 0.0), (-0.2, 0.0, math.pi)
SETTINGS = FilterParameters(keyframe_distance=0.5, keyframe_angle=20.0)


@pytest.mark.parametrize(
    ("relative", "same"),
    [
        ([0.0, 0.39, 0.0], True),
        ([0.41, 0.0, 0.0], False),
        ([0.3, 0.3, 0.0], False),
        ([0.1, 0.0, math.radians(15.9)], True),
        ([0.1, 0.0, math.radians(-16.1)], False),
    ],
)
def test_a_viewpoint_is_that_of_metric_slam(relative, same):
    assert is_same_viewpoint(np.array(relative), SETTINGS) == same


def test_the_nearest_keyframe_stands_for_one_that_is_forgotten():
    gone = np.array([2.0, 1.0, 0.5])
    others = {7: np.array([2.1, 1.0, 1.5]), 4: np.array([2.0, 1.6, 0.5]), 9: np.array([9.0, 9.0, 0.5])}
    held = nearest_replacement(gone, others)
    assert held.keyframe == 4
    np.testing.assert_allclose(se2.compose(others[4], held.pose), gone, atol=1e-12)


def passes(count, spacing=0.5):
    """Keyframes of some passes along one way of five places, those of a pass before those of the next."""
    return {5 * lap + k: np.array([spacing * k, 0.01 * lap, 0.0]) for lap in range(count) for k in range(5)}


def scan_by(*laser_pose):
    return Scan(0, np.ones(3, dtype=np.float32), -1.0, 1.0, 0.05, 30.0, np.array(laser_pose))


def redundant(placed, protected, most, lasers=(AHEAD,)):
    """The keyframes to prune, whose scans are of the lasers in turn."""
    scans = {keyframe: scan_by(*lasers[keyframe % len(lasers)]) for keyframe in placed}
    return redundant_keyframes(placed, scans, protected, most, SETTINGS)


def test_of_many_passes_as_many_keyframes_stay_as_a_place_may_hold():
    placed = passes(6)
    gone = redundant(placed, [], 2)
    left = sorted(placed.keys() - set(gone))
    assert left == [*range(20, 30)]


def test_protected_keyframes_stay_and_others_are_pruned_instead():
    gone = redundant(passes(3), [0, 1], 2)
    assert sorted(gone) == [2, 3, 4, 5, 6]


def test_without_crowded_viewpoints_nothing_is_pruned():
    assert redundant(passes(2), [], 2) == []
    assert redundant({}, [], 2) == []


def test_the_one_that_is_in_one_place_with_most_others_goes_first():
    placed = {k: np.array([x, 0.0, 0.0]) for k, x in enumerate([0.0, 0.35, 0.7, 1.05])}
    assert redundant(placed, [], 2) == [1]


def test_other_headings_are_other_places():
    placed = {k: np.array([0.0, 0.0, math.radians(angle)]) for k, angle in enumerate(range(0, 360, 20))}
    assert redundant(placed, [], 1) == []


def test_of_two_lasers_each_has_its_viewpoints():
    placed = {k: np.zeros(3) for k in range(6)}
    assert redundant(placed, [], 2) == [0, 1, 2, 3]
    assert sorted(redundant(placed, [], 2, lasers=(AHEAD, BACK))) == [0, 1]
    assert redundant(placed, [], 2, lasers=(AHEAD, (0.2, 0.1, 0.0))) == [0, 1, 2, 3]
