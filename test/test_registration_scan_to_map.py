"""Scan matching: compiled kernels against plain ones, and poses against the truth."""

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.patch_pool import InverseSensorModel, MappedBeams, PatchPool
from hmt_slam_ros.grids.patches import FAR
from hmt_slam_ros.registration.scan_to_map import (
    AlignmentSettings,
    Prior,
    align,
    count_agreement,
    make_beam_model,
    propose_all,
)
from hmt_slam_ros.sensors.scan import extract_surfels

CELL, RADIUS = 0.05, 0.5
MODEL = make_beam_model(RADIUS, 0.1, 10.0, 0.1)
ALIGNMENT = AlignmentSettings(0.1, 0.15, 1.0, 30)
ROOM = np.concatenate((box(-4.02, -3.03, 5.03, 4.01), box(1.01, 1.02, 2.03, 2.52), box(-3.02, 2.03, -2.52, 4.01)))
CORRIDOR = np.array([[-100.0, -1.22, 100.0, -1.22], [-100.0, 1.22, 100.0, 1.22]])


def make_map(walls, poses, beams=721, field_of_view=2 * np.pi):
    pool = PatchPool(20, CELL, RADIUS)
    table = pool.empty_table()
    for pose in poses:
        scan = scan_in(walls, pose, beams=beams, field_of_view=field_of_view)
        near = np.hypot(*scan.points.T) < 12.0
        mapped_beams = MappedBeams(scan.points[near], np.empty((0, 2)), scan.origins[near])
        pool.insert(table[None], np.array([pose], dtype=float), mapped_beams, InverseSensorModel(17, -8, 70))
    return pool, table


def scan_surfels(walls, pose, **settings):
    """The surfels of a scan."""
    scan = scan_in(walls, pose, **settings)
    return extract_surfels(scan.points, scan.origins)


@pytest.fixture(scope="module")
def room():
    pool, table = make_map(ROOM, [(0, 0, 0), (-1, 0.5, 1), (3, -1, 2)])
    return pool.view(table)


def test_unknown_space_has_no_information_and_known_free_space_contradicts():
    assert MODEL.in_unknown[FAR] == pytest.approx(0.0, abs=1e-3)
    assert MODEL.in_known[FAR] == pytest.approx(np.log(0.1), abs=0.01)
    assert MODEL.in_unknown[0] == pytest.approx(MODEL.in_known[0], abs=0.05)
    assert MODEL.in_known[0] > 3.0


@pytest.mark.parametrize("offset", [(0.1, -0.05, 0.03), (-0.15, 0.1, -0.05), (0.0, 0.2, 0.0)])
def test_gauss_newton_finds_the_true_pose_to_a_third_of_a_cell(room, offset):
    truth = np.array([0.5, -0.4, 0.7])
    points = scan_surfels(ROOM, truth, beams=361, noise=0.01)
    start = se2.compose(truth, offset)
    pose, information = align(points, start, Prior(start, np.diag([1.0, 1.0, 1.0])), room, ALIGNMENT)
    assert np.abs(pose - truth)[:2].max() < CELL / 3
    assert abs(pose[2] - truth[2]) < np.radians(0.2)
    assert np.linalg.eigvalsh(information)[0] > 1e3


def test_without_points_the_prior_stands(room):
    prior = Prior(np.array([0.3, 0.2, 0.1]), np.diag([4.0, 5.0, 6.0]))
    pose, information = align(np.empty((0, 4)), np.zeros(3), prior, room, ALIGNMENT)
    np.testing.assert_allclose(pose, prior.mean, atol=1e-12)
    np.testing.assert_array_equal(information, 0.0)


def propose(pool, table, points, truth, deviations):
    information = np.diag(1.0 / np.asarray(deviations) ** 2)
    return propose_all(
        points,
        points,
        truth[None],
        truth[None],
        information,
        table[None],
        pool.view(table),
        ALIGNMENT,
        MODEL,
        1.0,
        0.05,
    )


def test_in_a_corridor_the_proposal_keeps_the_prior_along_it_and_is_sharp_across():
    pool, table = make_map(CORRIDOR, [(x, 0, 0) for x in range(-6, 7)], beams=2881)
    truth = np.array([0.0, 0.1, 0.0])
    near = scan_surfels(CORRIDOR, truth, beams=361, field_of_view=2 * np.pi)
    drawn = propose(pool, table, near[np.hypot(near[:, 0], near[:, 1]) < 5.0], truth, (0.2, 0.2, 0.05))
    along, across = np.sqrt(np.diag(drawn.covariances[0])[:2])
    assert along == pytest.approx(0.2, rel=0.02)
    assert across < 0.02


def test_along_a_corridor_whose_far_walls_are_a_few_cells_a_pose_stays_where_odometry_has_it():
    pool, table = make_map(CORRIDOR, [(0.0, 0.1, 0.05)], beams=361)
    prior = Prior(np.array([0.5, 0.1, 0.05]), np.diag([1.0 / 0.05**2, 1.0 / 0.05**2, 1.0 / 0.01**2]))
    pose, information = align(
        scan_surfels(CORRIDOR, prior.mean, beams=361), prior.mean, prior, pool.view(table), ALIGNMENT
    )
    assert np.abs(pose - prior.mean).max() < 1e-3
    assert information[0, 0] < 0.02 * prior.information[0, 0]


def test_points_without_normals_are_refused(room):
    with pytest.raises(ValueError, match="surfels"):
        align(np.ones((3, 2)), np.zeros(3), Prior(np.zeros(3), np.eye(3)), room, ALIGNMENT)


def test_evidence_is_zero_in_unknown_space_positive_in_the_right_place_and_negative_in_a_wrong_one():
    pool, table = make_map(ROOM, [(0, 0, 0), (-1, 0.5, 1), (3, -1, 2)])
    points = scan_surfels(ROOM, (0, 0, 0))
    deviations = (0.05, 0.05, 0.02)
    empty = pool.empty_table()
    assert propose(pool, empty, points, np.zeros(3), deviations).evidences[0] == pytest.approx(0.0, abs=0.1)
    assert propose(pool, table, points, np.zeros(3), deviations).evidences[0] > 10.0
    wrong = scan_surfels(box(-1.5, -1.5, 1.5, 1.5), (0, 0, 0))
    assert propose(pool, table, wrong, np.zeros(3), deviations).evidences[0] < -3.0


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["right", "left"])
def test_a_point_on_the_edge_of_what_beams_passed_contradicts_nothing_and_one_amid_it_does(quarters, side):
    # Sees from straight ahead to one side: whatever stands on the line ahead is grazed.
    ahead = 0.5 * np.pi * quarters
    pool, table = make_map(box(-9.0, -9.0, 9.0, 9.0), [(0.0, 0.0, ahead + side * np.pi / 4)], field_of_view=np.pi / 2)
    along = np.column_stack((np.arange(2.0, 7.0, 0.2), np.zeros(25)))
    for aside, free in ((0.02, 0), (0.08, 0), (0.5, 25)):
        points = along + np.array([0.0, side * aside])
        agreement = count_agreement(points, np.array([0.0, 0.0, ahead]), pool.view(table), FAR // 3, FAR // 2)
        assert agreement == (0, free)
