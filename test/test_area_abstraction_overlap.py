"""Overlap of sensed space against hand-computed answers and a brute-force reference."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hmt_slam_ros.area_abstraction.overlap_graph import SensedSpace, overlaps, sensed_overlaps, sensed_points
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Scan

HERE = np.zeros(3)


def wall(start, end, spacing=0.1):
    x = np.arange(start, end, spacing)
    return np.stack((x, np.full_like(x, 2.0)), axis=1)


def overlap(a, b, a_T_b=HERE, radius=0.2):
    return overlaps(a, HERE, [b], np.asarray(a_T_b)[None], radius)[0]


def reference(a, b, a_T_b, radius):
    moved = se2.transform(a_T_b, b)
    of_a = np.mean(cKDTree(moved).query(a)[0] <= radius)
    of_b = np.mean(cKDTree(a).query(moved)[0] <= radius)
    return (of_a + of_b) / 2.0


def scan(ranges, **changes):
    geometry = {
        "angle_min": -np.pi / 2,
        "angle_increment": np.pi / (len(ranges) - 1),
        "range_min": 0.1,
        "range_max": 80.0,
    }
    return Scan(0, np.asarray(ranges, np.float32), **(geometry | changes))


def test_a_scan_overlaps_itself_wholly():
    assert overlap(wall(0, 10), wall(0, 10)) == 1.0


def test_scans_of_different_places_do_not_overlap():
    assert overlap(wall(0, 10), wall(0, 10), [0.0, 5.0, 0.0]) == 0.0


def test_half_a_wall_seen_by_the_other_is_the_mean_of_both_shares():
    # All 50 points of the short wall are met by the long one, 50 of whose 100 points are met, and 2 within the radius.
    assert overlap(wall(0, 10), wall(0, 5), radius=0.15) == pytest.approx((1.0 + 51 / 100) / 2.0)


def test_overlap_falls_as_the_second_scan_moves_along_the_wall():
    values = [overlap(wall(0, 10), wall(0, 10), [shift, 0.0, 0.0]) for shift in (0.0, 2.0, 4.0, 8.0, 20.0)]
    np.testing.assert_allclose(values, [1.0, 0.82, 0.62, 0.22, 0.0], atol=0.011)


def test_the_relative_pose_counts_and_not_the_frame():
    rng = np.random.default_rng(2)
    a, b, a_T_b = rng.uniform(-5, 5, (80, 2)), rng.uniform(-5, 5, (60, 2)), np.array([1.0, -0.5, 0.7])
    there = np.array([40.0, -30.0, 2.5])
    moved = overlaps(a, there, [b], se2.compose(there, a_T_b)[None], 0.3)
    assert moved[0] == pytest.approx(overlap(a, b, a_T_b, 0.3), abs=0.02)
    assert 0.1 < moved[0] < 0.9


def test_overlap_is_symmetric():
    rng = np.random.default_rng(3)
    a, b, a_T_b = rng.uniform(-5, 5, (80, 2)), rng.uniform(-5, 5, (60, 2)), np.array([1.0, -0.5, 0.7])
    assert overlap(a, b, a_T_b, 0.3) == pytest.approx(overlap(b, a, se2.inverse(a_T_b), 0.3), abs=1e-12)


def test_many_overlaps_in_one_call_are_those_of_a_kd_tree():
    rng = np.random.default_rng(4)
    a = rng.uniform(-4, 4, (150, 2))
    others = [rng.uniform(-4, 4, (count, 2)) for count in (1, 30, 180, 90)]
    poses = rng.uniform(-3, 3, (4, 3))
    found = overlaps(a, HERE, others, poses, 0.2)
    np.testing.assert_allclose(found, [reference(a, b, p, 0.2) for b, p in zip(others, poses, strict=True)])


def test_a_scan_without_returns_overlaps_nothing():
    empty = np.empty((0, 2))
    poses = np.zeros((3, 3))
    np.testing.assert_array_equal(overlaps(wall(0, 5), HERE, [wall(0, 5), empty, wall(0, 5)], poses, 0.2), [1, 0, 1])
    np.testing.assert_array_equal(overlaps(empty, HERE, [wall(0, 5), empty], poses[:2], 0.2), [0, 0])


def test_scans_that_saw_free_space_only_overlap_the_less_the_farther_apart_they_were_taken():
    blank, seen = SensedSpace(np.empty((0, 2)), 8.0), SensedSpace(wall(0, 5), 8.0)
    poses = np.array([[0.0, 0.0, 1.0], [8.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 0.0]])
    found = sensed_overlaps(blank, HERE, [blank, blank, blank, seen], poses, 0.2)
    np.testing.assert_allclose(found, [1.0, 0.5, 0.0, 0.0])
    np.testing.assert_array_equal(sensed_overlaps(seen, HERE, [blank, seen], poses[3:].repeat(2, 0), 0.2), [0.0, 1.0])


def test_without_other_scans_there_are_no_values():
    assert overlaps(wall(0, 5), HERE, [], np.empty((0, 3)), 0.2).shape == (0,)


def test_points_beyond_the_maximum_range_of_the_laser_are_left_out():
    points = sensed_points(scan([5.0, 10.0, 20.0, 30.0], laser_pose=np.array([1.0, 0.0, 0.0])), max_range=15.0)
    assert len(points) == 2
    np.testing.assert_allclose(np.hypot(points[:, 0] - 1.0, points[:, 1]), [5.0, 10.0])


def test_a_dense_scan_is_thinned_evenly_with_both_ends_kept():
    dense = scan(np.full(1081, 4.0))
    points = sensed_points(dense, 30.0, count=180)
    assert len(points) == 180
    np.testing.assert_array_equal(points[[0, -1]], dense.points[[0, -1]])
    gaps = np.hypot(*np.diff(points, axis=0).T)
    assert gaps.max() / gaps.min() < 1.2


def test_a_sparse_scan_is_kept_whole_less_the_beams_without_return():
    assert len(sensed_points(scan([1.0, np.nan, 2.0, np.inf, 80.0, 3.0]), 30.0)) == 3
