"""The stochastic map of a room: consistent, and right about which line is which."""

import numpy as np
import pytest

from benchmark.linemap import map_rooms
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.landmarks.line_extraction import Lines
from hmt_slam_ros.landmarks.stochastic_map import LineMap
from hmt_slam_ros.sensors.relative_motion import RelativeMotion

FEATURES = FeatureParameters()
SIGMAS = np.array([0.004, 0.01])  # rad, m
WALLS = np.array([[0.0, 4.0], [0.5 * np.pi, 3.0], [-np.pi, 2.0], [-0.5 * np.pi, 2.5]])


def observe_walls(pose, walls=WALLS, noise=None, extents=((-1.0, 1.0),)):
    """The lines of a scan at ``map_T_base``: of walls (n, 2) in the map, seen along its extent (n, 2) or (1, 2)."""
    alpha = walls[:, 0] - pose[2]
    cos, sin = np.cos(walls[:, 0]), np.sin(walls[:, 0])
    r = walls[:, 1] - pose[0] * cos - pose[1] * sin
    pieces = np.broadcast_to(np.array(extents, dtype=float), (len(walls), 2)) - (pose[1] * cos - pose[0] * sin)[:, None]
    if noise is not None:
        alpha, r = np.stack((alpha, r)) + SIGMAS[:, None] * noise.standard_normal((2, len(walls)))
    other = r < 0.0
    alpha, r = se2.wrap(np.where(other, alpha + np.pi, alpha)), np.abs(r)
    pieces = np.where(other[:, None], -pieces[:, ::-1], pieces)
    covariances = np.tile(np.diag(SIGMAS**2), (len(walls), 1, 1))
    return Lines(np.stack((alpha, r), axis=1), covariances, pieces, np.arange(len(walls)), np.empty(0, np.int32))


def nees(error, covariance):
    return float(error @ np.linalg.solve(covariance, error))


def error_of(room, line, wall):
    alpha, r = room.lines[line]
    return np.array([float(se2.wrap(alpha - wall[0])), r - wall[1]])


def line_covariance(room, line):
    own = slice(3 + 2 * line, 5 + 2 * line)
    return room.covariance[own, own]


def test_pose_and_lines_are_as_far_off_as_stated():
    deviations, poses, lines = np.array([0.05, 0.05, 0.03]), [], []
    for seed in range(60):
        draw = np.random.default_rng(seed)
        room, true = LineMap(FEATURES), np.zeros(3)
        for k in range(16):
            if k:
                step = np.array([0.2, 0.05, 0.4])
                true = se2.compose(se2.compose(true, step), se2.exp(deviations * draw.standard_normal(3)))
                room.predict(RelativeMotion(step, np.diag(deviations**2)))
            seen = draw.permutation(len(WALLS))[:3]
            room.observe(observe_walls(true, WALLS[seen], draw))
        poses.append(nees(se2.log(se2.between(room.pose.mean, true)), room.pose.covariance))
        assert len(room) == 4
        for line, (alpha, _) in enumerate(room.lines):
            wall = WALLS[np.argmax(np.cos(WALLS[:, 0] - alpha))]
            lines.append(nees(error_of(room, line, wall), line_covariance(room, line)))
    assert 2.0 < np.mean(poses) < 4.2
    assert 1.5 < np.mean(lines) < 2.6


