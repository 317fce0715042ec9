"""Known walls are met or passed by the beams of a scan; who is in the way passes none."""

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.registration.consistency import WALLS_OF_SUBMAP
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter

ROOM = box(-3.0, -2.0, 5.0, 2.0)
HERE = np.zeros(3)
ALL_ROUND = {"beams": 361, "field_of_view": 2.0 * np.pi}


@pytest.fixture(scope="module")
def room_filter():
    """A filter at the origin of a map of the room."""
    mapping = LocalMapping(Configuration())
    area_filter = ParticleFilter(mapping, 0, area=0)
    for k, x in enumerate((0.0, 1.5, 3.0)):
        area_filter.poses[:] = (x, 0.0, 0.0)
        area_filter.add_keyframe(k, scan_in(ROOM, np.array([x, 0.0, 0.0]), noise=0.01, seed=k, **ALL_ROUND))
    area_filter.poses[:] = HERE
    return area_filter


def count_evidence(area_filter, walls, pose=HERE, laser_pose=(0.0, 0.0, 0.0)):
    scan = scan_in(walls, pose, noise=0.01, seed=9, laser_pose=laser_pose, **ALL_ROUND)
    found = area_filter.compare_scan(PreparedScan(area_filter.mapping, scan)).walls
    return found, WALLS_OF_SUBMAP.log_likelihood_ratio(found, area_filter.clutter_estimate.wall_outliers.rate)


@pytest.mark.parametrize("laser_pose", [(0.0, 0.0, 0.0), (0.4, -0.3, 1.0)], ids=["amid", "mounted aside"])
def test_where_it_was_mapped_walls_are_met_and_none_is_passed(room_filter, laser_pose):
    found, log_ratio = count_evidence(room_filter, ROOM, laser_pose=laser_pose)
    assert found.on_surface > 80  # of 24 m of walls, a sample every 0.2 m
    assert found.in_free_space == 0
    assert log_ratio > 1.0


def test_people_in_the_way_pass_no_wall(room_filter):
    people = np.concatenate([ROOM, *(box(x, y, x + 0.4, y + 0.4) for x, y in ((1.0, 0.5), (-1.5, -1.2), (2.0, -1.0)))])
    found, log_ratio = count_evidence(room_filter, people)
    assert found.in_free_space == 0
    assert log_ratio > 0.5


def test_from_elsewhere_walls_are_passed(room_filter):
    found, log_ratio = count_evidence(room_filter, box(-2.0, -5.0, 3.0, 4.0))
    assert found.in_free_space > 30  # 8 m of each long wall, of which the corners are too near to the beams' ends
    assert log_ratio < -10.0


def test_a_door_that_was_opened_is_little(room_filter):
    doorway = np.array([[-3.0, 2.0, 0.0, 2.0], [0.9, 2.0, 5.0, 2.0]])
    found, log_ratio = count_evidence(
        room_filter, np.concatenate((ROOM[[0, 1, 3]], doorway, box(-1.0, 2.1, 2.0, 6.0)[1:]))
    )
    assert 2 <= found.in_free_space <= 5
    assert -4.0 < log_ratio < 0.0


@pytest.mark.parametrize("shift", [(0.03, -0.03, 0.0), (0.0, 0.05, 0.01), (0.1, 0.0, -0.01)])
def test_a_pose_that_is_a_little_off_passes_no_wall(room_filter, shift):
    assert count_evidence(room_filter, ROOM, pose=np.array(shift))[0].in_free_space == 0


def test_unknown_ground_has_no_information():
    area_filter = ParticleFilter(LocalMapping(Configuration()), 0, area=0)
    found, log_ratio = count_evidence(area_filter, ROOM)
    assert (found.on_surface, found.in_free_space, log_ratio) == (0, 0, 0.0)


def test_the_inconsistency_is_hits_in_free_space_and_passed_surfaces_less_the_usual(room_filter):
    scan = scan_in(box(-2.0, -5.0, 3.0, 4.0), HERE, noise=0.01, seed=9, **ALL_ROUND)
    found = room_filter.compare_scan(PreparedScan(room_filter.mapping, scan))
    first = room_filter.clutter_estimate.evaluate(found)
    assert first.log_evidence < -1.0  # the short walls stand in what was free
    assert first.log_kidnapping_ratio > 10.0 - first.log_evidence
    again = room_filter.clutter_estimate.update(found).evaluate(found)
    assert first.log_evidence < again.log_evidence < 0.0
    assert 0.0 < again.log_kidnapping_ratio < first.log_kidnapping_ratio
