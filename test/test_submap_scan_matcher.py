"""Tracking: odometry is believed, unless the scan fits much better elsewhere."""

import numpy as np
import pytest
from worlds import blank_scan, box, scan_in

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter

ROOM = np.concatenate((box(-6.02, -4.03, 6.03, 7.01), box(3.51, 1.02, 4.53, 2.52), box(-4.02, 3.03, -3.52, 7.01)))
CORRIDOR = np.array([[-100.0, -1.22, 100.0, -1.22], [-100.0, 1.22, 100.0, 1.22]])
SURE = np.diag([0.02, 0.02, 0.01]) ** 2
# About the covariance of the prediction by inertia over a second.
VAGUE = np.diag([0.5, 0.5, 1.0]) ** 2
STILL = RelativeMotion(np.zeros(3), VAGUE)


@pytest.fixture(scope="module")
def mapping():
    return LocalMapping(Configuration())


def map_walls(mapping, walls, poses, beams=361):
    """A filter at the origin whose map holds the walls, as seen all round from some poses."""
    area_filter = ParticleFilter(mapping, 0, 0)
    for k, pose in enumerate(poses):
        area_filter.poses[:] = pose
        area_filter.add_keyframe(k, scan_in(walls, pose, beams=beams, field_of_view=2 * np.pi))
    area_filter.poses[:] = 0.0
    area_filter._restart_prediction()
    return area_filter


def make_prediction(odometry, inertia=STILL):
    """A prediction where odometry is as good as its model."""
    return Prediction(odometry, inertia, fused=inertia if odometry is None else odometry)


def track(area_filter, walls, truth, odometry, inertia=STILL):
    prepared = PreparedScan(area_filter.mapping, scan_in(walls, truth, noise=0.01))
    return area_filter.track(prepared, make_prediction(odometry, inertia))


def error_of(pose, truth):
    error = se2.between(truth, pose)
    return np.hypot(error[0], error[1]), abs(np.degrees(error[2]))


@pytest.mark.parametrize("slip", [-35.0, -10.0, 10.0, 35.0])
def test_a_heading_slip_is_found_and_reported(mapping, slip):
    area_filter = map_walls(mapping, ROOM, [(0, 0, 0)])
    truth = np.array([0.3, 0.1, 0.2])
    slipped = se2.compose(truth, (0.0, 0.0, np.radians(slip)))
    tracked = track(area_filter, ROOM, truth, RelativeMotion(slipped, SURE))
    distance, angle = error_of(area_filter.pose, truth)
    assert distance < 0.05
    assert angle < 1.0
    assert tracked.contradicts_odometry


def test_odometry_that_the_scan_confirms_is_not_rejected(mapping):
    area_filter = map_walls(mapping, ROOM, [(0, 0, 0)])
    truth = np.array([0.3, 0.1, 0.2])
    tracked = track(area_filter, ROOM, truth, RelativeMotion(truth + np.array([0.02, -0.02, 0.01]), SURE))
    assert not tracked.contradicts_odometry
    np.testing.assert_allclose(area_filter.pose, truth, atol=0.02)


def test_after_a_slip_the_particles_spread_in_heading_alone(mapping):
    area_filter = map_walls(mapping, CORRIDOR, [(x, 0, 0) for x in range(-6, 7)])
    truth = np.array([0.3, 0.0, 0.0])
    track(area_filter, CORRIDOR, truth, RelativeMotion(np.array([0.3, 0.0, np.radians(30.0)]), SURE))
    spread = np.sqrt(np.diag(area_filter._modes.tracked[0].motion_since_update.covariance))
    assert 20.0 < np.degrees(spread[2]) < 31.0
    assert spread[:2].max() < 0.2
    np.testing.assert_allclose(area_filter.pose, truth, atol=0.05)


def test_in_a_corridor_that_looks_the_same_all_along_odometry_tells_how_far(mapping):
    area_filter = map_walls(mapping, CORRIDOR, [(x, 0, 0) for x in range(-6, 7)])
    for k in range(1, 11):
        truth = np.array([0.3 * k, 0.0, 0.0])
        # The velocity has it that the robot stands; and people hide a third of the walls.
        scan = scan_in(CORRIDOR, truth, noise=0.01, seed=k)
        scan.ranges[60:120] = 0.9
        prepared = PreparedScan(mapping, scan)
        tracked = area_filter.track(prepared, make_prediction(RelativeMotion(np.array([0.3, 0.0, 0.0]), SURE)))
        assert not tracked.contradicts_odometry
    assert area_filter.pose[0] == pytest.approx(3.0, abs=0.1)


def test_a_scan_that_shows_nothing_of_the_map_is_placed_by_odometry(mapping):
    area_filter = map_walls(mapping, ROOM, [(0, 0, 0)])
    elsewhere = box(-1.0, -0.6, 14.0, 0.9)
    area_filter.poses[:] = area_filter._predicted_poses[:] = (40.0, 0.0, 0.0)
    prepared = PreparedScan(mapping, scan_in(elsewhere, np.zeros(3)))
    tracked = area_filter.track(prepared, make_prediction(RelativeMotion(np.array([0.3, 0.0, 0.1]), SURE)))
    np.testing.assert_allclose(area_filter.pose, [40.3, 0.0, 0.1], atol=1e-6)
    np.testing.assert_allclose(tracked.information, 0.0, atol=1e-9)
    assert not tracked.contradicts_odometry
    # Nothing proves odometry: with a probability of 1 % it is wrong.
    wider = np.diag(area_filter._modes.tracked[0].motion_since_update.covariance - SURE)
    assert (wider[:2] >= 0.01 * np.diag(VAGUE)[:2]).all()


