"""Hallway or room, of the free space around a robot and of an area."""

import numpy as np
import pytest
from worlds import box, drive, scan_at, scan_in

from benchmark.heading import depth_in_rooms
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.landmarks.area_classes import (
    AreaClassifier,
    FreeSpace,
    classify_area,
    decide_hallway,
    hallway_log_odds,
    measure_free_space,
    min_hallway_length,
)
from hmt_slam_ros.landmarks.beam_labels import rays_from_scan
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.submap.local_mapping import LocalMapping

FEATURES = FeatureParameters()
HALLWAY, ROOM = box(-12, -1, 12, 1), box(-2.5, -2, 2.5, 2)
THIN, WIDE = FreeSpace(2.0, 15.0), FreeSpace(4.5, 6.0)


@pytest.mark.parametrize("heading", [0.0, 0.4, 1.3])
def test_a_space_is_as_wide_as_its_shortest_chord_and_as_long_as_all_but_a_few(heading):
    hallway = measure_free_space(rays_from_scan(scan_at(HALLWAY, (0.3, 0.2, heading), beams=720), FEATURES))
    assert hallway.width == pytest.approx(2.0, abs=0.02)
    # All but three of 36 axes: those within 7.5 degrees of the hallway's, and from half a sector's width less on.
    assert 2.0 / np.sin(np.radians(11.0)) < hallway.length < 2.0 / np.sin(np.radians(4.0))
    room = measure_free_space(rays_from_scan(scan_at(ROOM, (0.3, 0.2, heading), beams=720), FEATURES))
    assert room.width == pytest.approx(4.0, abs=0.05)
    assert 5.0 < room.length < np.hypot(5.0, 4.0)


def test_what_is_seen_through_a_door_makes_no_room_longer():
    door, behind = 0.9, box(2.5, -8, 12, 8)
    with_door = [wall for wall in ROOM.tolist() if wall[0] != 2.5 or wall[2] != 2.5]
    with_door += [[2.5, -2.0, 2.5, -0.5 * door], [2.5, 0.5 * door, 2.5, 2.0]]
    behind = [wall for wall in behind.tolist() if wall[0] != 2.5 or wall[2] != 2.5]
    pose = (-1.6, 0.3, 0.0)
    closed = measure_free_space(rays_from_scan(scan_at(ROOM, pose, beams=720), FEATURES))
    opened = measure_free_space(rays_from_scan(scan_at(np.array(with_door + behind), pose, beams=720), FEATURES))
    assert opened.width == pytest.approx(closed.width, abs=0.02)
    assert opened.length < 1.15 * closed.length
    assert hallway_log_odds(opened, FEATURES) < -3.0


def test_half_a_circle_has_no_information():
    assert measure_free_space(rays_from_scan(scan_in(ROOM, (0.0, 0.0, 0.0), beams=181), FEATURES)) is None


def test_thin_and_long_is_a_hallway():
    assert hallway_log_odds(THIN, FEATURES) > 3.0
    assert hallway_log_odds(WIDE, FEATURES) < -3.0
    longer, wider = THIN._replace(length=20.0), FreeSpace(2.5, 15.0)
    assert hallway_log_odds(wider, FEATURES) < hallway_log_odds(THIN, FEATURES) < hallway_log_odds(longer, FEATURES)


@pytest.mark.parametrize("width", [1.2, 2.0, 4.5])
def test_from_the_shortest_length_on_a_space_is_a_hallway(width):
    shortest = min_hallway_length(width, FEATURES)
    assert hallway_log_odds(FreeSpace(width, shortest), FEATURES) == pytest.approx(0.0, abs=1e-9)
    assert min_hallway_length(2.5, FEATURES) > min_hallway_length(2.0, FEATURES)


def test_one_keyframe_of_another_kind_does_not_change_an_area():
    assert classify_area([THIN], FEATURES).is_hallway
    assert classify_area([THIN] * 5 + [WIDE], FEATURES).is_hallway
    assert not classify_area([WIDE] * 5 + [THIN], FEATURES).is_hallway
    assert not classify_area([THIN] + [WIDE] * 5, FEATURES).is_hallway
    assert classify_area([THIN, WIDE] * 3, FEATURES).probability == pytest.approx(
        1.0 / (1.0 + np.exp(-0.5 * (hallway_log_odds(THIN, FEATURES) + hallway_log_odds(WIDE, FEATURES))))
    )
    with pytest.raises(ValueError, match="keyframe"):
        classify_area([], FEATURES)


def test_what_an_area_is_taken_for_changes_only_where_that_is_clear():
    assert decide_hallway(None, 0.6, FEATURES) and not decide_hallway(None, 0.4, FEATURES)
    assert decide_hallway(True, 0.4, FEATURES) and not decide_hallway(False, 0.6, FEATURES)
    assert not decide_hallway(True, 0.2, FEATURES) and decide_hallway(False, 0.8, FEATURES)


@pytest.mark.parametrize(("walls", "hallway"), [(HALLWAY, True), (ROOM, False)])
def test_a_stored_area_is_distinguished_from_scans_of_half_a_circle(walls, hallway):
    poses = drive((-1.5, 0.2), (1.5, 0.2), (-1.5, 0.2))
    scans = [scan_in(walls, pose, beams=361, noise=0.015, seed=k) for k, pose in enumerate(poses)]
    kinds = AreaClassifier(LocalMapping(Configuration()))
    found = kinds.classify(scans, poses)
    assert found.is_hallway is hallway
    assert (found.probability > 0.9) if hallway else (found.probability < 0.1)
    assert kinds.classify(scans, poses) == found
    assert kinds.classify([], np.zeros((0, 3))) is None


def test_rooms_of_a_building_hold_its_furniture_and_no_way_in_a_corridor():
    scenario = open_simulated("sim:office,seed=4,size=0.7").scenario
    building = scenario.building
    assert len(building.rooms) == len(building.doors) > 5
    pieces = building.furniture[:, :3]
    assert depth_in_rooms(scenario, pieces).min() > 0.0
    doors = np.pad(building.doors.reshape(-1, 2, 2).mean(axis=1), ((0, 0), (0, 1)))
    assert np.abs(depth_in_rooms(scenario, doors) + 0.1).max() < 1e-6
