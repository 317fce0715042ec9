"""Corners and openings that scans show."""

import numpy as np
import pytest
from worlds import box, scan_at, scan_in

from benchmark.landmark_truth import Surroundings
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.beam_labels import rays_from_scan
from hmt_slam_ros.landmarks.corners import extract_corners
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_lines
from hmt_slam_ros.landmarks.openings import extract_openings
from hmt_slam_ros.simulation import open_simulated

NOISE = 0.01
FEATURES = FeatureParameters(range_deviation=NOISE)
ROOM = box(-3, -2, 5, 4)
# A hallway of 2 m with a door of 1 m to a room on the left, and at its end another hallway to the right.
HALLWAY = np.array(
    [
        [-6, -1, 4, -1],
        [4, -1, 4, -6],
        [6, -6, 6, 1],
        [6, 1, 2.5, 1],
        [2.5, 1, 2.5, 1.2],
        [2.5, 1.2, 4, 1.2],
        [4, 1.2, 4, 5],
        [4, 5, -1, 5],
        [-1, 5, -1, 1.2],
        [-1, 1.2, 1.5, 1.2],
        [1.5, 1.2, 1.5, 1],
        [1.5, 1, -6, 1],
        [-6, 1, -6, -1],
    ],
    dtype=float,
)


def corners_in(walls, pose, seed=0, beams=720):
    scan = scan_at(walls, pose, NOISE, np.random.default_rng(seed), beams)
    return extract_corners(extract_lines(scan, FEATURES), FEATURES)


def openings_in(walls, pose, seed=0, features=FEATURES):
    scan = scan_at(walls, pose, NOISE, np.random.default_rng(seed), 720)
    return extract_openings(extract_lines(scan, features), rays_from_scan(scan, features), features)


def by_place(poses, places):
    """The pose (3,) that is nearest to each place (n, 2)."""
    away = np.hypot(*(poses[None, :, :2] - np.asarray(places)[:, None]).transpose(2, 0, 1))
    return np.argmin(away, axis=1), away.min(axis=1)


def test_a_room_has_four_corners_that_open_towards_its_middle():
    pose = np.array([0.5, 0.3, 0.4])
    corners = corners_in(ROOM, pose)
    assert len(corners.poses) == 4
    assert not corners.convex.any()
    placed = se2.compose(pose, corners.poses)
    order, away = by_place(placed, [(-3, -2), (5, -2), (5, 4), (-3, 4)])
    assert away.max() < 0.02
    quarter = np.pi / 4
    np.testing.assert_allclose(placed[order, 2], [quarter, 3 * quarter, -3 * quarter, -quarter], atol=0.01)
    assert corners.confidences.min() > 0.99


def test_the_corner_of_a_pillar_points_at_the_robot():
    pillar = box(1.0, 1.0, 2.0, 2.0)
    corners = corners_in(np.concatenate((box(-9, -9, 9, 9), pillar)), (0.0, 0.0, 0.0))
    convex = corners.poses[corners.convex]
    assert len(convex) == 1
    np.testing.assert_allclose(convex[0], [1.0, 1.0, -0.75 * np.pi], atol=0.02)


def test_corners_are_as_far_off_as_stated():
    nees = []
    for seed in range(60):
        pose = np.array([np.sin(seed), 0.5 * np.cos(seed), 0.7 * seed])
        corners = corners_in(ROOM, pose, seed, beams=360)
        quarter = np.pi / 4
        true = se2.between(
            pose, np.array([[-3, -2, quarter], [5, -2, 3 * quarter], [5, 4, -3 * quarter], [-3, 4, -quarter]])
        )
        for k, nearest in enumerate(by_place(true, corners.poses[:, :2])[0]):
            error = se2.log(se2.between(corners.poses[k], true[nearest]))
            nees.append(error @ np.linalg.solve(corners.covariances[k], error))
    assert len(nees) > 200
    # Of 3 degrees of freedom; the corners of a scan share their lines.
    assert abs(np.mean(nees) - 3.0) < 0.6


def test_walls_that_end_before_they_meet_or_meet_at_another_angle_make_no_corner():
    apart = np.array([[2.0, -2.0, 2.0, 1.0], [1.5, 2.0, -3.0, 2.0]])
    assert not len(corners_in(apart, (0.0, 0.0, 0.0)).poses)
    slanted = np.array([[2.0, -2.0, 2.0, 2.0], [2.0, 2.0, -1.0, 4.5]])
    assert not len(corners_in(slanted, (0.0, 0.0, 0.0)).poses)


def test_confidence_grows_with_the_size():
    def corner(length):
        pieces = np.array([[-length, 0.0], [0.0, length]])
        covariances = np.tile(np.diag([1e-6, 1e-6]), (2, 1, 1))
        # Both walls end in (2, 2): x = 2 below it and y = 2 to its left.
        parameters = np.array([[0.0, 2.0], [0.5 * np.pi, 2.0]])
        lines = Lines(parameters, covariances, pieces + np.array([[2.0], [-2.0]]), np.arange(2), np.zeros(0, np.int32))
        return extract_corners(lines, FEATURES).confidences

    small, large = corner(0.2), corner(1.0)
    assert len(small) == len(large) == 1
    assert small[0] == pytest.approx(1.0 - np.exp(-1.0))
    assert large[0] == pytest.approx(1.0 - np.exp(-5.0))


