"""How far off matches are: against the truth of many steps, and what of it the drift keeps."""

import numpy as np
import pytest
from worlds import blank_scan, drive, scan_in, two_rooms

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration.match_covariance import estimate_match_error
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter

CORRIDOR = np.array([[-200.0, -1.0, 200.0, -1.0], [-200.0, 1.0, 200.0, 1.0]])
ODOMETRY = np.diag([0.05, 0.05, 0.025]) ** 2
ROOMS = drive((2.0, 2.0), (5.0, 3.0), (10.0, 3.0))
ALONG = drive((0.0, 0.2), (12.0, 0.2))


def track_drive(walls, truth, seed):
    """Steps of a filter along keyframes (n, 3): poses (n, 3) of the keyframes, and what was found of each step."""
    mapping, random = LocalMapping(Configuration(seed=seed)), np.random.default_rng(seed)
    area_filter = ParticleFilter(mapping, 0, area=0)
    area_filter.add_keyframe(0, scan_in(walls, truth[0], noise=0.015, seed=1000 * seed))
    steps = []
    for k in range(1, len(truth)):
        noise = se2.exp(np.sqrt(np.diag(ODOMETRY)) * random.standard_normal(3))
        step = RelativeMotion(se2.compose(se2.between(truth[k - 1], truth[k]), noise), ODOMETRY)
        scan = scan_in(walls, truth[k], noise=0.015, seed=1000 * seed + k)
        prepared = PreparedScan(mapping, scan)
        area_filter.track(prepared, Prediction(step, step, step))
        steps.append(area_filter.update(prepared, k))
        area_filter.add_keyframe(k, scan)
    return area_filter.leading_keyframe_poses(), steps


def drift(poses, steps):
    """The belief over the last pose in the frame of the first."""
    covariance = np.zeros((3, 3))
    for k, step in enumerate(steps):
        ad = se2.adjoint(se2.between(poses[k + 1], poses[k]))
        covariance = ad @ covariance @ ad.T + step.match_error.drift_covariance
    return PoseGaussian(se2.between(poses[0], poses[-1]), covariance)


def squared_distance(belief, truth):
    xi = se2.log(se2.between(belief.mean, truth))
    return xi @ np.linalg.solve(belief.covariance, xi)


@pytest.mark.parametrize(("walls", "truth"), [(two_rooms(), ROOMS), (CORRIDOR, ALONG)])
def test_steps_and_what_they_add_up_to_are_as_far_off_as_stated(walls, truth):
    of_steps, of_drift = [], []
    for seed in range(12):
        poses, steps = track_drive(walls, truth, seed)
        of_drift.append(squared_distance(drift(poses, steps), se2.between(truth[0], truth[-1])))
        for k, step in enumerate(steps):
            of_steps.append(
                squared_distance(
                    PoseGaussian(step.increment, step.match_error.pose_covariance), se2.between(truth[k], truth[k + 1])
                )
            )
    # 3 where all is right; of the drift there are only twelve.
    assert 1.0 < np.mean(of_steps) < 4.5
    assert 1.0 < np.mean(of_drift) < 6.0


def test_along_a_bare_corridor_the_drift_is_that_of_odometry_and_across_it_the_map_bounds_it():
    poses, steps = track_drive(CORRIDOR, ALONG, 0)
    deviations = np.sqrt(np.diag(drift(poses, steps).covariance))
    assert deviations[0] == pytest.approx(np.sqrt(len(steps) * ODOMETRY[0, 0]), rel=0.1)
    assert np.sqrt(steps[-1].match_error.drift_covariance[1, 1]) < 0.2 * np.sqrt(ODOMETRY[1, 1])
    assert steps[-1].match_error.gain[0, 0] < 0.1
    assert steps[-1].match_error.gain[1, 1] > 0.9


def error_of(points, block=0.0):
    """The error of a match in a room of which a block of beams is shifted by so much, m."""
    mapping = LocalMapping(Configuration())
    area_filter = ParticleFilter(mapping, 0, area=0)
    area_filter.add_keyframe(0, scan_in(two_rooms(), (2.0, 2.0, 0.3)))
    found = points.copy()
    found[64:80, :2] += block * found[64:80, 2:]
    return estimate_match_error(
        found,
        np.zeros(3),
        np.diag([1e4, 1e4, 1e4]),
        np.diag([400.0, 400.0, 1600.0]),
        area_filter._leading_view(),
        mapping.alignment,
        mapping.match_noise,
    )


def test_beams_that_err_together_make_a_match_less_certain():
    points = LocalMapping(Configuration()).matching_surfels(scan_in(two_rooms(), (2.0, 2.0, 0.3)))
    as_seen, misled = error_of(points), error_of(points, block=0.1)
    assert np.trace(misled.pose_covariance) > 1.5 * np.trace(as_seen.pose_covariance)
    np.testing.assert_array_equal(misled.gain, as_seen.gain)


def test_without_returns_odometry_alone_tells():
    mapping = LocalMapping(Configuration())
    nothing = PreparedScan(mapping, blank_scan())
    area_filter = ParticleFilter(mapping, 0, area=0)
    step = RelativeMotion(np.zeros(3), ODOMETRY)
    area_filter.track(nothing, Prediction(step, step, step))
    error = area_filter.update(nothing, 1).match_error
    np.testing.assert_allclose(error.pose_covariance, ODOMETRY, rtol=1e-6)
    np.testing.assert_allclose(error.drift_covariance, ODOMETRY, rtol=1e-6)
    assert not error.gain.any()
