"""The robot's way through way-points, and how it drives it."""

import math

import numpy as np
import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation.drive import drive_along, path_through
from hmt_slam_ros.simulation.scenario import driven_route

CORNERS = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 5.0], [9.0, 8.0], [6.0, 5.0], [2.0, 5.0], [2.0, 5.2]])


def end_of(path):
    return path.poses_at(np.array([len(path.lengths) - 1]), path.sizes[-1:])[0]


def test_the_way_begins_and_ends_at_its_way_points_and_goes_on_without_a_jump():
    path = path_through(CORNERS, 0.5)
    assert path.starts[0] == pytest.approx([0.0, 0.0, 0.0])
    assert end_of(path) == pytest.approx([2.0, 5.2, 0.5 * np.pi])
    ends = path.poses_at(np.arange(len(path.lengths)), path.sizes)
    np.testing.assert_allclose(se2.between(ends[:-1], path.starts[1:]), 0.0, atol=1e-12)


def test_corners_are_rounded_by_arcs_of_the_radius_requested_or_smaller_where_there_is_no_room():
    path = path_through(CORNERS, 0.5)
    arcs = ~path.is_turn_in_place & (path.turns != 0.0)
    radii = path.lengths[arcs] / np.abs(path.turns[arcs])
    assert radii[0] == pytest.approx(0.5)
    assert (radii <= 0.5 + 1e-12).all()
    assert radii[-1] == pytest.approx(0.1)  # half of the last leg of 0.2 m


def test_where_the_way_turns_back_the_robot_turns_on_the_spot():
    path = path_through(CORNERS, 0.5)
    (spot,) = np.flatnonzero(path.is_turn_in_place)
    assert path.starts[spot, :2] == pytest.approx([9.0, 8.0])
    assert abs(path.turns[spot]) == pytest.approx(np.pi)


def test_speeds_and_accelerations_stay_within_their_bounds_and_poses_within_the_motion_they_allow():
    drive = drive_along(path_through(CORNERS, 0.5), 0.6, math.radians(45.0))
    step = 0.01
    poses = drive.poses(np.arange(-1.0, drive.duration + 1.0, step))
    twists = se2.log(se2.between(poses[:-1], poses[1:])) / step
    # Wheels do not go sideways; a step over the joint of line and arc seems to, by its square.
    assert np.abs(twists[:, 1]).max() < 1e-3
    assert twists[:, 0].min() > -1e-9
    assert twists[:, 0].max() < 0.6 + 1e-9
    assert np.abs(twists[:, 2]).max() < math.radians(45.0) + 1e-9
    assert np.abs(np.diff(twists[:, 0])).max() < 0.5 * step + 1e-9
    np.testing.assert_allclose(twists[[0, -1]], 0.0, atol=1e-12)


def test_the_drive_ends_where_the_way_ends_after_its_whole_length():
    path = path_through(CORNERS, 0.5)
    drive = drive_along(path, 0.6, math.radians(45.0))
    np.testing.assert_allclose(drive.poses(np.array([drive.duration]))[0], end_of(path), atol=1e-9)
    poses = drive.poses(np.arange(0.0, drive.duration, 0.001))
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() == pytest.approx(path.lengths.sum(), abs=1e-3)


def test_laps_repeat_a_closed_route_and_go_there_and_back_on_an_open_one():
    closed = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 0.0]])
    assert driven_route(closed, 3).tolist() == [*closed.tolist(), *closed[1:].tolist(), *closed[1:].tolist()]
    assert driven_route(closed[:3], 2).tolist() == [[0, 0], [1, 0], [1, 1], [1, 0], [0, 0]]


def test_a_route_of_one_place_is_refused():
    with pytest.raises(HmtSlamError, match="at least two"):
        path_through(np.ones((3, 2)), 0.5)
