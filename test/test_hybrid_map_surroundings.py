"""Areas around an area, their cached grids, and places."""

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import (
    GridCache,
    GridCacheState,
    Neighborhood,
    areas_around,
    consistent_pose,
)
from hmt_slam_ros.registration.likelihood_grid import GridModel

NEAR = Neighborhood(max_sigma=0.3, max_distance=6.0)


def belief(x, sigma):
    return PoseGaussian(np.array([x, 0.0, 0.0]), np.diag([sigma, sigma, 0.01]) ** 2)


def area_poses(*poses):
    return {area: PoseGaussian(pose, np.eye(3)) for area, pose in enumerate(poses)}


def chain(*sigmas, spacing=4.0):
    """Areas 0, 1, ... in a row, each with one keyframe at its origin, joined by arcs of the given deviations."""
    hybrid_map = HybridMap()
    for area in range(len(sigmas) + 1):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    for area, sigma in enumerate(sigmas):
        hybrid_map.set_arc(area, area + 1, belief(spacing, sigma), closure=False)
    return hybrid_map


def test_areas_within_reach_whose_position_is_certain_are_around():
    assert list(areas_around(chain(0.05, 0.05), 0, NEAR)) == [0, 1]


def test_an_area_with_a_loose_arc_is_not_around():
    assert list(areas_around(chain(0.5), 0, NEAR)) == [0]
    # The deviation of the position has a part along each axis.
    assert list(areas_around(chain(0.25), 0, NEAR)) == [0]
    assert list(areas_around(chain(0.2), 0, NEAR)) == [0, 1]


def test_an_area_beyond_reach_does_not_hide_one_behind_it():
    """Arcs lead over an area far away back to one nearby."""
    hybrid_map = chain(0.02, 0.02, spacing=9.0)
    hybrid_map.set_arc(1, 2, belief(-7.0, 0.02), closure=False)
    assert list(areas_around(hybrid_map, 0, NEAR)) == [0, 2]


def test_excluded_areas_are_left_out():
    assert list(areas_around(chain(0.05), 0, NEAR, excluded={1})) == [0]


def test_a_global_pose_that_agrees_with_the_arcs_is_taken():
    poses = area_poses(np.array([1.0, 1.0, 0.5]), se2.compose([1.0, 1.0, 0.5], [4.05, 0.0, 0.0]))
    assert np.allclose(consistent_pose(belief(4.0, 0.1), 0, 1, poses, 16.0), [4.05, 0.0, 0.0])


def test_a_global_pose_that_contradicts_the_arcs_is_not():
    poses = area_poses(np.zeros(3), np.array([6.0, 0.0, 0.0]))
    assert np.allclose(consistent_pose(belief(4.0, 0.1), 0, 1, poses, 16.0), [4.0, 0.0, 0.0])
    assert np.allclose(consistent_pose(belief(4.0, 0.1), 0, 7, poses, 16.0), [4.0, 0.0, 0.0])


KEPT = 1_500_000


@pytest.fixture
def views():
    room = box(-2.0, -2.0, 10.0, 2.0)
    scans = {area: scan_in(room, np.array([4.0 * area, 0.0, 0.0])) for area in range(3)}
    return GridCache(scans, GridModel(), NEAR, KEPT)


def test_a_place_has_the_keyframes_of_the_areas_around_in_its_frame(views):
    place = views.place(chain(0.05, 0.05), 1, ())
    assert sorted(zip(place.keyframe_areas.tolist(), place.positions[:, 0].tolist(), strict=True)) == [
        (0, -4.0),
        (1, 0.0),
        (2, 4.0),
    ]


def test_a_grid_is_built_once_for_the_same_keyframes_at_the_same_poses(views):
    pose = np.array([0.0, 0.0, 0.1])
    assert views.grid({1: pose}) is views.grid({1: pose.copy()})
    assert views.grid({1: pose}) is not views.grid({1: pose + 0.01})


def test_the_grids_that_are_kept_take_bounded_memory(views):
    first = views.grid({0: np.zeros(3)})
    assert views.grid({0: np.zeros(3)}) is first
    for k in range(40):
        views.grid({0: np.array([0.0, 0.0, 0.05 * k])})
    assert sum(views._grids.known.values()) <= KEPT
    assert views._grids.known.keys() == views._grids._grids.keys()
    assert views.grid({0: np.zeros(3)}) is not first


def test_the_least_recently_used_grids_are_packed(views, monkeypatch):
    poses = [{0: np.array([0.0, 0.0, 0.05 * k])} for k in range(4)]
    first = views.grid(poses[0])
    views._grids._unpacked_bytes = 2 * first.nbytes
    others = [views.grid(pose) for pose in poses[1:]]
    assert views.grid(poses[3]) is others[2]
    monkeypatch.setattr("hmt_slam_ros.hybrid_map.surroundings.build_area_grid", None)
    again = views.grid(poses[0])
    assert again is not first
    assert again.fine_log_ratio.tobytes() == first.fine_log_ratio.tobytes()
    assert views.grid(poses[0]) is again


def test_a_coarse_grid_outlasts_grids(views):
    grid, coarse = views.grid({0: np.zeros(3)}), views.coarse_grid({0: np.zeros(3)})
    for k in range(40):
        views.grid({0: np.array([0.0, 0.0, 0.05 * k])})
    assert views.grid({0: np.zeros(3)}) is not grid
    assert views.coarse_grid({0: np.zeros(3)}) is coarse
    views.clear()
    assert views.coarse_grid({0: np.zeros(3)}) is not coarse


def test_a_restored_cache_counts_no_grid_that_was_held_and_evicts_the_same():
    scans = {0: scan_in(box(-2.0, -2.0, 10.0, 2.0), np.zeros(3))}
    turned = [{0: np.array([0.0, 0.0, 0.05 * k])} for k in range(12)]
    counted = []

    def make(state=None):
        own = []
        counted.append(own)
        cache = GridCache(scans, GridModel(), NEAR, KEPT, own.append)
        cache.restore(state or GridCacheState())
        return cache

    first = make()
    for keyframes in (*turned[:6], turned[2]):
        first.grid(keyframes)
    first.coarse_grid(turned[3])
    second = make(first.state)
    assert second.state == first.state
    assert len(counted[0]) == 7
    assert counted[0][6] == counted[0][3] // 3
    counted[0].clear()
    grids = []
    for cache in (first, second):
        coarse = [cache.coarse_grid(turned[3])]
        own = [cache.grid(turned[k]) for k in (0, 2, 7, 8, 1, 9, 10, 3)]
        grids.append([*own, *coarse, cache.coarse_grid(turned[0])])
    for one, two in zip(*grids, strict=True):
        np.testing.assert_array_equal(one.log_ratio, two.log_ratio)
    assert counted[0] == counted[1]
    assert second.state == first.state
    assert len(first.state.grids) < 10
    first.clear()
    assert first.state == GridCacheState()


def test_the_grids_that_are_kept_are_forgotten_when_they_are_needed_no_more(views):
    first = views.grid({0: np.zeros(3)})
    views.clear()
    assert views.grid({0: np.zeros(3)}) is not first
