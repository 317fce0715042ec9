"""The landmarks of a stored area."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import box, scan_at, scan_in

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.landmarks.area_landmarks import AreaLandmarkExtractor
from hmt_slam_ros.landmarks.landmarks import CONCAVE_CORNER
from hmt_slam_ros.submap.local_mapping import LocalMapping

ROOM = box(-2.02, -1.51, 2.53, 2.02)
POSES = np.array([(0.2 * k, 0.1, 0.8 * k) for k in range(9)])


def half(pose, seed):
    return scan_in(ROOM, pose, beams=361, noise=0.01, seed=seed)


def whole(pose, seed):
    return scan_at(ROOM, pose, 0.01, np.random.default_rng(seed), 720)


@pytest.mark.parametrize("look", [half, whole])
def test_a_room_has_its_four_corners_whatever_the_laser_sees_at_once(look):
    landmarks = AreaLandmarkExtractor(LocalMapping(Configuration()))
    scans = [look(pose, k) for k, pose in enumerate(POSES)]
    found = landmarks.extract(scans, POSES)
    corners = np.array(
        [one.pose.mean[:2] for one in found if one.kind == CONCAVE_CORNER and one.existence.probability > 0.5]
    )
    true = np.array([(-2.02, -1.51), (2.53, -1.51), (2.53, 2.02), (-2.02, 2.02)])
    assert corners.shape == (4, 2)
    assert np.hypot(*(corners[None] - true[:, None]).transpose(2, 0, 1)).min(axis=1).max() < 0.05
    # It keeps nothing of one area for the next.
    again = landmarks.extract(scans, POSES)
    assert [one.pose.mean.tolist() for one in again] == [one.pose.mean.tolist() for one in found]


def test_what_is_gone_at_a_later_visit_is_not_believed_in_because_the_map_held_it():
    landmarks = AreaLandmarkExtractor(LocalMapping(Configuration()))
    bigger = box(-2.02, -1.51, 4.03, 2.02)
    first = [half(pose, k) for k, pose in enumerate(POSES)]
    then = [scan_in(bigger, pose, beams=361, noise=0.01, seed=k) for k, pose in enumerate(POSES)]
    later = [replace(scan, stamp=scan.stamp + 100_000_000_000) for scan in then]
    found = landmarks.extract(first + later, np.concatenate((POSES, POSES)))
    believed = np.array(
        [one.pose.mean[:2] for one in found if one.kind == CONCAVE_CORNER and one.existence.probability > 0.5]
    )
    true = np.array([(-2.02, -1.51), (4.03, -1.51), (4.03, 2.02), (-2.02, 2.02)])
    assert believed.shape == (4, 2)
    assert np.hypot(*(believed[None] - true[:, None]).transpose(2, 0, 1)).min(axis=1).max() < 0.1


@pytest.mark.parametrize("away", [10, 100])
def test_only_a_robot_that_was_away_returns(away):
    scans = [replace(whole(POSES[0], k), stamp=away * k * 1_000_000_000) for k in range(3)]
    sightings = AreaLandmarkExtractor(LocalMapping(Configuration())).observations(scans, POSES[[0, 0, 0]])
    assert [sighting.begins_visit for sighting in sightings] == [False, away > 60, away > 60]
