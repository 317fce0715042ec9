"""Samples of walls that beams hit and pass, on a map without a pool, so that kernels need not be compiled."""

import math

import numpy as np
import pytest
from plain_map import plain_view
from worlds import box

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.patches import FAR
from hmt_slam_ros.registration.consistency import count_hits_and_violations

KNOWN = (-4.0, -5.0, 8.0, 5.0), (-5.0, -4.0, 5.0, 8.0)
# Both sides of the wall across are free.
ACROSS = np.concatenate((box(-4.0, -5.0, 8.0, 5.0), np.array([[2.0, -2.5, 2.0, 2.5]])))


@pytest.fixture(scope="module", params=[False, True], ids=["along y", "along x"])
def across(request):
    """A function that counts the samples that beams hit and pass where the wall is at x = 2 m, or at y = 2 m."""
    swap = [1, 0] if request.param else [0, 1]
    view = plain_view(np.concatenate((ACROSS[:, swap], ACROSS[:, [2 + k for k in swap]]), axis=1), KNOWN[request.param])

    def count(ends, start=(0.0, 0.0), pose=(0.0, 0.0, 0.0)):
        points, laser = (se2.transform(se2.inverse(pose), np.asarray(each)[..., swap]) for each in (ends, start))
        return count_hits_and_violations(points, laser, np.array(pose), view, FAR // 5)

    return count


@pytest.mark.parametrize("spacing", [0.05, 0.25, 0.5])
@pytest.mark.parametrize(("start", "pose"), [((0.0, 0.0), (0.0, 0.0, 0.0)), ((0.5, -0.6), (-0.3, 0.4, 0.7))])
def test_beams_hit_or_pass_a_sample_of_a_wall_every_fifth_of_a_meter(across, spacing, start, pose):
    y = np.arange(-1.5, 1.5, spacing)
    on_wall, start = np.column_stack((np.full_like(y, 2.0), y)), np.array(start)
    stride = math.ceil(0.2 / spacing - 1e-9)
    expected = math.ceil(len(y) / stride)
    hit, passed = across(on_wall, start, pose)
    assert passed == 0
    assert hit == pytest.approx(expected, abs=1)  # cells are 0.05 m
    # Of the first sample that is passed there is none before it.
    hit, passed = across(start + 2.0 * (on_wall - start), start, pose)
    assert hit == 0
    assert passed == pytest.approx(expected - 1, abs=1 + 0.15 * expected)


def test_walls_that_are_passed_far_from_each_other_do_not_count(across):
    y = np.arange(-2.1, 2.2, 0.7)
    through = np.column_stack((np.full_like(y, 4.0), 2.0 * y))
    assert across(through) == (0, 0)
    assert across(0.5 * through) == (len(y), 0)


@pytest.mark.parametrize(("beyond", "is_passed"), [(-0.3, False), (0.25, False), (0.6, True), (1.5, True)])
def test_a_beam_passes_a_wall_if_it_ends_well_behind_it(across, beyond, is_passed):
    y = np.arange(-1.0, 1.0, 0.25)
    passed = across(np.column_stack((np.full_like(y, 2.0 + beyond), y * (1.0 + 0.5 * beyond))))[1]
    assert (passed >= len(y) - 2) if is_passed else passed == 0


@pytest.mark.parametrize("start", [(0.0, 3.5), (0.5, -4.0)])
def test_beams_beside_the_end_of_a_wall_pass_none(across, start):
    y = start[1] + np.arange(-0.4, 0.4, 0.1)
    ends = np.column_stack((np.full_like(y, 4.0), y))
    assert across(ends, start) == (0, 0)
    assert across(ends, start, pose=(1.0, -0.5, 0.4)) == (0, 0)


def test_a_beam_along_a_wall_passes_none(across):
    x = 2.0 + np.linspace(-0.12, 0.12, 9)
    assert across(np.column_stack((x, np.full(9, 4.0))), start=(2.0, -4.0)) == (0, 0)


def test_walls_one_behind_the_other_are_run_along_and_not_passed():
    walls = np.concatenate([np.array([[x, -2.5, x, 2.5]]) for x in (2.0, 2.3, 2.6, 2.9)])
    y = np.arange(-1.5, 1.5, 0.25)
    ends = np.column_stack((np.full_like(y, 5.0), y))
    for count, is_passed in ((1, True), (4, False)):
        view = plain_view(walls[:count], KNOWN[0])
        passed = count_hits_and_violations(ends, np.zeros(2), np.zeros(3), view, FAR // 5)[1]
        assert passed >= 4 if is_passed else passed == 0
