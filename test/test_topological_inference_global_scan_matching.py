"""Keyframes of which the arcs have no information are laid into the whole map, at any pose."""

import numpy as np
import pytest
from test_topological_inference_branching import OTHER, PATH, ROOM
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import GridCache, Neighborhood
from hmt_slam_ros.registration.area_to_area import MatchSettings
from hmt_slam_ros.registration.likelihood_grid import GridModel
from hmt_slam_ros.topological_inference.global_scan_matching import FreeSpaceCheck, GlobalScanMatcher, regions

REACH = 6.0
ASKED = se2.compose(np.array([3.6, 2.6, 2.5]), np.array([[0.3 * k, 0.0, 0.05 * k] for k in range(4)]))


def make_scan(walls, pose, keyframe):
    return scan_in(walls, pose, noise=0.01, seed=keyframe, field_of_view=2 * np.pi, beams=361)


@pytest.fixture
def two_rooms():
    """Keyframes 0 to 11 in two rooms, areas 0 and 1, and 12 to 15 in the first of them."""
    hybrid_map, scans = HybridMap(), {}
    for area, walls in enumerate((ROOM, OTHER)):
        for k, pose in enumerate(PATH):
            scans[6 * area + k] = make_scan(walls, pose, 6 * area + k)
            hybrid_map.set_keyframe(6 * area + k, area, se2.between(PATH[0], pose))
    scans |= {12 + k: make_scan(ROOM, pose, 12 + k) for k, pose in enumerate(ASKED)}
    poses = {12 + k: se2.between(ASKED[0], pose) for k, pose in enumerate(ASKED)}
    return hybrid_map, poses, scans


def whole_map(scans):
    views = GridCache(scans, GridModel(), Neighborhood(0.3, REACH))
    return GlobalScanMatcher(views, FreeSpaceCheck(scans, Configuration()), MatchSettings(temper=0.3), 2.0, REACH)


@pytest.fixture
def match_areas(two_rooms):
    """Lays the keyframes of ``two_rooms`` into areas of the map."""
    hybrid_map, poses, scans = two_rooms
    whole = whole_map(scans)
    return lambda areas: whole.match_regions(hybrid_map, poses, 1000, dict.fromkeys(areas, 1.0 / len(areas)))


def fit_error(fit):
    away = se2.between(se2.between(PATH[0], ASKED[0]), fit.mode.pose.mean)
    return np.hypot(away[0], away[1])


def test_a_room_is_recognized_from_anywhere_in_it(match_areas):
    best = max(match_areas([0, 1]), key=lambda fit: fit.mode.log_mass)
    assert best.area == 0
    assert fit_error(best) < 0.05
    assert abs(se2.between(se2.between(PATH[0], ASKED[0]), best.mode.pose.mean)[2]) < 0.02


def test_what_came_after_is_no_part_of_the_map(two_rooms):
    hybrid_map, poses, scans = two_rooms
    whole = whole_map(scans)
    assert whole.match_regions(hybrid_map, poses, 0, {0: 1.0}) == []
    for keyframe, pose in poses.items():
        hybrid_map.set_keyframe(keyframe, 2, pose)
    assert {fit.area for fit in whole.match_regions(hybrid_map, poses, 12, {0: 0.5, 2: 0.5})} == {0}


def test_a_room_in_which_the_map_has_traces_of_people_is_recognized(two_rooms, match_areas):
    """They stand where the robot sees free space, which is no sign of another place."""
    hybrid_map, _, scans = two_rooms
    crowd = np.concatenate([box(x, y, x + 0.3, y + 0.3) for x in (0.8, 2.2, 4.3) for y in (0.9, 2.0, 3.4)])
    walls = np.concatenate((ROOM, crowd))
    for k, pose in enumerate(PATH):
        scans[20 + k] = make_scan(walls, pose, 20 + k)
        hybrid_map.set_keyframe(20 + k, 0, se2.between(PATH[0], pose))
    best = max(match_areas([0, 1]), key=lambda fit: fit.mode.log_mass)
    assert best.area == 0
    assert fit_error(best) < 0.1


