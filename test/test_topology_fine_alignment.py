"""Fine alignment of keyframes that joined an area, in a world of worlds."""

import numpy as np
import pytest
import worlds

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.topology.fine_alignment import FineAlignment

ROOMS = worlds.two_rooms()
# An endless corridor leaves the direction along it open.
CORRIDOR = np.array([[-100.0, 0.0, 100.0, 0.0], [-100.0, 2.0, 100.0, 2.0]])
LOOSE = np.diag([0.3**2, 0.3**2, 0.05**2])


@pytest.fixture(scope="module")
def alignment():
    return FineAlignment(Configuration())


def placed(walls, poses, error=None, beams=180):
    """Scans at the poses, put down with a common error in the area's frame."""
    put = poses if error is None else se2.compose(error, poses)
    rng = np.random.default_rng(8)
    return [(worlds.scan_at(walls, pose, 0.01, rng, beams), where) for pose, where in zip(poses, put, strict=True)]


KNOWN = worlds.drive((1.0, 2.0), (4.5, 3.0), (4.0, 5.0))
JOINED = worlds.drive((3.5, 2.0), (2.0, 3.5))


@pytest.mark.parametrize("error", [[0.08, -0.06, 0.02], [-0.15, 0.1, -0.03], [0.0, 0.2, 0.0]])
def test_a_displaced_group_of_scans_is_moved_back(alignment, error):
    motion = alignment.offset(placed(ROOMS, KNOWN), placed(ROOMS, JOINED, np.array(error)), LOOSE)
    left = se2.compose(motion, np.array(error))
    np.testing.assert_allclose(left[:2], 0.0, atol=0.03)
    assert abs(np.degrees(left[2])) < 0.3


def test_a_group_that_fits_already_hardly_moves(alignment):
    motion = alignment.offset(placed(ROOMS, KNOWN), placed(ROOMS, JOINED), LOOSE)
    if motion is not None:
        np.testing.assert_allclose(motion, 0.0, atol=0.02)


def test_a_motion_outside_the_gate_of_the_closure_is_refused(alignment):
    error = np.array([0.2, 0.0, 0.0])
    tight = np.diag([0.02**2, 0.02**2, 0.005**2])
    assert alignment.offset(placed(ROOMS, KNOWN), placed(ROOMS, JOINED, error), LOOSE) is not None
    assert alignment.offset(placed(ROOMS, KNOWN), placed(ROOMS, JOINED, error), tight) is None


def test_along_a_corridor_the_closure_decides_and_across_it_the_walls():
    # Dense scans of short range: single points far down a wall would stand for features that are not there.
    alignment = FineAlignment(with_changes(Configuration(), {"local_map.max_range": 5.0}))
    known = worlds.drive((0.0, 1.0), (6.0, 1.0))
    error = np.array([0.15, 0.1, 0.0])
    joined = np.add(known[3:8], [0.23, 0.1, 0.1])
    motion = alignment.offset(placed(CORRIDOR, known, beams=720), placed(CORRIDOR, joined, error, 720), LOOSE)
    assert motion[1] == pytest.approx(-0.1, abs=0.02)
    assert motion[0] == pytest.approx(0.0, abs=0.05)


def test_scans_in_unknown_space_are_left_where_they_are(alignment):
    far = np.array([60.0, 0.0, 0.0])
    assert alignment.offset(placed(ROOMS, KNOWN), placed(ROOMS, JOINED, far), LOOSE) is None
    assert alignment.offset(placed(ROOMS, KNOWN), [], LOOSE) is None


def test_one_alignment_leaves_nothing_behind_for_the_next(alignment):
    error = np.array([0.05, 0.02, 0.01])
    first = alignment.offset(placed(ROOMS, KNOWN), placed(ROOMS, JOINED, error), LOOSE)
    alignment.offset(placed(CORRIDOR, KNOWN), placed(CORRIDOR, JOINED, error), LOOSE)
    np.testing.assert_array_equal(alignment.offset(placed(ROOMS, KNOWN), placed(ROOMS, JOINED, error), LOOSE), first)
