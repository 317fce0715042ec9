"""Keyframes of which nothing is known are found in the whole map, at any pose, or not at all."""

import numpy as np
import pytest
from test_process_tsbi_branching import OTHER, PATH, ROOM
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.topology.appearance import Looks
from hmt_slam_ros.topology.area_grid import GridModel
from hmt_slam_ros.topology.area_matching import MatchSettings
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.relocation import Relocation
from hmt_slam_ros.topology.surroundings import Nearness, Views

ASKED = se2.compose(np.array([3.6, 2.6, 2.5]), np.array([[0.3 * k, 0.0, 0.05 * k] for k in range(4)]))


def seen(walls, pose, keyframe):
    return scan_in(walls, pose, noise=0.01, seed=keyframe, field_of_view=2 * np.pi, beams=361)


@pytest.fixture
def asked():
    """Keyframes 0 to 11 in two rooms, areas 0 and 1, and 12 to 15 in the first of them."""
    hybrid_map, scans = HybridMap(), {}
    for area, walls in enumerate((ROOM, OTHER)):
        for k, pose in enumerate(PATH):
            scans[6 * area + k] = seen(walls, pose, 6 * area + k)
            hybrid_map.place(6 * area + k, area, se2.between(PATH[0], pose))
    scans |= {12 + k: seen(ROOM, pose, 12 + k) for k, pose in enumerate(ASKED)}
    views = Views(scans, GridModel(), Nearness(0.3, 6.0))
    poses = {12 + k: se2.between(ASKED[0], pose) for k, pose in enumerate(ASKED)}
    return Relocation(views, Looks(scans), MatchSettings(temper=0.3), 2.0), hybrid_map, poses, scans


def test_a_room_is_recognised_from_anywhere_in_it(asked):
    relocation, hybrid_map, poses, _ = asked
    located, unseen = relocation.located(hybrid_map, poses, 12, 1)
    assert located.area == 0
    assert unseen == pytest.approx(0.0)
    away = se2.between(se2.between(PATH[0], ASKED[0]), located.mode.pose.mean)
    assert np.hypot(away[0], away[1]) < 0.05
    assert abs(away[2]) < 0.02


def test_what_came_after_is_no_part_of_the_map(asked):
    relocation, hybrid_map, poses, _ = asked
    assert relocation.located(hybrid_map, poses, 0, 1) == (None, 1.0)
    for keyframe, pose in poses.items():
        hybrid_map.place(keyframe, 2, pose)
    assert relocation.located(hybrid_map, poses, 12, 2)[0].area == 0


def test_the_looks_share_the_probability_among_areas(asked):
    relocation, hybrid_map, poses, _ = asked
    shares = relocation.shares(hybrid_map, list(poses), 12)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares[0] > 0.6


def test_a_room_in_which_the_map_has_traces_of_people_is_recognised(asked):
    """They stand where the robot sees free space, which is no sign of another place."""
    relocation, hybrid_map, poses, scans = asked
    crowd = np.concatenate([box(x, y, x + 0.3, y + 0.3) for x in (0.8, 2.2, 4.3) for y in (0.9, 2.0, 3.4)])
    walls = np.concatenate((ROOM, crowd))
    for k, pose in enumerate(PATH):
        scans[20 + k] = seen(walls, pose, 20 + k)
        hybrid_map.place(20 + k, 0, se2.between(PATH[0], pose))
    found, areas = relocation.everywhere(hybrid_map, poses, 1000)
    assert sorted(areas) == [0, 1]
    best = max(found, key=lambda fit: fit.mode.log_mass)
    away = se2.between(se2.between(PATH[0], ASKED[0]), best.mode.pose.mean)
    assert best.area == 0
    assert np.hypot(away[0], away[1]) < 0.1


def test_all_areas_are_looked_at_however_many_there_are(asked):
    relocation, hybrid_map, poses, scans = asked
    for area in range(2, 24):
        for k, pose in enumerate(PATH):
            keyframe = 100 + 6 * area + k
            scans[keyframe] = seen(OTHER, pose, keyframe)
            hybrid_map.place(keyframe, area, se2.between(PATH[0], pose))
    found, areas = relocation.everywhere(hybrid_map, poses, 1000)
    assert sorted(areas) == list(range(24))
    assert max(found, key=lambda fit: fit.mode.log_mass).area == 0
