"""The floor of the institute: what is open, where states are to be found, and that the robot passes all of it."""

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.building import Building
from hmt_slam_ros.simulation.laser import cast_rays, has_line_of_sight

SEEDS = range(6)


def scenario_of(seed=0, **settings):
    words = "".join(f",{name}={value}" for name, value in settings.items())
    return open_simulated(f"sim:institute,seed={seed}{words}").scenario


def distance_ahead(scenario, poses, reach=30.0):
    """How far it is to the next wall ahead of poses (n, 3), m."""
    return cast_rays(scenario.walls, np.ascontiguousarray(poses[:, :2]), np.ascontiguousarray(poses[:, 2]), reach)


def open_doors(scenario):
    """The middles of the doors in the frame of the hallways, to the centimeter."""
    crossings = scenario.building.states.poses[scenario.building.states.crossings]
    frame = np.array([*crossings[:2, :2].mean(axis=0), crossings[0, 2]])
    doors = scenario.building.doors
    middles = se2.transform(se2.inverse(frame), 0.5 * (doors[:, :2] + doors[:, 2:]))
    return {tuple(np.round(middle, 2)) for middle in middles}


@pytest.mark.parametrize("visit", [0, 1])
@pytest.mark.parametrize("seed", SEEDS)
def test_there_are_four_crossings_and_nine_open_rooms_apart_from_each_other(seed, visit):
    states = scenario_of(seed, visit=visit).building.states
    assert len(states.poses) == 13
    assert states.crossings.sum() == 4
    gaps = np.hypot(*(states.poses[:, None, :2] - states.poses[None, :, :2]).transpose(2, 0, 1))
    assert gaps[~np.eye(13, dtype=bool)].min() >= 2.5 - 1e-9


@pytest.mark.parametrize("visit", [0, 1])
@pytest.mark.parametrize("seed", SEEDS)
def test_openings_are_as_wide_as_stated_and_lead_somewhere(seed, visit):
    scenario = scenario_of(seed, visit=visit)
    states = scenario.building.states
    openings = states.openings
    # From the middle of the opening, just behind the line of the hallway's side, to both jambs.
    for turn in (0.5 * np.pi, -0.5 * np.pi):
        np.testing.assert_allclose(
            distance_ahead(scenario, se2.compose(openings, np.array([0.02, 0.0, turn]))), 0.5 * states.widths, atol=1e-3
        )
    assert (distance_ahead(scenario, openings) > 1.5).all()
    # The pose is in the middle of its hallway: both ways across a hallway without an opening are as long.
    back = distance_ahead(scenario, se2.compose(states.poses, np.array([0.0, 0.0, np.pi])))
    assert (back >= states.ahead - 1e-3).all()
    np.testing.assert_allclose(back[states.crossings], states.ahead[states.crossings], atol=0.1)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_robot_passes_every_state_and_stands_in_every_open_room(seed):
    scenario = scenario_of(seed)
    building, way = scenario.building, scenario.poses[:, :2]
    for pose in building.states.poses:
        assert np.hypot(*(way - pose[:2]).T).min() < 0.4
    for room in building.rooms:
        inside = np.abs(se2.transform(se2.inverse(room[:3]), way)) < 0.5 * room[3:] - 0.4
        assert inside.all(axis=1).any()


@pytest.mark.parametrize("seed", SEEDS)
def test_both_hallways_are_driven_from_end_to_end(seed):
    scenario = scenario_of(seed)
    states, way = scenario.building.states, scenario.poses
    for pose in states.poses[states.crossings][::2]:
        hallway = se2.compose(pose, np.array([0.0, 0.0, -0.5 * np.pi]))
        ends = distance_ahead(scenario, np.array([hallway, se2.compose(hallway, [0.0, 0.0, np.pi])]), 60.0)
        assert ends.sum() == pytest.approx(50.0)
        along, across = se2.transform(se2.inverse(hallway), way[:, :2]).T
        driven = along[np.abs(across) < 0.2]
        assert driven.max() > ends[0] - 1.1
        assert driven.min() < -ends[1] + 1.1


def test_the_floor_is_fifty_by_twenty_five_meters():
    for seed in SEEDS:
        scenario = scenario_of(seed)
        crossings = scenario.building.states.poses[:2]
        along = np.arctan2(*(crossings[1] - crossings[0])[[1, 0]])
        x, y = se2.transform(np.array([0.0, 0.0, -along]), scenario.building.walls.reshape(-1, 2)).T
        assert np.ptp(x) == pytest.approx(50.0)
        assert 21.0 < np.ptp(y) <= 25.0 + 1e-9


def test_later_visits_find_other_doors_open_in_the_same_floor():
    first, second, third, same = (
        scenario_of(3, visit=visit, changed=changed) for visit, changed in ((0, 0.5), (1, 0.5), (2, 0.5), (1, 0.0))
    )
    doors = [open_doors(scenario) for scenario in (first, second, third)]
    assert open_doors(same) == doors[0]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert 1 <= len(doors[one] - doors[other]) <= 8
    for other in (second, third):
        crossings = first.building.states.crossings
        np.testing.assert_array_equal(other.building.states.poses[crossings], first.building.states.poses[crossings])


def test_the_laser_sees_all_around_and_people_walk():
    scenario = scenario_of(2)
    angles = scenario.laser.angles
    assert np.ptp(angles) == pytest.approx(2.0 * np.pi * 719 / 720)
    places = [scenario.people.discs_at(seconds, scenario.poses[0])[:, :2] for seconds in (0.0, 0.2)]
    assert len(places[0]) == 4
    assert (np.hypot(*(places[1] - places[0]).T) > 0.01).all()


def test_states_move_with_their_building():
    states = scenario_of(1).building.states
    walls = np.array([[0.0, 0.0, 1.0, 0.0]])
    pose = np.array([3.0, -2.0, 0.7])
    placed = Building(walls, np.zeros((2, 2)), states=states).transform(pose).states
    np.testing.assert_allclose(placed.openings, se2.compose(pose, states.openings))
    assert len(Building(walls, np.zeros((2, 2))).states.poses) == 0


def test_doors_of_rooms_are_free_to_walk_through():
    scenario = scenario_of(4)
    states = scenario.building.states
    doors = ~states.crossings
    inside = se2.compose(states.openings[doors], np.array([1.0, 0.0, 0.0]))
    assert has_line_of_sight(scenario.walls, states.poses[doors, :2].copy(), inside[:, :2].copy()).all()
