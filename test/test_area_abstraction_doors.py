"""Passages of openings while the robot goes on, and the chambers that they make."""

import numpy as np
import pytest

from hmt_slam_ros.area_abstraction.doors import DoorTracker
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.landmarks.area_landmarks import LandmarkObservation
from hmt_slam_ros.landmarks.beam_labels import Rays
from hmt_slam_ros.landmarks.landmarks import CONCAVE_CORNER, OPENING, ScanLandmarks
from hmt_slam_ros.landmarks.opening_detection import LandmarkOpenings

FEATURES = FeatureParameters()
# Uninformative beams, so that no landmark is missed.
BLIND = Rays(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.bool_))
DOOR, OTHER = (3.2, 0.0, 0.0), (6.2, 0.0, 0.0)


def landmark_openings(pose, openings, confidence=0.9, kind=OPENING):
    """What a keyframe shows of openings, as landmarks with uninformative beams otherwise."""
    poses = np.array([se2.between(pose, np.array(one)) for one in openings]).reshape(-1, 3)
    count = len(poses)
    covariances = np.tile(np.diag([0.02, 0.02, 0.01]) ** 2, (count, 1, 1))
    sizes = np.ones(count)
    seen = ScanLandmarks(np.full(count, kind), poses, covariances, confidence * sizes, sizes, 0.05 * sizes)
    return LandmarkOpenings(LandmarkObservation(PoseGaussian.from_pose(pose), seen, BLIND, False, False), FEATURES)


def go(way, xs, openings, first=0, y=0.0, **how):
    """Along x, looking ahead; an opening is shown where the robot is before it and it is within 2 m."""
    for event, x in enumerate(xs, start=first):
        pose = np.array([x, y, 0.0])
        near = [one for one in openings if 0.0 < (one[0] - x) * np.cos(one[2]) < 2.0]
        way = way.update(event, PoseGaussian(pose, np.eye(3) * 1e-4), landmark_openings(pose, near, **how))
    return way


def test_the_path_passes_an_opening_that_only_keyframes_before_it_saw():
    way = go(DoorTracker(), 0.5 * np.arange(10), [DOOR])
    (passage,) = way.crossings
    assert passage.event == 7  # at x = 3.5 m
    np.testing.assert_allclose(passage.pose, DOOR, atol=1e-6)
    assert way.segment_labels(range(10)) == {k: int(k >= 7) for k in range(10)}


@pytest.mark.parametrize("how", [{"confidence": 0.3}, {"kind": CONCAVE_CORNER}, {"y": 0.8}])
def test_nothing_else_is_a_passage(how):
    way = go(DoorTracker(), 0.5 * np.arange(10), [DOOR], **how)
    assert way.crossings == ()
    assert set(way.segment_labels(range(10)).values()) == {0}


def test_the_same_opening_leads_back_and_another_one_on():
    way = go(DoorTracker(), 0.5 * np.arange(10), [DOOR])
    back = go(way, 4.0 - 0.5 * np.arange(5), [DOOR], first=10)
    assert [passage.event for passage in back.crossings] == [7, 12]
    assert back.segment_labels([6, 7, 11, 12, 14]) == {6: 0, 7: 1, 11: 1, 12: 0, 14: 0}
    on = go(way, 4.5 + 0.5 * np.arange(8), [OTHER], first=10)
    assert on.segment_labels([6, 7, 13, 14, 17]) == {6: 0, 7: 1, 13: 1, 14: 2, 17: 2}


def test_both_faces_of_a_wall_are_passed_at_once():
    assert len(go(DoorTracker(), 0.5 * np.arange(10), [DOOR, (3.6, 0.0, np.pi)]).crossings) == 1


def test_an_opening_that_shows_late_was_passed_where_the_path_passed_it():
    seen_from_behind = (3.2, 0.0, np.pi)
    way = go(DoorTracker(), 0.5 * np.arange(10), [seen_from_behind])
    (passage,) = way.crossings
    assert passage.event == 7
    assert se2.wrap(passage.pose[2]) == pytest.approx(0.0, abs=1e-6)


def test_what_is_far_behind_is_forgotten_but_not_that_it_was_passed():
    way = go(DoorTracker(), 0.5 * np.arange(25), [DOOR])
    assert way.openings == ()
    assert len(way.crossings) == 1


def test_in_another_frame_all_is_where_it_was():
    frame = np.array([5.0, -3.0, 2.0])
    way = go(DoorTracker(), 0.5 * np.arange(6), [DOOR]).transform(frame)
    for event, x in ((6, 3.0), (7, 3.5)):
        pose = se2.compose(frame, np.array([x, 0.0, 0.0]))
        way = way.update(event, PoseGaussian(pose, np.eye(3) * 1e-4), landmark_openings(pose, []))
    (passage,) = way.crossings
    np.testing.assert_allclose(passage.pose, se2.compose(frame, np.array(DOOR)), atol=1e-6)


def test_a_robot_that_was_moved_passes_nothing_on_its_way():
    way = go(DoorTracker(), 0.5 * np.arange(6), [DOOR]).break_path()
    assert go(way, 3.5 + 0.5 * np.arange(4), [DOOR], first=6).crossings == ()


def test_passages_before_an_event_are_none_of_the_next_area():
    way = go(DoorTracker(), 0.5 * np.arange(16), [DOOR, OTHER])
    assert [passage.event for passage in way.keep_crossings_after(7).crossings] == [13]
    assert way.keep_crossings_after(None).crossings == ()
