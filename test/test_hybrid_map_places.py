"""Places of areas against brute force: which keyframes are seen from where, and in whose place most lie."""

import itertools
import math

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import (
    NO_AREA,
    AreaPlace,
    GridCache,
    Neighborhood,
    _is_visible,
    areas_around,
    consistent_pose,
    containing_area,
    containing_areas,
    has_same_poses,
    min_distance,
)
from hmt_slam_ros.registration.likelihood_grid import AreaGrid, GridModel

ORIGIN, CELL = np.array([-1.5, -2.5]), 0.2


def make_place(seed):
    """A wall with a gap, unknown ground in a corner, and keyframes of three areas at random."""
    rng = np.random.default_rng(seed)
    log_ratio = np.full((30, 45), -0.6, np.float32)
    log_ratio[11, :30], log_ratio[11, 20:23] = 0.6, 0.4
    free = log_ratio < 0.0
    free[18:, 25:] = False
    log_ratio[18:, 25:] = 0.0
    grid = AreaGrid(ORIGIN, CELL, log_ratio, np.repeat(np.repeat(log_ratio, 2, 0), 2, 1), free, np.zeros((0, 2)))
    positions = ORIGIN + rng.uniform([0.0, 0.0], [9.0, 6.0], (14, 2))
    return AreaPlace(5, rng.choice([5, 2, 9], 14), positions, grid), rng


def is_visible(place, start, end):
    steps = math.ceil(math.dist(start, end) / (0.5 * CELL)) + 1
    free_steps = 0
    for point in start + np.arange(steps)[:, None] / steps * (end - start):
        column, row = np.floor((point - ORIGIN) / CELL).astype(int)
        if 0 <= column < 45 and 0 <= row < 30:
            if place.grid.log_ratio[row, column] > 0.5:
                return False
            free_steps += place.grid.free[row, column]
    return 2 * free_steps >= steps


@pytest.mark.parametrize("seed", range(3))
def test_most_keyframes_decide_by_the_nearest_that_they_see(seed):
    place, rng = make_place(seed)
    positions = ORIGIN + rng.uniform([-1.0, -1.0], [10.0, 7.0], (60, 5, 2))
    found = containing_areas(place, positions, 2.5)
    seen = []
    for group, area in zip(positions, found, strict=True):
        owners = []
        for at in group:
            order = np.argsort(np.hypot(*(place.positions - at).T))
            near = [k for k in order if math.dist(place.positions[k], at) <= 2.5]
            owner = next((place.keyframe_areas[k] for k in near if is_visible(place, at, place.positions[k])), NO_AREA)
            owners.append(owner)
        votes = {a: owners.count(a) for a in (2, 5, 9)}
        inside = sum(votes.values())
        expected = NO_AREA if 2 * inside < 5 else min(votes, key=lambda a: (-votes[a], a))
        assert area == expected
        seen.append(expected)
        poses = np.column_stack((group, rng.uniform(-3.0, 3.0, 5)))
        assert containing_area(place, poses, 2.5) == (None if expected == NO_AREA else expected)
    assert len(set(seen)) >= 3


def test_half_of_the_keyframes_are_enough_and_of_equal_areas_the_smaller_counts():
    place = make_place(0)[0]
    ends = np.array([[0.0, -2.0], [0.0, -1.0], [4.0, -2.0]])
    place = AreaPlace(7, np.array([7, 7, 4]), ends, place.grid)
    far = [30.0, 30.0]
    for group, area in (
        ([[0.1, -2.0], far], 7),
        ([[0.1, -2.0], far, far], NO_AREA),
        ([[0.1, -2.0], [4.0, -1.9]], 4),
        ([[0.1, -2.0], [4.0, -1.9], [0.1, -1.1]], 7),
        ([far, far], NO_AREA),
    ):
        assert containing_areas(place, np.array([group]), 1.0)[0] == area


def test_half_of_a_line_of_sight_has_to_be_known_as_free():
    log_ratio, free = np.zeros((4, 40), np.float32), np.zeros((4, 40), bool)
    # 39 steps of half a cell and one: at the centers of 20 cells.
    start, end = np.array([0.05, 0.3]), np.array([3.9, 0.3])
    columns = np.floor((start[0] + np.arange(40) / 40 * 3.85) / 0.2).astype(int)
    for count in range(20):
        free[1, :count] = True
        is_seen = _is_visible(start, end, log_ratio, free, np.zeros(2), 0.2)
        assert is_seen == (2 * np.sum(columns < count) >= 40)
    for value, is_seen in ((0.5, True), (0.51, False)):
        log_ratio[1, 7] = value
        assert _is_visible(start, end, log_ratio, free, np.zeros(2), 0.2) == is_seen


def rotated_chain():
    """Areas 0 to 3, each with keyframes off its origin and turned against the area before."""
    hybrid_map, rng = HybridMap(), np.random.default_rng(2)
    arcs = rng.uniform([2.0, -1.0, -2.0], [3.0, 1.0, 2.0], (3, 3))
    for area in range(4):
        for k in range(3):
            hybrid_map.set_keyframe(10 * k + area, area, rng.uniform([-1.0, -2.0, -3.0], [1.5, 1.0, 3.0]))
        if area:
            belief = PoseGaussian(arcs[area - 1], np.diag([0.05, 0.04, 0.01]) ** 2)
            hybrid_map.set_arc(area - 1, area, belief, closure=False)
    frames = [np.zeros(3), *itertools.accumulate(arcs, se2.compose)]
    return hybrid_map, [se2.between(frames[1], frame) for frame in frames]


