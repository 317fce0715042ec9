"""Portals between areas, from the path and the openings that it passed."""

import numpy as np
import pytest

from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark
from hmt_slam_ros.landmarks.landmarks import CONCAVE_CORNER, OPENING
from hmt_slam_ros.landmarks.portals import find_portals

FEATURES = FeatureParameters()
# Area 1 begins at x = 2.25 m of area 0, turned to the left.
ARC = np.array([2.25, 0.0, 0.5 * np.pi])


def make_drive(xs=None, first=0, second=1):
    """A drive along x, half a meter to a keyframe, five of which are in the first area."""
    hybrid_map = HybridMap()
    frames = {0: np.zeros(3), 1: ARC}
    xs = 0.5 * np.arange(10) if xs is None else xs
    for k, x in enumerate(xs):
        area = first if k < 5 else second
        hybrid_map.set_keyframe(k, area, se2.between(frames[area], np.array([x, 0.0, 0.0])))
    hybrid_map.set_arc(0, 1, PoseGaussian(ARC, np.diag([0.03, 0.03, 0.01]) ** 2), closure=False)
    return hybrid_map


def opening(x, y=0.0, heading=0.0, probability=0.9, kind=OPENING, width=1.0, frame=(0.0, 0.0, 0.0)):
    """In the world, that is, area 0; stated in a frame."""
    pose = se2.between(np.array(frame), np.array([x, y, heading]))
    return Landmark(kind, PoseGaussian(pose, np.diag([0.02, 0.02, 0.01]) ** 2), width, 0.05, Existence(probability))


def test_an_opening_that_the_path_passes_where_the_area_changes_is_a_portal():
    (portal,) = find_portals(make_drive(), {0: [opening(2.2)], 1: []}, FEATURES)
    assert portal.areas == (0, 1)
    np.testing.assert_allclose(portal.pose_in_a.mean, [2.2, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(portal.pose_in_b.mean, se2.between(ARC, np.array([2.2, 0.0, 0.0])), atol=1e-9)
    assert (portal.width, portal.existence, portal.crossing_count) == (1.0, 0.9, 1)
    # What the arc is uncertain by, it is uncertain by in the other area.
    assert np.trace(portal.pose_in_b.covariance) > np.trace(portal.pose_in_a.covariance) + 2 * 0.03**2


def test_its_heading_is_from_the_first_area_to_the_second_whoever_saw_it():
    seen_from_behind = opening(2.3, heading=np.pi, frame=ARC)
    (portal,) = find_portals(make_drive(), {0: [], 1: [seen_from_behind]}, FEATURES)
    np.testing.assert_allclose(portal.pose_in_a.mean[:2], [2.3, 0.0], atol=1e-9)
    assert se2.wrap(portal.pose_in_a.mean[2]) == pytest.approx(0.0, abs=1e-9)
    backwards = make_drive(0.5 * np.arange(10)[::-1], first=1, second=0)
    (portal,) = find_portals(backwards, {0: [opening(2.2)], 1: []}, FEATURES)
    assert se2.wrap(portal.pose_in_a.mean[2]) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(opening(2.2, y=0.8), id="beside the path"),
        pytest.param(opening(2.2, probability=0.3), id="hardly believed in"),
        pytest.param(opening(2.2, kind=CONCAVE_CORNER), id="a corner"),
        pytest.param(opening(4.7, frame=ARC), id="beyond the path"),
    ],
)
def test_what_is_no_portal(other):
    area = 1 if other.pose.mean[1] < -1.0 else 0
    assert find_portals(make_drive(), {0: [], 1: []} | {area: [other]}, FEATURES) == ()


def test_an_opening_far_from_the_change_of_areas_is_none():
    near = FeatureParameters(portal_reach=0.9)
    assert find_portals(make_drive(), {0: [opening(0.7)], 1: []}, near) == ()
    assert len(find_portals(make_drive(), {0: [opening(0.7)], 1: []}, FEATURES)) == 1


def test_of_several_the_one_nearest_to_the_change_counts():
    (portal,) = find_portals(make_drive(), {0: [opening(0.7), opening(2.2), opening(3.3)], 1: []}, FEATURES)
    assert portal.pose_in_a.mean[0] == pytest.approx(2.2)


def test_a_step_over_unknown_ground_is_no_path():
    xs = np.concatenate((0.5 * np.arange(5), 6.0 + 0.5 * np.arange(5)))
    assert find_portals(make_drive(xs), {0: [opening(2.2)], 1: []}, FEATURES) == ()


def test_two_passages_are_of_one_portal():
    hybrid_map = make_drive()
    for k, x in enumerate((4.2, 3.7, 3.2, 2.7), start=10):
        hybrid_map.set_keyframe(k, 1, se2.between(ARC, np.array([x, 0.1, np.pi])))
    for k, x in enumerate((1.9, 1.4, 0.9), start=14):
        hybrid_map.set_keyframe(k, 0, np.array([x, 0.1, np.pi]))
    (portal,) = find_portals(hybrid_map, {0: [opening(2.2)], 1: [opening(2.35, heading=np.pi, frame=ARC)]}, FEATURES)
    assert portal.crossing_count == 2
