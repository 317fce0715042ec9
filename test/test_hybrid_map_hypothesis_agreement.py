"""Equivalent hypotheses are distinguished from others, and those under which the robot is elsewhere."""

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.hypothesis_agreement import (
    LocalizedHypothesis,
    elsewhere_probability,
    merge_equivalent,
    supports,
)

SHARP, VAGUE = np.diag([0.05, 0.05, 0.01]) ** 2, np.diag([2.0, 2.0, 0.2]) ** 2
STEP = np.array([10.0, 0.0, 0.0])
POSE = np.array([1.0, 0.5, 0.3])
DOMINANCE = 0.99


def chain(covariance=SHARP):
    """Areas 0 to 3, definite, 10 m apart along x."""
    hybrid_map = HybridMap()
    for area in range(4):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    for area in range(3):
        hybrid_map.set_arc(area, area + 1, PoseGaussian(STEP, covariance), closure=False)
    hybrid_map.commit()
    return hybrid_map


def enter_known_area(area, pose, covariance=SHARP):
    """From area 3 the robot came into a known one, where it is at ``area_T_base``."""
    hybrid_map = chain(VAGUE)
    hybrid_map.set_arc(3, area, PoseGaussian(area * STEP - np.array([5.0, 0.0, 0.0]), covariance), closure=True)
    return LocalizedHypothesis(hybrid_map, area, pose, {area})


def in_next_area(pose):
    """``1_T_base`` where ``pose`` is ``0_T_base``."""
    return se2.between(STEP, pose)


def with_sharp_arc(hypothesis):
    hypothesis.hybrid_map.set_arc(0, 1, PoseGaussian(STEP, SHARP), closure=False)
    return hypothesis


def test_the_same_place_entered_by_one_area_or_by_the_next_is_one_placement():
    one, other = with_sharp_arc(enter_known_area(0, POSE)), with_sharp_arc(enter_known_area(1, in_next_area(POSE)))
    assert one.is_equivalent(other)
    assert other.is_equivalent(one)


@pytest.mark.parametrize(
    ("offset", "same"), [([0.3, 0.2, 0.05], True), ([0.7, 0.0, 0.0], False), ([0.0, 0.0, 0.2], False)]
)
def test_modes_that_part_by_less_than_is_mended_are_one_placement(offset, same):
    assert enter_known_area(0, POSE).is_equivalent(enter_known_area(0, se2.compose(POSE, np.array(offset)))) == same


def test_known_ground_is_a_placement_of_its_own():
    tracked = LocalizedHypothesis(chain(), 0, POSE, {0})
    recognized = enter_known_area(0, POSE)
    assert not tracked.is_equivalent(recognized)
    assert not recognized.is_equivalent(tracked)


def with_another_loop(hypothesis, covariance=SHARP, offset=(0.0, 0.0, 0.0)):
    """The same with an arc from the robot's area to area 2, which is off by ``offset``."""
    arc = PoseGaussian(2.0 * STEP + np.array(offset), covariance)
    hypothesis.hybrid_map.set_arc(hypothesis.area, 2, arc, closure=True)
    return hypothesis


@pytest.mark.parametrize("covariance", [SHARP, 100.0 * SHARP])
def test_a_further_loop_is_a_placement_of_its_own(covariance):
    open_still, closed = enter_known_area(0, POSE), with_another_loop(enter_known_area(0, POSE), covariance)
    assert not open_still.is_equivalent(closed)
    assert not closed.is_equivalent(open_still)


def test_a_loop_that_one_hypothesis_closes_by_two_arcs_and_one_by_the_second_is_one_placement():
    direct, around = enter_known_area(0, POSE), with_another_loop(enter_known_area(0, POSE))
    for hypothesis in (direct, around):
        hypothesis.hybrid_map.set_arc(0, 1, PoseGaussian(STEP, SHARP), closure=False)
        hypothesis.hybrid_map.set_arc(1, 2, PoseGaussian(STEP, SHARP), closure=False)
    assert direct.is_equivalent(around)
    assert around.is_equivalent(direct)


@pytest.mark.parametrize(("distance", "same"), [(0.3, True), (1.0, False)])
@pytest.mark.parametrize("direction", [0.0, 0.5 * np.pi, 2.5])
def test_closures_of_the_same_areas_are_equivalent_as_far_as_alignment_moves_arcs_in_any_direction(
    distance, direction, same
):
    offset = (distance * np.cos(direction), distance * np.sin(direction), 0.0)
    one = with_another_loop(enter_known_area(0, POSE))
    other = with_another_loop(enter_known_area(0, POSE), offset=offset)
    assert one.is_equivalent(other) == other.is_equivalent(one) == same


def test_a_closure_with_an_area_that_only_one_hypothesis_has_does_not_distinguish_the_two():
    without, has = enter_known_area(0, POSE), enter_known_area(0, POSE)
    has.hybrid_map.set_keyframe(9, 9, np.zeros(3))
    has.hybrid_map.set_arc(9, 1, PoseGaussian(STEP, SHARP), closure=True)
    assert without.is_equivalent(has)
    assert has.is_equivalent(without)


