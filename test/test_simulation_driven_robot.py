"""A robot that is driven by commands goes where commands lead, measures as the scripted one, and stops at obstacles."""

import math

import numpy as np
import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.building import Building, furniture_walls
from hmt_slam_ros.simulation.drive import integrate_increments, noisy_increments
from hmt_slam_ros.simulation.driven_robot import DrivenLog, DrivenRobot
from hmt_slam_ros.simulation.laser import clearance
from hmt_slam_ros.simulation.people import People, ReactivePeople
from hmt_slam_ros.simulation.scenario import START, Scenario
from hmt_slam_ros.simulation.settings import Settings

ROOM = furniture_walls(np.array([[0.0, 0.0, 0.0, 12.0, 8.0]]))
ROUTE = np.array([[-4.0, 0.0], [4.0, 0.0]])


def robot_in(building=None, start=None, **settings):
    return DrivenRobot(Scenario(building or Building(ROOM, ROUTE), Settings(**settings)), start)


def drive(robot, speed, turn_rate, readings):
    for _ in range(readings):
        robot.set_velocity(speed, turn_rate)
        robot.advance()


def test_it_begins_where_the_scripted_drive_does_and_sees_the_same():
    scenario = open_simulated("sim:institute,seed=3,people=0").scenario
    reading, scan = DrivenRobot(scenario).measure()
    assert scan.stamp == reading.stamp == START
    np.testing.assert_array_equal(scan.ranges, scenario.scan(0).ranges)
    np.testing.assert_array_equal(reading.pose, scenario.odometry[0])


def test_it_follows_an_exact_arc_once_it_is_as_fast_as_requested():
    robot = robot_in(odometry=0.0, start=np.array([0.0, -1.0, 0.0]))
    drive(robot, 0.4, 0.3, 15)
    assert robot.velocity == pytest.approx((0.4, 0.3))
    before, count = robot.pose, 20
    drive(robot, 0.4, 0.3, count)
    moved = se2.between(before, robot.pose)
    np.testing.assert_allclose(moved, se2.exp(0.1 * count * np.array([0.4, 0.0, 0.3])), atol=1e-9)
    radius = 0.4 / 0.3
    assert moved[0] == pytest.approx(radius * math.sin(0.3 * 2.0))


def test_accelerations_and_speeds_are_limited():
    robot = robot_in(speed=0.5, turn_rate=30.0)
    robot.set_velocity(3.0, -9.0)
    robot.advance()
    assert robot.velocity == pytest.approx((0.05, -math.radians(9.0)))
    drive(robot, 3.0, -9.0, 30)
    assert robot.velocity == pytest.approx((0.5, -math.radians(30.0)))
    drive(robot, -3.0, 0.0, 30)
    assert robot.velocity == pytest.approx((-0.5, 0.0))


def test_without_a_command_it_stands_still():
    robot = robot_in()
    robot.advance()
    assert robot.distance_traveled == 0.0
    robot.set_velocity(0.2, 0.0)
    for _ in range(5):
        robot.advance()
    assert robot.velocity[0] == pytest.approx(0.2)
    for _ in range(4):  # it brakes with 0.5 m/s^2
        robot.advance()
    assert robot.velocity == (0.0, 0.0)
    still = robot.pose
    robot.advance()
    np.testing.assert_array_equal(robot.pose, still)


@pytest.mark.parametrize("heading", [0.0, 0.4, 2.0, -2.8])
def test_it_does_not_pass_a_wall_and_touches_it_once(heading):
    robot = robot_in(odometry=0.0, start=np.array([0.0, 0.0, heading]))
    drive(robot, 0.6, 0.0, 130)
    assert robot.contacts == 1
    assert clearance(ROOM, robot.pose[None, :2])[0] == pytest.approx(0.25, abs=0.013)
    assert clearance(ROOM, robot.pose[None, :2])[0] >= 0.25
    # It can turn away and leave, and comes upon the wall again.
    away = robot.pose
    drive(robot, 0.0, 0.5, 66)
    np.testing.assert_array_equal(robot.pose[:2], away[:2])
    drive(robot, 0.6, 0.0, 20)
    assert robot.contacts == 1
    assert np.hypot(*(robot.pose - away)[:2]) > 0.5


