"""The dynamic window drives to goals around what the scan shows, and touches nothing."""

import math

import numpy as np
import pytest

from benchmark.driving import drive_goals, scenario_of
from hmt_slam_ros.exploration.laser_views import LaserViews
from hmt_slam_ros.exploration.local_motion import (
    _MAX_FREE_DISTANCE,
    MotionLimits,
    _free_distance,
    command_towards,
    local_goal,
)
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Scan

LIMITS = MotionLimits(0.6, math.radians(45.0), 0.5, math.radians(90.0), 0.25)
NOTHING = np.empty((0, 2))


def scan_of(points, beams=720):
    """What a laser that sees all around would see of points (n, 2), one return for each."""
    ranges = np.full(beams, np.inf, dtype=np.float32)
    for x, y in points:
        beam = round((math.atan2(y, x) + math.pi) / (2.0 * math.pi) * beams) % beams
        ranges[beam] = min(ranges[beam], math.hypot(x, y))
    return LaserViews().add(Scan(0, ranges, -math.pi, 2.0 * math.pi / beams, 0.02, 20.0))


def wall(start, end):
    return start + np.linspace(0.0, 1.0, 200)[:, None] * (np.subtract(end, start))


def test_at_the_goal_it_stands():
    assert command_towards(scan_of(NOTHING), np.array([0.1, 0.1]), (0.3, 0.0), LIMITS) == (0.0, 0.0, True)


def test_with_nothing_in_the_way_it_speeds_up_straight_ahead():
    command = command_towards(scan_of(NOTHING), np.array([5.0, 0.0]), (0.4, 0.0), LIMITS)
    assert command.speed == pytest.approx(0.5)
    assert abs(command.turn_rate) < 0.05


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_turns_to_the_side_of_the_goal(side):
    command = command_towards(scan_of(NOTHING), np.array([-2.0, 1.0 * side]), (0.0, 0.0), LIMITS)
    assert command.turn_rate * side > 0.2


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.6, 0.5), (0.3, -0.7), (-0.2, 0.0), (0.9, 2.0)])
def test_commands_can_be_reached_and_keep_the_limits(velocity):
    for goal in ([4.0, 0.0], [0.3, 0.3], [-1.0, 0.2], [0.0, -3.0]):
        command = command_towards(scan_of(wall([1.0, -1.0], [1.0, 1.0])), np.array(goal), velocity, LIMITS)
        assert 0.0 <= command.speed <= LIMITS.speed
        assert abs(command.turn_rate) <= LIMITS.turn_rate
        assert command.speed - velocity[0] <= LIMITS.acceleration * LIMITS.period + 0.2 + 1e-9


def test_before_a_wall_it_brakes_in_time():
    """From full speed, with the brakes that it has, it stands before its margin, whatever the goal."""
    speed, away = 0.6, 3.0
    for _ in range(60):
        points = wall([away, -4.0], [away, 4.0])
        command = command_towards(scan_of(points), np.array([away + 2.0, 0.0]), (speed, 0.0), LIMITS)
        change = LIMITS.acceleration * LIMITS.period
        now = speed + max(-change, min(change, command.speed - speed))
        away -= 0.5 * (speed + now) * LIMITS.period
        speed = now
    assert speed < 0.02
    assert LIMITS.radius + LIMITS.margin - 0.01 <= away < 0.8


def test_the_way_to_a_contact_is_that_of_a_walk_in_small_steps():
    draw = np.random.default_rng(5)
    step, radius = 0.001, 0.3
    for _ in range(60):
        point = draw.uniform(-1.5, 1.5, 2)
        if np.hypot(*point) <= radius:
            continue
        v, omega = draw.uniform(0.05, 0.6), draw.choice([0.0, draw.uniform(-0.8, 0.8)])
        ways = np.arange(0.0, _MAX_FREE_DISTANCE, step)
        poses = se2.exp(np.stack((ways, 0.0 * ways, ways / v * omega), axis=1))
        touching = np.hypot(*(poses[:, :2] - point).T) < radius
        walked = ways[touching.argmax()] if touching.any() else _MAX_FREE_DISTANCE
        assert _free_distance(point[None], v, omega, radius) == pytest.approx(walked, abs=0.01)


def test_what_is_too_near_keeps_it_from_nearing_but_not_from_leaving():
    assert _free_distance(np.array([[0.2, 0.1]]), 0.3, 0.1, 0.3) == 0.0
    assert _free_distance(np.array([[-0.2, 0.1]]), 0.3, 0.1, 0.3) == _MAX_FREE_DISTANCE
    assert _free_distance(np.array([[0.2, 0.1]]), 0.0, 0.5, 0.3) == _MAX_FREE_DISTANCE


