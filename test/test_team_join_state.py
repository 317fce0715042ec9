"""Whether two maps stay joined while they grow: at one placement, while it is probable."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.team import JoiningArc, Verdict
from hmt_slam_ros.team.join import Meeting
from hmt_slam_ros.team.join_state import JoinState, next_join
from hmt_slam_ros.team.placement import Placement, PlacementDistribution
from hmt_slam_ros.team.placement_evidence import PlacementEvidence

CONFIGURATION = Configuration()
PLACE, TWIN = np.array([20.0, 1.0, 3.0]), np.array([11.0, 1.0, 3.0])


def meeting(verdict, probability, pose=PLACE):
    """A comparison whose best placement has that pose; the maps themselves are not needed."""
    placement = Placement(pose, {}, {}, PlacementEvidence(5.0, 5.0), probability)
    return Meeting(None, (), PlacementDistribution((placement,), 1.0 - probability), verdict)


def compare(join, found, has_lasted=False, configuration=CONFIGURATION):
    return next_join(join, found, configuration, is_first=True, has_lasted=has_lasted)


JOINED = JoinState(PLACE)


@pytest.mark.parametrize(
    ("verdict", "has_lasted"), [(Verdict.JOINED, False), (Verdict.OPEN, True), (Verdict.APART, True)]
)
def test_only_a_sure_placement_that_has_lasted_joins(verdict, has_lasted):
    assert not compare(JoinState(), meeting(verdict, 0.999), has_lasted).is_joined
    assert compare(JoinState(), meeting(Verdict.JOINED, 0.999), has_lasted=True).is_joined


@pytest.mark.parametrize(
    ("found", "stays"),
    [
        (meeting(Verdict.JOINED, 0.999), True),
        (meeting(Verdict.OPEN, 0.7), True),
        (meeting(Verdict.OPEN, 0.4), False),
        (meeting(Verdict.APART, 0.4), False),
        (meeting(Verdict.CONTRADICTORY, 0.999), False),
        (meeting(Verdict.OPEN, 0.7, TWIN), False),
        (meeting(Verdict.JOINED, 0.999, TWIN), False),
        (Meeting(None, (), PlacementDistribution((), 1.0), Verdict.APART), False),
    ],
)
def test_a_join_stays_while_its_placement_is_probable(found, stays):
    assert JOINED.holds(found) is compare(JOINED, found).is_joined is stays


def test_a_placement_moves_with_maps_that_bend():
    join = JOINED
    for n in range(20):
        bent = PLACE + np.array([0.4 * n, 0.0, 0.0])
        join = compare(join, meeting(Verdict.OPEN, 0.9, bent))
        np.testing.assert_array_equal(join.pose, bent)


def test_two_maps_are_joined_at_another_placement_once_that_has_lasted():
    found = meeting(Verdict.JOINED, 0.999, TWIN)
    np.testing.assert_array_equal(compare(JOINED, found, has_lasted=True).pose, TWIN)


def test_ground_is_sent_again_where_the_placement_is_another_one():
    arc = JoiningArc(0, 0, PoseGaussian.from_pose(PLACE))
    join = replace(JOINED, joining_arcs=(arc,), sent_version=7)
    uses_ground = with_changes(CONFIGURATION, {"team.uses_ground": True})
    assert compare(join, meeting(Verdict.OPEN, 0.9), configuration=uses_ground).joining_arcs == (arc,)
    assert compare(join, meeting(Verdict.OPEN, 0.9), configuration=uses_ground).sent_version == 7
    moved = compare(join, meeting(Verdict.OPEN, 0.9, TWIN), configuration=uses_ground)
    assert (moved.joining_arcs, moved.sent_version) == ((), 0)
