"""The grid of log-likelihood ratios around an area."""

import itertools

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration.likelihood_grid import (
    AreaGrid,
    GridModel,
    build_area_grid,
    build_coarse_grid,
    surface_points,
    thin_points,
)

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


def test_coarse_log_ratios_are_nearly_those_of_the_whole_grid(room):
    poses = np.array([[2.0, 2.0, 0.0], [3.0, 2.0, 3.1]])
    scans = [scan_in(ROOM, pose, field_of_view=2 * np.pi, beams=721) for pose in poses]
    coarse = build_coarse_grid(scans, poses, MODEL)
    np.testing.assert_array_equal(coarse.origin, room.origin)
    assert (coarse.cell, coarse.log_ratio.shape) == (room.cell, room.log_ratio.shape)
    difference = np.abs(coarse.log_ratio - room.log_ratio)
    assert difference.mean() < 0.02
    # One cell in a hundred differs by more, at the edges of free space, and amid a wall, which four quarters blur.
    assert np.quantile(difference, 0.99) < 0.25
    assert coarse.log_ratio.max() == pytest.approx(room.fine_log_ratio.max(), abs=0.1)


def test_without_an_end_point_nothing_is_known():
    scan = scan_in(ROOM, np.zeros(3), beams=21)
    grid = build_coarse_grid([scan], np.zeros((1, 3)), GridModel(max_range=0.01))
    assert not grid.log_ratio.any()


def test_points_beyond_the_range_are_not_used():
    near = GridModel(max_range=2.5)
    pose = np.array([2.0, 2.0, 0.0])
    grid = build_area_grid([scan_in(ROOM, pose, field_of_view=2 * np.pi, beams=721)], pose[None], near)
    assert np.hypot(*(grid.points - pose[:2]).T).max() <= 2.5


def test_the_surface_points_of_a_scan_are_its_ends_within_the_range_one_a_voxel(room):
    scan = scan_in(box(-2.0, -1.5, 9.0, 4.0), (0.3, 0.2, 0.4), beams=721)
    model = GridModel(max_range=5.0)
    near = scan.points[np.hypot(*(scan.points - scan.laser_pose[:2]).T) <= 5.0]
    assert len(near) < len(scan.points)
    np.testing.assert_allclose(surface_points(scan, model), thin_points(near, model.spacing))


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


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["right", "left"])
def test_a_surface_on_the_edge_of_what_beams_passed_contradicts_nothing_and_one_amid_it_does(quarters, side):
    # Sees from straight ahead to one side: whatever stands on the line ahead is grazed.
    ahead = 0.5 * np.pi * quarters
    # The line is in the middle of cells.
    pose = np.array([*se2.transform((0.0, 0.0, ahead), np.array([0.0, side * 0.05])), ahead + side * np.pi / 4])
    seen = scan_in(box(-9.0, -9.0, 9.0, 9.0), pose, beams=181, field_of_view=np.pi / 2)
    grid = build_area_grid([seen], pose[None], GridModel())
    along = np.column_stack((np.arange(2.0, 7.0, 0.2), np.zeros(25)))
    for aside, free in ((0.02, 0), (0.08, 0), (0.5, 25)):
        points = along + np.array([0.0, side * (0.05 + aside)])
        assert grid.compare(points, np.array([0.0, 0.0, ahead])) == (25, 0, free)


def test_the_points_of_voxels_are_the_means_of_those_within():
    points = np.random.default_rng(2).uniform(-2.0, 1.0, (300, 2)) * [1.0, 2.5]
    voxels = {}
    for point in points:
        voxels.setdefault(tuple(np.floor(point / 0.3).astype(int)), []).append(point)
    np.testing.assert_allclose(thin_points(points, 0.3), [np.mean(voxels[key], axis=0) for key in sorted(voxels)])


def test_agreement_counts_samples_on_surfaces_and_amid_free_space():
    rng = np.random.default_rng(6)
    fine = np.where(rng.random((24, 30)) < 0.8, -1.0, rng.uniform(-0.5, 1.0, (24, 30))).astype(np.float32)
    grid = AreaGrid(np.array([-1.0, 0.5]), 0.2, fine[::2, ::2], fine, fine[::2, ::2] < 0.0, np.zeros((0, 2)))
    points, pose = rng.uniform([-1.5, -1.5], [2.5, 2.0], (400, 2)), np.array([0.3, 1.5, 0.4])
    cells = np.floor((se2.transform(pose, points) - grid.origin) / 0.1).astype(int)
    inside = [(c, r) for c, r in cells if 3 <= c < 27 and 3 <= r < 21]
    free = [all(fine[r + y, c + x] < -0.5 for x, y in ((0, 0), (3, 0), (-3, 0), (0, 3), (0, -3))) for c, r in inside]
    expected = (400, sum(fine[r, c] > 0.3 for c, r in inside), sum(free))
    assert grid.compare(points, pose) == expected
    assert min(expected) > 5


def points_near(points, x, y, reach=0.3):
    return np.count_nonzero(np.hypot(*(points - [x, y]).T) < reach)


