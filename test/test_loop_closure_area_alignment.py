"""Keyframes that joined an area are laid where they fit best."""

import numpy as np
import pytest
import worlds

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.loop_closure.area_alignment import AreaAlignment

ROOMS = worlds.two_rooms()
# An endless corridor leaves the direction along it open.
CORRIDOR = np.array([[-100.0, 0.0, 100.0, 0.0], [-100.0, 2.0, 100.0, 2.0]])
LOOSE = np.diag([0.3**2, 0.3**2, 0.05**2])
KNOWN = worlds.drive((1.0, 2.0), (4.5, 3.0), (4.0, 5.0))
JOINED = worlds.drive((3.5, 2.0), (2.0, 3.5))


@pytest.fixture(scope="module")
def alignment():
    return AreaAlignment(Configuration())


def place_scans(walls, poses, beams=180):
    rng = np.random.default_rng(8)
    return [(worlds.scan_at(walls, pose, 0.01, rng, beams), pose) for pose in poses]


def placed_with_error(error, covariance=LOOSE):
    """What a closure says that is wrong by ``error``: both areas have the same frame."""
    return PoseGaussian(np.array(error), covariance)


@pytest.mark.parametrize("error", [[0.08, -0.06, 0.02], [-0.15, 0.1, -0.03], [0.0, 0.2, 0.0], [0.6, -0.5, 0.1]])
def test_a_displaced_group_of_scans_is_moved_back(alignment, error):
    found = alignment.align(place_scans(ROOMS, KNOWN), place_scans(ROOMS, JOINED), placed_with_error(error)).mean
    np.testing.assert_allclose(found[:2], 0.0, atol=0.03)
    assert abs(np.degrees(found[2])) < 0.3


def test_what_was_seen_since_decides_along_a_wall():
    """A step downhill would stay where the closure is, for the wall alone fits there as well."""
    walls = np.vstack([CORRIDOR, [[14.0, 0.0, 14.0, 2.0]]])
    alignment = AreaAlignment(with_changes(Configuration(), {"local_map.max_range": 5.0}))
    known, later = worlds.drive((0.0, 1.0), (12.0, 1.0)), worlds.drive((2.0, 1.2), (11.0, 1.2))
    loose = np.diag([1.5**2, 0.1**2, 0.02**2])
    found = alignment.align(
        place_scans(walls, known), place_scans(walls, later), placed_with_error([1.3, 0.0, 0.0], loose)
    ).mean
    np.testing.assert_allclose(found[:2], 0.0, atol=0.05)


def test_a_motion_outside_the_gate_of_the_closure_is_not_searched(alignment):
    tight = np.diag([0.01**2, 0.01**2, 0.002**2])
    found = alignment.align(
        place_scans(ROOMS, KNOWN), place_scans(ROOMS, JOINED), placed_with_error([0.3, 0.0, 0.0], tight)
    )
    assert found is None or abs(found.mean[0] - 0.3) < 0.1


def test_along_a_corridor_the_closure_decides_and_across_it_the_walls():
    # Dense scans of short range: single points far down a wall would stand for features that are not there.
    alignment = AreaAlignment(with_changes(Configuration(), {"local_map.max_range": 5.0}))
    known = worlds.drive((0.0, 1.0), (6.0, 1.0))
    joined = np.add(known[3:8], [0.23, 0.1, 0.1])
    found = alignment.align(
        place_scans(CORRIDOR, known, 720), place_scans(CORRIDOR, joined, 720), placed_with_error([0.15, 0.1, 0.0])
    )
    assert found.mean[1] == pytest.approx(0.0, abs=0.03)
    assert found.mean[0] == pytest.approx(0.15, abs=0.05)


def test_scans_in_unknown_space_are_left_where_they_are(alignment):
    far = placed_with_error([60.0, 0.0, 0.0])
    assert alignment.align(place_scans(ROOMS, KNOWN), place_scans(ROOMS, JOINED), far) is None
    assert alignment.align(place_scans(ROOMS, KNOWN), [], placed_with_error([0.0, 0.0, 0.0])) is None


def test_one_alignment_leaves_nothing_behind_for_the_next(alignment):
    closure = placed_with_error([0.05, 0.02, 0.01])
    first = alignment.align(place_scans(ROOMS, KNOWN), place_scans(ROOMS, JOINED), closure)
    alignment.align(place_scans(CORRIDOR, KNOWN), place_scans(CORRIDOR, JOINED), closure)
    again = alignment.align(place_scans(ROOMS, KNOWN), place_scans(ROOMS, JOINED), closure)
    np.testing.assert_array_equal(again.mean, first.mean)
    np.testing.assert_array_equal(again.covariance, first.covariance)
