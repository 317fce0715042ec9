"""Keyframes are matched into the whole map, at any pose."""

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
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.registration.likelihood_grid import GridModel
from hmt_slam_ros.topological_inference import global_scan_matching
from hmt_slam_ros.topological_inference.global_scan_matching import FreeSpaceCheck, GlobalScanMatcher, region_around

REACH = 6.0
ASKED = se2.compose(np.array([3.6, 2.6, 2.5]), np.array([[0.3 * k, 0.0, 0.05 * k] for k in range(4)]))


def make_scan(walls, pose, keyframe):
    return scan_in(walls, pose, noise=0.01, seed=keyframe, field_of_view=2 * np.pi, beams=361)


@pytest.fixture
def query():
    """Keyframes 0 to 11 in two rooms, areas 0 and 1, and 12 to 15 in the first of them."""
    hybrid_map, scans = HybridMap(), {}
    for area, walls in enumerate((ROOM, OTHER)):
        for k, pose in enumerate(PATH):
            scans[6 * area + k] = make_scan(walls, pose, 6 * area + k)
            hybrid_map.set_keyframe(6 * area + k, area, se2.between(PATH[0], pose))
    scans |= {12 + k: make_scan(ROOM, pose, 12 + k) for k, pose in enumerate(ASKED)}
    poses = {12 + k: se2.between(ASKED[0], pose) for k, pose in enumerate(ASKED)}
    return hybrid_map, poses, scans


def make_matcher(scans):
    grid_cache = GridCache(scans, GridModel(), Neighborhood(0.3, REACH))
    return GlobalScanMatcher(grid_cache, FreeSpaceCheck(scans, Configuration()), MatchSettings(temper=0.3), 2.0, REACH)


@pytest.fixture
def match(query):
    """Matches the keyframes of ``query`` into areas of the map."""
    hybrid_map, poses, scans = query
    matcher = make_matcher(scans)
    return lambda areas: match_all(matcher, hybrid_map, poses, 1000, areas)


def match_all(matcher, hybrid_map, poses, before, areas):
    """The candidates in all regions of some areas, the first area's first."""
    found, unexamined = [], dict.fromkeys(areas, 1.0 / len(areas))
    while unexamined:
        best_share = max((fit.agreement.matched_share for fit in found), default=0.0)
        region = matcher.find_region(hybrid_map, before, unexamined)
        assert region.reference in region.own_areas
        matcher.prepare_region(hybrid_map, region, before, whole=True)
        match = matcher.match_region(hybrid_map, region, poses, before, best_share)
        assert match.work > 0
        found += match.candidates
        unexamined = {area: p for area, p in unexamined.items() if area not in region.own_areas}
    return found


def position_error(fit):
    difference = se2.between(se2.between(PATH[0], ASKED[0]), fit.mode.pose.mean)
    return np.hypot(difference[0], difference[1])


def test_a_room_is_recognized_from_anywhere_in_it(match):
    best = max(match([0, 1]), key=lambda fit: fit.mode.log_mass)
    assert best.area == 0
    assert position_error(best) < 0.05
    assert abs(se2.between(se2.between(PATH[0], ASKED[0]), best.mode.pose.mean)[2]) < 0.02


def test_later_keyframes_are_no_part_of_the_map(query):
    hybrid_map, poses, scans = query
    matcher = make_matcher(scans)
    for keyframe, pose in poses.items():
        hybrid_map.set_keyframe(keyframe, 2, pose)
    assert {fit.area for fit in match_all(matcher, hybrid_map, poses, 12, [0])} == {0}


def test_a_room_is_recognized_despite_traces_of_people_in_its_map(query, match):
    """They stand where the robot sees free space, which is no sign of another place."""
    hybrid_map, _, scans = query
    crowd = np.concatenate([box(x, y, x + 0.3, y + 0.3) for x in (0.8, 2.2, 4.3) for y in (0.9, 2.0, 3.4)])
    walls = np.concatenate((ROOM, crowd))
    for k, pose in enumerate(PATH):
        scans[20 + k] = make_scan(walls, pose, 20 + k)
        hybrid_map.set_keyframe(20 + k, 0, se2.between(PATH[0], pose))
    best = max(match([0, 1]), key=lambda fit: fit.mode.log_mass)
    assert best.area == 0
    assert position_error(best) < 0.1


