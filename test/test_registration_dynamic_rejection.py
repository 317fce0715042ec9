"""Dynamic rejection: objects that moved since they entered the map do not pull the match."""

import numpy as np
import pytest
from test_submap_scan_matcher import CORRIDOR, ROOM, make_prediction, map_walls
from worlds import box, scan_in

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration.dynamic_rejection import reject_dynamic
from hmt_slam_ros.registration.scan_to_map import Prior
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, increment_covariance
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan

STEP = np.array([0.12, 0.0, 0.0])


@pytest.fixture(scope="module")
def mapping():
    return LocalMapping(Configuration())


def person(x, y=0.7):
    return box(x - 0.2, y - 0.2, x + 0.2, y + 0.2)


def left_out(mapping, area_filter, walls, truth, error):
    """How many points of a scan are left out where the prediction is off by ``error`` deviations, and of how many."""
    deviations = np.array([0.02, 0.02, 0.01])
    points = mapping.matching_surfels(scan_in(walls, truth, noise=0.01))
    prior = Prior(se2.compose(truth, se2.exp(error * deviations)), np.diag(deviations**-2.0))
    kept = reject_dynamic(points, prior.mean, prior, area_filter._leading_view(), mapping.alignment)
    return len(points) - len(kept), len(points)


@pytest.mark.parametrize("pace", [0.2, 0.28, -0.14])
def test_in_a_corridor_the_robot_goes_where_odometry_leads_and_not_with_a_person(mapping, pace):
    """Scans and keyframes at 5 Hz, the robot at 0.6 m/s, the person at 0.7 to 1.4 m/s."""
    area_filter = map_walls(mapping, np.concatenate((CORRIDOR, person(3.0))), [(-0.5, 0, 0), (0, 0, 0)], beams=721)
    step = RelativeMotion(STEP, increment_covariance(STEP, mapping.configuration.motion))
    for k in range(1, 17):
        truth = k * STEP
        scan = scan_in(np.concatenate((CORRIDOR, person(3.0 + pace * k))), truth, beams=361, noise=0.01, seed=k)
        prepared = PreparedScan(mapping, scan)
        tracked = area_filter.track(prepared, make_prediction(step))
        assert not tracked.contradicts_odometry
        if k % 4 == 0:
            area_filter.update(prepared, k)
            area_filter.add_keyframe(k, scan)
        np.testing.assert_allclose(area_filter.pose, truth, atol=0.08)


@pytest.mark.parametrize("pace", [-0.1, 0.1])
def test_nobody_draws_the_robot_along_by_steps_that_noisy_odometry_does_not_contradict_one_by_one(mapping, pace):
    area_filter = map_walls(mapping, np.concatenate((CORRIDOR, person(6.0))), [(-0.5, 0, 0), (0, 0, 0)], beams=721)
    step = RelativeMotion(STEP, 4.0 * increment_covariance(STEP, mapping.configuration.motion))
    deviation = np.sqrt(step.covariance[0, 0])
    off = []
    for k in range(1, 25):
        truth = k * STEP
        scan = scan_in(np.concatenate((CORRIDOR, person(6.0 + pace * k))), truth, beams=361, noise=0.01, seed=k)
        prepared = PreparedScan(mapping, scan)
        area_filter.track(prepared, make_prediction(step))
        off.append(np.hypot(*(area_filter.pose - truth)[:2]))
        if k % 6 == 0:
            area_filter.update(prepared, k)
            area_filter.add_keyframe(k, scan)
    # Odometry is believed to four deviations of the six steps between two keyframes; without that, 1.8 m.
    assert max(off) < 4.1 * np.sqrt(6.0) * deviation


def test_a_person_who_stays_tells_along_a_corridor_how_far_the_robot_went(mapping):
    area_filter = map_walls(mapping, np.concatenate((CORRIDOR, person(2.5))), [(0, 0, 0)], beams=721)
    assert left_out(mapping, area_filter, np.concatenate((CORRIDOR, person(2.5))), STEP, np.zeros(3))[0] == 0


def test_a_person_who_went_on_is_left_out_and_the_walls_are_not(mapping):
    area_filter = map_walls(mapping, np.concatenate((CORRIDOR, person(2.5))), [(0, 0, 0)], beams=721)
    walls = np.concatenate((CORRIDOR, person(2.75)))
    count, _ = left_out(mapping, area_filter, walls, STEP, np.zeros(3))
    seen = mapping.matching_surfels(scan_in(walls, STEP, noise=0.01))
    on_person = (np.abs(seen[:, 1]) < 0.95) & (seen[:, 0] < 3.0)
    assert 0 < count <= on_person.sum() + 1


@pytest.mark.parametrize("error", [(4.0, 4.0, 0.0), (-4.0, 4.0, 4.0), (0.0, 0.0, -5.0)])
def test_what_many_things_say_together_stands_against_odometry(mapping, error):
    posts = np.concatenate([person(x, y) for x, y in ((3.0, 4.0), (4.0, -2.0), (2.0, -3.0), (1.5, 2.5))])
    world = np.concatenate((ROOM, posts))
    area_filter = map_walls(mapping, world, [(0, 0, 0)], beams=721)
    count, total = left_out(mapping, area_filter, world, np.array([0.1, 0.05, 0.02]), np.array(error))
    assert count < 0.1 * total


def test_a_scan_without_points_has_nothing_to_leave_out(mapping):
    area_filter = map_walls(mapping, ROOM, [(0, 0, 0)])
    prior = Prior(np.zeros(3), np.eye(3))
    assert reject_dynamic(
        np.empty((0, 4)), prior.mean, prior, area_filter._leading_view(), mapping.alignment
    ).shape == (0, 4)
