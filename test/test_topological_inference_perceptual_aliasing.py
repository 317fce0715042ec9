"""Perceptual aliasing: matches in places where the keyframes surely do not lie."""

import math

import numpy as np
import pytest
from worlds import box, drive, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration.area_to_area import MatchSettings
from hmt_slam_ros.registration.likelihood_grid import GridModel, build_area_grid
from hmt_slam_ros.topological_inference.place_recognition import NegativeSample, PerceptualAliasing, best_share

MODEL, SETTINGS = GridModel(), MatchSettings(temper=0.3)
PATH = drive((-4.0, 0.0), (4.0, 0.0))
ROOM = np.concatenate((box(-6.0, -3.0, 6.0, 4.0), box(1.0, 1.0, 2.5, 2.0), box(-5.0, -2.5, -4.0, -1.0)))


def corridor(seed):
    """A corridor of 40 m with a niche every few meters, each 0.2 m deep and 1 m wide, on both sides."""
    walls = []
    for side in (-1.0, 1.0):
        at, steps = -20.0, np.random.default_rng([seed, int(side) + 1]).uniform(2.0, 5.0, 30)
        for step in steps:
            y, deep = side, 1.2 * side
            walls += [[at, y, at + step, y], [at + step, y, at + step, deep]]
            walls += [[at + step, deep, at + step + 1.0, deep], [at + step + 1.0, deep, at + step + 1.0, y]]
            at += step + 1.0
    return np.array(walls)


def make_grid(walls, poses, seed):
    scans = [scan_in(walls, pose, noise=0.01, seed=seed + k) for k, pose in enumerate(poses)]
    return build_area_grid(scans, se2.between(poses[0], poses), MODEL)


def elsewhere(walls, seed):
    return NegativeSample(make_grid(walls, PATH, seed), se2.between(PATH[0], PATH[len(PATH) // 2]))


def share_of(query, place):
    share, work = best_share(query, place, SETTINGS)
    assert (work > 0) == bool(len(query.points))
    return share


@pytest.mark.parametrize("seed", range(4))
def test_a_corridor_fits_into_the_same_one_better_than_into_others_and_there_better_than_a_room(seed):
    query, place = make_grid(corridor(seed), PATH[6:11], 50), elsewhere(corridor(100 + seed), 200)
    same, other = share_of(query, elsewhere(corridor(seed), 300)), share_of(query, place)
    room = share_of(make_grid(ROOM, PATH[6:11], 50), place)
    assert same > 0.95
    assert room < 0.6 < other < same


def test_both_ways_through_a_corridor_are_tried():
    there, back = corridor(1), drive((4.0, 0.0), (1.5, 0.0))
    forth = share_of(make_grid(there, PATH[6:11], 50), elsewhere(there, 200))
    turned = share_of(make_grid(there, back, 50), elsewhere(there, 200))
    assert min(forth, turned) > 0.7


def test_without_surfaces_nothing_matches():
    nothing = build_area_grid([], np.zeros((0, 3)), MODEL)
    assert share_of(nothing, elsewhere(corridor(0), 200)) == 0.0


def test_a_rare_match_is_distinctive():
    likeness = PerceptualAliasing(0.25)
    assert likeness.log_distinctiveness(0.9, already_expected=False) == pytest.approx(math.log(4.0))
    likeness.add_negatives([0.2] * 38)
    assert likeness.log_distinctiveness(0.9, already_expected=False) == pytest.approx(math.log(40.0 / 0.5))
    assert likeness.log_distinctiveness(0.2, already_expected=False) == pytest.approx(math.log(40.0 / 38.5))
    likeness.add_negatives([0.95] * 20)
    assert likeness.log_distinctiveness(0.9, already_expected=False) == pytest.approx(math.log(60.0 / 20.5))


def test_a_fit_that_is_hardly_better_is_not_better():
    likeness = PerceptualAliasing(0.25)
    likeness.add_negatives([0.96] * 8)
    assert likeness.log_distinctiveness(0.97, already_expected=False) == pytest.approx(math.log(10.0 / 8.5))
    assert likeness.log_distinctiveness(0.99, already_expected=False) == pytest.approx(math.log(10.0 / 0.5))


def test_an_expected_match_is_hardly_distinctive():
    likeness = PerceptualAliasing(0.25)
    likeness.add_negatives([0.2] * 38)
    assert likeness.log_distinctiveness(0.9, already_expected=True) == pytest.approx(math.log(2.5))
    assert likeness.log_distinctiveness(0.2, already_expected=True) == likeness.log_distinctiveness(
        0.2, already_expected=False
    )


def test_a_building_of_similar_places_is_learned():
    likeness = PerceptualAliasing(0.25)
    likeness.add_negatives([1.0] * 64)
    assert 0.0 < likeness.log_distinctiveness(1.0, already_expected=False) < 0.03
