"""What contradicts: surfaces where the map knows free space."""

import numpy as np
import pytest
from worlds import box, drive, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration.consistency import MAP_IN_MAP, MAPS_OUTLIER_RATE, SCAN_IN_SUBMAP, Agreement, OutlierRate
from hmt_slam_ros.registration.likelihood_grid import GridModel, build_area_grid

ROOM = box(-4.0, -3.0, 4.0, 3.0)
PATH = drive((-2.0, 0.0), (2.0, 0.0))


def grid(walls, poses, seed):
    scans = [scan_in(walls, pose, noise=0.01, seed=seed + k) for k, pose in enumerate(poses)]
    return build_area_grid(scans, se2.between(poses[0], poses), GridModel())


@pytest.mark.parametrize("model", [MAP_IN_MAP, SCAN_IN_SUBMAP])
@pytest.mark.parametrize("usual", [0.001, MAPS_OUTLIER_RATE, 0.03, 0.1])
@pytest.mark.parametrize("samples", [100, 400])
def test_the_ratio_falls_with_every_contradiction(model, usual, samples):
    found = [model.log_likelihood_ratio(Agreement(samples, samples - free, free), usual) for free in range(samples + 1)]
    assert (np.diff(found) < 0.0).all()
    assert found[0] > 0.0 > found[samples // 4]


@pytest.mark.parametrize("model", [MAP_IN_MAP, SCAN_IN_SUBMAP])
def test_what_nothing_is_known_of_has_no_information(model):
    assert model.log_likelihood_ratio(Agreement(300, 0, 0), 0.01) == 0.0


def test_where_clutter_is_usual_the_same_contradictions_tell_less():
    found = Agreement(200, 190, 10)
    assert SCAN_IN_SUBMAP.log_likelihood_ratio(found, 0.05) > SCAN_IN_SUBMAP.log_likelihood_ratio(found, 0.005)


def test_what_is_usual_is_learnt_in_the_course_of_the_scans():
    usual = OutlierRate()
    assert 0.005 < usual.rate < 0.01
    for _ in range(300):
        usual = usual.update(Agreement(200, 190, 10), SCAN_IN_SUBMAP.correlated_samples)
    assert usual.rate == pytest.approx(0.05, rel=0.05)


def test_a_room_agrees_with_itself_and_a_pillar_that_was_not_there_contradicts():
    known = grid(ROOM, PATH, 0)
    same = known.compare(grid(ROOM, PATH, 50).points, np.zeros(3))
    assert same.in_free_space == 0
    assert same.matched_share > 0.98
    pillar = grid(np.concatenate((ROOM, box(1.0, 1.0, 2.0, 2.0))), PATH, 50)
    other = known.compare(pillar.points, np.zeros(3))
    assert other.in_free_space >= 5
    assert other.matched_share < same.matched_share


def test_points_outside_of_the_map_neither_agree_nor_contradict():
    found = grid(ROOM, PATH, 0).compare(np.array([[100.0, 0.0], [-80.0, 3.0]]), np.zeros(3))
    assert found == Agreement(2, 0, 0)