def test_without_odometry_the_scan_is_searched_for_around_what_the_velocity_predicts(mapping):
    area_filter = map_walls(mapping, ROOM, [(0, 0, 0), (1, 1, 2)])
    truth = np.array([0.8, 0.6, np.radians(40.0)])
    tracked = track(area_filter, ROOM, truth, None)
    distance, angle = error_of(area_filter.pose, truth)
    assert distance < 0.05
    assert angle < 1.0
    assert not tracked.contradicts_odometry


def test_a_certain_prediction_stands_where_there_is_nothing_to_match(mapping):
    area_filter = ParticleFilter(mapping, 0, 0)
    area_filter.track(
        PreparedScan(mapping, blank_scan()), make_prediction(RelativeMotion(np.array([0.1, 0.0, 0.0]), SURE))
    )
    np.testing.assert_allclose(area_filter.pose, [0.1, 0.0, 0.0], atol=1e-12)


def with_niches(seed=0, length=60.0):
    """A corridor 2.4 m wide along x with doors on both sides, 0.9 m wide and 12 cm deep, every 1.3 to 2.9 m."""
    random = np.random.default_rng(seed)
    walls = []
    for y, behind in ((-1.22, -1.34), (1.22, 1.34)):
        x = -length
        while x < length:
            door = x + random.uniform(0.4, 2.0)
            walls += [[x, y, door, y], [door, y, door, behind], [door, behind, door + 0.9, behind]]
            x = door + 0.9
            walls.append([x, behind, x, y])
    return np.array(walls)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("ahead", [0.35, 0.6])
def test_along_a_corridor_the_best_of_many_fits_is_taken(mapping, seed, ahead):
    walls = with_niches(seed)
    area_filter = map_walls(mapping, walls, [(x, 0, 0) for x in np.arange(-6.0, 0.1, 0.5)])
    truth = np.array([ahead, 0.05, 0.02])
    track(area_filter, walls, truth, None, RelativeMotion(np.zeros(3), np.diag([0.3, 0.05, 0.05]) ** 2))
    distance, angle = error_of(area_filter.pose, truth)
    assert distance < 0.15
    assert angle < 1.0


def test_what_the_scans_leave_open_is_extrapolated_until_the_next_keyframe(mapping):
    area_filter = map_walls(mapping, CORRIDOR, [(x, 0, 0) for x in range(-6, 7)])
    along = []
    for k in range(1, 9):
        truth = np.array([0.1 * k, 0.0, 0.0])
        track(area_filter, CORRIDOR, truth, RelativeMotion(np.array([0.1, 0.0, 0.0]), SURE))
        deviations = np.sqrt(np.diag(area_filter._modes.tracked[0].residual_covariance))
        along.append(deviations[0])
        assert deviations[1] < 0.02
        assert deviations[2] < 0.01
    assert (np.diff(along) > 0).all()
    assert along[-1] == pytest.approx(np.sqrt(8) * 0.02, rel=0.2)
    area_filter.update(PreparedScan(mapping, scan_in(CORRIDOR, truth)), 1)
    np.testing.assert_array_equal(area_filter._modes.tracked[0].residual_covariance, 0.0)


@pytest.mark.parametrize("beams", [81, 91, 101])
def test_a_turn_that_odometry_missed_in_a_pause_is_found_by_a_scan_that_fits_there_and_not_here(mapping, beams):
    area_filter = map_walls(mapping, ROOM, [(0, 0, 0)])
    truth = np.array([0.0, -0.45, -1.4])
    prepared = PreparedScan(mapping, scan_in(ROOM, truth, beams=beams, noise=0.01))
    prediction = make_prediction(
        RelativeMotion(np.array([0.0, 0.0, -0.4]), SURE), RelativeMotion(np.array([0.0, -0.2, -1.6]), 16.0 * VAGUE)
    )
    tracked = area_filter.track(prepared, prediction)
    distance, angle = error_of(area_filter.pose, truth)
    assert distance < 0.1
    assert angle < 2.0
    assert tracked.contradicts_odometry


def test_a_reset_of_odometry_that_leads_to_a_place_that_looks_alike_is_not_believed(mapping):
    """The reset is a step of 14 m in 0.2 s, into a room with the same walls but for a box."""
    twin = np.concatenate((box(7.98, -4.03, 20.03, 7.01), box(9.98, 3.03, 10.48, 7.01)))
    area_filter = map_walls(mapping, np.concatenate((ROOM, twin)), [(0, 0, 0), (14, 0, 0)])
    truth, reset = np.array([0.1, 0.0, 0.02]), np.array([14.1, 0.0, 0.02])
    inertia = RelativeMotion(truth, np.diag([0.05, 0.05, 0.1]) ** 2)
    tracked = track(area_filter, ROOM, truth, RelativeMotion(reset, np.diag([1.4, 1.4, 0.01]) ** 2), inertia)
    assert tracked.contradicts_odometry
    np.testing.assert_allclose(area_filter.pose, truth, atol=0.02)
