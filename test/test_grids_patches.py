"""Shared patches: the insertion of scans, and that maps never write into each other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from scipy.ndimage import distance_transform_edt
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.distance_field import lowest_bit
from hmt_slam_ros.grids.patch_pool import InverseSensorModel, MappedBeams, PatchPool
from hmt_slam_ros.grids.patches import FAR, PATCH, field_at, odds_at

CELL, RADIUS = 0.05, 0.5
MODEL = InverseSensorModel(17, -8, 70)


@pytest.fixture
def pool():
    return PatchPool(table_size=8, cell=CELL, radius=RADIUS)


@njit
def lowest(word):
    return lowest_bit(word)


def insert(pool, table, scan, pose=(0.0, 0.0, 0.0)):
    pool.insert(
        table[None], np.array([pose], dtype=float), MappedBeams(scan.points, np.empty((0, 2)), scan.origins), MODEL
    )


def dense(pool, table, read):
    edge = pool.table_size * PATCH
    view = pool.view(table)
    return np.array([[read(view, column, row) for column in range(edge)] for row in range(edge)])


@pytest.mark.parametrize("radius", [0.12, RADIUS, 1.93], ids=["two cells and a bit", "ten cells", "beyond a patch"])
def test_the_distance_field_equals_the_exact_distance_transform_after_walls_came_and_went(radius):
    pool = PatchPool(table_size=8, cell=CELL, radius=radius)
    table, went = pool.empty_table(), 0
    for k in range(12):
        before = dense(pool, table, odds_at) > 0
        walls = box(-3, -3, 3, 3) if k < 3 else box(-4, -4, 4, 4)
        insert(pool, table, scan_in(walls, (0.0, 0.0, 0.0), field_of_view=2 * np.pi), (0.1 * k, 0.03 * k, 0.3 * k))
        odds, field = dense(pool, table, odds_at), dense(pool, table, field_at)
        went += (before & (odds <= 0)).sum()
        exact = np.minimum(np.rint(distance_transform_edt(odds <= 0) * CELL / radius * FAR), FAR)
        np.testing.assert_array_equal(field, exact)
    assert went > 100


def test_the_most_patches_ever_in_use_are_on_record(pool):
    first, second = pool.empty_table(), pool.empty_table()
    scan = scan_in(box(-3, -4, 5, 4), (0.0, 0.0, 0.0))
    insert(pool, first, scan)
    alone = pool.peak_bytes
    assert alone == pool.patches_in_use * PATCH * (2 * PATCH + 4) > 0
    insert(pool, second, scan)
    pool.release(second)
    pool.release(first)
    insert(pool, pool.empty_table(), scan)
    assert pool.patches_in_use * PATCH * (2 * PATCH + 4) == alone
    assert pool.peak_bytes == 2 * alone


def test_odds_follow_from_the_cells_that_beams_pass_and_in_which_they_end(pool):
    table, expected = pool.empty_table(), np.zeros((8 * PATCH, 8 * PATCH), dtype=int)
    for k in range(8):
        pose = (0.1 * k + 0.013, 0.217, 0.3 * k)
        scan = scan_in(box(-3, -4, 5, 4), pose, noise=0.1, seed=k)
        insert(pool, table, scan, pose)
        hit, passed = np.zeros(expected.shape, dtype=bool), np.zeros(expected.shape, dtype=bool)
        origins = se2.transform(pose, scan.origins) / CELL + 4 * PATCH
        ends = se2.transform(pose, scan.points) / CELL + 4 * PATCH
        for origin, end in zip(origins, ends, strict=True):
            # The cells between two crossings of the grid's lines, from their middles.
            lines = [np.arange(np.ceil(min(a, b)), max(a, b)) for a, b in zip(origin, end, strict=True)]
            crossings = [(line - a) / (b - a) for line, a, b in zip(lines, origin, end, strict=True)]
            shares = np.sort(np.concatenate(([0.0], *crossings)))
            middles = origin + 0.5 * (shares[:-1] + shares[1:])[:, None] * (end - origin)
            passed[tuple(np.floor(middles).astype(int)[:, ::-1].T)] = True
            hit[tuple(np.floor(end).astype(int)[::-1])] = True
        change = np.where(hit, MODEL.hit, np.where(passed, MODEL.miss, 0))
        expected = np.clip(expected + change, -MODEL.limit, MODEL.limit)
        np.testing.assert_array_equal(dense(pool, table, odds_at), expected)


@given(st.integers(1, 2**32 - 1))
def test_the_lowest_bit_of_a_word_is_found(word):
    assert lowest(np.uint32(word)) == f"{word:b}"[::-1].index("1")


def test_a_wall_is_occupied_the_room_is_free_and_what_lies_behind_is_unknown(pool):
    table = pool.empty_table()
    insert(pool, table, scan_in(box(-3.02, -3.02, 3.02, 3.02), (0, 0, 0), beams=721, field_of_view=2 * np.pi))
    view, half = pool.view(table), 4 * PATCH
    assert odds_at(view, half + int(3.0 / CELL), half) > 0
    assert odds_at(view, half + int(2.0 / CELL), half + 3) < 0
    assert odds_at(view, half + int(3.5 / CELL), half) == 0


def test_a_cell_counts_once_per_scan_however_many_beams_pass_it(pool):
    table = pool.empty_table()
    insert(pool, table, scan_in(box(-3, -3, 3, 3), (0, 0, 0), beams=721, field_of_view=2 * np.pi))
    assert odds_at(pool.view(table), 4 * PATCH + 1, 4 * PATCH + 1) == MODEL.miss


def test_each_beam_frees_the_cells_from_its_own_origin(pool):
    table = pool.empty_table()
    origins = np.array([[0.01, 0.01], [0.01, 1.01]])
    pool.insert(
        table[None], np.zeros((1, 3)), MappedBeams(origins + np.array([2.0, 0.0]), np.empty((0, 2)), origins), MODEL
    )
    odds = dense(pool, table, odds_at)
    assert sorted(set(np.nonzero(odds < 0)[0])) == [4 * PATCH, 4 * PATCH + 20]
    assert (odds < 0).sum() == 80
    assert (odds > 0).sum() == 2


def test_a_shared_map_keeps_its_content_when_its_twin_is_written_to(pool):
    table = pool.empty_table()
    insert(pool, table, scan_in(box(-3, -3, 3, 3), (0, 0, 0)))
    twin = pool.share(table)
    used = pool.patches_in_use
    before = dense(pool, table, odds_at), dense(pool, table, field_at)
    insert(pool, twin, scan_in(box(-2, -2, 2, 2), (0, 0, 0)))
    np.testing.assert_array_equal(dense(pool, table, odds_at), before[0])
    np.testing.assert_array_equal(dense(pool, table, field_at), before[1])
    assert (dense(pool, twin, odds_at) != before[0]).any()
    assert used < pool.patches_in_use <= 2 * used


def test_released_maps_leave_no_patch_behind(pool):
    table = pool.empty_table()
    insert(pool, table, scan_in(box(-3, -3, 3, 3), (0, 0, 0)))
    twin = pool.share(table)
    insert(pool, twin, scan_in(box(-2, -2, 2, 2), (0, 0, 0)))
    pool.release(table)
    assert pool.patches_in_use > 0
    pool.release(twin)
    assert pool.patches_in_use == 0


def test_a_patch_used_again_starts_empty(pool):
    table = pool.empty_table()
    insert(pool, table, scan_in(box(-3, -3, 3, 3), (0, 0, 0)))
    pool.release(table)
    other = pool.empty_table()
    insert(pool, other, scan_in(box(-1, -1, 1, 1), (0, 0, 0), field_of_view=2 * np.pi))
    occupied = np.argwhere(dense(pool, other, odds_at) > 0)
    assert np.abs(occupied - 4 * PATCH).max() <= int(1.0 / CELL) + 1


def test_a_scan_without_a_return_changes_nothing(pool):
    table = pool.empty_table()
    insert(pool, table, scan_in(np.full((1, 4), 99.0), (0, 0, 0)))
    assert pool.patches_in_use == 0


def test_a_scan_that_leaves_the_map_is_cut_off_there(pool):
    table = pool.empty_table()
    insert(pool, table, scan_in(box(-20, -20, 20, 20), (0, 0, 0), field_of_view=2 * np.pi))
    assert (dense(pool, table, odds_at) > 0).sum() == 0
    assert (dense(pool, table, odds_at) < 0).sum() > 1000


def test_the_laser_stands_where_its_mounting_puts_it(pool):
    table = pool.empty_table()
    insert(pool, table, scan_in(box(-3, -3, 3, 3), (0, 0, 0), laser_pose=(0.5, 0.2, 0.4)))
    occupied = (np.argwhere(dense(pool, table, odds_at) > 0)[:, ::-1] - 4 * PATCH + 0.5) * CELL
    assert np.abs(np.abs(occupied).max(axis=1) - 3.0).max() <= CELL
