"""How far off a live hypothesis takes its pose to be in its area's frame."""

import itertools
from functools import partial

import numpy as np
import pytest
from worlds import drive, scan_in

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.metric_slam.live_hypothesis import LiveHypothesis
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.local_filter import PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter, ParticleFilters

CORRIDOR = np.array([[-200.0, -1.0, 200.0, -1.0], [-200.0, 1.0, 200.0, 1.0]])
ODOMETRY = np.diag([0.05, 0.05, 0.025]) ** 2
THERE = drive((0.0, 0.1), (8.0, 0.1))
AGAIN = drive((0.1, 0.1), (8.1, 0.1))


class Drive:
    """A hypothesis of a robot in a corridor."""

    def __init__(self):
        configuration = Configuration()
        self.mapping = LocalMapping(configuration)
        self.live = LiveHypothesis(ParticleFilter(self.mapping, 0, 0), configuration.filter)
        self.truth, self.scans = THERE[0], {}
        self.drive_to(THERE[0])

    def drive_to(self, pose, walls=CORRIDOR):
        """Drive to a pose and take a keyframe there; returns its estimate."""
        step = RelativeMotion(se2.between(self.truth, pose), ODOMETRY)
        sequence, self.truth = len(self.scans), pose
        scan = self.scans[sequence] = scan_in(walls, pose, noise=0.01, seed=sequence)
        prepared = PreparedScan(self.mapping, scan)
        if sequence:
            self.live.filter.track(prepared, Prediction(step, step, step))
        is_new = partial(self.live.is_new_viewpoint, scan, self.scans)
        return self.live.process_keyframe(sequence, prepared, after_reset=sequence == 0, is_informative=is_new)

    def drive_along(self, poses, walls=CORRIDOR):
        return [self.drive_to(pose, walls) for pose in poses]


def deviations(estimate):
    return np.sqrt(np.diag(estimate.pose.covariance))


@pytest.fixture(scope="module")
def drives():
    """There by 15 steps, and after a leap back once more over the same ground."""
    drive_ = Drive()
    return drive_.drive_along(THERE[1:]), drive_.drive_along(AGAIN)


def test_over_ground_that_is_mapped_a_bare_corridor_bounds_the_drift_across_alone(drives):
    there, again = drives
    assert all(estimate.stored for estimate in there)
    assert not any(estimate.stored for estimate in again)
    first, last = deviations(there[-1]), deviations(again[-1])
    assert first[0] == pytest.approx(0.05 * np.sqrt(15), rel=0.15)
    assert last[0] == pytest.approx(0.05 * np.sqrt(31), rel=0.15)
    assert last[1] < 0.5 * 0.05 * np.sqrt(31)


def test_where_the_map_is_as_far_off_as_its_keyframes_so_is_a_pose_in_it(drives):
    there, again = drives
    near, far = deviations(again[1]), deviations(again[-1])
    assert near[2] < far[2]
    assert far[2] == pytest.approx(deviations(there[-1])[2], rel=0.5)


def enter_area(live, moved, rebase):
    """After TSBI sent the robot into area 1, with some keyframes."""
    poses = dict(zip(live.filter.keyframes, live.filter.leading_keyframe_poses(), strict=True))
    relabelled = tuple(MovedKeyframe(k, 0, 1, se2.compose(rebase.mean, poses[k])) for k in moved)
    return Hypothesis(0, 0, 1.0, 1, rebase, relabelled), poses