def test_furniture_is_in_its_way_too():
    piece = np.array([[2.0, 1.2, 0.0, 1.0, 1.0]])
    robot = robot_in(Building(ROOM, ROUTE, piece), odometry=0.0, start=np.array([-2.0, 1.2, 0.0]))
    drive(robot, 0.6, 0.0, 70)
    assert robot.contacts == 1
    assert robot.pose[0] == pytest.approx(1.5 - 0.25, abs=0.013)


def test_a_disc_of_another_radius_stops_elsewhere():
    robot = robot_in(odometry=0.0, radius=0.6)
    drive(robot, 0.6, 0.0, 180)
    assert robot.pose[0] == pytest.approx(6.0 - 0.6, abs=0.013)


def test_people_walk_wait_before_the_robot_and_turn_back_and_are_not_passed_through():
    robot = robot_in(people=8, seed=2, odometry=0.0)
    nearest, walked = math.inf, np.zeros(8)
    for _ in range(300):
        before = robot.people_discs
        robot.set_velocity(0.6 if robot.contacts % 2 == 0 else -0.6, 0.0)
        robot.advance()
        steps = np.hypot(*(robot.people_discs - before)[:, :2].T)
        # Where the robot's route turns back, its left side is another.
        assert steps.max() <= 0.1 * 1.4 + 0.5
        assert np.median(steps) <= 0.1 * 1.4
        walked += steps
        nearest = min(nearest, np.hypot(*(robot.people_discs[:, :2] - robot.pose[:2]).T).min())
    assert robot.contacts > 0
    assert (walked > 3.0).all()
    # The discs of a person and the robot never overlap more than where the person stood when the drive began.
    start = np.hypot(*(robot_in(people=8, seed=2).people_discs[:, :2] - ROUTE[0]).T).min()
    assert nearest >= min(start, 0.2 + 0.25)


def test_who_cannot_turn_back_for_long_squeezes_past_a_robot_that_stands():
    # A walk of 2 m to and fro, and in its middle 0.8 m from the end a robot that wants nothing but to stand there.
    drive_ = robot_in(people=1, seed=2).scenario.people.drive
    people = People(drive_, *np.array([[0.0], [2.0], [1.0], [0.0], [0.0]]))
    robot = np.append(people.positions(np.array([1.2]))[0], 0.0)
    walkers, passed = ReactivePeople(people), []
    for _ in range(1000):
        walkers.walk(0.05, robot)
        passed.append(np.hypot(*(walkers.discs[0, :2] - people.positions(np.array([2.0]))[0])))
    assert min(passed) < 0.3
    assert max(passed) > 1.7


def test_the_laser_sees_people_where_they_are():
    robot = robot_in(people=1, seed=1, range_noise=0.0, dropout=0.0, field_of_view=360.0, beams=720)
    scan = robot.measure()[1]
    points = se2.transform(robot.pose, scan.points)
    x, y, radius = robot.people_discs[0]
    on_disc = np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius) < 1e-4
    assert on_disc.sum() >= 3


@pytest.mark.parametrize("readings", [1, 2, 5])
def test_odometry_at_scans_is_the_scripted_drives_model_of_the_same_draws(readings):
    robot = robot_in(readings=readings, seed=4)
    poses, wheels = [], []
    turns = np.random.default_rng(1)
    for k in range(40 * readings):
        reading, scan = robot.measure()
        if scan is not None:
            poses.append(robot.pose)
            wheels.append(reading.pose)
        if k % 7 == 0:
            turn = turns.uniform(-0.7, 0.7)
        robot.set_velocity(0.4, turn)
        robot.advance()
    true = se2.between(np.array(poses[:-1]), np.array(poses[1:]))
    expected = integrate_increments(noisy_increments(true, 1.0, random_stream(4, Purpose.WHEELS, 0)))
    np.testing.assert_allclose(np.array(wheels), expected, atol=1e-12)


