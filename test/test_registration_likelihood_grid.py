"""The grid of log-likelihood ratios around an area."""

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.registration.likelihood_grid import GridModel, build_area_grid, thin_points

ROOM = box(0.0, 0.0, 6.0, 4.0)
MODEL = GridModel()


def log_ratio_at(grid, x, y):
    column, row = np.floor((np.array([x, y]) - grid.origin) / (0.5 * grid.cell)).astype(int)
    return grid.fine_log_ratio[row, column]


@pytest.fixture(scope="module")
def room():
    poses = np.array([[2.0, 2.0, 0.0], [3.0, 2.0, 3.1]])
    return build_area_grid([scan_in(ROOM, pose, field_of_view=2 * np.pi, beams=721) for pose in poses], poses, MODEL)


def test_a_surface_is_likelier_on_a_wall_than_in_unknown_space(room):
    assert log_ratio_at(room, 6.0, 2.0) == pytest.approx(np.log(3.0), abs=0.1)


def test_a_surface_is_less_likely_in_the_open_than_in_unknown_space(room):
    assert log_ratio_at(room, 2.5, 2.5) == pytest.approx(np.log(0.1), abs=1e-3)


def test_nothing_is_known_behind_a_wall(room):
    assert log_ratio_at(room, 6.39, 2.0) == pytest.approx(0.0, abs=0.01)


def test_the_two_flanks_of_a_wall_are_alike_close_to_it(room):
    assert log_ratio_at(room, 5.9, 2.0) == pytest.approx(log_ratio_at(room, 6.1, 2.0), abs=0.35)


def test_the_coarse_grid_is_the_mean_of_the_fine_one(room):
    rows, columns = room.log_ratio.shape
    assert np.allclose(room.log_ratio, room.fine_log_ratio.reshape(rows, 2, columns, 2).mean(axis=(1, 3)))


def test_points_beyond_the_range_are_not_used():
    near = GridModel(max_range=2.5)
    pose = np.array([2.0, 2.0, 0.0])
    grid = build_area_grid([scan_in(ROOM, pose, field_of_view=2 * np.pi, beams=721)], pose[None], near)
    assert np.hypot(*(grid.points - pose[:2]).T).max() <= 2.5


def test_poses_place_the_scans():
    pose = np.array([2.0, 1.0, 0.7])
    grid = build_area_grid([scan_in(ROOM, pose, field_of_view=2 * np.pi, beams=721)], pose[None], MODEL)
    distance = np.minimum.reduce(
        [
            np.abs(grid.points[:, 0]),
            np.abs(grid.points[:, 0] - 6.0),
            np.abs(grid.points[:, 1]),
            np.abs(grid.points[:, 1] - 4.0),
        ]
    )
    assert np.quantile(distance, 0.95) < 0.03


def test_thinning_leaves_one_point_a_voxel():
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (5000, 2))
    few = thin_points(points, 0.25)
    assert len(few) == 64
    assert len({tuple(voxel) for voxel in np.floor(few / 0.25).astype(int)}) == 64


def test_scans_without_a_return_give_a_blank_grid():
    pose = np.zeros(3)
    grid = build_area_grid([scan_in(ROOM + 100.0, pose)], pose[None], GridModel(max_range=10.0))
    assert grid.points.shape == (0, 2)
    assert not grid.log_ratio.any()


def test_a_moved_grid_gives_the_same_in_the_same_place(room):
    moved = room.shift_origin(np.array([1.0, -2.0]))
    assert log_ratio_at(moved, 5.0, 4.0) == log_ratio_at(room, 6.0, 2.0)


def test_a_surface_on_the_edge_of_what_beams_passed_contradicts_nothing_and_one_amid_it_does():
    # Sees from straight ahead to the right: whatever stands on the line ahead is grazed.
    ahead = scan_in(box(-9.0, -9.0, 9.0, 9.0), (0.0, 0.0, -np.pi / 4), beams=181, field_of_view=np.pi / 2)
    grid = build_area_grid([ahead], np.array([[0.0, 0.0, -np.pi / 4]]), GridModel())
    along = np.column_stack((np.arange(2.0, 7.0, 0.2), np.zeros(25)))
    for aside, free in ((-0.02, 0), (-0.08, 0), (-0.5, 25)):
        assert grid.compare(along + np.array([0.0, aside]), np.zeros(3)) == (25, 0, free)