def test_a_motion_and_a_new_line_propagate_uncertainty_as_first_order_says():
    start = PoseGaussian(np.array([0.7, -0.4, 0.6]), np.diag([0.01, 0.02, 0.005]) ** 2)
    step = RelativeMotion(np.array([0.5, 0.1, 0.3]), np.diag([0.02, 0.01, 0.01]) ** 2)
    room = LineMap(FEATURES, start)
    room.predict(step)
    expected = start.compose(PoseGaussian(step.increment, step.covariance))
    np.testing.assert_allclose(room.pose.mean, expected.mean)
    np.testing.assert_allclose(room.pose.covariance, expected.covariance, atol=1e-12)
    # A line that is added has the derivatives of Eq. (9) by the robot's pose, in the covariance of both, Eq. (11).
    before, lines = room.covariance.copy(), observe_walls(room.mean, WALLS[:1])
    assert room.observe(lines).new == ((0, 0),)
    slopes = np.empty((2, 3))
    for k in range(3):
        moved = room.mean[:3] + 1e-6 * np.eye(3)[k]
        other = LineMap(FEATURES, PoseGaussian.from_pose(moved))
        other.observe(lines)
        slopes[:, k] = (other.lines[0] - room.lines[0]) / 1e-6
    np.testing.assert_allclose(room.covariance[3:, :3], slopes @ before, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(room.covariance, room.covariance.T)


def test_a_wall_has_two_faces_and_in_its_plane_noise_does_not_tell_which():
    wall = WALLS[:1]
    room = LineMap(FEATURES, PoseGaussian(np.zeros(3), np.diag([0.001, 0.001, 0.001]) ** 2))
    assert room.observe(observe_walls(np.zeros(3), wall)).new == ((0, 0),)
    # In the door the robot is in the plane of the wall, and noise has it on the other side.
    room.predict(RelativeMotion(np.array([4.0, 0.0, 0.0]), np.diag([0.02, 0.01, 0.002]) ** 2))
    behind = observe_walls(np.array([4.005, 0.0, 0.0]), wall)
    assert abs(behind.parameters[0, 0]) > 3.0
    assert room.observe(behind).matched == ((0, 0),)
    np.testing.assert_allclose(room.lines, wall, atol=0.01)
    # From the other room its other face is seen.
    room.predict(RelativeMotion(np.array([1.0, 0.0, 0.0]), np.diag([0.01, 0.01, 0.002]) ** 2))
    assert room.observe(observe_walls(np.array([5.0, 0.0, 0.0]), wall)).new == ((0, 1),)
    assert np.linalg.eigvalsh(room.covariance).min() > 0.0


def test_what_may_be_either_of_two_lines_is_decided_by_the_others():
    """The recess of a door is nearer to where the wall is predicted than the wall; the wall across the room tells."""
    walls = np.array([[0.0, 4.0], [0.0, 4.08], [-np.pi, 2.0]])
    room = LineMap(FEATURES)
    room.observe(observe_walls(np.zeros(3), walls))
    room.predict(RelativeMotion(np.zeros(3), np.diag([0.05, 0.05, 0.001]) ** 2))
    moved = np.array([0.06, 0.0, 0.0])
    assert room.observe(observe_walls(moved, walls)).matched == ((0, 0), (1, 1), (2, 2))
    room.predict(RelativeMotion(np.zeros(3), np.diag([0.05, 0.05, 0.001]) ** 2))
    found = room.observe(observe_walls(np.array([0.13, 0.0, 0.0]), walls[[1, 2]]))
    assert found.matched == ((0, 1), (1, 2))
    np.testing.assert_allclose(room.mean[:2], [0.13, 0.0], atol=0.01)


def test_only_what_lies_beside_what_was_seen_is_compared():
    """Whether the wall behind a door goes on in the plane of this one, its line cannot tell."""
    step = RelativeMotion(np.zeros(3), np.diag([0.03, 0.03, 0.002]) ** 2)
    room = LineMap(FEATURES)
    for _ in range(FEATURES.min_sightings):
        room.observe(observe_walls(np.zeros(3), WALLS[:1], extents=[(-1.0, 1.0)]))
    room.predict(step)
    beside = np.array([[0.0, 4.06]])
    assert room.observe(observe_walls(np.zeros(3), beside, extents=[(1.1, 2.0)])).new == ((0, 1),)
    room.predict(step)
    assert room.observe(observe_walls(np.zeros(3), WALLS[:1], extents=[(-0.5, 1.5)])).matched == ((0, 0),)
    np.testing.assert_allclose(room.mean[:3], 0.0, atol=1e-3)


def test_pieces_of_one_wall_are_joined_when_their_distance_is_known():
    room, draw, joined = LineMap(FEATURES), np.random.default_rng(0), []
    extents = [(-2.0, -1.0), (1.0, 2.0)]
    for k in range(40):
        walls = np.repeat(WALLS[:1], 2, axis=0)
        found = room.observe(observe_walls(np.zeros(3), walls, draw, extents))
        assert len(found.matched) + len(found.new) == 2
        joined += [(k, *pair) for pair in found.merged]
        room.predict(RelativeMotion(np.zeros(3), np.zeros((3, 3))))
    assert len(joined) == 1
    assert joined[0][0] > 0
    assert [wall.number for wall in room.walls] == [0]
    np.testing.assert_allclose(room.walls[0].segments, extents, atol=0.1)
    assert nees(error_of(room, 0, WALLS[0]), line_covariance(room, 0)) < 9.0


def test_what_may_be_either_of_two_lines_and_nothing_tells_is_neither():
    walls = np.array([[0.0, 4.0], [0.0, 4.04], [0.5 * np.pi, 3.0]])
    room = LineMap(FEATURES)
    for _ in range(3):
        room.observe(observe_walls(np.zeros(3), walls))
    room.predict(RelativeMotion(np.zeros(3), np.diag([0.05, 0.05, 0.001]) ** 2))
    before = room.mean[0]
    found = room.observe(observe_walls(np.array([0.02, 0.0, 0.0]), walls[[1, 2]]))
    assert found.matched == ((1, 2),)
    assert found.new == ()
    assert room.mean[0] == pytest.approx(before, abs=1e-3)
    assert room.pose.covariance[0, 0] > 0.04**2


def test_a_line_that_one_scan_shows_is_forgotten():
    room = LineMap(FEATURES)
    room.observe(observe_walls(np.zeros(3), WALLS))
    for _ in range(FEATURES.min_sightings - 1):
        room.observe(observe_walls(np.zeros(3), WALLS[1:]))
    assert [wall.number for wall in room.walls] == [1, 2, 3]
    room.observe(observe_walls(np.zeros(3), WALLS[:1]))
    assert [wall.number for wall in room.walls] == [1, 2, 3, 4]
    assert room.mean.size == 3 + 2 * 4


def test_a_scan_without_lines_changes_nothing():
    room = LineMap(FEATURES)
    room.observe(observe_walls(np.zeros(3)))
    for _ in range(FEATURES.min_sightings - 1):
        room.observe(observe_walls(np.zeros(3)))
    mean, covariance = room.mean.copy(), room.covariance.copy()
    assert room.observe(observe_walls(np.zeros(3), WALLS[:0])) == ((), (), ())
    np.testing.assert_array_equal(room.mean, mean)
    np.testing.assert_array_equal(room.covariance, covariance)


@pytest.mark.parametrize("kind", ["room", "busy office"])
def test_a_simulated_room_is_mapped_to_the_centimeter(kind):
    drive = map_rooms(kind, 3, "laps=1,rate=2,field_of_view=360,beams=360", Configuration())
    assert drive.pose_nees.mean() < 9.0
    assert 2.0 * drive.pose_sigmas[:, :2].mean() < 0.01
    assert np.abs(drive.pose_errors[:, :2]).max() < 0.03
    assert drive.strays <= 1
    assert drive.bytes[0] < 10.0 * drive.floor


def test_where_the_robot_was_is_corrected_by_what_is_seen_later():
    # Along a hallway whose end is hidden nothing tells how far the robot goes; it goes farther than odometry says.
    room, true, hidden = LineMap(FEATURES), np.zeros(3), WALLS[[1, 3]]
    long = ((-6.0, 6.0),)
    room.observe(observe_walls(true, extents=long), keep_new=True)
    noise, along = np.diag([0.05, 0.02, 0.01]) ** 2, []
    for _ in range(12):
        true = se2.compose(true, np.array([0.15, 0.0, 0.0]))
        room.predict(RelativeMotion(np.array([0.12, 0.0, 0.0]), noise))
        room.observe(observe_walls(true, hidden, extents=long))
        room.clone_pose()
        along.append(true[0])
    off = np.array(along) - room.clones.poses[:, 0]
    assert off[-1] > 0.3
    room.observe(observe_walls(true, extents=long))
    assert np.abs(np.array(along) - room.clones.poses[:, 0]).max() < 0.02
    # A pose that is known is not corrected.
    before = room.clones.poses.copy()
    room.reset_pose(PoseGaussian.from_pose(room.pose.mean + np.array([0.1, 0.0, 0.0])))
    room.observe(observe_walls(true, extents=long))
    np.testing.assert_allclose(room.clones.poses, before, atol=0.02)


def test_marks_are_as_far_off_as_the_state_says():
    # What a mark has in common with the robot is what the robot's covariance was, as long as nothing is observed.
    room, step = LineMap(FEATURES), RelativeMotion(np.array([0.2, 0.0, 0.1]), np.diag([0.05, 0.02, 0.01]) ** 2)
    room.predict(step)
    room.clone_pose()
    np.testing.assert_array_equal(room.clones.cross_covariances[0], room.covariance[:3])
    before = room.covariance.copy()
    room.predict(step)
    np.testing.assert_allclose(room.clones.cross_covariances[0][2, 2], before[2, 2])
    # Its errors turn about where it was: theta moves the robot's x and y.
    lever = room.mean[:2] - room.clones.poses[0, :2]
    turned = before[2, 2] * np.array([-lever[1], lever[0]])
    np.testing.assert_allclose(room.clones.cross_covariances[0][2, :2] - before[2, :2], turned)