def test_the_points_of_a_person_who_walked_on_are_no_surface_of_the_map_and_those_of_a_post_are():
    post, poses = box(4.5, 1.0, 4.7, 1.2), np.array([[1.0 + 0.2 * k, 2.0, 0.0] for k in range(6)])
    people = [box(2.0 + 0.5 * k, 2.2, 2.3 + 0.5 * k, 2.5) for k in range(6)]
    worlds = [np.concatenate((ROOM, post, person)) for person in people]
    scans = [
        scan_in(world, pose, field_of_view=2 * np.pi, beams=721) for world, pose in zip(worlds, poses, strict=True)
    ]
    one_by_one = [build_area_grid([scan], pose[None], MODEL).points for scan, pose in zip(scans, poses, strict=True)]
    points = build_area_grid(scans, poses, MODEL).points
    # The last two stand where no later scan looked through them.
    for k in range(4):
        x, y = 2.15 + 0.5 * k, 2.35
        assert points_near(one_by_one[k], x, y) > 1
        assert points_near(points, x, y) == 0
    assert points_near(points, 4.6, 1.1) > 1
    walls = build_area_grid([scan_in(ROOM, pose, field_of_view=2 * np.pi, beams=721) for pose in poses], poses, MODEL)
    assert len(points) > 0.9 * len(walls.points)


def plain_log_ratios(scans, poses, model, grid):
    """The log-ratio in the middle of each half cell, from the distances to all end points and the cells on beams.

    Of points within a sixteenth of a half cell the first counts.
    """
    half, (rows, columns), counted = 0.5 * model.cell, grid.fine_log_ratio.shape, set()
    x, y = (grid.origin[k] + half * (np.arange(size) + 0.5) for k, size in enumerate((columns, rows)))
    distance2, free = np.full((rows, columns), np.inf), np.zeros((rows // 2, columns // 2), bool)
    for scan, pose in zip(scans, poses, strict=True):
        near = np.hypot(*(scan.points - scan.origins).T) <= model.max_range
        ends, laser = se2.transform(pose, scan.points[near]), se2.transform(pose, scan.origins[near][0])
        for end in ends:
            steps = int(np.ceil(np.abs((end - laser) / model.cell).max()))
            way = laser + (end - laser) * np.arange(steps - 1)[:, None] / steps
            free[tuple(np.floor((way - grid.origin) / model.cell).astype(int).T[::-1])] = True
        surface = []
        for one, other in itertools.pairwise(ends):
            length = np.hypot(*(other - one))
            count = int(np.ceil(length / half)) if length <= 0.3 else 1
            surface.append(one + (other - one) * np.arange(count)[:, None] / count)
        for px, py in np.concatenate([*surface, ends[-1:]]):
            part = tuple(np.floor(4.0 * ((px, py) - grid.origin) / half).astype(int))
            if part in counted:
                continue
            counted.add(part)
            # Up to five deviations, in whole cells, from the cell nearest to the point.
            reach = half * (np.ceil(5.0 * model.sigma / half) + 0.5)
            nearest_x, nearest_y = x[np.abs(x - px).argmin()], y[np.abs(y - py).argmin()]
            reached = (np.abs(x - nearest_x) < reach)[None] & (np.abs(y - nearest_y) < reach)[:, None]
            own = (x - px)[None] ** 2 + (y - py)[:, None] ** 2
            distance2 = np.where(reached, np.minimum(distance2, own), distance2)
    free = np.kron(free, np.ones((2, 2))) > 0.0
    near = np.exp(-0.5 * distance2 / model.sigma**2)
    away = np.where(free, 1.0 + (model.free_ratio - 1.0) * (1.0 - near**0.25), 1.0)
    values = np.log(away + (model.surface_ratio - away) * np.where(near >= 1e-3, near, 0.0))
    return np.where(~free & (distance2 > 14.0 * model.sigma**2), 0.0, values)


def test_the_log_ratios_are_those_of_distances_and_beams():
    model = GridModel(cell=0.1, sigma=0.08, surface_ratio=4.0, free_ratio=0.2, max_range=4.0)
    poses = np.array([[2.0, 2.0, 0.3], [3.1, 1.4, 2.9]])
    scans = [scan_in(ROOM, pose, beams=91, field_of_view=4.0, laser_pose=(0.2, -0.1, 0.4)) for pose in poses]
    grid = build_area_grid(scans, poses, model)
    np.testing.assert_allclose(grid.origin / model.cell, np.round(grid.origin / model.cell), atol=1e-9)
    expected = plain_log_ratios(scans, poses, model, grid)
    off = np.abs(grid.fine_log_ratio - expected) > 1e-4
    # Beams along the edge of a cell may be rounded to either side, and distances at the limit of the reach.
    assert off.mean() < 0.001
    ends = np.concatenate([se2.transform(pose, scan.points) for pose, scan in zip(poses, scans, strict=True)])
    ends = ends[np.hypot(*(ends - grid.points.mean(axis=0)).T) < 4.0]
    corner = grid.origin + model.cell * np.array(grid.free.shape[::-1])
    assert (grid.points.min(axis=0) - grid.origin >= 5.0 * model.sigma).all()
    assert (corner - grid.points.max(axis=0) >= 5.0 * model.sigma).all()
    assert (corner - grid.points.max(axis=0) <= 5.0 * model.sigma + 2.0 * model.cell + model.spacing).all()