def test_doors_and_hallways_to_the_side_are_openings():
    pose = np.array([2.8, -0.2, 0.1])
    openings = openings_in(HALLWAY, pose)
    placed = se2.compose(pose, openings.poses)
    (door, side), away = by_place(placed, [(2.0, 1.0), (5.0, -1.0)])
    assert away.max() < 0.05
    assert abs(placed[door, 2] - 0.5 * np.pi) < 0.01 and abs(placed[side, 2] + 0.5 * np.pi) < 0.01
    assert abs(openings.widths[door] - 1.0) < 0.05 and abs(openings.widths[side] - 2.0) < 0.05
    assert openings.confidences[[door, side]].min() > 0.7
    assert not np.any(np.delete(openings.confidences, [door, side]) > 0.5)


def test_from_within_a_room_its_door_is_an_opening():
    openings = openings_in(HALLWAY, (1.5, 3.0, 0.0))
    assert len(openings.poses) == 1
    np.testing.assert_allclose(openings.poses[0], [0.5, -1.8, -0.5 * np.pi], atol=0.03)
    assert abs(openings.widths[0] - 1.0) < 0.05


def test_a_niche_and_a_closed_door_are_no_openings():
    closed = np.concatenate((HALLWAY, [[1.5, 1.08, 2.5, 1.08]]))
    openings = openings_in(closed, (2.8, -0.2, 0.1))
    headings = openings.poses[:, 2] + 0.1
    assert not np.any(np.abs(se2.wrap(headings - 0.5 * np.pi)) < 0.3)
    deep = openings_in(closed, (2.8, -0.2, 0.1), features=FeatureParameters(range_deviation=NOISE, opening_max=1.5))
    assert not len(deep.poses)


def test_a_gap_beside_furniture_is_hardly_an_opening():
    """Between the end of a cupboard in the room and its wall."""
    cupboard = np.concatenate((HALLWAY, box(0.6, 3.4, 2.2, 3.8)))
    openings = openings_in(cupboard, (1.0, 2.3, 0.2))
    placed = se2.compose((1.0, 2.3, 0.2), openings.poses)
    beside = placed[:, 1] > 3.0
    assert beside.any()
    assert openings.confidences[beside].max() < 0.5
    (door,), away = by_place(placed, [(2.0, 1.2)])
    assert away.max() < 0.05 and openings.confidences[door] > 0.8


def test_openings_are_as_far_off_as_stated():
    nees = []
    for seed in range(40):
        pose = np.array([2.5 + 0.01 * seed, 0.2 * np.sin(seed), 0.3 * seed])
        openings = openings_in(HALLWAY, pose, seed)
        true = se2.between(pose, np.array([[2.0, 1.0, 0.5 * np.pi], [5.0, -1.0, -0.5 * np.pi]]))
        for truth, found, away in zip(true, *by_place(openings.poses, true[:, :2]), strict=True):
            assert away < 0.3
            error = se2.log(se2.between(openings.poses[found], truth))
            nees.append(error @ np.linalg.solve(openings.covariances[found], error))
    assert 1.0 < np.mean(nees) < 4.0


def test_nothing_is_found_in_nothing():
    scan = scan_in(ROOM, (0.0, 0.0, 0.0), beams=91)
    scan.ranges[:] = np.nan
    lines = extract_lines(scan, FEATURES)
    assert not len(extract_corners(lines, FEATURES).poses)
    assert not len(extract_openings(lines, rays_from_scan(scan, FEATURES), FEATURES).poses)


def test_the_truth_of_a_drive_has_the_doors_of_its_building():
    """Every door in sight, right before the robot, is a true opening of its width."""
    scenario = open_simulated("sim:office,seed=3,size=0.7").scenario
    doors, checked = scenario.building.doors.reshape(-1, 2, 2), 0
    for stamp in scenario.scan_stamps[100:600:25]:
        pose = scenario.true_poses(np.array([stamp]))[0]
        world = Surroundings(scenario, int(stamp), pose)
        truth = world.openings(FEATURES)
        local = se2.transform(se2.inverse(pose), doors.reshape(-1, 2)).reshape(-1, 2, 2)
        middles, widths = local.mean(axis=1), np.hypot(*(local[:, 1] - local[:, 0]).T)
        near = np.flatnonzero((np.hypot(*middles.T) < 2.0) & (np.hypot(*middles.T) > 0.6) & world.is_visible(middles))
        for k in near:
            away = np.hypot(*(truth.poses[:, :2] - middles[k]).T)
            assert away.min() < 0.12
            assert truth.kinds[np.argmin(away)] == pytest.approx(widths[k], abs=0.01)
            checked += 1
    assert checked > 5


def test_a_door_that_is_closed_at_a_later_visit_is_no_true_opening():
    """And those that are still open are the same as before."""
    before, after = (open_simulated(f"sim:office,seed=3,size=0.7,changed=1,visit={k}").scenario for k in (0, 1))
    doors, walls = before.building.doors, after.building.walls
    closed = (doors[:, None] == walls[None]).all(axis=2).any(axis=1)
    open_before, checked = 0, 0
    for stamp in before.scan_stamps[100:600:25]:
        pose = before.true_poses(np.array([stamp]))[0]
        local = se2.transform(se2.inverse(pose), doors.reshape(-1, 2)).reshape(-1, 2, 2).mean(axis=1)
        seen = [
            Surroundings(scenario, int(stamp), pose).openings(FEATURES).poses[:, :2] for scenario in (before, after)
        ]
        for k in np.flatnonzero(np.hypot(*local.T) < 4.0):
            there = [bool(np.any(np.hypot(*(places - local[k]).T) < 0.12)) for places in seen]
            checked, open_before = checked + closed[k], open_before + there[0]
            assert there[1] == (there[0] and not closed[k])
    assert checked > 5 and open_before > checked
