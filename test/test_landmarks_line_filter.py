"""The filter whose local map is one of lines: as good as its odometry is not, and behind the same interface."""

import numpy as np
import pytest
from worlds import blank_scan, box, scan_in

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.landmarks.line_filter import FilterSelector
from hmt_slam_ros.registration.consistency import WALLS_OF_SUBMAP
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.local_filter import PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan

ROOM = np.concatenate((box(-6.02, -4.03, 6.03, 7.01), box(3.51, 1.02, 4.53, 2.52), box(-4.02, 3.03, -3.52, 7.01)))
STEP = np.array([0.1, 0.0, 0.05])
SURE = np.diag([0.03, 0.03, 0.015]) ** 2
INERTIA = RelativeMotion(STEP, np.diag([0.1, 0.1, 0.15]) ** 2)
CONFIGURATION = with_changes(Configuration(), {"local_map.kind": "lines"})


@pytest.fixture(scope="module")
def mapping():
    return LocalMapping(CONFIGURATION)


def make_prediction(increment, inertia=INERTIA):
    odometry = RelativeMotion(np.asarray(increment), SURE)
    return Prediction(odometry, inertia, fused=odometry)


def drive_filter(mapping, odometry_error=(0.0, 0.0, 0.0), steps=60):
    """A filter after a drive on a circle, the true pose and the keyframes' scans."""
    own, truth = FilterSelector(mapping).new(0, 0), np.zeros(3)
    scans = [scan_in(ROOM, truth, noise=0.01)]
    own.add_keyframe(0, scans[0])
    for k in range(1, steps):
        truth = se2.compose(truth, STEP)
        scan = scan_in(ROOM, truth, noise=0.01, seed=k)
        own.track(PreparedScan(mapping, scan), make_prediction(STEP + np.asarray(odometry_error)))
        if k % 5 == 0:
            own.update(PreparedScan(mapping, scan), k // 5)
            own.add_keyframe(k // 5, scan)
            scans.append(scan)
    return own, truth, scans


def place_keyframes(own, scans, frame=(0.0, 0.0, 0.0), area=0):
    poses = se2.compose(np.asarray(frame), own.leading_keyframe_poses())
    return [PlacedKeyframe(k, area, scans[k], pose) for k, pose in zip(own.keyframes, poses, strict=True)]


def test_the_robot_is_found_though_odometry_drifts_and_knows_how_well(mapping):
    own, truth, _ = drive_filter(mapping, odometry_error=(0.02, 0.01, 0.01))
    error = se2.log(se2.between(own.pose, truth))
    assert np.hypot(*error[:2]) < 0.02
    assert abs(error[2]) < np.radians(0.3)
    assert error @ np.linalg.solve(own.line_map.pose.covariance, error) < 16.0


def test_a_step_tells_what_the_match_determines(mapping):
    own, truth, _ = drive_filter(mapping, steps=9)
    scan = PreparedScan(mapping, scan_in(ROOM, se2.compose(truth, STEP), noise=0.01, seed=90))
    tracked = own.track(scan, make_prediction(STEP))
    assert not tracked.contradicts_odometry
    assert np.linalg.eigvalsh(tracked.information)[0] > 1e4
    before = own.pose
    step = own.update(scan, 9)
    np.testing.assert_allclose(own.pose, before)
    np.testing.assert_allclose(step.match_error.gain, np.eye(3), atol=0.1)
    assert np.sqrt(np.diag(step.match_error.pose_covariance)[:2]).max() < 0.01
    assert np.linalg.eigvalsh(step.match_error.drift_covariance).min() > -1e-12
    # Without a line nothing is known but the prediction.
    blank = PreparedScan(mapping, blank_scan())
    own.track(blank, make_prediction(STEP))
    step = own.update(blank, 10)
    np.testing.assert_allclose(step.match_error.gain, 0.0, atol=1e-12)
    np.testing.assert_allclose(step.match_error.pose_covariance, SURE, atol=1e-12)
    assert np.sqrt(np.diag(step.match_error.drift_covariance)[:2]).min() > 0.02


@pytest.mark.parametrize("slip", [-35.0, 35.0])
def test_a_heading_slip_is_found_by_inertia_and_reported(mapping, slip):
    own, truth, _ = drive_filter(mapping, steps=21)
    truth = se2.compose(truth, STEP)
    slipped = se2.compose(STEP, (0.0, 0.0, np.radians(slip)))
    tracked = own.track(PreparedScan(mapping, scan_in(ROOM, truth, noise=0.01)), make_prediction(slipped))
    assert tracked.contradicts_odometry
    error = se2.between(truth, own.pose)
    assert np.hypot(*error[:2]) < 0.03
    assert abs(error[2]) < np.radians(0.5)


def test_a_change_of_area_is_one_of_the_frame_and_loads_its_lines(mapping):
    own, truth, scans = drive_filter(mapping, steps=31)
    new_T_old = np.array([2.0, -1.0, 0.7])
    own.change_area(7, new_T_old, place_keyframes(own, scans, new_T_old, 7))
    assert (own.area, own.keyframe_areas) == (7, [7] * 7)
    assert len(own.line_map) >= 6
    truth = se2.compose(truth, STEP)
    tracked = own.track(PreparedScan(mapping, scan_in(ROOM, truth, noise=0.01, seed=77)), make_prediction(STEP))
    assert not tracked.contradicts_odometry
    np.testing.assert_allclose(own.pose, se2.compose(new_T_old, truth), atol=0.02)


def test_where_keyframes_moved_the_robot_moves_with_one_of_them(mapping):
    own, _, scans = drive_filter(mapping, steps=31)
    anchor = own.leading_keyframe_poses()[4]
    seen = se2.between(anchor, own.pose)
    content = place_keyframes(own, scans, (0.1, 0.0, 0.02))
    own.reload(content, 4)
    np.testing.assert_allclose(se2.between(content[4].pose, own.pose), seen, atol=1e-9)


def test_a_branch_goes_its_own_way_and_a_state_goes_on_to_the_bit(mapping):
    parent, truth, _ = drive_filter(mapping, steps=20)
    before, child = parent.line_map.covariance.copy(), parent.branch(1)
    again = FilterSelector(mapping).restore(parent.state)
    sighting = PreparedScan(mapping, scan_in(ROOM, se2.compose(truth, STEP), noise=0.01, seed=3))
    child.track(sighting, make_prediction(STEP))
    child.add_keyframe(99, sighting.scan)
    np.testing.assert_array_equal(parent.line_map.covariance, before)
    assert (child.hypothesis, parent.hypothesis) == (1, 0)
    assert 99 not in parent.keyframes
    again.track(sighting, make_prediction(STEP))
    np.testing.assert_array_equal(again.line_map.covariance, child.line_map.covariance)
    np.testing.assert_array_equal(again.pose, child.pose)


def test_walls_are_met_where_the_robot_is_and_passed_where_it_is_not(mapping):
    own, truth, _ = drive_filter(mapping)
    found = own.compare_scan(PreparedScan(mapping, scan_in(ROOM, truth, noise=0.01, seed=5)))
    assert found.ends.matched_share > 0.7
    assert found.ends.in_free_space == found.walls.in_free_space == 0
    assert found.walls.on_surface > 30
    elsewhere = own.compare_scan(PreparedScan(mapping, scan_in(box(-9.0, -9.0, 12.0, 9.0), np.zeros(3), noise=0.01)))
    assert elsewhere.walls.in_free_space > 30
    assert WALLS_OF_SUBMAP.log_likelihood_ratio(elsewhere.walls, own.clutter_estimate.wall_outliers.rate) < -10.0


def test_keyframes_are_dropped_and_what_was_known_is_forgotten(mapping):
    own, _, _ = drive_filter(mapping, steps=21)
    kept = own.leading_keyframe_poses()[[0, 2, 4]]
    own.drop_keyframes({1, 3})
    assert own.keyframes == [0, 2, 4]
    np.testing.assert_array_equal(own.leading_keyframe_poses(), kept)
    own.initialize(PoseGaussian.from_pose(own.pose))
    np.testing.assert_array_equal(own.line_map.pose.covariance, 0.0)
    np.testing.assert_array_equal(own.tracking_covariance, 0.0)
    own.track(PreparedScan(mapping, blank_scan()), make_prediction(STEP))
    np.testing.assert_allclose(own.line_map.pose.covariance, SURE, atol=1e-12)


def test_keyframes_of_a_drift_are_corrected_and_reported(mapping):
    # A hallway whose end comes into sight only near it, as it does behind people.
    hallway = box(-2.0, -1.0, 12.0, 1.0)
    own, truth, ahead = FilterSelector(mapping).new(0, 0), np.zeros(3), np.array([0.1, 0.0, 0.0])
    own.add_keyframe(0, scan_in(hallway, truth, noise=0.01))
    for k in range(1, 81):
        truth = se2.compose(truth, ahead)
        sides = hallway[np.abs(hallway[:, 0] - hallway[:, 2]) > 1.0] if 3 < k < 80 else hallway
        sighting = PreparedScan(mapping, scan_in(sides, truth, noise=0.01, seed=k))
        own.track(sighting, make_prediction(ahead - np.array([0.005, 0.0, 0.0])))
        if k % 5 == 0:
            step = own.update(sighting, k)
            own.add_keyframe(k, sighting.scan)
            assert step.keyframes_moved == (k == 80)
    assert own.pose[0] == pytest.approx(8.0, abs=0.03)
    np.testing.assert_allclose(own.leading_keyframe_poses()[:, 0], 0.5 * np.arange(17), atol=0.05)
    assert step.increment[0] == pytest.approx(0.5, abs=0.05)
