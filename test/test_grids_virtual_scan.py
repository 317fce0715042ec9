"""A scan all around that is cast in a local map."""

import numpy as np
import pytest
from worlds import box, distances, scan_in

from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.virtual_scan import cast_virtual_scan
from hmt_slam_ros.landmarks.line_extraction import extract_map_lines
from hmt_slam_ros.landmarks.rays import rays_from_virtual_scan
from hmt_slam_ros.submap.local_mapping import LocalMapping

ROOM = box(-3.02, -2.01, 5.03, 4.02)
EYE = np.array([0.7, 0.4, 0.3])


def view_of(poses, walls=ROOM):
    """A local map of scans of half a circle."""
    mapping = LocalMapping(Configuration())
    table = mapping.pool.empty_table()
    for n, pose in enumerate(poses):
        scan = scan_in(walls, pose, beams=361, noise=0.01, seed=n)
        mapping.insert_scan(table[None], np.array(pose, dtype=float)[None], scan)
    return mapping.pool.view(table)


@pytest.fixture(scope="module")
def room():
    """All of a room."""
    return view_of([(x, 0.5, turn) for x in (-1.0, 0.0, 1.0, 2.0) for turn in (0.0, 1.5, 3.0, 4.5)])


@pytest.mark.parametrize("beams", [360, 720])
def test_ranges_are_those_of_a_laser_all_around(room, beams):
    virtual = cast_virtual_scan(room, EYE, beams, 10.0)
    angles = virtual.scan.angle_min + virtual.scan.angle_increment * np.arange(beams)
    true = distances(ROOM, EYE, angles)
    assert virtual.scan.valid.mean() > 0.99
    seen = virtual.scan.valid
    # Across the surface, where a map errs.
    across = (virtual.scan.ranges - true)[seen] * virtual.incidence_cosine[seen]
    assert np.abs(np.mean(across)) < 0.01
    assert np.quantile(np.abs(across), 0.95) < 0.05
    np.testing.assert_array_equal(virtual.free_range[seen].astype(np.float32), virtual.scan.ranges[seen])


def test_beams_face_a_surface_as_it_stands(room):
    virtual = cast_virtual_scan(room, EYE, 720, 10.0)
    angles = virtual.scan.angle_min + virtual.scan.angle_increment * np.arange(720)
    near = 2e-3
    first, second = (distances(ROOM, EYE, angles + turn) for turn in (-near, near))
    ends = [
        r[:, None] * np.stack((np.cos(angles + turn), np.sin(angles + turn)), axis=1)
        for r, turn in ((first, -near), (second, near))
    ]
    along = ends[1] - ends[0]
    along /= np.linalg.norm(along, axis=1)[:, None]
    facing = np.abs(np.cos(angles) * along[:, 1] - np.sin(angles) * along[:, 0])
    smooth = np.abs(first - second) < 0.1
    assert np.median(np.abs(virtual.incidence_cosine - facing)[smooth]) < 0.05


def test_what_was_not_seen_is_unknown_and_what_is_out_of_reach_is_free(room):
    half = view_of([(0.0, 0.5, 0.0)])
    virtual = cast_virtual_scan(half, np.array([1.0, 0.5, 0.0]), 360, 10.0)
    angles = virtual.scan.angle_min + virtual.scan.angle_increment * np.arange(360)
    behind = np.cos(angles) < -0.5
    unknown = np.isnan(virtual.scan.ranges) & (virtual.free_range < 10.0)
    assert unknown[behind].all()
    # Far away one scan leaves holes in a wall.
    assert unknown[np.cos(angles) > 0.5].mean() < 0.1
    assert virtual.free_range[behind].max() < 2.5
    short = cast_virtual_scan(room, EYE, 360, 1.0)
    assert not short.scan.valid.any()
    np.testing.assert_array_equal(short.free_range, 1.0)


def test_who_walked_by_is_not_met(room):
    """A person before the wall ends beams once and lets them pass at all other times."""
    person = box(2.0, 0.9, 2.3, 1.2)
    poses = [(0.0, 0.5, 0.0)] * 8
    mapping = LocalMapping(Configuration())
    table = mapping.pool.empty_table()
    for n, pose in enumerate(poses):
        walls = np.concatenate((ROOM, person)) if n == 0 else ROOM
        mapping.insert_scan(table[None], np.array(pose)[None], scan_in(walls, pose, beams=361, noise=0.01, seed=n))
    virtual = cast_virtual_scan(mapping.pool.view(table), np.array([0.0, 0.5, 0.0]), 360, 10.0)
    ahead = virtual.scan.valid & (np.abs(virtual.scan.angle_min + virtual.scan.angle_increment * np.arange(360)) < 0.5)
    assert np.nanmin(virtual.scan.ranges[ahead]) > 4.5


def test_lines_of_a_map_are_its_walls(room):
    features = FeatureParameters()
    lines = extract_map_lines(cast_virtual_scan(room, EYE, 720, 10.0), features)
    normals = lines.parameters[:, 0] + EYE[2]
    r = lines.parameters[:, 1] + np.cos(normals) * EYE[0] + np.sin(normals) * EYE[1]
    found = sorted(zip(np.round(np.degrees(se2.wrap(normals)) / 90.0) % 4, r, strict=True))
    assert len(found) == 4
    np.testing.assert_allclose([place for _, place in found], [5.03, 4.02, 3.02, 2.01], atol=0.03)
    deviations = np.sqrt(lines.covariances[:, 1, 1])
    assert (deviations > features.map_deviation / 2.0).all()


def test_beams_into_the_unknown_are_free_up_to_there():
    virtual = cast_virtual_scan(view_of([(0.0, 0.5, 0.0)]), np.array([1.0, 0.5, 0.0]), 360, 10.0)
    rays = rays_from_virtual_scan(virtual, FeatureParameters())
    assert len(rays.free_range) == 360
    np.testing.assert_array_equal(rays.hit, virtual.scan.valid)
    np.testing.assert_allclose(np.hypot(*rays.directions.T), 1.0)
