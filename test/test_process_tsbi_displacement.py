"""A robot that was displaced without notice is found in the map, where there is one place alone that it can be in."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_process_tsbi_branching import OTHER, PATH, ROOM, rooms_apart

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.processes.tsbi_displacement import with_displaced
from hmt_slam_ros.topology.hypothesis_tree import LeafNotes

FAR = (30.0, 20.0)


def asked(rooms, doubts):
    """What comes of the question in the last room, far from which the arcs have all others."""
    parent, branching, newest = rooms_apart(rooms, [FAR] * (len(rooms) - 1), 0.1)
    doubtful = replace(parent, notes=replace(parent.notes, doubts={newest[n]: odds for n, odds in doubts.items()}))
    branches = branching.cut(doubtful, newest[1:])
    return branches, with_displaced(branching, doubtful, newest[1:], branches)


def test_where_the_arcs_lied_the_robot_is_found_and_no_arc_is_bent():
    before, after = asked((ROOM, OTHER, ROOM), {2: 0.1})
    assert [child.area for child in before.children] == [3]
    found = after.children[-1]
    assert found.area == 0
    assert found.arcs == ()
    poses = {r.keyframe: r.pose for r in found.relabelled}
    assert sorted(poses) == [14, 15, 16, 17]  # what was stored before the displacement stays
    for keyframe, pose in poses.items():
        np.testing.assert_allclose(pose, se2.between(PATH[0], PATH[keyframe - 12]), atol=0.05)
    assert math.log(0.1) - 4.0 < found.log_weight < math.log(0.1) + 6.0
    assert all(not child.notes.doubts for child in after.children)


@pytest.mark.parametrize(
    "doubts",
    [{}, {2: 1e-5}, {4: 0.1}],
    ids=["sure", "hardly doubtful", "just now, and two keyframes are too few"],
)
def test_a_robot_that_is_hardly_displaced_is_not_looked_for(doubts):
    before, after = asked((ROOM, OTHER, ROOM), doubts)
    assert after is before


@pytest.mark.parametrize("rooms", [(ROOM, ROOM, ROOM), (OTHER, OTHER, ROOM)], ids=["one of two alike", "a new one"])
def test_a_robot_that_may_be_anywhere_is_not_found_and_that_is_said(rooms):
    before, after = asked(rooms, {2: 0.1})
    assert after.children == before.children
    assert math.exp(after.log_skipped) == pytest.approx(0.05)


def test_a_scan_that_contradicts_is_remembered_for_a_while_and_in_the_next_area():
    notes = LeafNotes().heard(5, -1.0).heard(6, -8.0).heard(7, -7.0)
    odds, since = notes.displaced
    assert since == 6
    assert odds == pytest.approx(1e-5 * (math.exp(8.0) + math.exp(7.0)))
    assert notes.entered({}).displaced == (odds, since)
    assert notes.heard(100, 0.0).displaced == (0.0, 0)


def test_what_contradicted_long_before_is_another_matter():
    assert LeafNotes().heard(5, -3.0).heard(20, -5.0).heard(21, -8.0).displaced[1] == 20


def test_odds_do_not_exceed_one():
    assert LeafNotes().heard(5, -900.0).heard(6, -900.0).displaced == (1.0, 5)