def test_people_in_the_scans_do_not_count_against_a_place(query, match):
    """Two people stand elsewhere at every keyframe, where the others see through."""
    _, poses, scans = query
    for n, keyframe in enumerate(poses):
        people = [box(x, y, x + 0.4, y + 0.4) for x, y in ((0.6 + 1.1 * n, 0.6), (4.6 - 1.0 * n, 1.2))]
        scans[keyframe] = make_scan(np.concatenate((ROOM, *people)), ASKED[n], keyframe)
    best = max(match([0, 1]), key=lambda fit: fit.mode.log_mass)
    assert best.area == 0
    assert position_error(best) < 0.05
    assert best.agreement.in_free_space <= 1


def test_all_of_many_areas_are_searched(query, match):
    hybrid_map, _, scans = query
    for area in range(2, 24):
        for k, pose in enumerate(PATH):
            keyframe = 100 + 6 * area + k
            scans[keyframe] = make_scan(OTHER, pose, keyframe)
            hybrid_map.set_keyframe(keyframe, area, se2.between(PATH[0], pose))
    assert max(match(range(24)), key=lambda fit: fit.mode.log_mass).area == 0


def test_wrong_poses_violate_walls(query, match):
    """At the pose found, no beam passes a wall; half a meter aside, some would."""
    hybrid_map, poses, scans = query
    best = max(match([0]), key=lambda fit: fit.mode.log_mass)
    found, work = make_matcher(scans).check_walls(hybrid_map, best, poses, 1000)
    beams = sum(len(scans[k].points) for k in (*range(12), *poses) if k not in hybrid_map.keyframes(1))
    assert work == global_scan_matching._BEAM_WORK * beams
    assert found.on_surface > 100
    assert found.in_free_space == 0
    aside = PoseGaussian(best.mode.pose.mean + np.array([0.5, 0.5, 0.0]), best.mode.pose.covariance)
    moved = best._replace(mode=best.mode._replace(pose=aside))
    assert make_matcher(scans).check_walls(hybrid_map, moved, poses, 1000)[0].in_free_space > 20
    assert make_matcher(scans).check_walls(hybrid_map, best, poses, 0) == (Agreement(0, 0, 0), 0)


def test_only_the_given_areas_are_searched(match):
    assert {fit.area for fit in match([1])} <= {1}
    assert {fit.area for fit in match([0])} == {0}


def test_a_candidate_is_in_the_frame_of_its_area_anywhere_in_its_region(query, match):
    hybrid_map, _, scans = query
    for k, pose in enumerate(PATH):
        scans[30 + k] = make_scan(ROOM, pose, 30 + k)
        hybrid_map.set_keyframe(30 + k, 2, se2.between(PATH[0], pose))
    hybrid_map.set_arc(1, 2, PoseGaussian(np.array([1.0, -5.5, 2.0]), 1e-4 * np.eye(3)), closure=False)
    found = match([2])
    assert {fit.area for fit in found} == {2}
    assert position_error(max(found, key=lambda fit: fit.mode.log_mass)) < 0.05


@pytest.mark.parametrize(("deviation", "count"), [(0.05, 2), (3.0, 6)])
def test_areas_are_searched_together_where_they_lie_for_certain_beside_each_other(deviation, count):
    """Six areas in a row, 5 m apart: each belongs to one region, whose map reaches beyond it."""
    hybrid_map = HybridMap()
    for area in range(6):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
        if area:
            arc = PoseGaussian(np.array([5.0, 0.0, 0.0]), np.diag([deviation, deviation, 0.01]) ** 2)
            hybrid_map.set_arc(area - 1, area, arc, closure=False)
    found, unexamined = [], list(range(6))
    while unexamined:
        found.append(region_around(hybrid_map, unexamined[0], range(6), unexamined, 10.0))
        unexamined = [area for area in unexamined if area not in found[-1].own_areas]
    assert sorted(area for part in found for area in part.own_areas) == list(range(6))
    assert len(found) == count
    assert all(part.own_areas <= part.poses.keys() for part in found)
    if count == 2:
        assert found[0].poses.keys() == {0, 1, 2, 3, 4}


def test_a_later_region_needs_the_mean_log_ratio_of_a_share_0_15_below_the_best(match, monkeypatch):
    """A known surface makes a sample three times as likely; half of the samples have to be on one at least."""
    required, search = [], global_scan_matching.find_cells

    def record_search(query, candidate, points, prior, settings, *constraints):
        required.append(settings.min_log_ratio)
        return search(query, candidate, points, prior, settings, *constraints)

    monkeypatch.setattr(global_scan_matching, "find_cells", record_search)
    best_share = max(fit.agreement.matched_share for fit in match([0, 1]) if fit.area == 0)
    assert best_share > 0.9
    assert required == pytest.approx([0.5 * np.log(3.0), (best_share - 0.15) * np.log(3.0)])