def test_odometry_between_scans_grows_evenly_on_an_even_way():
    robot = robot_in(readings=4, seed=5, start=np.array([-5.0, 0.0, 0.0]))
    drive(robot, 0.5, 0.0, 40)
    start, wheels, errors = robot.pose, robot.measure()[0].pose, []
    for _ in range(4):
        robot.set_velocity(0.5, 0.0)
        robot.advance()
        measured = se2.between(wheels, robot.measure()[0].pose)
        errors.append(se2.log(se2.between(se2.between(start, robot.pose), measured)))
    np.testing.assert_allclose(errors, np.arange(1, 5)[:, None] / 4 * errors[-1], atol=1e-9)
    assert np.abs(errors[-1]).max() > 1e-3


def test_wheels_do_not_notice_that_it_is_kidnapped():
    robot = robot_in(odometry=0.0, readings=2)
    drive(robot, 0.3, 0.1, 11)
    before, wheels = robot.pose, robot.measure()[0].pose
    robot.kidnap(np.array([1.0, 2.0, 2.5]))
    assert robot.velocity == (0.0, 0.0)
    put = robot.pose
    drive(robot, 0.3, 0.1, 10)
    np.testing.assert_allclose(se2.between(wheels, robot.measure()[0].pose), se2.between(put, robot.pose), atol=1e-9)
    assert np.hypot(*(put - before)[:2]) > 1.0


def test_the_truth_is_known_at_any_time():
    robot = robot_in(readings=3, rate=7.0)
    stamps, poses = [robot.stamp], [robot.pose]
    for k in range(60):
        drive(robot, 0.4, 0.5 * math.sin(0.2 * k), 1)
        stamps.append(robot.stamp)
        poses.append(robot.pose)
    np.testing.assert_allclose(robot.true_poses(np.array(stamps)), poses, atol=1e-6)
    between = robot.true_poses(np.arange(stamps[0], stamps[-1], 1_000_000))
    steps = np.hypot(*np.diff(between[:, :2], axis=0).T)
    assert steps.max() <= 0.4 * 0.001 + 1e-6


def test_the_same_commands_and_seed_give_the_same_run():
    def run(seed):
        robot = DrivenRobot(open_simulated(f"sim:institute,seed=2,people=3,visit={seed}").scenario)
        drive(robot, 0.4, 0.1, 30)
        reading, scan = robot.measure()
        return reading.pose.tobytes() + scan.ranges.tobytes() + robot.pose.tobytes()

    assert run(0) == run(0)
    assert run(0) != run(1)


def test_as_a_log_it_goes_on_until_its_end():
    robot = robot_in(rate=5.0, readings=2)
    log = DrivenLog("room", robot, 2.0)
    records = []
    for record in log.records():
        records.append(record)
        robot.set_velocity(0.3, 0.0)
    assert log.scan_count == 11 == sum(hasattr(record.measurement, "ranges") for record in records)
    assert len(records) == 11 + 21
    assert records[-1].measurement.stamp == START + 2_000_000_000
    np.testing.assert_array_equal(records[-1].true_pose, robot.pose)
    assert robot.pose[0] > -4.0 + 0.3
    assert DrivenLog("room", robot).scan_count == 0


@pytest.mark.parametrize("name", ["slips", "sweep", "moved", "carried"])
def test_settings_of_scripted_drives_alone_are_refused(name):
    with pytest.raises(HmtSlamError, match=f"has no setting {name}: set {name}=0"):
        robot_in(**{name: 0.1})