@pytest.mark.parametrize("sigma", [0.1, 0.3])
def test_a_robot_that_enters_an_area_is_as_uncertain_in_it_as_the_newest_keyframe_that_came_over(sigma):
    driven = Drive()
    driven.drive_along(THERE[1:])
    live = driven.live
    reference, newest = live.filter.leading_keyframe_poses()[[12, 15]]
    placed = se2.compose([1.0, 2.0, 0.5], se2.between(reference, newest))
    entry = PoseGaussian(placed, np.diag([sigma, sigma, 0.01]) ** 2)
    rebase = entry.compose(PoseGaussian(se2.inverse(newest), np.zeros((3, 3))))
    hypothesis, poses = enter_area(live, (12, 13, 14, 15), rebase)
    content = [PlacedKeyframe(k, 1, driven.scans[k], se2.compose(rebase.mean, poses[k])) for k in range(16)]
    live.change_area(hypothesis, content, ParticleFilters(live.filter.mapping))
    np.testing.assert_allclose(live.filter.pose, entry.mean, atol=1e-9)
    np.testing.assert_allclose(live.event.pose_covariance, entry.covariance, atol=1e-6)
    assert live.pose_belief().covariance[0, 0] >= 0.9 * sigma**2


def test_a_robot_that_goes_back_into_an_area_is_as_far_off_as_the_map_there_and_along_it_as_the_arc():
    drive_ = Drive()
    drive_.drive_along(THERE[1:])
    live, rebase = drive_.live, PoseGaussian(np.array([-1.0, 0.0, 0.0]), np.diag([0.4, 0.4, 0.0]) ** 2)
    before = live.event.pose_covariance
    hypothesis, poses = enter_area(live, (), rebase)
    content = [PlacedKeyframe(k, 1, drive_.scans[k], se2.compose(rebase.mean, poses[k])) for k in range(16)]
    live.change_area(hypothesis, content, ParticleFilters(live.filter.mapping))
    assert live.event.pose_covariance[0, 0] == pytest.approx(before[0, 0] + 0.16, rel=0.2)
    assert live.event.pose_covariance[1, 1] < 0.05


NOWHERE = np.array([[-200.0, -150.0, 200.0, -150.0]])
"""A wall out of reach."""


def test_a_scan_that_shows_nothing_is_not_stored_and_the_drift_behind_it_counts():
    drive_ = Drive()
    drive_.drive_along(THERE[1:3])
    blind = drive_.drive_along(THERE[3:9], NOWHERE)
    assert not any(estimate.stored for estimate in blind)
    assert all(a[0] < b[0] and a[2] < b[2] for a, b in itertools.pairwise(map(deviations, blind)))
    again = drive_.drive_to(THERE[9])
    assert again.stored
    assert deviations(again)[0] == pytest.approx(0.05 * np.sqrt(9), rel=0.15)
    step = drive_.live.step_covariances[len(drive_.scans) - 1]
    assert np.sqrt(step[0, 0]) == pytest.approx(0.05 * np.sqrt(7), rel=0.15)
    np.testing.assert_array_equal(drive_.live.event.blind_drift, np.zeros((3, 3)))


def test_the_first_scan_of_a_map_is_stored_whatever_it_shows():
    mapping = LocalMapping(Configuration())
    live = LiveHypothesis(ParticleFilter(mapping, 0, 0), Configuration().filter)
    scan = PreparedScan(mapping, scan_in(NOWHERE, THERE[0]))
    assert len(scan.surfels) == 0
    step = RelativeMotion(np.zeros(3), ODOMETRY)
    live.filter.track(scan, Prediction(step, step, step))
    assert live.process_keyframe(0, scan, is_informative=lambda: False).stored


@pytest.mark.parametrize(
    ("beams", "hits", "is_blind"), [(180, 8, True), (180, 9, False), (1080, 54, False), (16, 1, False)]
)
def test_how_many_beams_a_keyframe_needs_goes_by_how_many_there_are(beams, hits, is_blind):
    ranges = np.full(beams, np.inf, np.float32)
    ranges[: hits * max(1, beams // 180)] = 5.0
    scan = Scan(0, ranges, -0.5 * np.pi, np.pi / beams, 0.02, 30.0, np.zeros(3))
    assert PreparedScan(LocalMapping(Configuration()), scan).is_blind == is_blind