def test_the_path_goes_straight_where_nothing_is_and_around_what_is_there():
    np.testing.assert_allclose(local_goal(NOTHING, np.array([0.5, 0.2]), 0.3), [0.5, 0.2])
    assert local_goal(NOTHING, np.array([9.0, 0.0]), 0.3) == pytest.approx([4.0, 0.0], abs=0.11)
    # A wall with an open end on the left.
    ahead = local_goal(wall([0.8, -4.0], [0.8, 0.5]), np.array([2.0, 0.0]), 0.3)
    assert ahead[1] > 0.3
    assert np.hypot(*ahead) >= 0.6


def test_the_path_leads_out_of_a_dead_end():
    ends = [([1.0, -1.0], [1.0, 1.0]), ([-1.0, 1.0], [1.0, 1.0]), ([-1.0, -1.0], [1.0, -1.0])]
    ahead = local_goal(np.concatenate([wall(*two) for two in ends]), np.array([2.5, 0.0]), 0.3)
    assert ahead[0] < -0.3


def test_the_path_goes_through_the_middle_of_a_door_and_not_through_a_gap_that_is_too_narrow():
    for gap, through in ((0.9, True), (0.5, False)):
        sides = [wall([0.6, 0.5 * gap], [0.6, 6.0]), wall([0.6, -6.0], [0.6, -0.5 * gap])]
        points = np.concatenate(sides)
        place, goal = np.zeros(3), np.array([2.0, 0.0])
        for _ in range(12):
            local = se2.transform(se2.inverse(place), points)
            ahead = local_goal(local, se2.transform(se2.inverse(place), goal[None])[0], 0.3)
            place[:2] += 0.3 * ahead
        assert (place[0] > 1.0) == through
        assert abs(place[1]) < 0.15 or not through


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_it_reaches_goals_in_floors_with_people_without_contact(seed):
    legs = list(drive_goals(scenario_of("institute", seed, "360°"), 17))
    assert len(legs) == 17
    assert all(leg.reached for leg in legs)
    assert sum(leg.contacts for leg in legs) == 0
    assert sum(leg.distance for leg in legs) > 50.0


@pytest.mark.parametrize("laser", ["360°", "180°"])
def test_it_passes_doors_of_ninety_centimeters(laser):
    legs = list(drive_goals(scenario_of("doors", 4, laser), 8))
    assert all(leg.reached for leg in legs)
    assert sum(leg.contacts for leg in legs) == 0


def half_scan(points, theta, stamp=0, x=0.0):
    """What a laser with half a field of view at (x, 0, theta) sees of points (n, 2) in the robot's frame."""
    laser, ranges = np.array([x, 0.0, theta]), np.full(181, np.inf, dtype=np.float32)
    for along, left in se2.transform(se2.inverse(laser), np.asarray(points)):
        beam = round(math.degrees(math.atan2(left, along))) + 90
        if 0 <= beam <= 180:
            ranges[beam] = math.hypot(along, left)
    return Scan(stamp, ranges, -0.5 * math.pi, math.pi / 180.0, 0.02, 20.0, laser)


def test_it_brakes_for_what_another_laser_than_that_of_the_last_scan_sees():
    posts, views = np.array([[1.0, 0.0], [-2.0, 0.0]]), LaserViews()
    views.add(half_scan(posts, 0.0, x=0.2))
    # It drives on by half a meter, and the laser behind scans.
    views.move(np.array([0.5, 0.0, 0.0]))
    rear = half_scan(posts - (0.5, 0.0), math.pi, 50_000_000, x=-0.2)
    view = views.add(rear)
    np.testing.assert_allclose(view.points, [[0.5, 0.0], [-2.5, 0.0]], atol=0.01)
    assert (view.stamp, view.field) == (50_000_000, math.pi)
    assert command_towards(view, np.array([3.0, 0.0]), (0.4, 0.0), LIMITS).speed < 0.4
    assert command_towards(LaserViews().add(rear), np.array([3.0, 0.0]), (0.4, 0.0), LIMITS).speed > 0.4


def test_what_a_laser_saw_long_ago_is_no_obstacle():
    views = LaserViews()
    views.add(half_scan([[1.0, 0.0]], 0.0))
    view = views.add(half_scan([[-1.0, 0.0]], math.pi, 1_500_000_000))
    np.testing.assert_allclose(view.points, [[-1.0, 0.0]], atol=1e-6)
    assert view.field < 0.1


@pytest.mark.parametrize(("angles", "field"), [([0.0], 0.5), ([0.0, 1.0], 1.0 / 3.0), ([0.0, 0.5, -0.5], 1.0)])
def test_the_field_of_view_of_lasers_together(angles, field):
    """In half turns, to both sides of the robot alike; two lasers that leave a gap at a side see as far as there."""
    beams = {0.5: 181, 1.0 / 3.0: 121, 1.0: 181}[field]
    first = -math.radians(0.5 * (beams - 1))
    views = LaserViews()
    for angle in angles:
        scan = Scan(
            0, np.ones(beams, np.float32), first, math.pi / 180.0, 0.02, 20.0, np.array([0, 0, math.pi * angle])
        )
        view = views.add(scan)
    assert view.field == pytest.approx(math.pi * field, abs=math.radians(1.1))
