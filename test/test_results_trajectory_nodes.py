"""The nodes of the final refinement, from the small run of test_output_folder whose right answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from test_results_final_map import blind, room_recording, room_scan, with_arc
from test_results_output_folder import EVERY, SCANS, STAMPS, TRUTH, make_recorder

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.pose_graph import Edges, optimize
from hmt_slam_ros.loop_closure import joint_refinement
from hmt_slam_ros.loop_closure.joint_refinement import concatenate_edges
from hmt_slam_ros.results.final_map import final_map
from hmt_slam_ros.results.recorder import Recording
from hmt_slam_ros.results.trajectories import trajectory_in_map
from hmt_slam_ros.results.trajectory_nodes import (
    follow_nodes,
    motion_edges,
    node_scans,
    select_nodes,
)

MOTION = Configuration().motion
KEYFRAMES = np.arange(0, SCANS, EVERY)
PASS = np.arange(5, 8)
"""Scans between two keyframes."""


def recording_of(recording: Recording, offset: float) -> Recording:
    """The recording with the scans of the pass placed beside their place, m along the corridor."""
    relative = recording.relative_trajectory
    poses = relative.poses.copy()
    poses[PASS] = se2.compose(poses[PASS], [offset, 0.0, 0.0])
    relative = relative._replace(poses=poses)
    frames = {area: belief.mean for area, belief in recording.area_poses.items()}
    keyframes = {
        keyframe: se2.compose(frame, pose)
        for area, frame in frames.items()
        for keyframe, pose in recording.hybrid_map.keyframes(area).items()
    }
    return replace(recording, relative_trajectory=relative, trajectory=trajectory_in_map(relative, keyframes))


def test_nodes_are_all_keyframes_and_scans_as_far_apart_as_these() -> None:
    recorder = make_recorder()
    recording = recorder.finish(STAMPS)
    nodes = select_nodes(recording, recorder.configuration)
    assert nodes.rows[nodes.is_keyframe].tolist() == KEYFRAMES.tolist()
    assert nodes.keyframes[nodes.is_keyframe].tolist() == list(range(len(KEYFRAMES)))
    np.testing.assert_allclose(nodes.poses, TRUTH[nodes.rows], atol=1e-9)
    frames = np.array([recording.area_poses[area].mean for area in nodes.areas.tolist()])
    np.testing.assert_allclose(se2.compose(frames, nodes.poses_in_area), nodes.poses, atol=1e-9)
    steps = np.hypot(*np.diff(TRUTH[nodes.rows], axis=0)[:, :2].T)
    least = recorder.configuration.filter.keyframe_distance
    assert steps[~nodes.is_keyframe[1:]].min() >= least
    assert 0.5 * least <= steps.min()
    assert steps.max() < 2.0 * least


def test_where_keyframes_are_close_there_are_no_other_nodes() -> None:
    recorder = make_recorder()
    configuration = replace(
        recorder.configuration,
        filter=replace(recorder.configuration.filter, keyframe_distance=1.5, keyframe_angle=30.0),
    )
    nodes = select_nodes(recorder.finish(STAMPS), configuration)
    assert nodes.rows.tolist()[: len(KEYFRAMES)] == KEYFRAMES.tolist()


def test_a_turn_on_the_spot_has_nodes_as_well() -> None:
    recorder = make_recorder()
    recording = recorder.finish(STAMPS)
    turning = recording.trajectory.copy()
    turning[KEYFRAMES[-1] :, :2] = turning[KEYFRAMES[-1], :2]
    turning[KEYFRAMES[-1] :, 2] += np.radians(30.0) * np.arange(SCANS - KEYFRAMES[-1])
    nodes = select_nodes(replace(recording, trajectory=turning), recorder.configuration)
    assert nodes.rows[nodes.rows > KEYFRAMES[-1]].tolist() == list(range(KEYFRAMES[-1] + 1, SCANS))


def test_scans_of_nodes_are_those_of_the_log_and_the_stored_ones_of_keyframes() -> None:
    recorder = make_recorder()
    recording = room_recording(recorder)
    nodes = select_nodes(recording, recorder.configuration)
    scans = node_scans(nodes, recording, map(room_scan, range(SCANS)))
    assert [scan.stamp for scan in scans] == STAMPS[nodes.rows].tolist()
    for scan, keyframe, own in zip(scans, nodes.keyframes.tolist(), nodes.is_keyframe.tolist(), strict=True):
        assert (scan is recording.replica.scans[keyframe]) == own


def test_odometry_tells_the_motion_where_it_had_no_fault_between_keyframes() -> None:
    recorder = make_recorder()
    recording = recording_of(recorder.finish(STAMPS), 0.6)
    odometry = TRUTH.copy()
    odometry[KEYFRAMES[-1] :, 0] += 0.9  # a slip between the last two keyframes
    configuration = replace(
        recorder.configuration, filter=replace(recorder.configuration.filter, keyframe_distance=0.8)
    )
    nodes = select_nodes(replace(recording, odometry=odometry), configuration)
    matched, measured = motion_edges(nodes, replace(recording, odometry=odometry), MOTION)
    assert sorted([*matched.sources, *measured.sources]) == list(range(len(nodes.rows) - 1))
    for edges, poses in ((matched, nodes.poses), (measured, odometry[nodes.rows])):
        np.testing.assert_array_equal(edges.targets, edges.sources + 1)
        np.testing.assert_allclose(edges.poses, se2.between(poses[edges.sources], poses[edges.targets]), atol=1e-9)


@pytest.mark.parametrize(("slip", "by_slam"), [(0.1, False), (0.9, True)])
def test_a_fault_of_odometry_between_two_keyframes_is_left_to_metric_slam(slip: float, by_slam: bool) -> None:
    recorder = make_recorder()
    odometry = TRUTH.copy()
    odometry[KEYFRAMES[-1] :, 0] += slip
    recording = replace(recorder.finish(STAMPS), odometry=odometry)
    configuration = replace(
        recorder.configuration, filter=replace(recorder.configuration.filter, keyframe_distance=3.0)
    )
    nodes = select_nodes(recording, configuration)
    assert nodes.is_keyframe.all()
    assert motion_edges(nodes, recording, MOTION).matched.sources.tolist() == ([len(KEYFRAMES) - 2] if by_slam else [])


@pytest.mark.parametrize(("correction", "jump"), [(0.6, 0.0), (0.0, 20.0)])
def test_a_jump_of_odometry_on_a_pass_is_left_to_metric_slam(correction: float, jump: float) -> None:
    """A correction of the place contradicts odometry as well, but there the robot moves on as before."""
    recorder = make_recorder()
    odometry = TRUTH.copy()
    odometry[PASS[2] :, 1] += jump
    recording = replace(recording_of(recorder.finish(STAMPS), correction), odometry=odometry)
    configuration = replace(
        recorder.configuration, filter=replace(recorder.configuration.filter, keyframe_distance=0.5)
    )
    nodes = select_nodes(recording, configuration)
    matched = motion_edges(nodes, recording, MOTION).matched
    across = np.flatnonzero((nodes.rows[:-1] < PASS[2]) & (nodes.rows[1:] >= PASS[2]))
    assert not nodes.is_keyframe[across[0] : across[0] + 2].all()
    assert matched.sources.tolist() == (across.tolist() if jump else [])
    assert np.sqrt(matched.covariances[:, 0, 0]).max(initial=0.0) < 0.3


@pytest.mark.parametrize(("sigma", "by_slam"), [(0.05, True), (1.0, False)])
def test_between_two_areas_their_arc_is_contradicted_or_metric_slam_is(sigma: float, by_slam: bool) -> None:
    """Area 1 is displaced by 0.9 m since its arc was measured, as a closure moves it where the arc is uncertain."""
    recorder = make_recorder()
    recording = replace(recorder.finish(STAMPS), odometry=TRUTH)
    moved = with_arc(recording, np.array([0.9, 0.0, 0.0]), np.diag([sigma, sigma, 0.02]) ** 2)
    configuration = replace(
        recorder.configuration, filter=replace(recorder.configuration.filter, keyframe_distance=3.0)
    )
    nodes = select_nodes(moved, configuration)
    (border,) = np.flatnonzero(np.diff(nodes.areas))
    assert motion_edges(nodes, moved, MOTION).matched.sources.tolist() == [border] * by_slam


def test_scans_follow_the_nodes_around_them() -> None:
    recorder = make_recorder()
    recording = recorder.finish(STAMPS)
    nodes = select_nodes(recording, recorder.configuration)
    moved = nodes.poses.copy()
    moved[:, 0] += 0.1 * np.arange(len(moved))
    found = follow_nodes(recording, nodes, moved)
    np.testing.assert_allclose(found[nodes.rows], moved, atol=1e-9)
    shift = found[:, 0] - TRUTH[:, 0]
    np.testing.assert_allclose(shift, 0.1 * np.interp(np.arange(SCANS), nodes.rows, np.arange(len(moved))), atol=0.01)


def test_the_scan_of_a_keyframe_that_moved_since_is_where_the_keyframe_is() -> None:
    recorder = make_recorder()
    recording = recorder.finish(STAMPS)
    nodes = select_nodes(recording, recorder.configuration)
    trajectory = recording.trajectory.copy()
    trajectory[KEYFRAMES[2]] += 0.3
    found = follow_nodes(replace(recording, trajectory=trajectory), nodes, nodes.poses)
    np.testing.assert_allclose(found, TRUTH, atol=1e-9)


def test_all_scans_follow_a_single_node() -> None:
    recorder = make_recorder()
    recording = recorder.finish(STAMPS)
    nodes = select_nodes(recording, recorder.configuration)
    one = type(nodes)(*(value[:1] for value in nodes))
    offset = np.array([0.3, -0.2, 0.5])
    found = follow_nodes(recording, one, se2.compose(offset, one.poses))
    np.testing.assert_allclose(found, se2.compose(offset, recording.trajectory), atol=1e-9)


def test_scans_do_not_follow_nodes_of_another_log() -> None:
    """The first log ends with a scan after its last node; the second begins with one before its first node."""
    recorder = make_recorder()
    recording = replace(recorder.finish(STAMPS), first_scans=(0, 10))
    nodes = select_nodes(recording, recorder.configuration)
    kept = ~np.isin(nodes.rows, (9, 10))
    nodes = type(nodes)(*(value[kept] for value in nodes))
    moved = nodes.poses.copy()
    moved[nodes.rows >= 10, 1] += 0.5
    found = follow_nodes(recording, nodes, moved)
    np.testing.assert_allclose(found[:10], TRUTH[:10], atol=1e-9)
    np.testing.assert_allclose(found[10:, 1], TRUTH[10:, 1] + 0.5, atol=1e-9)


CHAIN = 30


def chain(steps: np.ndarray) -> Edges:
    sources = np.arange(len(steps))
    return Edges(sources, sources + 1, steps, np.tile(np.diag([0.07, 0.07, 0.03]) ** 2, (len(steps), 1, 1)))


def solve_chain(steps: np.ndarray, start: np.ndarray, known: dict[int, float]) -> np.ndarray:
    """Places along a corridor by odometry, with places that are known to 1 cm; the first node is fixed at 0."""
    places = np.array([[x, 0.0, 0.0] for x in known.values()])
    surveyed = Edges(
        np.zeros(len(known), np.int64), np.array(list(known)), places, np.tile(0.01**2 * np.eye(3), (len(known), 1, 1))
    )
    poses = start
    for _ in range(4):
        edges = concatenate_edges(surveyed, joint_refinement._limit_pull(chain(steps), poses))
        poses = optimize(poses, edges, 0, marginals=False).poses
    return poses[:, 0]


def test_a_correction_at_the_end_of_a_corridor_spreads_over_all_of_it() -> None:
    """Odometry is 2 % short; the filter noticed in one jump of 0.6 m, beyond the gate for one step."""
    steps = np.tile([0.98, 0.0, 0.0], (CHAIN, 1))
    start = np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0)))
    start[-1, 0] = CHAIN
    found = solve_chain(steps, start, {CHAIN: float(CHAIN)})
    np.testing.assert_allclose(found, np.arange(CHAIN + 1), atol=0.01)


def test_a_fault_of_odometry_between_known_places_does_not_pull_them_apart() -> None:
    steps = np.tile([1.0, 0.0, 0.0], (CHAIN, 1))
    steps[10, 0] = 6.0
    start = np.stack((np.arange(CHAIN + 1.0), np.zeros(CHAIN + 1), np.zeros(CHAIN + 1)), axis=1)
    found = solve_chain(steps, start, {k: float(k) for k in range(1, CHAIN + 1)})
    np.testing.assert_allclose(found, np.arange(CHAIN + 1), atol=0.02)


def test_a_pass_without_features_goes_where_odometry_leads_from_one_known_place_to_the_next() -> None:
    recorder = make_recorder()
    recording = recording_of(room_recording(recorder), 0.2)

    def scans() -> list:
        return [blind(room_scan(row)) if row in PASS else room_scan(row) for row in range(SCANS)]

    off = se2.between(TRUTH, recording.trajectory)
    assert np.abs(off[PASS, 0]).min() > 0.19
    found = final_map(recording, scans, recorder.configuration).recording.trajectory
    off = np.hypot(*se2.between(TRUTH, found)[:, :2].T)
    nodes = select_nodes(recording, recorder.configuration)
    assert np.isin(nodes.rows, PASS).any()
    assert off[nodes.rows].max() < 0.01
    # Between two nodes a scan goes with both.
    assert off.max() < 0.11
