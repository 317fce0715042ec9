"""Ray casting against brute force, and fast enough for what it is for."""

import time

import numpy as np
import pytest

from hmt_slam_ros.simulation.building import furniture_walls
from hmt_slam_ros.simulation.laser import cast_rays, clearance, has_line_of_sight, shorten_at_discs, wall_index


def brute_force(walls, origins, angles, reach):
    """Distance of every beam to every wall, and the smallest: shape (n,)."""
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    offset, along = walls[:, :2] - origins[:, None], walls[:, 2:] - walls[:, :2]
    cross = directions[:, None, 0] * along[None, :, 1] - directions[:, None, 1] * along[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (offset[..., 0] * along[None, :, 1] - offset[..., 1] * along[None, :, 0]) / cross
        share = (offset[..., 0] * directions[:, None, 1] - offset[..., 1] * directions[:, None, 0]) / cross
    met = (distance >= 0.0) & (share >= -1e-9) & (share <= 1.0 + 1e-9) & (distance <= reach)
    return np.where(met, distance, np.inf).min(axis=1)


@pytest.mark.parametrize("cell", [0.4, 1.0, 5.0])
@pytest.mark.parametrize("whole", [False, True], ids=["anywhere", "on the grid's own lines"])
def test_every_beam_ends_where_brute_force_says_from_inside_and_from_outside(cell, whole):
    random = np.random.default_rng(7)
    for _ in range(10):
        walls, origins = random.uniform(-10.0, 10.0, (40, 4)), random.uniform(-15.0, 15.0, (400, 2))
        angles = random.uniform(-7.0, 7.0, 400)
        if whole:
            walls, origins[::2] = np.round(walls), np.round(origins[::2])
            angles[::3] = 0.25 * np.pi * np.round(angles[::3] / (0.25 * np.pi))
        index = wall_index(walls, cell)
        np.testing.assert_allclose(
            cast_rays(index, origins, angles, 9.0), brute_force(walls, origins, angles, 9.0), rtol=0.0, atol=1e-9
        )


def test_nothing_is_met_beyond_reach_or_where_there_is_nothing():
    index = wall_index(np.array([[4.0, -1.0, 4.0, 1.0]]))
    origin, ahead = np.zeros((1, 2)), np.zeros(1)
    assert cast_rays(index, origin, ahead, 3.9)[0] == np.inf
    assert cast_rays(index, origin, ahead, 4.1)[0] == 4.0
    assert cast_rays(index, origin, ahead + np.pi, 4.1)[0] == np.inf


def test_no_beam_slips_out_of_a_room_through_its_corners():
    corners = furniture_walls(np.array([[1.3, -0.7, 0.3, 5.0, 4.0]]))
    index = wall_index(corners)
    inside = np.array([1.0, -0.5])
    targets = corners[:, :2] - inside
    angles = np.arctan2(targets[:, 1], targets[:, 0])
    nearly = np.concatenate([angles + offset for offset in (-1e-15, 0.0, 1e-15, 3e-16, -3e-16)])
    found = cast_rays(index, np.tile(inside, (nearly.size, 1)), nearly, 50.0)
    np.testing.assert_allclose(found, np.tile(np.hypot(*targets.T), 5), atol=1e-6)


def test_discs_stand_before_walls_and_cover_what_geometry_says():
    angles = np.linspace(-0.5, 0.5, 10001)
    distances = np.full(angles.size, 6.0)
    discs = np.array([[3.0, 0.0, 0.4], [9.0, 0.0, 1.0], [-3.0, 0.0, 1.0]])
    shorten_at_discs(discs, np.zeros((angles.size, 2)), angles, distances)
    assert distances.min() == pytest.approx(2.6)
    covered = angles[distances < 6.0]
    assert covered.max() == pytest.approx(np.arcsin(0.4 / 3.0), abs=2e-4)
    assert covered.min() == pytest.approx(-np.arcsin(0.4 / 3.0), abs=2e-4)


def test_sight_ends_at_a_wall_and_clearance_is_the_distance_to_the_nearest():
    walls = np.array([[0.0, -1.0, 0.0, 1.0], [5.0, 0.0, 6.0, 0.0]])
    starts, ends = np.array([[-1.0, 0.0], [-1.0, 0.0], [-1.0, 2.0]]), np.array([[1.0, 0.0], [-0.1, 0.5], [1.0, 2.0]])
    assert has_line_of_sight(wall_index(walls), starts, ends).tolist() == [False, True, True]
    points = np.array([[-1.0, 0.0], [0.0, 3.0], [7.0, 0.0], [5.5, -0.25]])
    assert clearance(walls, points).tolist() == pytest.approx([1.0, 2.0, 1.0, 0.25])


def test_casting_is_far_more_than_twenty_times_as_fast_as_a_laser_of_361_beams_at_10_hz():
    random = np.random.default_rng(1)
    pieces = np.stack([*random.uniform(-20, 20, (2, 100)), *random.uniform(0.2, 2.0, (3, 100))], axis=1)
    index = wall_index(furniture_walls(np.concatenate((pieces, [[0.0, 0.0, 0.0, 44.0, 44.0]]))))
    origins, angles = np.zeros((361, 2)), np.linspace(-0.5 * np.pi, 0.5 * np.pi, 361)
    cast_rays(index, origins, angles, 30.0)
    begin = time.process_time()
    for _ in range(200):
        cast_rays(index, origins, angles, 30.0)
    assert 200 / (time.process_time() - begin) > 5.0 * 20.0 * 10.0
