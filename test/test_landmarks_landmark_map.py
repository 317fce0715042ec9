"""Landmarks that a scan should show, and the map of those of an area."""

import numpy as np
import pytest
from worlds import box, scan_at

from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.landmarks.beam_labels import rays_from_scan
from hmt_slam_ros.landmarks.landmark_map import LandmarkMap, scatter_ratio
from hmt_slam_ros.landmarks.landmarks import (
    CONCAVE_CORNER,
    CONVEX_CORNER,
    OPENING,
    extract_landmarks,
    should_be_visible,
)
from hmt_slam_ros.landmarks.line_extraction import extract_lines

NOISE = 0.01
FEATURES = FeatureParameters(range_deviation=NOISE)
ROOM, PILLAR = box(-3, -2, 5, 4), box(2.0, 1.0, 3.0, 2.0)
# Below the room a hallway, and a door of 1 m to it.
DOOR = np.array(
    [
        [-3, -2, 0.5, -2],
        [1.5, -2, 5, -2],
        [0.5, -2, 0.5, -2.2],
        [1.5, -2, 1.5, -2.2],
        [-3, -2.2, 0.5, -2.2],
        [1.5, -2.2, 5, -2.2],
        [-3, -4.5, 5, -4.5],
        [5, -2, 5, 4],
        [5, 4, -3, 4],
        [-3, 4, -3, -2],
    ],
    dtype=float,
)
PLACES = [np.array([0.1 * k, 0.05 * k, 0.3 * k]) for k in range(8)]


def extract_shown(walls, pose, seed=0):
    scan = scan_at(walls, pose, NOISE, np.random.default_rng(seed), 720)
    rays = rays_from_scan(scan, FEATURES)
    return extract_landmarks(extract_lines(scan, FEATURES), rays, FEATURES), rays


def gather_landmarks(found, walls, places, first=0):
    for k, pose in enumerate(places):
        found.observe(PoseGaussian(pose, np.diag([0.01, 0.01, 0.002]) ** 2), *extract_shown(walls, pose, first + k))
    return found


def of_kind(found, kind):
    return [one for one in found.landmarks if one.kind == kind]


def is_due(walls, pose, kind, landmark, width=0.0):
    rays = extract_shown(walls, pose)[1]
    local = se2.between(np.asarray(pose, dtype=float), np.array([landmark], dtype=float))
    return bool(should_be_visible(np.array([kind]), local, np.array([width]), rays, FEATURES)[0])


def test_a_corner_should_be_seen_where_both_its_walls_are_in_sight():
    corner = (5.0, 4.0, -0.75 * np.pi)
    assert is_due(ROOM, (2.0, 1.5, 0.0), CONCAVE_CORNER, corner)
    assert not is_due(ROOM, (0.0, 0.0, 0.0), CONCAVE_CORNER, corner)
    screen = np.array([[4.0, 3.9, 4.0, 1.0]])
    assert not is_due(np.concatenate((ROOM, screen)), (2.0, 1.5, 0.0), CONCAVE_CORNER, corner)


def test_the_corner_of_a_pillar_should_be_seen_from_before_it_alone():
    corner = (2.0, 1.0, -0.75 * np.pi)
    walls = np.concatenate((ROOM, PILLAR))
    assert is_due(walls, (0.0, -0.5, 0.3), CONVEX_CORNER, corner)
    assert not is_due(walls, (4.0, 3.0, 0.3), CONVEX_CORNER, corner)
    # Where the pillar was, beams pass: it should be seen, and is not.
    assert is_due(ROOM, (0.0, -0.5, 0.3), CONVEX_CORNER, corner)


def test_a_corner_is_gone_where_beams_pass_one_of_its_walls():
    corner, walls, beside = (2.0, 1.0, -0.75 * np.pi), np.concatenate((ROOM, PILLAR)), (0.0, 2.0, 0.3)
    assert not is_due(walls, beside, CONVEX_CORNER, corner)
    assert is_due(ROOM, beside, CONVEX_CORNER, corner)


def test_an_opening_should_be_seen_from_before_it_open_or_closed():
    opening = (1.0, -2.0, -0.5 * np.pi)
    closed = np.concatenate((DOOR, [[0.5, -2.0, 1.5, -2.0]]))
    assert is_due(DOOR, (0.5, 0.5, 0.0), OPENING, opening, 1.0)
    assert is_due(closed, (0.5, 0.5, 0.0), OPENING, opening, 1.0)
    assert not is_due(DOOR, (0.5, -3.5, 0.0), OPENING, opening, 1.0)
    cupboard = np.concatenate((DOOR, box(0.0, -1.5, 2.0, -0.5)))
    assert not is_due(cupboard, (0.5, 0.5, 0.0), OPENING, opening, 1.0)


def test_who_stands_before_an_opening_closes_none():
    opening = (1.0, -2.0, -0.5 * np.pi)
    person = np.concatenate((DOOR, box(1.3, -1.6, 1.8, -1.3)))
    # The gap is in sight, and so is one jamb.
    assert not is_due(person, (0.8, 0.5, 0.0), OPENING, opening, 1.0)
    assert is_due(np.concatenate((person, [[0.5, -2.0, 1.5, -2.0]])), (0.8, 0.5, 0.0), OPENING, opening, 1.0)


