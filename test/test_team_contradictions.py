"""Contradictions between a window and the place in which a placement has it."""

import math

import numpy as np
import pytest
from laps import CONFIGURATION
from worlds import box, drive, scan_at

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.team.components import Component, combine
from hmt_slam_ros.team.contradictions import PlaceComparison
from hmt_slam_ros.team.placement import PlacementGeometry
from hmt_slam_ros.team.windows import find_windows
from hmt_slam_ros.topological_inference.event_work import EventWork
from hmt_slam_ros.topological_inference.map_search import MapSearch

TIGHT = np.diag([0.02, 0.02, 0.005]) ** 2
HALL = np.concatenate((box(0.0, 0.0, 14.0, 6.0), box(3.0, 0.0, 4.5, 0.6)))
PILLAR = box(6.0, 2.5, 9.0, 4.5)


def way(walls, seed):
    """The map of a straight way along a hall, one area."""
    hybrid_map, rng = HybridMap(), np.random.default_rng(seed)
    poses = dict(enumerate(drive((1.0, 1.5), (8.0, 1.5))))
    for keyframe, pose in poses.items():
        hybrid_map.set_keyframe(keyframe, 0, se2.between(poses[0], pose))
    hybrid_map.commit()
    return Component(hybrid_map, {k: scan_at(walls, pose, 0.01, rng, 360) for k, pose in poses.items()})


def compare(walls, offset, is_matched):
    """The contradictions of the way in a hall, of which a placement is off by (x, y, theta)."""
    pair = combine(way(HALL, 0), way(walls, 1))
    windows = find_windows(pair.hybrid_map, pair.other)
    geometry = PlacementGeometry(pair.hybrid_map, windows)
    grids = MapSearch(CONFIGURATION, pair.scans, EventWork()).grid_cache
    comparison = PlaceComparison(pair, windows, geometry, CONFIGURATION, grids)
    return comparison.log_ratio(0, pair.known[0], PoseGaussian(np.array(offset), TIGHT), is_matched)


@pytest.mark.parametrize("is_matched", [True, False])
def test_the_same_hall_contradicts_nothing(is_matched):
    assert compare(HALL, (0.0, 0.0, 0.0), is_matched) == 0.0


@pytest.mark.parametrize("is_matched", [True, False])
def test_decimeters_that_arcs_leave_open_are_no_contradiction(is_matched):
    assert compare(HALL, (0.3, -0.2, math.radians(3.0)), is_matched) == 0.0


def test_surfaces_where_the_other_one_saw_free_space_contradict():
    assert compare(np.concatenate((HALL, PILLAR)), (0.0, 0.0, 0.0), False) < -5.0


def test_a_window_beyond_the_ground_of_the_other_is_in_no_place():
    assert compare(HALL, (0.0, 20.0, 0.0), False) is None