def test_uncertain_poses_imply_no_closure():
    assert not enter_known_area(0, POSE).is_equivalent(enter_known_area(1, in_next_area(POSE)))


def test_the_heaviest_represents_all_equivalent_ones():
    hypotheses = [enter_known_area(0, POSE), enter_known_area(1, POSE), enter_known_area(0, POSE + 0.01)]
    weights = np.log([0.2, 0.3, 0.5])
    found = merge_equivalent(hypotheses, weights)
    assert list(found) == [2, 1]
    np.testing.assert_allclose(np.exp(list(found.values())), [0.7, 0.3])


def with_remote_loop(hypothesis):
    """The same with an arc between two areas that the robot is not near, of which the arcs tell little."""
    hypothesis.hybrid_map.set_arc(1, 3, PoseGaussian(2.0 * STEP, SHARP), closure=True)
    return hypothesis


@pytest.mark.parametrize(
    ("probabilities", "supported"), [([0.15, 0.85], [1.0, 0.85]), ([0.005, 0.995], [0.005, 0.995])]
)
def test_a_hypothesis_has_the_support_of_those_whose_loops_elsewhere_it_leaves_open(probabilities, supported):
    hypotheses = [enter_known_area(0, POSE), with_remote_loop(enter_known_area(0, POSE))]
    assert hypotheses[0].leaves_open(hypotheses[1])
    assert not hypotheses[1].leaves_open(hypotheses[0])
    found = supports(dict(enumerate(hypotheses)), dict(enumerate(probabilities)), DOMINANCE)
    assert list(found.values()) == pytest.approx(supported)


def test_a_loop_beside_the_robot_is_not_left_open():
    hypotheses = [enter_known_area(0, POSE), with_another_loop(enter_known_area(0, POSE))]
    assert not hypotheses[0].leaves_open(hypotheses[1])
    assert supports(dict(enumerate(hypotheses)), {0: 0.5, 1: 0.5}, DOMINANCE) == {0: 0.5, 1: 0.5}


def test_a_hypothesis_without_a_loop_has_no_support_of_one_that_closes_some():
    tracked, closed = (LocalizedHypothesis(chain(VAGUE), 0, POSE, {0}) for _ in range(2))
    assert not tracked.leaves_open(with_remote_loop(closed))


def test_hypotheses_with_different_poses_of_the_robot_stay_apart():
    one, other = enter_known_area(0, POSE), with_remote_loop(enter_known_area(0, POSE + 1.0))
    assert not one.leaves_open(other)


def in_new_ground(covariance):
    """From area 3 the robot came into a new area, 3 m beside area 0."""
    hybrid_map = chain()
    hybrid_map.set_keyframe(9, 9, np.zeros(3))
    hybrid_map.set_arc(3, 9, PoseGaussian(np.array([-30.0, 3.0, 0.0]), covariance), closure=False)
    return LocalizedHypothesis(hybrid_map, 9, POSE, {9})


@pytest.mark.parametrize(
    ("offset", "elsewhere"),
    [([0.9, 0.0, 0.0], False), ([1.2, 0.0, 0.0], True), ([0.0, 0.0, 0.25], False), ([0.0, 0.0, 3.0], True)],
)
def test_a_robot_is_elsewhere_where_its_pose_differs_by_more_than_is_uncertain(offset, elsewhere):
    one, other = (LocalizedHypothesis(chain(), 1, pose, {1}) for pose in (POSE, se2.compose(POSE, np.array(offset))))
    assert one.is_elsewhere(other) == other.is_elsewhere(one) == elsewhere


@pytest.mark.parametrize(("covariance", "elsewhere"), [(SHARP, True), (VAGUE, False)])
def test_a_robot_behind_a_wide_arc_may_be_where_a_closure_has_it(covariance, elsewhere):
    closed, new = enter_known_area(0, POSE), in_new_ground(covariance)
    assert closed.is_elsewhere(new) == elsewhere


def test_without_an_area_relative_to_which_both_are_certain_nothing_is_elsewhere():
    apart = HybridMap()
    apart.set_keyframe(8, 8, np.zeros(3))
    assert not enter_known_area(0, POSE).is_elsewhere(LocalizedHypothesis(apart, 8, POSE, {8}))


def test_elsewhere_is_what_the_most_probable_hypothesis_denies():
    hypotheses = [LocalizedHypothesis(chain(), 1, se2.compose(POSE, [x, 0.0, 0.0]), {1}) for x in (9.0, 0.0, 0.3)]
    assert elsewhere_probability(hypotheses, [0.2, 0.5, 0.3]) == pytest.approx(0.2)
    assert elsewhere_probability(hypotheses, [0.6, 0.3, 0.1]) == pytest.approx(0.4)
    assert elsewhere_probability(hypotheses[:1], [0.6]) == 0.0