def test_a_place_has_the_keyframes_before_one_in_the_frame_of_its_area():
    hybrid_map, frames = rotated_chain()
    walls = box(-6.0, -6.0, 9.0, 9.0)
    scans = {k: scan_in(walls, (0.1 * k, 0.0, 0.2), beams=31, seed=k) for k in range(30)}
    cache = GridCache(scans, GridModel(), Neighborhood(0.4, 50.0))
    place = cache.place(hybrid_map, 1, (3,), before=21)
    expected = {
        k: (area, se2.compose(frames[area], pose))
        for area in (0, 1, 2)
        for k, pose in hybrid_map.keyframes(area).items()
        if k < 21
    }
    assert place.area == 1
    assert sorted(place.keyframe_areas) == sorted(area for area, _ in expected.values())
    found = {tuple(np.round(p, 9)): area for p, area in zip(place.positions, place.keyframe_areas, strict=True)}
    assert found == {tuple(np.round(pose[:2], 9)): area for area, pose in expected.values()}
    same = cache.grid_before(hybrid_map, {a: frames[a] for a in (1, 0, 2)}, 21)
    np.testing.assert_allclose(np.sort(same.points, axis=0), np.sort(place.grid.points, axis=0), atol=0.2)
    assert next(iter(areas_around(hybrid_map, 1, Neighborhood(0.4, 50.0)))) == 1
    assert set(cache.place(hybrid_map, 1, (), max_sigma=0.08).keyframe_areas) == {0, 1, 2}
    assert set(cache.place(hybrid_map, 1, (), max_sigma=0.01).keyframe_areas) == {1}


def test_areas_are_around_up_to_a_distance_of_their_nearest_keyframes():
    hybrid_map, frames = rotated_chain()
    own = np.array(list(hybrid_map.keyframes(1).values()))[:, :2]
    for other in (0, 2, 3):
        positions = se2.compose(frames[other], np.array(list(hybrid_map.keyframes(other).values())))[:, :2]
        away = min(math.dist(a, b) for a in own for b in positions)
        assert min_distance(own, positions) == pytest.approx(away)
        assert other in areas_around(hybrid_map, 1, Neighborhood(1.0, away + 1e-6))
        assert other not in areas_around(hybrid_map, 1, Neighborhood(1.0, away - 1e-6))
    assert min_distance(own, own[:0]) == math.inf


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_global_pose_counts_within_the_gate_of_the_belief(share):
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.01], [0.0, 0.01, 0.02]])
    belief = PoseGaussian(np.array([2.0, -1.0, 2.5]), covariance)
    off = np.array([0.3, -0.2, 0.15])
    off *= share * math.sqrt(9.0 / (off @ np.linalg.inv(covariance) @ off))
    base = np.array([5.0, 3.0, -2.0])
    pose = se2.compose(belief.mean, se2.exp(off))
    poses = {4: PoseGaussian(base, np.eye(3)), 6: PoseGaussian(se2.compose(base, pose), np.eye(3))}
    found = consistent_pose(belief, 4, 6, poses, 9.0)
    np.testing.assert_allclose(found, pose if share < 1.0 else belief.mean, atol=1e-9)
    np.testing.assert_array_equal(consistent_pose(belief, 4, 8, poses, 9.0), belief.mean)
    np.testing.assert_array_equal(consistent_pose(belief, 8, 6, poses, 9.0), belief.mean)


def test_the_same_poses_are_those_of_the_same_keyframes():
    one = {3: np.array([1.0, 2.0, 3.0]), 4: np.zeros(3)}
    assert has_same_poses(one, {4: np.zeros(3), 3: np.array([1.0, 2.0, 3.0])})
    assert not has_same_poses(one, {3: np.array([1.0, 2.0, 3.0])})
    assert not has_same_poses(one, {3: np.array([1.0, 2.0, 3.0]), 5: np.zeros(3)})
    assert not has_same_poses(one, {3: np.array([1.0, 2.0, 3.1]), 4: np.zeros(3)})


def test_points_through_which_another_keyframe_sees_are_no_surface():
    """A pillar that only the first of two scans has."""
    walls, pillar = box(-4.0, -3.0, 5.0, 3.0), box(1.5, 0.5, 1.9, 0.9)
    poses = {0: np.array([-1.0, -0.5, 0.4]), 1: np.array([0.2, -1.0, 1.0])}
    with_pillar = scan_in(np.concatenate((walls, pillar)), poses[0], beams=361)
    without, later = (scan_in(world, poses[1], beams=361) for world in (walls, np.concatenate((walls, pillar))))
    points, both = (
        GridCache({0: with_pillar, 1: scan}, GridModel(), Neighborhood(0.3, 6.0)).grid(poses).points
        for scan in (without, later)
    )
    on_pillar, on_both = (np.all((found > [1.3, 0.3]) & (found < [2.1, 1.1]), axis=1).sum() for found in (points, both))
    assert on_pillar == 0
    assert on_both > 3
    assert len(points) > 0.9 * (len(both) - on_both)