def test_what_many_scans_show_is_one_landmark_each():
    inner = of_kind(gather_landmarks(LandmarkMap(FEATURES), ROOM, PLACES), CONCAVE_CORNER)
    assert len(inner) == 4
    outer = of_kind(gather_landmarks(LandmarkMap(FEATURES), np.concatenate((ROOM, PILLAR)), PLACES), CONVEX_CORNER)
    places = np.array([one.pose.mean[:2] for one in inner])
    away = np.hypot(*(places[None] - np.array([(-3, -2), (5, -2), (5, 4), (-3, 4)])[:, None]).transpose(2, 0, 1))
    assert away.min(axis=1).max() < 0.03
    assert any(np.hypot(*(one.pose.mean[:2] - (2.0, 1.0))) < 0.03 for one in outer)
    assert min(one.existence.probability for one in inner) > 0.9


def test_what_scans_have_in_common_makes_no_landmark_more_certain():
    """Covariance intersection: of like observations the covariance stays that of one."""
    certain = [
        np.trace(
            of_kind(gather_landmarks(LandmarkMap(FEATURES), ROOM, [PLACES[0]] * count), CONCAVE_CORNER)[
                0
            ].pose.covariance
        )
        for count in (1, 10)
    ]
    assert certain[1] == pytest.approx(certain[0], rel=0.2)


def test_a_door_has_its_width_and_is_gone_when_it_was_closed():
    found = gather_landmarks(LandmarkMap(FEATURES), DOOR, PLACES)
    (door,) = of_kind(found, OPENING)
    np.testing.assert_allclose(door.pose.mean, [1.0, -2.0, -0.5 * np.pi], atol=0.05)
    assert door.width == pytest.approx(1.0, abs=0.05)
    assert door.existence.probability > 0.9
    gather_landmarks(found, np.concatenate((DOOR, [[0.5, -2.0, 1.5, -2.0]])), PLACES, first=20)
    assert not of_kind(found, OPENING)
    assert len(of_kind(found, CONCAVE_CORNER)) >= 4


def test_what_is_hidden_is_not_missed():
    found = gather_landmarks(LandmarkMap(FEATURES), DOOR, PLACES)
    (before,) = of_kind(found, OPENING)
    gather_landmarks(found, np.concatenate((DOOR, box(-0.5, -1.8, 2.5, -0.8))), PLACES, first=20)
    (after,) = (one for one in of_kind(found, OPENING) if one.pose is before.pose)
    assert after.existence == before.existence


@pytest.mark.parametrize(("off", "low", "high"), [(0.0, 0.0, 0.005), (0.04, 0.02, 0.08)])
def test_where_a_door_is_follows_from_how_far_its_sightings_are_apart(off, low, high):
    found, rng = LandmarkMap(FEATURES), np.random.default_rng(3)
    stated = np.diag([0.02, 0.02, 0.005]) ** 2
    for k in range(12):
        believed = np.array([0.8, -0.5, 0.0]) + off * np.array([*rng.normal(size=2), 0.0])
        found.observe(PoseGaussian(believed, stated), *extract_shown(DOOR, np.array([0.8, -0.5, 0.0]), k))
    (door,) = of_kind(found, OPENING)
    assert door.existence.detections >= 10
    across = np.sqrt(door.pose_from_scatter(scatter_ratio(found.landmarks)).covariance[0, 0])
    assert low < across < high
    assert np.sqrt(door.pose.covariance[0, 0]) == pytest.approx(0.02, abs=0.002)


def test_errors_of_scans_average_out_those_of_their_places_do_not():
    found = LandmarkMap(FEATURES)
    for k in range(8):
        found.observe(PoseGaussian(np.zeros(3), np.diag([0.02, 0.02, 0.005]) ** 2), *extract_shown(DOOR, PLACES[0], k))
    (door,) = of_kind(found, OPENING)
    stated = door.pose_from_scatter(8.0 * np.eye(3) - door.scatter).covariance
    across, along = np.sqrt(np.diag(stated)[:2] / np.diag(door.pose.covariance)[:2])
    assert across == pytest.approx(1.0, abs=0.02)
    assert along < 0.95


def test_the_scatter_of_sightings_that_are_vague_in_different_ways_is_one_of_squares():
    found = LandmarkMap(FEATURES)
    for k, (x, y) in enumerate([(0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, -0.1), (-0.1, 0.1)]):
        aslant = np.array([1.0, 1.0 if k % 2 else -1.0, 0.0]) * 0.2
        stated = np.outer(aslant, aslant) + np.diag([0.02, 0.02, 0.01]) ** 2
        look = extract_shown(DOOR, np.array([0.8, -0.5, 0.0]), k)
        found.observe(PoseGaussian(np.array([0.8 + x, -0.5 + y, 0.0]), stated), *look)
    for door in of_kind(found, OPENING):
        assert np.linalg.eigvalsh(door.scatter).min() > -1e-9
        assert np.linalg.eigvalsh(door.pose_from_scatter(scatter_ratio(found.landmarks)).covariance).min() > 0.0
    assert max(door.existence.detections for door in of_kind(found, OPENING)) > 2
