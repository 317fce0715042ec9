"""New ground that looks like known ground: what fits into places where it surely is not."""

import math

import numpy as np
import pytest
from worlds import box, drive, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.area_grid import GridModel, build_area_grid
from hmt_slam_ros.topology.area_matching import MatchSettings, match
from hmt_slam_ros.topology.chance import Elsewhere, log_chance

MODEL, SETTINGS = GridModel(), MatchSettings(temper=0.3)
ALIKE = 0.5
UNLIKE = math.log(1.0 - ALIKE)
PATH = drive((-4.0, 0.0), (4.0, 0.0))
ROOM = np.concatenate((box(-6.0, -3.0, 6.0, 4.0), box(1.0, 1.0, 2.5, 2.0), box(-5.0, -2.5, -4.0, -1.0)))


def corridor(seed):
    """A corridor of 40 m with a niche every few metres, each 0.2 m deep and 1 m wide, on both sides."""
    walls = []
    for side in (-1.0, 1.0):
        at, steps = -20.0, np.random.default_rng([seed, int(side) + 1]).uniform(2.0, 5.0, 30)
        for step in steps:
            y, deep = side, 1.2 * side
            walls += [[at, y, at + step, y], [at + step, y, at + step, deep]]
            walls += [[at + step, deep, at + step + 1.0, deep], [at + step + 1.0, deep, at + step + 1.0, y]]
            at += step + 1.0
    return np.array(walls)


def seen(walls, poses, seed):
    scans = [scan_in(walls, pose, noise=0.01, seed=seed + k) for k, pose in enumerate(poses)]
    return build_area_grid(scans, se2.between(poses[0], poses), MODEL)


def elsewhere(walls, seed):
    return Elsewhere(seen(walls, PATH, seed), se2.between(PATH[0], PATH[len(PATH) // 2]))


def evidence(query, walls, seed):
    """Of the query at the place where it would be if these were the same walls, known within 2 m."""
    prior = PoseGaussian(se2.between(PATH[0], PATH[6]), np.diag([2.0, 0.5, math.radians(3.0)]) ** 2)
    return match(query, seen(walls, PATH, seed), prior, SETTINGS).log_evidence


@pytest.mark.parametrize("seed", range(4))
def test_a_corridor_is_told_from_another_corridor_but_not_from_new_ground_that_is_one(seed):
    walls, others = corridor(seed), [corridor(100 + 10 * seed + k) for k in range(5)]
    query = seen(walls, PATH[6:11], 50)
    new = log_chance(query, [elsewhere(other, 200) for other in others[1:]], ALIKE, SETTINGS)
    assert evidence(query, walls, 300) > new + 3.0
    assert 10.0 < evidence(query, others[0], 300) < new + 3.0


def test_a_room_looks_like_no_corridor():
    query = seen(ROOM, PATH[6:11], 50)
    assert log_chance(query, [elsewhere(corridor(k), 200) for k in range(4)], ALIKE, SETTINGS) < UNLIKE + 1.0


def test_both_ways_through_a_corridor_look_alike():
    there, back = corridor(1), drive((4.0, 0.0), (1.5, 0.0))
    forth = log_chance(seen(corridor(2), PATH[6:11], 50), [elsewhere(there, 200)], ALIKE, SETTINGS)
    assert log_chance(seen(corridor(2), back, 50), [elsewhere(there, 200)], ALIKE, SETTINGS) > 0.5 * forth > 5.0


def test_where_nothing_is_known_elsewhere_new_ground_is_unknown_space():
    assert log_chance(seen(ROOM, PATH[:5], 0), [], ALIKE, SETTINGS) == 0.0
