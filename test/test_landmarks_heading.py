"""The heading between the walls of a building, by its lines and without a map."""

import math

import numpy as np
import pytest
from worlds import blank_scan, box, scan_in

from benchmark import heading as measured
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.landmarks.line_extraction import extract_lines
from hmt_slam_ros.places.corridor_frame import BuildingHeading
from hmt_slam_ros.places.observation_graph import QUARTER_TURN
from hmt_slam_ros.sensors.relative_motion import RelativeMotion

FEATURES = FeatureParameters(range_deviation=0.01)
ROOM = box(-3.0, -2.0, 5.0, 4.0)
ASLANT = np.array([[-1.0, 2.0, 1.5, 3.2], [3.0, -1.5, 4.5, -0.5]])


def lines_at(heading, walls=ROOM, seed=0):
    pose = np.array([0.5, 0.3, heading])
    return extract_lines(scan_in(walls, pose, beams=361, field_of_view=2.0 * math.pi, noise=0.01, seed=seed), FEATURES)


def turn_motion(angle, deviation):
    return RelativeMotion(np.array([0.3, 0.0, angle]), np.diag([0.01, 0.01, deviation]) ** 2)


@pytest.mark.parametrize("heading", [0.1, -0.7, 1.2, 3.0, -2.3])
def test_the_first_lines_tell_it_up_to_quarters(heading):
    robot = BuildingHeading(FEATURES)
    assert not robot.is_known
    assert robot.observe(lines_at(heading)) == 4
    assert -0.25 * math.pi <= robot.angle < 0.25 * math.pi
    assert abs((robot.angle - heading + 0.5) % QUARTER_TURN - 0.5) < 0.005
    assert robot.variance < math.radians(0.5) ** 2


def test_while_nothing_is_seen_it_is_unknown():
    robot = BuildingHeading(FEATURES)
    nothing = extract_lines(blank_scan(), FEATURES)
    assert robot.observe(nothing) == 0
    robot.predict(turn_motion(0.3, 0.1))
    assert robot.observe(nothing) == 0
    assert not robot.is_known
    assert robot.observe(lines_at(0.2)) == 4
    assert robot.angle == pytest.approx(0.2, abs=0.005)


def test_it_does_not_drift_however_wrong_odometry_turns():
    robot, truth, odometry = BuildingHeading(FEATURES), 0.0, 0.0
    for k in range(150):
        robot.observe(lines_at(truth, seed=k))
        assert abs(robot.angle - truth) < 0.01
        robot.predict(turn_motion(0.16, 0.05))
        truth, odometry = truth + 0.15, odometry + 0.16
    assert odometry - truth > 1.4  # three turns and a half, and nearly a quarter too many by odometry


def test_what_stands_aslant_is_left_out():
    robot = BuildingHeading(FEATURES)
    walls = np.concatenate((ROOM, ASLANT))
    assert len(lines_at(0.3, walls)) >= 6
    assert robot.observe(lines_at(0.3, walls)) == len(lines_at(0.3, walls)) - 2
    assert robot.angle == pytest.approx(0.3, abs=0.005)
    robot.predict(turn_motion(0.1, 0.03))
    robot.observe(lines_at(0.4, walls, seed=1))
    assert robot.angle == pytest.approx(0.4, abs=0.005)


def test_walls_that_are_not_square_bound_what_is_known():
    def variance_after(square_deviation, looks):
        robot = BuildingHeading(FeatureParameters(range_deviation=0.01, square_deviation=square_deviation))
        for k in range(looks):
            robot.observe(lines_at(0.2, seed=k))
        return robot.variance

    assert variance_after(0.0, 50) < 0.1 * variance_after(0.0, 1)
    one = math.radians(1.0) ** 2 / 4.0  # of four walls
    assert one * 0.9 < variance_after(1.0, 500) < one * 1.2


def test_where_nothing_is_seen_the_variance_grows():
    robot = BuildingHeading(FEATURES)
    robot.observe(lines_at(0.0))
    before = robot.variance
    robot.predict(turn_motion(0.4, 0.1))
    assert robot.variance == pytest.approx(before + 0.01)


def test_drives_are_measured():
    rows = measured.heading_errors(World("office", 1000), "", Configuration())
    assert len(rows) == 400
    assert np.abs(rows[:, 0]).max() < math.radians(1.5)
    assert np.abs(rows[:, 2]).max() > math.radians(5.0)
    assert rows[:, 3].mean() > 2.0
