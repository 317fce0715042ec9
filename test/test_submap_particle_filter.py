"""The particle filter of one area."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import blank_scan, box, scan_in

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration.scan_to_map import matched_fraction
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.local_filter import PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter

ROOM = np.concatenate((box(-6.02, -4.03, 6.03, 7.01), box(3.51, 1.02, 4.53, 2.52), box(-4.02, 3.03, -3.52, 7.01)))
STEP = np.array([0.1, 0.0, 0.05])
COVARIANCE = np.diag([0.02, 0.02, 0.01]) ** 2
# About the covariance of the prediction by inertia over 0.2 s.
INERTIA = RelativeMotion(STEP, np.diag([0.03, 0.03, 0.04]) ** 2)


def make_prediction(increment, covariance=COVARIANCE, inertia=INERTIA):
    odometry = RelativeMotion(np.asarray(increment), covariance)
    return Prediction(odometry, inertia, fused=odometry)


def drive_filter(mapping, odometry_error=(0.0, 0.0, 0.0), steps=60, hypothesis=0):
    """A filter after a drive on a circle, and the true pose."""
    area_filter = ParticleFilter(mapping, hypothesis, area=0)
    truth = np.zeros(3)
    area_filter.add_keyframe(0, scan_in(ROOM, truth))
    events = 0
    for k in range(1, steps):
        truth = se2.compose(truth, STEP)
        scan = scan_in(ROOM, truth, noise=0.01, seed=k)
        prepared = PreparedScan(mapping, scan)
        area_filter.track(prepared, make_prediction(STEP + np.asarray(odometry_error)))
        if k % 5 == 0:
            events += 1
            area_filter.update(prepared, events)
            area_filter.add_keyframe(events, scan)
    return area_filter, truth


def test_the_robot_is_found_though_odometry_drifts():
    area_filter, truth = drive_filter(LocalMapping(Configuration()), odometry_error=(0.02, 0.01, 0.01))
    dead_reckoned = 59 * np.array([0.02, 0.01, 0.01])
    error = se2.between(truth, area_filter.pose)
    assert np.hypot(*error[:2]) < 0.05 < 0.1 * np.hypot(*dead_reckoned[:2])
    assert abs(error[2]) < np.radians(0.5)


def test_one_seed_gives_one_result_bit_for_bit_and_another_seed_another():
    first, _ = drive_filter(LocalMapping(Configuration(seed=1)))
    again, _ = drive_filter(LocalMapping(Configuration(seed=1)))
    other, _ = drive_filter(LocalMapping(Configuration(seed=2)))
    np.testing.assert_array_equal(first.poses, again.poses)
    np.testing.assert_array_equal(first.log_weights, again.log_weights)
    assert (first.poses != other.poses).any()


def test_a_branch_goes_its_own_way():
    mapping = LocalMapping(Configuration())
    parent, _ = drive_filter(mapping, steps=20)
    child = parent.branch(1)
    before = parent.poses.copy(), parent.keyframe_poses.copy()
    scan = scan_in(ROOM, (1.0, 0.5, 0.3))
    child.track(PreparedScan(mapping, scan), make_prediction(STEP))
    child.update(PreparedScan(mapping, scan), 99)
    child.add_keyframe(99, scan)
    np.testing.assert_array_equal(parent.poses, before[0])
    np.testing.assert_array_equal(parent.keyframe_poses, before[1])
    assert parent.keyframes[-1] != 99
    child.release()
    parent.release()
    assert mapping.pool.patches_in_use == 0


def test_resampling_keeps_the_leader_and_drops_what_has_no_weight():
    mapping = LocalMapping(Configuration())
    area_filter, _ = drive_filter(mapping, steps=8)
    count = len(area_filter.poses)
    area_filter.log_weights = np.full(count, -50.0)
    area_filter.log_weights[count - 1] = 0.0
    leading = area_filter.keyframe_poses[count - 1].copy()
    scan = scan_in(ROOM, (0.8, 0.1, 0.35))
    step = area_filter.update(PreparedScan(mapping, scan), 50)
    assert step.effective_samples == pytest.approx(1.0, abs=0.1)
    assert step.keyframes_moved
    assert area_filter.leader == 0
    for poses in area_filter.keyframe_poses:
        np.testing.assert_array_equal(poses, leading)
    np.testing.assert_array_equal(area_filter.log_weights, 0.0)


def test_the_leader_stays_until_another_is_clearly_more_likely():
    area_filter, _ = drive_filter(LocalMapping(with_changes(Configuration(), {"filter.ess_fraction": 0.0})), steps=8)
    leader, count = area_filter.leader, len(area_filter.poses)
    other = (leader + 1) % count
    for advantage, leads in ((0.0, leader), (2.9, leader), (3.1, other)):
        area_filter.log_weights = np.full(count, -5.0)
        area_filter.log_weights[leader], area_filter.log_weights[other] = -advantage, 0.0
        # A scan without returns makes none likelier.
        area_filter.track(PreparedScan(area_filter.mapping, blank_scan()), make_prediction(STEP))
        area_filter.update(PreparedScan(area_filter.mapping, blank_scan()), 50)
        np.testing.assert_array_equal(area_filter.pose, area_filter.poses[area_filter.leader])
        assert area_filter.leader == leads


def test_a_leader_that_is_less_likely_though_not_clearly_is_kept_by_resampling():
    area_filter, _ = drive_filter(LocalMapping(Configuration()), steps=8)
    count = len(area_filter.poses)
    leader, heaviest = area_filter.leader, (area_filter.leader + 1) % count
    area_filter.log_weights = np.full(count, -50.0)
    area_filter.log_weights[heaviest], area_filter.log_weights[leader] = 0.0, -2.9
    histories = area_filter.keyframe_poses[[leader, heaviest]]
    step = area_filter.update(PreparedScan(area_filter.mapping, blank_scan()), 50)
    assert not step.keyframes_moved
    np.testing.assert_array_equal(area_filter.log_weights, 0.0)
    np.testing.assert_array_equal(area_filter.leading_keyframe_poses(), histories[0])
    shares = [(area_filter.keyframe_poses == history).all(axis=(1, 2)).sum() for history in histories]
    assert shares == [1, count - 1]


def test_a_particle_that_is_clearly_more_likely_takes_the_lead_and_it_is_reported():
    area_filter, _ = drive_filter(LocalMapping(Configuration()), steps=8)
    count = len(area_filter.poses)
    heaviest = (area_filter.leader + 1) % count
    area_filter.log_weights = np.full(count, -50.0)
    area_filter.log_weights[heaviest] = 0.0
    leading = area_filter.keyframe_poses[heaviest].copy()
    assert area_filter.update(PreparedScan(area_filter.mapping, blank_scan()), 50).keyframes_moved
    np.testing.assert_array_equal(area_filter.leading_keyframe_poses(), leading)


def test_the_motion_of_a_step_is_that_of_one_particle_also_where_the_lead_changes():
    area_filter, _ = drive_filter(LocalMapping(Configuration()), steps=8)
    area_filter.update(PreparedScan(area_filter.mapping, blank_scan()), 49)
    other = (area_filter.leader + 1) % len(area_filter.poses)
    area_filter.poses[other] = area_filter._last_poses[other] = area_filter._predicted_poses[other] = (1.0, 2.0, 0.5)
    area_filter.log_weights = np.full(len(area_filter.poses), -10.0)
    area_filter.log_weights[other] = 0.0
    area_filter.track(PreparedScan(area_filter.mapping, blank_scan()), make_prediction(STEP))
    step = area_filter.update(PreparedScan(area_filter.mapping, blank_scan()), 50)
    assert step.keyframes_moved
    np.testing.assert_allclose(step.increment, STEP, atol=1e-9)


def test_effective_samples_equal_the_particles_where_all_weigh_the_same():
    mapping = LocalMapping(Configuration())
    area_filter = ParticleFilter(mapping, 0, 0)
    area_filter.track(PreparedScan(area_filter.mapping, blank_scan()), make_prediction(STEP))
    step = area_filter.update(PreparedScan(area_filter.mapping, blank_scan()), 1)
    assert step.effective_samples == pytest.approx(len(area_filter.poses))


def test_without_returns_the_particles_spread_as_odometry_says():
    configuration = Configuration()
    configuration = replace(configuration, filter=replace(configuration.filter, particles=400))
    area_filter = ParticleFilter(LocalMapping(configuration), 0, 0)
    blank = PreparedScan(area_filter.mapping, blank_scan())
    area_filter.track(blank, make_prediction([1.0, 0.0, 0.0], np.diag([0.2, 0.1, 0.05]) ** 2))
    area_filter.update(blank, 1)
    spread = area_filter.poses[1:].std(axis=0)
    np.testing.assert_allclose(spread, [0.2, 0.1, 0.05], rtol=0.1)


def test_a_scan_of_another_place_than_the_map_leaves_the_pose_as_uncertain_as_the_motion():
    mapping = LocalMapping(Configuration())
    area_filter, _ = drive_filter(mapping, steps=30)
    before, deviations = area_filter.pose, np.array([0.5, 0.5, 0.7])
    elsewhere = scan_in(box(-0.5, -0.6, 0.7, 0.6), np.zeros(3))
    prepared = PreparedScan(mapping, elsewhere)
    wide = RelativeMotion(np.array([2.0, 0.0, 1.0]), np.diag(deviations) ** 2)
    area_filter.track(prepared, Prediction(wide, wide, fused=wide))
    step = area_filter.update(prepared, 99)
    np.testing.assert_allclose(se2.between(before, area_filter.pose), wide.increment, atol=0.005)
    assert not step.information.any()
    assert (np.sqrt(np.diag(step.match_error.drift_covariance)) > 0.9 * deviations).all()
    # A scan that fits the map is measured again.
    back = RelativeMotion(se2.between(area_filter.pose, before), np.diag([0.05, 0.05, 0.02]) ** 2)
    fitting = PreparedScan(mapping, scan_in(ROOM, before))
    area_filter.track(fitting, Prediction(back, back, fused=back))
    assert area_filter.update(fitting, 100).information.any()


def test_a_lost_robot_is_found_by_the_search():
    mapping = LocalMapping(Configuration())
    area_filter, truth = drive_filter(mapping, steps=30)
    scan = scan_in(ROOM, se2.compose(truth, (0.3, 0.2, np.radians(12))))
    area_filter.track(PreparedScan(mapping, scan), make_prediction(np.zeros(3), np.diag([0.1, 0.1, 0.1]) ** 2))
    error = se2.between(se2.compose(truth, (0.3, 0.2, np.radians(12))), area_filter.pose)
    assert np.hypot(*error[:2]) < 0.05
    assert abs(error[2]) < np.radians(1.0)


def test_a_change_of_area_moves_frame_and_map_together():
    mapping = LocalMapping(Configuration())
    area_filter, truth = drive_filter(mapping, steps=30)
    new_T_old = np.array([3.0, -1.0, 0.8])
    poses = [np.zeros(3)]
    for _ in range(3):
        poses.append(se2.compose(poses[-1], se2.exp(10.0 * STEP)))
    content = [PlacedKeyframe(k, 7, scan_in(ROOM, pose), se2.compose(new_T_old, pose)) for k, pose in enumerate(poses)]
    area_filter.change_area(7, new_T_old, content)
    truth = se2.compose(truth, STEP)
    area_filter.track(PreparedScan(mapping, scan_in(ROOM, truth)), make_prediction(STEP))
    error = se2.between(se2.compose(new_T_old, truth), area_filter.pose)
    assert np.hypot(*error[:2]) < 0.03
    assert area_filter.area == 7
    assert area_filter.keyframes == [0, 1, 2, 3]
    area_filter.release()
    assert mapping.pool.patches_in_use == 0


def test_in_another_area_each_particle_stays_where_it_is_from_the_newest_keyframe():
    """Where the robot saw nothing the particles spread, so that each has the first keyframe of the area elsewhere."""
    area_filter = ParticleFilter(LocalMapping(Configuration()), 0, 0)
    blank = PreparedScan(area_filter.mapping, blank_scan())
    area_filter.track(blank, make_prediction([8.0, 0.0, 0.0], np.diag([2.0, 2.0, 0.3]) ** 2))
    area_filter.update(blank, 1)
    scan = scan_in(ROOM, np.zeros(3))
    area_filter.add_keyframe(1, scan)
    seen = np.random.default_rng(0).normal(size=area_filter.poses.shape) * [0.02, 0.02, 0.01]
    area_filter.poses = se2.compose(area_filter.poses, seen)
    leader, new_T_old = area_filter.pose.copy(), se2.inverse(area_filter.leading_keyframe_poses()[-1])
    assert area_filter.poses[:, :2].std() > 1.0
    area_filter.change_area(3, new_T_old, [PlacedKeyframe(1, 3, scan, np.zeros(3))])
    np.testing.assert_allclose(area_filter.poses, seen, atol=1e-9)
    np.testing.assert_allclose(area_filter.pose, se2.compose(new_T_old, leader), atol=1e-9)


def test_beams_beyond_the_range_tell_free_space_up_to_it():
    configuration = Configuration()
    mapping = LocalMapping(replace(configuration, local_map=replace(configuration.local_map, max_range=5.0)))
    points, free, _ = mapping.mapped_beams(scan_in(ROOM, (0, 0, 0), laser_pose=(0.2, 0.1, 0.3)))
    assert np.hypot(*(points - (0.2, 0.1)).T).max() <= 5.0
    np.testing.assert_allclose(np.hypot(*(free - (0.2, 0.1)).T), 5.0)
    assert len(points) + len(free) == 181


def test_when_keyframes_move_the_map_is_rebuilt_and_the_robot_stays_where_it_is_from_its_anchor():
    area_filter, _ = drive_filter(LocalMapping(Configuration()), steps=30)
    scans = {0: scan_in(ROOM, np.zeros(3))}
    truth = np.zeros(3)
    for k in range(1, 30):
        truth = se2.compose(truth, STEP)
        if k % 5 == 0:
            scans[k // 5] = scan_in(ROOM, truth, noise=0.01, seed=k)
    anchor = area_filter.keyframes.index(2)
    seen = se2.between(area_filter.keyframe_poses[:, anchor], area_filter.poses)
    shift = np.array([0.3, -0.2, 0.1])
    poses = se2.compose(shift, area_filter.leading_keyframe_poses())
    content = [PlacedKeyframe(k, 0, scans[k], pose) for k, pose in zip(area_filter.keyframes, poses, strict=True)]
    area_filter.reload(content, 2)
    np.testing.assert_allclose(area_filter.leading_keyframe_poses(), poses)
    np.testing.assert_allclose(se2.between(poses[anchor], area_filter.poses), seen, atol=1e-9)
    points = area_filter.mapping.matching_surfels(scans[2])
    assert matched_fraction(points, poses[anchor], area_filter._leading_view(), area_filter.mapping.hit_distance) > 0.9
