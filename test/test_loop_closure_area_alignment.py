"""Keyframes that joined an area are aligned with it."""

import numpy as np
import pytest
import worlds

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.loop_closure.acceptance import AreaAlignment

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
    """A closure that is wrong by ``error``: both areas have the same frame."""
    return PoseGaussian(np.array(error), covariance)


@pytest.mark.parametrize("error", [[0.08, -0.06, 0.02], [-0.15, 0.1, -0.03], [0.0, 0.2, 0.0], [0.6, -0.5, 0.1]])
def test_a_displaced_group_of_scans_is_moved_back(alignment, error):
    found = alignment.align(place_scans(ROOMS, KNOWN), place_scans(ROOMS, JOINED), placed_with_error(error)).mean
    np.testing.assert_allclose(found[:2], 0.0, atol=0.03)
    assert abs(np.degrees(found[2])) < 0.3


def test_later_keyframes_determine_the_pose_along_a_wall():
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


NICHE = np.vstack([CORRIDOR, [[14.0, 0.0, 14.0, 2.0]]])
"""A corridor that ends at x = 14 m, which few of the scans see."""


def aligned_along(replaced):
    """Position after an alignment, of which the closure has 1.3 m along the corridor; `replaced` was known before."""
    alignment = AreaAlignment(with_changes(Configuration(), {"local_map.max_range": 5.0}))
    known, later = worlds.drive((0.0, 1.0), (12.0, 1.0)), worlds.drive((2.0, 1.2), (11.0, 1.2))
    loose = placed_with_error([1.3, 0.0, 0.0], np.diag([1.5**2, 0.1**2, 0.02**2]))
    return alignment.align(place_scans(NICHE, known), place_scans(NICHE, later), loose, replaced).mean


def test_along_a_wall_an_arc_that_was_known_holds_the_scans():
    """The scans tell their position along the corridor to 0.16 m."""
    tight, wide = (PoseGaussian(np.zeros(3), np.diag([sigma**2, 0.1**2, 0.02**2])) for sigma in (0.03, 0.6))
    assert aligned_along(tight)[0] == pytest.approx(1.3, abs=0.08)
    assert aligned_along(None)[0] == pytest.approx(0.0, abs=0.05)
    assert aligned_along(tight)[0] > aligned_along(wide)[0] > aligned_along(None)[0]
    # Across it, the scans decide.
    assert aligned_along(tight)[1] == pytest.approx(0.0, abs=0.03)


def test_directions_are_open_where_the_scans_are_not_where_the_frame_begins(alignment):
    """A heading that is known to 2 degrees leaves a frame 10 m away open, and not the scans."""
    heading = np.diag([0.02, 0.02, np.radians(2.0)]) ** 2
    middle = np.array([10.0, 0.0])
    at_frame = PoseGaussian(np.array([3.0, 1.0, 0.5]), heading)
    assert len(alignment._open_directions(at_frame, np.zeros(2))) == 0
    (across,) = alignment._open_directions(at_frame, middle)
    assert abs(across @ [np.cos(0.5), np.sin(0.5)]) < 1e-6


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
