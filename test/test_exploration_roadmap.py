"""The roadmap of an exploration: hallways, doors, rooms and frontiers of scans and maps."""

from __future__ import annotations

import numpy as np
from explored_floor import LASER, ROOMS, scan_at, small_floor, with_keyframes

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.frontiers import NavigationGrid
from hmt_slam_ros.exploration.roadmap import Frontier, Roadmap, classify_place, crosses_doors
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.openings import distance_to_doors, jamb_positions
from hmt_slam_ros.simulation.building import FloorPlan
from hmt_slam_ros.simulation.laser import Laser, wall_index


def test_hallways_and_doors_of_a_scan() -> None:
    features = Configuration().features
    for pose, is_hallway in (((3.0, 0.0, 0.3), True), ((3.0, -3.0, 0.0), False)):
        outlook = classify_place(scan_at(pose), features, 1.75)
        assert outlook.is_hallway == is_hallway
        way = se2.transform(se2.inverse(np.array(pose)), np.array([[3.0, -0.2], [3.0, -2.0]])).reshape(1, 4)
        assert crosses_doors(way, outlook.doors).all()
        beside = se2.transform(se2.inverse(np.array(pose)), np.array([[1.0, 0.0], [5.0, 0.0]])).reshape(1, 4)
        assert not crosses_doors(beside, outlook.doors).any()


def test_an_arm_as_wide_as_a_hallway_is_no_door() -> None:
    doors = classify_place(scan_at((6.0, 0.0, 0.0)), Configuration().features, 1.75).doors
    assert not crosses_doors(np.array([[0.0, 0.0, 0.0, 2.5]]), doors).any()


def test_a_room_is_as_long_as_to_its_door() -> None:
    # Through the door of the southern room one sees the hallway behind it from wall to wall.
    origins, directions = np.zeros((3, 2)), np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    doors = jamb_positions(np.array([[2.0, 0.2, 0.0], [3.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.array([1.0, 1.0, 0.9]))
    assert np.allclose(doors[0], (2.0, 0.7, 2.0, -0.3))
    assert np.allclose(distance_to_doors(origins, directions, doors), (2.0, np.inf, np.inf))


def test_a_room_that_is_seen_from_outside_as_a_whole_is_to_be_entered() -> None:
    door = np.array([[2.5, -1.0, 3.5, -1.0]])
    outside = np.array([(3.0, 0.0, 0.0), (3.0, -0.7, 0.0), (2.0, 0.0, 0.0), (4.0, 0.0, 0.0)])
    inside = np.array([(3.0, -3.0, 0.0)])
    for poses, count in ((outside, 1), (np.concatenate((outside, inside)), 0)):
        ground = NavigationGrid([scan_at(tuple(pose)) for pose in poses.tolist()], poses, 0.3)
        ways = ground.paths_to_unvisited_rooms(door)
        assert len(ways) == count
        assert all(np.abs(way.points[-1] - ROOMS[0]).max() < 1.5 for way in ways)
        assert not ground.paths_to_unvisited_rooms(np.empty((0, 4)))


def test_what_is_open_is_not_forgotten_with_the_keyframe_beside_it() -> None:
    survey, scans = Roadmap(Configuration().features, 0.3, 1.75), {k: scan_at((1.0 + k, 0.0, 0.0)) for k in range(3)}
    survey.update(with_keyframes({0: (1.0, 0.0, 0.0), 1: (2.0, 0.0, 0.5)}), scans, 0, np.array([1.0, 0.0, 0.0]))
    way = np.array([[0.0, 0.0], [20.0, 0.0]])
    survey.frontiers = [Frontier(1, way, is_in_hallway=True)]
    left = with_keyframes({0: (1.0, 0.0, 0.0), 2: (3.0, 0.0, 0.0)})
    survey.update(left, scans, 0, np.array([1.0, 0.0, 0.0]))
    (kept,) = (one for one in survey.frontiers if one.length > 19.0)
    assert kept.keyframe == 0
    there = se2.transform(np.array([2.0, 0.0, 0.5]), way[-1])
    assert np.allclose(se2.transform(np.array([1.0, 0.0, 0.0]), kept.path[-1]), there)


def test_places_beside_each_other_are_joined_whatever_stands_about() -> None:
    survey = Roadmap(Configuration().features, 0.3, 1.75)
    # So near to a wall no cell of the ground is free.
    hybrid_map = with_keyframes({0: (2.0, 0.85, 0.0), 4: (2.2, 0.85, 0.0), 9: (2.9, 0.85, 0.0)})
    survey.update(hybrid_map, dict.fromkeys((0, 4, 9), scan_at((2.0, 0.85, 0.0))), 0, np.array([2.0, 0.0, 0.0]))
    assert set(survey.distances(0)) == {0, 4}


def make_survey(poses: list[tuple[float, float, float]], walls: Float64, person: Float64, until: int = 0) -> Roadmap:
    """A survey of a floor with keyframes at these poses, one after the other, with a person at (1, 3) at first.

    :param until: this keyframe.
    """
    survey, laser = Roadmap(Configuration().features, 0.3, 1.75), Laser(LASER)
    index, people = wall_index(walls), [person] * until + [np.empty((0, 3))] * (len(poses) - until)
    seen = [laser.distances(np.array([pose]), index, own) for pose, own in zip(poses, people, strict=True)]
    scans = {k: laser.scan(0, 0, distances) for k, distances in enumerate(seen)}
    survey.update_everywhere(with_keyframes(dict(enumerate(poses))), scans)
    return survey


def test_the_end_of_a_hallway_is_no_room() -> None:
    hallway = [(x, 0.0, 0.0) for x in np.arange(1.0, 11.1, 0.5)]
    person = np.array([[4.2, 0.0, 0.5]])
    survey = make_survey(hallway, small_floor().walls, person, until=4)
    # From there it looked like one.
    laser = Laser(LASER)
    seen = laser.distances(np.array([hallway[0]]), wall_index(small_floor().walls), person)
    assert not classify_place(laser.scan(0, 0, seen), Configuration().features, 1.75).is_hallway
    assert survey.room_around(0) == ()
    assert survey.rooms() == []


def test_a_room_behind_a_gap_in_a_room_is_part_of_it() -> None:
    plan = FloorPlan()
    plan.cut_rectangle(0.0, -1.0, 12.0, 1.0)
    plan.cut_rectangle(4.5, -1.3, 5.5, -0.9)
    # Two cupboards leave a gap of a meter in the middle of the room.
    plan.cut_rectangle(3.0, -4.0, 7.0, -1.2)
    plan.cut_rectangle(4.5, -4.4, 5.5, -3.9)
    plan.cut_rectangle(3.0, -8.0, 7.0, -4.3)
    poses = [(x, 0.0, 0.0) for x in np.arange(1.0, 10.0, 0.5)]
    poses += [(5.0, y, -0.5 * np.pi) for y in np.arange(-0.4, -7.0, -0.5)]
    poses += [(x, y, 0.0) for x in (4.0, 6.0) for y in (-2.5, -6.0, -6.8)]
    survey = make_survey(poses, plan.walls(), np.empty((0, 3)))
    doors = [survey.graph.edges[edge]["door"] for edge in ((24, 27), (18, 21))]
    assert doors == [True, True]
    assert len(survey.rooms()) == 1
    assert {bool(survey.room_around(k)) for k in (24, 29, 30)} == {True}
