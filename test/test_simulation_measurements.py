"""The simulated laser, people and furniture."""

import math

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.building import Building, furniture_walls
from hmt_slam_ros.simulation.laser import has_line_of_sight
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.simulation.settings import Settings

ROOM = furniture_walls(np.array([[0.0, 0.0, 0.0, 12.0, 8.0]]))
ROUTE = np.array([[-4.0, 0.0], [4.0, 0.0]])


def in_room(**settings):
    return Scenario(Building(ROOM, ROUTE), Settings(**settings))


def noiseless(**settings):
    return in_room(range_noise=0.0, dropout=0.0, **settings)


@pytest.mark.parametrize(("field_of_view", "beams"), [(180.0, 361), (270.0, 1081), (360.0, 360), (90.0, 7)])
def test_end_points_lie_on_the_walls_whatever_the_field_of_view(field_of_view, beams):
    scenario = noiseless(field_of_view=field_of_view, beams=beams, forward=0.3)
    scan = scenario.scan(20)
    points = se2.transform(scenario.true_poses(np.array([scan.stamp]))[0], scan.points)
    assert len(points) == beams
    on_wall = np.minimum(np.abs(np.abs(points[:, 0]) - 6.0), np.abs(np.abs(points[:, 1]) - 4.0))
    assert on_wall.max() < 1e-5
    angles = scan.angle_min + scan.angle_increment * np.arange(beams)
    assert math.degrees(angles[0]) == pytest.approx(-0.5 * field_of_view, abs=1e-4)
    assert math.degrees(angles[-1] - angles[0]) == pytest.approx(min(field_of_view, 359.0), abs=1e-3)


def test_noise_and_dropout_are_as_requested():
    scans = [in_room(range_noise=0.03, dropout=0.05).scan(k) for k in range(40)]
    truth = [noiseless().scan(k) for k in range(40)]
    valid = np.concatenate([scan.valid for scan in scans])
    errors = np.concatenate([scan.ranges - true.ranges for scan, true in zip(scans, truth, strict=True)])[valid]
    # Of 40 x 361 beams: the deviation of the share is 0.0018, of the mean 0.00025 and of the deviation 0.00018.
    assert 1.0 - valid.mean() == pytest.approx(0.05, abs=0.0073)
    assert errors.mean() == pytest.approx(0.0, abs=0.001)
    assert errors.std() == pytest.approx(0.03, abs=0.0008)
    neighbours = np.corrcoef(errors[:-1], errors[1:])[0, 1]
    assert abs(neighbours) < 0.035


def test_beams_beyond_the_range_do_not_return():
    scan = noiseless(range=5.0).scan(0)
    assert scan.range_max == 5.0
    far = noiseless().scan(0).ranges >= 5.0
    assert far.any()
    assert np.array_equal(np.isinf(scan.ranges), far)


def test_during_a_sweep_the_robot_moves_on():
    scenario = noiseless(sweep=0.1, field_of_view=360.0, beams=360)
    scan = scenario.scan(25)
    assert scan.sweep_duration == pytest.approx(0.1, abs=1e-6)
    at_once = noiseless(field_of_view=360.0, beams=360).scan(25)
    ahead = 180
    assert at_once.ranges[ahead] - scan.ranges[ahead] == pytest.approx(0.6 * 0.1 * 180 / 359, abs=1e-4)
    assert at_once.ranges[0] == pytest.approx(scan.ranges[0], abs=1e-6)


def test_one_scan_is_the_same_whichever_was_made_before_it():
    one, other = in_room(), in_room()
    later = [one.scan(k) for k in (3, 9)][1]
    assert other.scan(9).ranges.tobytes() == later.ranges.tobytes()
    assert in_room(seed=1).scan(9).ranges.tobytes() != later.ranges.tobytes()


def test_people_walk_no_faster_than_people_keep_off_the_robot_and_are_seen():
    scenario = noiseless(people=4)
    empty = noiseless()
    seen = 0
    times = np.arange(0.0, scenario.drive.duration, 0.05)
    poses = scenario.drive.poses(times)
    # Far away from the robot nobody steps aside.
    discs = np.array([scenario.people.discs_at(time, np.array([1e6, 0.0, 0.0])) for time in times])
    speeds = np.hypot(*np.diff(discs[:, :, :2], axis=0).transpose(2, 0, 1)) / 0.05
    assert 0.5 < np.median(speeds) < 1.4
    assert (speeds < 1.4 + 1e-9).mean() > 0.99
    for time, pose in zip(times[::20], poses[::20], strict=True):
        away = scenario.people.discs_at(time, pose)[:, :2] - pose[:2]
        assert np.hypot(*away.T).min() > 0.8 - 1e-9
    for k in range(scenario.scan_stamps.size):
        with_people, without = scenario.scan(k).ranges, empty.scan(k).ranges
        assert (with_people <= without).all()
        seen += int((with_people < without).any())
    assert seen > 10


@pytest.mark.parametrize("seed", range(3))
def test_furniture_is_moved_only_while_the_robot_does_not_see_it_and_is_seen_elsewhere_afterwards(seed):
    scenario = open_simulated(f"sim:busy,seed={seed},people=0").scenario
    stamps = scenario.scan_stamps
    standing = [scenario.furniture(stamp) for stamp in stamps]
    moves = [k for k in range(1, len(stamps)) if not np.array_equal(standing[k - 1], standing[k])]
    assert len(moves) > 5
    for k in moves:
        pieces = np.flatnonzero((standing[k - 1] != standing[k]).any(axis=1))
        eye = scenario.true_poses(stamps[k : k + 1])[0, :2]
        for middle in np.concatenate((standing[k - 1][pieces, :2], standing[k][pieces, :2])):
            near = np.hypot(*(middle - eye)) < scenario.settings.range
            assert not (near and has_line_of_sight(scenario.walls, eye[None], middle[None])[0])


def test_where_nothing_is_moved_the_furniture_stays():
    scenario = open_simulated("sim:office,seed=1").scenario
    assert len(scenario.building.furniture) > 5
    assert np.array_equal(scenario.furniture(scenario.scan_stamps[-1]), scenario.building.furniture)
