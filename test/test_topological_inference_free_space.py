"""Keyframes of one room beside those of another: violations of free space show whether they are the same."""

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.registration.consistency import WALLS_OF_MAP, WALLS_OUTLIER_RATE
from hmt_slam_ros.topological_inference.global_scan_matching import FreeSpaceCheck

OUTER, SHELF = box(-3.0, -2.0, 5.0, 2.0), box(1.0, 1.0, 2.5, 1.3)
OPEN = np.array([[-3.0, 2.0, 0.0, 2.0], [1.2, 2.0, 5.0, 2.0], *OUTER[[0, 1, 3]], *box(-1.0, 2.1, 2.5, 6.0)[1:]])
KNOWN = {k: np.array([x, -0.5, 0.3 * k]) for k, x in enumerate((-1.5, 0.0, 1.5, 3.0))}
SEEN = {10 + k: np.array([x, -1.0, 1.5 + 0.2 * k]) for k, x in enumerate((-0.5, 1.0, 2.5))}


def compare_rooms(there, here, known=KNOWN, seen=SEEN):
    """Walls of a map of one room, and of keyframes that are in the other."""
    scans = {
        k: scan_in(walls, pose, noise=0.01, seed=k, beams=361, field_of_view=2.0 * np.pi)
        for walls, poses in ((there, KNOWN), (here, SEEN))
        for k, pose in poses.items()
    }
    return FreeSpaceCheck(scans, Configuration()).compare(known, seen)[0]


def test_in_the_same_room_no_wall_is_seen_through():
    found = compare_rooms(OUTER, OUTER)
    # 24 m of walls, a sample every 0.2 m, in nearly all scans of both.
    assert found.on_surface > 600
    assert found.in_free_space == 0
    assert found.samples == found.on_surface
    assert WALLS_OF_MAP.log_likelihood_ratio(found, WALLS_OUTLIER_RATE) > 0.0


@pytest.mark.parametrize("turned", [False, True], ids=["in the map", "in the scans"])
def test_a_door_is_found_open_whichever_side_knows_it_closed(turned):
    rooms = (OUTER, OPEN)
    found = compare_rooms(*rooms[::-1] if turned else rooms)
    assert found.in_free_space >= 10  # five samples across, in scans that see it at all
    assert WALLS_OF_MAP.log_likelihood_ratio(found, WALLS_OUTLIER_RATE) < -1.0


def test_a_shelf_speaks_against_the_room_and_people_do_little():
    """What only one side knows is seen through by the other; what is behind it is not."""
    shelf = compare_rooms(np.concatenate((OUTER, SHELF)), OUTER)
    people = compare_rooms(OUTER, np.concatenate([OUTER, *(box(x, 0.5, x + 0.3, 0.8) for x in (-1.0, 2.0))]))
    assert shelf.in_free_space > 2 * people.in_free_space
    assert -1.0 < WALLS_OF_MAP.log_likelihood_ratio(people, WALLS_OUTLIER_RATE) < 0.0
    assert WALLS_OF_MAP.log_likelihood_ratio(people, 0.003) > WALLS_OF_MAP.log_likelihood_ratio(
        people, WALLS_OUTLIER_RATE
    )  # where walls are passed usually


def test_keyframes_that_are_far_off_see_nothing_of_each_other():
    away = {k: pose + np.array([100.0, 0.0, 0.0]) for k, pose in SEEN.items()}
    assert compare_rooms(OUTER, OUTER, seen=away).samples == 0
    assert compare_rooms(OUTER, OUTER, known={}).samples == 0
