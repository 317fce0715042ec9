"""The final refinement, from the small run of test_output_folder whose right answer is known."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from test_results_output_folder import EVERY, SCANS, STAMPS, TRUTH, make_recorder, scan
from worlds import scan_in, two_rooms

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.messages import Notice
from hmt_slam_ros.results import final_map as results_final_map
from hmt_slam_ros.results.final_map import final_map
from hmt_slam_ros.results.recorder import Recorder, Recording, keyframe_poses
from hmt_slam_ros.results.trajectories import RelativeTrajectory, trajectory_in_map
from hmt_slam_ros.results.trajectory_nodes import select_nodes
from hmt_slam_ros.sensors import Scan


def with_wrong_odometry(recording: Recording) -> Recording:
    """Odometry that turns by 10 degrees more from each keyframe to the next."""
    wrong = np.radians(10.0) / EVERY * np.arange(SCANS)
    return replace(recording, odometry=recording.odometry + np.stack([0.0 * wrong, 0.0 * wrong, wrong], axis=1))


def blind(seen: Scan) -> Scan:
    return replace(seen, ranges=np.full_like(seen.ranges, np.inf))


def test_where_no_scans_overlap_the_motion_that_metric_slam_found_stands() -> None:
    recorder = make_recorder()
    recording = with_wrong_odometry(recorder.finish(STAMPS))
    replica = replace(recording.replica, scans={k: blind(seen) for k, seen in recording.replica.scans.items()})
    scans = [blind(scan(index)) for index in range(SCANS)]
    found = final_map(replace(recording, replica=replica), lambda: scans, recorder.configuration).recording.trajectory
    off = se2.between(TRUTH, found)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 1e-6
    assert np.abs(off[:, 2]).max() < 1e-6


def room_scan(index: int) -> Scan:
    """Two rooms with a door between them, from the true pose."""
    pose = se2.compose(np.array([2.0, 2.9, 0.0]), TRUTH[index])
    return scan_in(two_rooms(), pose, stamp=int(STAMPS[index]), beams=361)


def room_scans() -> Iterator[Scan]:
    return map(room_scan, range(SCANS))


def room_recording(recorder: Recorder) -> Recording:
    """The small run with these scans."""
    recording = recorder.finish(STAMPS)
    scans = {keyframe: room_scan(EVERY * keyframe) for keyframe in recording.replica.scans}
    return replace(recording, replica=replace(recording.replica, scans=scans))


def with_arc(recording: Recording, offset: np.ndarray, covariance: np.ndarray) -> Recording:
    """The recording with area 1 displaced by an offset in the frame of its arc, and a covariance of that."""
    hybrid_map = recording.hybrid_map.branch()
    arc = hybrid_map.arc(0, 1)
    assert arc is not None
    moved = PoseGaussian(se2.compose(arc.mean, offset), covariance)
    hybrid_map.set_arc(0, 1, moved, closure=False)
    origin = PoseGaussian.from_pose(recording.area_poses[0].mean)
    area_poses = recording.area_poses | {1: origin.compose(moved)}
    maps = recording.replica.maps | {recording.replica.best_hypothesis: hybrid_map}
    poses = keyframe_poses(hybrid_map, area_poses)
    return replace(
        recording,
        replica=replace(recording.replica, maps=maps),
        area_poses=area_poses,
        trajectory=trajectory_in_map(recording.relative_trajectory, poses),
    )


def refined_arc(recording: Recording, configuration: Configuration) -> tuple[np.ndarray, tuple[Notice, ...]]:
    """Pose of area 1 in area 0 after the refinement, and its notices."""
    final = final_map(recording, room_scans, configuration).recording
    arc = final.hybrid_map.arc(0, 1)
    assert arc is not None
    return arc.mean, final.notices[len(recording.notices) :]


def test_the_scans_move_an_area_within_what_its_arc_allows() -> None:
    """Its place is off by 0.2 m: a wide arc lets the scans move it, a sure one does not."""
    recorder = make_recorder()
    recording, offset = room_recording(recorder), np.array([0.0, 0.2, 0.0])
    truth = recording.hybrid_map.arc(0, 1)
    assert truth is not None
    ends = {}
    for sigma in (0.3, 0.01):
        wrong = with_arc(recording, offset, np.diag([sigma, sigma, 0.3 * sigma]) ** 2)
        found, notices = refined_arc(wrong, recorder.configuration)
        ends[sigma] = float(np.hypot(*se2.between(truth.mean, found)[:2]))
        assert notices == ()
    assert ends[0.3] < 0.05
    assert ends[0.01] > 0.15


def test_sure_arcs_hold_areas_together() -> None:
    """Area 1 is drawn 0.2 m beside its place by a sure arc, so that no pair of scans may bring it there."""
    recorder = make_recorder()
    sure = with_arc(room_recording(recorder), np.zeros(3), 0.01**2 * np.eye(3))
    arc = sure.hybrid_map.arc(0, 1)
    assert arc is not None
    beside = PoseGaussian(se2.compose(sure.area_poses[1].mean, np.array([0.0, 0.2, 0.0])), arc.covariance)
    found, _ = refined_arc(replace(sure, area_poses=sure.area_poses | {1: beside}), recorder.configuration)
    assert np.hypot(*se2.between(arc.mean, found)[:2]) < 0.05


def test_a_result_with_which_the_scans_agree_less_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = make_recorder()
    recording = room_recording(recorder)
    before = keyframe_poses(recording.hybrid_map, recording.area_poses)

    def scatter(surfaces: object, poses: np.ndarray, *_: object, **__: object) -> np.ndarray:
        return se2.compose(poses, np.random.default_rng(1).normal(0.0, 0.3, poses.shape))

    monkeypatch.setattr(results_final_map, "refine_jointly", scatter)
    final = final_map(recording, room_scans, recorder.configuration).recording
    after = keyframe_poses(final.hybrid_map, final.area_poses)
    for keyframe, pose in before.items():
        np.testing.assert_allclose(after[keyframe], pose, atol=1e-12)


def test_a_notice_names_an_arc_that_was_left_by_more_than_it_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = make_recorder()
    right = room_recording(recorder)
    recording = with_arc(right, np.array([0.3, 0.0, 0.0]), np.diag([0.05, 0.05, 0.02]) ** 2)
    nodes = select_nodes(right, recorder.configuration)
    monkeypatch.setattr(results_final_map, "refine_jointly", lambda *_, **__: nodes.poses)
    _, (notice,) = refined_arc(recording, recorder.configuration)
    assert notice.text.startswith("area 1 moved by 0.30 m and 0.0 degrees as seen from area 0, more than their arc")
    allowed = with_arc(right, np.array([0.3, 0.0, 0.0]), np.diag([0.2, 0.05, 0.02]) ** 2)
    assert refined_arc(allowed, recorder.configuration)[1] == ()


def with_foreign_area(recording: Recording) -> Recording:
    """The recording with an area of another robot beside area 1, to which its last scans are relative."""
    hybrid_map, covariance = recording.hybrid_map.branch(), 1e-4 * np.eye(3)
    scans = dict(recording.replica.scans)
    for number, keyframe in enumerate((-2, -3)):
        hybrid_map.set_keyframe(keyframe, 9, np.array([0.1 * number, 0.0, 0.0]))
        scans[keyframe] = room_scan(SCANS - 1)
    beside = PoseGaussian(np.array([0.3, 0.2, 0.5]), covariance)
    hybrid_map.set_arc(1, 9, beside, closure=True)
    area_poses = recording.area_poses | {9: recording.area_poses[1].compose(beside)}
    poses, relative = keyframe_poses(hybrid_map, area_poses), recording.relative_trajectory
    keyframes, offsets = relative.keyframes.copy(), relative.poses.copy()
    keyframes[-3:], offsets[-3:] = -2, se2.between(poses[-2], recording.trajectory[-3:])
    replica = replace(
        recording.replica, scans=scans, maps=recording.replica.maps | {recording.replica.best_hypothesis: hybrid_map}
    )
    return replace(
        recording,
        replica=replica,
        area_poses=area_poses,
        relative_trajectory=RelativeTrajectory(keyframes, offsets),
    )


def test_the_ground_of_another_robot_moves_with_that_of_its_own() -> None:
    recorder = make_recorder()
    recording = with_arc(room_recording(recorder), np.array([0.1, 0.05, 0.02]), np.diag([0.2, 0.2, 0.05]) ** 2)
    alone = final_map(recording, room_scans, recorder.configuration).recording
    whole = with_foreign_area(recording)
    found = final_map(whole, room_scans, recorder.configuration).recording
    for keyframe in (0, 1):
        own, expected = (each.hybrid_map.keyframes(0)[keyframe] for each in (found, alone))
        np.testing.assert_allclose(own, expected, atol=1e-9)
    np.testing.assert_allclose(found.trajectory, alone.trajectory, atol=1e-9)
    assert not np.allclose(found.area_poses[1].mean, recording.area_poses[1].mean, atol=0.01)
    before, after = (se2.between(poses[1].mean, poses[9].mean) for poses in (whole.area_poses, found.area_poses))
    np.testing.assert_allclose(after, before, atol=1e-9)
    arc = found.hybrid_map.arc(1, 9)
    assert arc is not None
    np.testing.assert_allclose(arc.mean, after, atol=1e-9)
    assert set(found.relative_trajectory.keyframes.tolist()) <= set(alone.replica.scans)