def test_who_walks_through_what_the_robot_sees_speaks_against_no_place(two_rooms, match_areas):
    """Two people stand elsewhere at every keyframe, where the others see through."""
    _, poses, scans = two_rooms
    for n, keyframe in enumerate(poses):
        people = [box(x, y, x + 0.4, y + 0.4) for x, y in ((0.6 + 1.1 * n, 0.6), (4.6 - 1.0 * n, 1.2))]
        scans[keyframe] = make_scan(np.concatenate((ROOM, *people)), ASKED[n], keyframe)
    best = max(match_areas([0, 1]), key=lambda fit: fit.mode.log_mass)
    assert best.area == 0
    assert fit_error(best) < 0.05
    assert best.agreement.in_free_space <= 1


def test_all_areas_are_looked_at_however_many_there_are(two_rooms, match_areas):
    hybrid_map, _, scans = two_rooms
    for area in range(2, 24):
        for k, pose in enumerate(PATH):
            keyframe = 100 + 6 * area + k
            scans[keyframe] = make_scan(OTHER, pose, keyframe)
            hybrid_map.set_keyframe(keyframe, area, se2.between(PATH[0], pose))
    assert max(match_areas(range(24)), key=lambda fit: fit.mode.log_mass).area == 0


def test_walls_tell_where_keyframes_lie(two_rooms, match_areas):
    """As they were found, no wall is seen through; half a meter aside, the robot would see through some."""
    hybrid_map, poses, scans = two_rooms
    best = max(match_areas([0]), key=lambda fit: fit.mode.log_mass)
    found = whole_map(scans).check_walls(hybrid_map, best, poses, 1000)
    assert found.on_surface > 100
    assert found.in_free_space == 0
    aside = PoseGaussian(best.mode.pose.mean + np.array([0.5, 0.5, 0.0]), best.mode.pose.covariance)
    moved = best._replace(mode=best.mode._replace(pose=aside))
    assert whole_map(scans).check_walls(hybrid_map, moved, poses, 1000).in_free_space > 20
    assert whole_map(scans).check_walls(hybrid_map, best, poses, 0).samples == 0


def test_none_but_the_areas_requested_are_looked_at(match_areas):
    assert {fit.area for fit in match_areas([1])} <= {1}
    assert {fit.area for fit in match_areas([0])} == {0}


def test_a_fit_is_reported_in_the_frame_of_its_area_wherever_that_lies_in_its_region(two_rooms, match_areas):
    hybrid_map, _, scans = two_rooms
    for k, pose in enumerate(PATH):
        scans[30 + k] = make_scan(ROOM, pose, 30 + k)
        hybrid_map.set_keyframe(30 + k, 2, se2.between(PATH[0], pose))
    hybrid_map.set_arc(1, 2, PoseGaussian(np.array([1.0, -5.5, 2.0]), 1e-4 * np.eye(3)), closure=False)
    found = match_areas([2])
    assert {fit.area for fit in found} == {2}
    assert fit_error(max(found, key=lambda fit: fit.mode.log_mass)) < 0.05


@pytest.mark.parametrize(("deviation", "count"), [(0.05, 2), (3.0, 6)])
def test_areas_are_searched_together_where_they_lie_for_certain_beside_each_other(deviation, count):
    """Six areas in a row, 5 m apart: each belongs to one region, whose map reaches beyond it."""
    hybrid_map = HybridMap()
    for area in range(6):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
        if area:
            arc = PoseGaussian(np.array([5.0, 0.0, 0.0]), np.diag([deviation, deviation, 0.01]) ** 2)
            hybrid_map.set_arc(area - 1, area, arc, closure=False)
    found = regions(hybrid_map, range(6), 10.0)
    assert sorted(area for part in found for area in part.own_areas) == list(range(6))
    assert len(found) == count
    assert all(part.own_areas <= part.poses.keys() for part in found)
    if count == 2:
        assert found[0].poses.keys() == {0, 1, 2, 3, 4}
