"""Packed grids: a packed and unpacked grid has the same bits, and takes less memory."""

import numpy as np

from hmt_slam_ros.registration.likelihood_grid import GridModel, build_area_grid, build_coarse_grid
from hmt_slam_ros.registration.packed_grid import pack_log_ratio_grid, pack_ratios
from hmt_slam_ros.sensors import Scan

SCANS = [Scan(0, np.linspace(2.0, 9.0, 361, dtype=np.float32), -3.0, 0.017, 0.1, 20.0)]
POSES = np.array([[0.5, -0.2, 0.3]])


def test_an_area_grid_is_the_same_after_packing():
    grid = build_area_grid(SCANS, POSES, GridModel())
    packed = grid.pack()
    again = packed.unpack()
    assert (again.cell, again.nbytes) == (grid.cell, grid.nbytes)
    for name in ("origin", "log_ratio", "fine_log_ratio", "free", "points"):
        one, two = getattr(grid, name), getattr(again, name)
        assert (one.dtype, one.shape, one.tobytes()) == (two.dtype, two.shape, two.tobytes())
    ratios = packed.fine_log_ratio
    assert ratios.known.nbytes + ratios.others.nbytes + ratios.values.nbytes < 0.5 * grid.fine_log_ratio.nbytes


def test_a_grid_of_nothing_is_the_same_after_packing():
    grid = build_area_grid([], np.zeros((0, 3)), GridModel())
    again = grid.pack().unpack()
    assert again.fine_log_ratio.shape == grid.fine_log_ratio.shape
    assert again.log_ratio.shape == grid.log_ratio.shape
    assert not again.free.any()


def test_a_coarse_grid_is_the_same_after_packing():
    grid = build_coarse_grid(SCANS, POSES, GridModel())
    again = pack_log_ratio_grid(grid).unpack()
    assert again.log_ratio.tobytes() == grid.log_ratio.tobytes()
    assert again.origin is grid.origin
    assert again.cell == grid.cell


def test_zeros_of_either_sign_stay_as_they_are():
    ratios = np.array([[0.0, -0.0, 1.0], [-2.0, 0.5, -0.0]], dtype=np.float32)
    assert pack_ratios(ratios).unpack().tobytes() == ratios.tobytes()
