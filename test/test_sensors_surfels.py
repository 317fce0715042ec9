"""The normals that a scan shows of what it sees."""

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.scan import extract_surfels, transform_surfels

REACH = 8.0
CORRIDOR = np.array([[-100.0, -1.1, 100.0, -1.1], [-100.0, 1.1, 100.0, 1.1]])
ROOM = box(-3, -2, 5, 4)


def world_surfels(walls, pose, stride=1, **settings):
    """Surfels in the world, of beams up to the reach."""
    scan = scan_in(walls, pose, **settings)
    near = np.hypot(*scan.points.T) < REACH
    return transform_surfels(
        np.asarray(pose, dtype=float), extract_surfels(scan.points[near], scan.origins[near], stride)
    )


def flat(found):
    return found[(found[:, 2:] != 0.0).any(axis=1)]


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (3.0, 0.5, 0.1), (-2.0, -0.4, 3.0)])
def test_all_points_of_a_corridor_face_across_it_also_those_that_beams_hardly_meet(pose):
    found = world_surfels(CORRIDOR, pose, beams=361, field_of_view=2 * np.pi)
    assert len(flat(found)) == len(found)
    np.testing.assert_allclose(np.abs(found[:, 3]), 1.0, atol=1e-6)


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_noise_turns_normals_neither_forwards_nor_backwards(noise):
    turns = []
    for seed in range(300):
        found = world_surfels(CORRIDOR, (0.0, 0.2 * np.sin(seed), 0.05), noise=noise, seed=seed)
        outward = found[:, 2] * np.sign(found[:, 3]) * np.sign(found[:, 1])
        turns.append(outward[np.abs(found[:, 0]) < 3.0].mean())
    # Total least squares would turn them by 0.0005 and 0.0045.
    assert abs(np.mean(turns)) < 0.0002 + noise**2


def test_the_error_of_a_point_is_not_that_of_its_normal():
    scan = scan_in(CORRIDOR, (0.0, 0.2, 0.05), beams=361, noise=0.01)
    near = np.hypot(*scan.points.T) < REACH
    points, origins = scan.points[near], scan.origins[near]
    before = extract_surfels(points, origins)
    points[100] *= 1.0001
    after = extract_surfels(points, origins)
    np.testing.assert_array_equal(after[100, 2:], before[100, 2:])
    assert (after[:, 2:] != before[:, 2:]).any()


def test_at_a_corner_each_point_belongs_to_its_own_wall():
    found = world_surfels(ROOM, (0.0, 0.0, 0.0), beams=721, field_of_view=2 * np.pi)
    x, _, normal_x, normal_y = found[np.hypot(found[:, 0] - 5.0, found[:, 1] - 4.0) < 0.4].T
    assert len(x) > 10
    on_x_wall = np.abs(x - 5.0) < 1e-5
    np.testing.assert_allclose(np.abs(normal_x[on_x_wall]), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.abs(normal_y[~on_x_wall]), 1.0, atol=1e-5)


def test_a_post_has_no_normal_and_stays():
    found = world_surfels(np.concatenate((ROOM, box(1.99, 0.99, 2.01, 1.01))), (0.0, 0.0, 0.0), beams=361)
    post = found[np.hypot(found[:, 0] - 2.0, found[:, 1] - 1.0) < 0.1]
    assert len(post)
    np.testing.assert_array_equal(post[:, 2:], 0.0)


def test_a_point_that_only_shows_where_a_shadow_ends_is_left_out():
    # A niche in the wall, of which a single beam sees the back, beside the edge that hides the rest.
    niche = np.array(
        [[-100, 1.1, 4.0, 1.1], [4.0, 1.1, 4.0, 1.3], [4.0, 1.3, 4.9, 1.3], [4.9, 1.3, 4.9, 1.1], [4.9, 1.1, 100, 1.1]],
        dtype=float,
    )
    walls = np.concatenate((CORRIDOR[:1], niche))
    scan = scan_in(walls, (0.0, 0.0, 0.0))
    backs = np.abs(scan.points[:, 1] - 1.3) < 1e-5
    assert backs.sum() == 1
    found = world_surfels(walls, (0.0, 0.0, 0.0))
    assert not (np.abs(found[:, 1] - 1.3) < 1e-5).any()


def test_thinning_leaves_the_normals_as_they_are():
    every, third = (world_surfels(ROOM, (0.0, 0.0, 0.3), stride, noise=0.01) for stride in (1, 3))
    places = {tuple(surfel[:2]): surfel for surfel in every}
    assert len(every) // 4 < len(third) <= -(-181 // 3)
    for surfel in third:
        np.testing.assert_array_equal(surfel, places[tuple(surfel[:2])])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_have_no_normals(count):
    points = np.array([[1.0, 0.0], [1.0, 0.01]])[:count]
    found = extract_surfels(points, np.zeros((count, 2)))
    assert found.shape == (count, 4)
    np.testing.assert_array_equal(found[:, 2:], 0.0)


def test_moved_surfels_turn_with_the_frame():
    found = world_surfels(ROOM, (0.0, 0.0, 0.0))
    there = transform_surfels(np.array([1.0, 2.0, np.pi / 2]), found)
    np.testing.assert_allclose(there[:, :2], se2.transform((1.0, 2.0, np.pi / 2), found[:, :2]))
    np.testing.assert_allclose(there[:, 2:], np.stack((-found[:, 3], found[:, 2]), axis=1), atol=1e-12)
