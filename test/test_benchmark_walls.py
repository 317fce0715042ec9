"""Maps that close are distinguished from torn ones, without any truth."""

import numpy as np
import pytest
from worlds import box, scan_in

from benchmark.scoring import judge_walls
from hmt_slam_ros.geometry import se2

ROUND = 24  # poses of one round, a meter apart


@pytest.fixture(scope="module")
def ring():
    """Scans and poses of two rounds through a corridor around a block."""
    walls = np.concatenate([box(0, 0, 10, 10), box(3, 3, 7, 7), box(4.8, 0, 5.3, 0.4), box(9.5, 6, 10, 6.7)])
    corners = np.array([[1.5, 1.5], [8.5, 1.5], [8.5, 8.5], [1.5, 8.5]])
    sides = np.linspace(0.0, 1.0, ROUND // 4, endpoint=False)[:, None]
    ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    round_trip = np.concatenate([a + sides * (b - a) for a, b in ends])
    headings = np.repeat(np.arange(4) * np.pi / 2, ROUND // 4)
    poses = np.tile(np.column_stack([round_trip, headings]), (2, 1))
    scans = [scan_in(walls, pose, noise=0.01, seed=k) for k, pose in enumerate(poses)]
    return scans, poses


def test_a_second_round_that_fits_the_first_is_not_torn(ring):
    scans, poses = ring
    walls = judge_walls(scans, poses)
    assert len(walls.stretches) >= 2
    assert walls.torn_stretches == []
    assert walls.agreement > 0.8


@pytest.mark.parametrize("shift", [(0.4, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.06), (2.5, 0.0, 0.3)])
def test_a_second_round_beside_the_first_is_torn(ring, shift):
    scans, poses = ring
    second = np.arange(len(poses)) >= ROUND
    moved = np.where(second[:, None], se2.compose(np.array(shift), poses), poses)
    walls = judge_walls(scans, moved)
    assert walls.torn_stretches
    assert walls.agreement < 0.6


def test_the_way_back_to_where_a_torn_stretch_fits_is_reported(ring):
    scans, poses = ring
    moved = poses + np.where(np.arange(len(poses)) >= ROUND, 0.4, 0.0)[:, None] * [1.0, 0.0, 0.0]
    (worst, *_) = sorted(judge_walls(scans, moved).torn_stretches, key=lambda stretch: -stretch.gain)
    assert worst.shift == pytest.approx(0.4, abs=0.11)


def test_new_ground_is_not_scored(ring):
    scans, poses = ring
    walls = judge_walls(scans[:ROUND], poses[:ROUND])
    assert walls.stretches == ()
    assert np.isnan(walls.agreement)
