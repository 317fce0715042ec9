"""Rules of relocalization, each by itself, on distributions that are given."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from relocalizing import (
    ARC,
    KIDNAPPED_UNMAPPED,
    OPTIONS,
    SHARP,
    WIDE,
    GivenSearch,
    candidate,
    distribution,
    make_map,
    make_parent,
    search,
)

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative, uninformative_belief
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.topological_inference import pose_verification, relocalization, relocalization_arcs
from hmt_slam_ros.topological_inference.branches import Branches
from hmt_slam_ros.topological_inference.hypothesis_tree import (
    FalseAlarm,
    HypothesisState,
    Lost,
    PoseInArea,
    Tracking,
)
from hmt_slam_ros.topological_inference.kidnapping_prior import EventCounts
from hmt_slam_ros.topological_inference.search_prior import PoseHint


@pytest.mark.parametrize(
    ("offset", "is_same"),
    [
        ((0.79, -0.6, 0.0), True),
        ((0.81, -0.6, 0.0), False),
        ((0.0, 0.0, math.radians(14.9)), True),
        ((0.0, 0.0, math.radians(15.1)), False),
        ((0.0, 0.0, -math.radians(15.1)), False),
        ((0.5, 0.5, -math.radians(14.9)), True),
    ],
)
def test_two_poses_are_the_same_within_a_meter_and_15_degrees_in_whatever_areas(offset, is_same):
    hybrid_map, pose = make_map(), np.array([0.4, -0.8, 3.0])
    other = se2.compose(pose, offset)
    same = pose_verification.is_same_place
    assert same(hybrid_map, PoseInArea(1, 20, pose), PoseInArea(1, 20, other)) is is_same
    assert same(hybrid_map, PoseInArea(0, 20, se2.compose(ARC, pose)), PoseInArea(1, 20, other)) is is_same
    assert same(hybrid_map, PoseInArea(1, 20, pose), PoseInArea(0, 20, se2.compose(ARC, other))) is is_same
    assert not same(hybrid_map, PoseInArea(2, 20, pose), PoseInArea(1, 20, other))


POSES = {20: np.zeros(3), 23: np.array([1.0, 0.5, 0.4])}
TRACKED = PoseInArea(0, 23, np.array([2.0, 1.0, 1.0]))


def at_tracked_pose(area=0):
    """``area_T_reference`` of a candidate at the tracked pose."""
    pose = se2.compose(TRACKED.pose, se2.inverse(POSES[23]))
    return pose if area == 0 else se2.compose(se2.inverse(ARC), pose)


@pytest.mark.parametrize(("here", "away"), [(0.1, 0.5), (0.6, 0.1), (0.0, 0.9), (0.3, 0.2)])
def test_the_bayes_factor_of_a_kidnapping_is_that_of_being_elsewhere_over_having_stayed(here, away):
    found = distribution(
        (candidate(1, [5.0, 5.0, 0.0]), 0.6 * away),
        (candidate(1, at_tracked_pose(1)), here),
        (candidate(2, at_tracked_pose()), 0.4 * away),
    )
    unmapped = 1.0 - here - away
    # The prior of moved robots is flat over the four areas; staying at new ground has the likelihood 1.
    likelihood = here / unmapped * KIDNAPPED_UNMAPPED / (1.0 - KIDNAPPED_UNMAPPED) * 4
    expected = math.log((unmapped + away) / unmapped * KIDNAPPED_UNMAPPED) - math.log(max(1.0, likelihood))
    factor = pose_verification.log_bayes_factor(make_map(), found, TRACKED, POSES)
    assert factor == pytest.approx(expected)


@pytest.mark.parametrize(
    ("here", "away", "matched", "preferred"),
    [(0.3, 0.29, 0.6, True), (0.3, 0.3, 0.6, False), (0.3, 0.1, 0.59, False), (0.0, 0.0, 0.9, False)],
)
def test_the_tracked_pose_is_preferred_over_other_candidates_where_most_surfaces_match(here, away, matched, preferred):
    found = distribution((candidate(1, [5.0, 5.0, 0.0], 0.95), away), (candidate(1, at_tracked_pose(1), matched), here))
    assert pose_verification.prefers_tracked_pose(make_map(), found, TRACKED, POSES, OPTIONS) is preferred
    assert not pose_verification.prefers_tracked_pose(make_map(), distribution(), TRACKED, POSES, OPTIONS)


@pytest.mark.parametrize(
    ("probability", "matched", "covariance", "mapping", "kidnapped"),
    [
        (0.8, 0.6, SHARP, True, True),
        (0.79, 0.6, SHARP, False, False),
        (0.8, 0.59, SHARP, True, False),
        (0.8, 0.0, SHARP, True, False),
        (0.9, 0.9, WIDE, False, False),
    ],
)
def test_a_search_determines_the_pose_where_it_is_probable_certain_and_matches(
    probability, matched, covariance, mapping, kidnapped
):
    each = candidate(1, [2.0, 1.0, 0.4], matched, covariance)
    decisive = [pose_verification.is_decisive(each, probability, OPTIONS, is_kidnapped=k) for k in (False, True)]
    assert decisive == [mapping, kidnapped]
    found = pose_verification.decisive_candidate(distribution((each, probability)), POSES, OPTIONS)
    assert (found is not None) is kidnapped
    if found is not None:
        assert (found.area, found.keyframe) == (1, 23)
        np.testing.assert_allclose(found.pose, se2.compose([2.0, 1.0, 0.4], POSES[23]))
    assert pose_verification.decisive_candidate(distribution(), POSES, OPTIONS) is None


@pytest.mark.parametrize(
    ("since", "probability", "keeps"), [(21, 0.11, True), (21, 0.09, False), (22, 0.09, True), (20, 0.0, False)]
)
def test_a_pose_hint_is_refuted_by_five_keyframes_that_fit_nowhere(since, probability, keeps):
    hint = PoseHint(23, 1, PoseGaussian(np.array([4.0, 2.0, 0.5]), SHARP))
    found = search(Lost(since, pose_hint=hint), (candidate(1, [2.0, 1.0, 0.4]), probability))[2]
    assert (found.children[0].state.localization.pose_hint is hint) is keeps


@pytest.mark.parametrize(("hinted", "probability", "count"), [(False, 0.95, 1), (True, 0.85, 2), (True, 0.79, 1)])
def test_one_search_is_enough_with_a_hint_and_without_it_another_confirms_it(hinted, probability, count):
    hint = PoseHint(21, 1, PoseGaussian(np.array([4.0, 2.0, 0.5]), SHARP)) if hinted else None
    pose = np.array([2.0, 1.0, 0.4])
    pair = (candidate(1, pose), probability)
    _, parent, found = search(Lost(21, pose_hint=hint), pair)
    assert len(found.children) == count
    own = parent.hybrid_map.keyframes(5)
    remembered = found.children[0].state.localization.candidate
    if probability >= 0.8:
        assert (remembered.area, remembered.keyframe) == (1, 25)
        np.testing.assert_allclose(remembered.pose, se2.compose(pose, se2.between(own[21], own[25])))
        # The same pose in the other area.
        again = search(Lost(21, candidate=remembered), (candidate(0, se2.compose(ARC, pose)), 0.9))[2]
        assert len(again.children) == 2
        away = search(Lost(21, candidate=remembered), (candidate(0, pose), 0.9))[2]
        assert len(away.children) == 1
        gone = search(Lost(21, candidate=replace(remembered, keyframe=9)), pair)[2]
        assert len(gone.children) == 1
    else:
        assert remembered is None


def test_a_relocalized_child_has_the_probability_of_its_candidate_and_an_arc_to_it():
    hint = PoseHint(21, 1, PoseGaussian(np.array([4.0, 2.0, 0.5]), SHARP))
    each = candidate(
        1, [2.0, 1.0, 0.4], covariance=np.array([[0.01, 0.002, 0.0], [0.002, 0.02, 0.001], [0, 0.001, 0.003]])
    )
    _, parent, found = search(Lost(21, pose_hint=hint), (each, 0.85), (candidate(2, [0.0, 0.0, 0.0]), 0.05))
    lost, relocalized = found.children
    assert lost.log_weight == pytest.approx(-0.7 + math.log(0.15))
    assert relocalized.log_weight == pytest.approx(-0.7 + math.log(0.85))
    assert lost.state.localization.counted_evidence is None
    assert lost.state.is_lost
    assert not relocalized.state.is_lost
    assert relocalized.state.localization.relocalized_area == 1
    assert relocalized.reload_local_map
    (arc,) = relocalized.arcs
    assert (arc.source, arc.target, arc.closure) == (5, 1, True)
    reference = parent.hybrid_map.keyframes(5)[21]
    np.testing.assert_allclose(arc.pose.mean, se2.compose(reference, se2.inverse([2.0, 1.0, 0.4])))
    np.testing.assert_allclose(arc.pose.covariance, each.mode.measured.inverse().covariance)
    assert relocalization.accept_relocalization(found).children == [relocalized]
    only_lost = Branches([lost])
    assert relocalization.accept_relocalization(only_lost).children == [lost]


@pytest.mark.parametrize(("off", "is_refuted"), [(0.0, False), (1.5, False), (2.5, True)])
def test_a_wide_arc_that_does_not_admit_the_pose_found_says_nothing_any_more(off, is_refuted):
    """Behind it the robot was lost, and found where its drive cannot have led: it was moved."""
    hybrid_map, found_at = make_map(), np.array([2.0, 1.0, 0.4])
    reference = hybrid_map.keyframes(5)[20]
    implied = se2.compose(se2.compose(ARC, found_at), se2.inverse(reference))
    measured = se2.compose(implied, [off, 0.0, 0.0])
    hybrid_map.set_arc(0, 5, PoseGaussian(measured, np.diag([0.5, 0.5, 0.7]) ** 2), closure=False)
    hint = PoseHint(20, 1, PoseGaussian(found_at, SHARP))
    _, _, found = search(Lost(20, pose_hint=hint), (candidate(1, found_at), 0.95), hybrid_map=hybrid_map)
    lost, relocalized = found.children
    closure, *refuted = relocalized.arcs
    assert (closure.source, closure.target, closure.closure) == (5, 1, True)
    assert [(arc.source, arc.target) for arc in refuted] == [(0, 5)] * is_refuted
    for arc in refuted:
        assert is_uninformative(arc.pose)
        np.testing.assert_allclose(arc.pose.mean, implied)
    assert lost.arcs == ()


def test_a_kidnapped_hypothesis_counts_its_evidence_once():
    lost = Lost(21, tracked_pose=PoseInArea(5, 21, np.array([1.2, 0.5, 0.3])), counted_evidence=0.4)
    pair = (candidate(1, [2.0, 1.0, 0.4]), 0.6)
    _, parent, found = search(lost, pair)
    own = parent.hybrid_map.keyframes(5)
    poses = {k: se2.between(own[21], own[k]) for k in range(21, 26)}
    expected = distribution(pair).with_unmapped_prior(KIDNAPPED_UNMAPPED)
    np.testing.assert_allclose(found.pose_distribution.probabilities, expected.probabilities)
    evidence = pose_verification.log_bayes_factor(parent.hybrid_map, expected, lost.tracked_pose, poses)
    (child,) = found.children
    assert child.log_weight == pytest.approx(-0.7 + evidence - 0.4)
    assert child.state.localization.counted_evidence == pytest.approx(evidence)
    for changed in (replace(lost, counted_evidence=None), replace(lost, since=22)):
        (child,) = search(changed, pair)[2].children
        assert child.log_weight == -0.7
        assert child.state.localization.counted_evidence == changed.counted_evidence


def test_a_false_alarm_counts_where_its_keyframe_was_searched():
    alarm = FalseAlarm(PoseInArea(1, 22, np.array([3.0, 2.0, 0.5])), 0.7, "after_gap")
    hybrid_map = make_map()
    own = hybrid_map.keyframes(5)
    there = candidate(1, se2.compose(alarm.tracked_pose.pose, se2.between(own[22], own[21])))
    pairs = (candidate(2, [0.0, 0.0, 0.0]), 0.3), (there, 0.2)
    found = search(Lost(21, false_alarm=alarm), *pairs)[2].pose_distribution
    expected = distribution(*pairs).with_false_alarm(np.array([False, True]), 0.7, 4)
    np.testing.assert_allclose(found.probabilities, expected.probabilities)
    later = search(Lost(23, false_alarm=alarm), *pairs)[2].pose_distribution
    np.testing.assert_array_equal(later.probabilities, [0.3, 0.2])


def test_the_newest_forty_keyframes_of_the_submap_are_searched():
    hybrid_map = make_map()
    for k in range(60):
        hybrid_map.set_keyframe(100 + k, 2, np.array([0.1 * k, 0.2, 0.3]))
    beside = np.array([4.0, -1.0, 2.0])
    state = HypothesisState(localization=Lost(5), local_area_poses={2: beside, 9: np.zeros(3)})
    parent = replace(make_parent(Tracking(), hybrid_map), state=state)
    found = relocalization._poses_since(parent, 5)
    assert list(found) == list(range(120, 160))
    np.testing.assert_allclose(found[130], se2.compose(beside, [3.0, 0.2, 0.3]))
    assert list(relocalization._poses_since(parent, 150)) == list(range(150, 160))
    alone = make_parent(Tracking(), hybrid_map)
    assert list(relocalization._poses_since(alone, 22)) == [22, 23, 24, 25]


@pytest.mark.parametrize(("since", "initial_pose", "stays"), [(30, None, True), (29, None, False), (30, 0, False)])
def test_a_false_alarm_moves_to_the_odometry_pose_of_the_first_keyframe_alone(since, initial_pose, stays):
    alarm = FalseAlarm(PoseInArea(1, 22, np.array([3.0, 2.0, 0.5])), 0.7, "after_gap")
    keyframe = SimpleNamespace(sequence=30, initial_pose=initial_pose)
    pose = np.array([0.2, 0.4, 0.6])
    found = relocalization._update_false_alarm(make_parent(Lost(since, false_alarm=alarm)), keyframe, pose)
    false_alarm = found.state.localization.false_alarm
    if stays:
        assert (false_alarm.tracked_pose.area, false_alarm.tracked_pose.keyframe) == (5, 30)
        assert false_alarm.tracked_pose.pose is pose
        assert false_alarm.probability == 0.7
    else:
        assert false_alarm is None
    tracking = make_parent(Tracking())
    assert relocalization._update_false_alarm(tracking, keyframe, pose) is tracking


def test_the_area_of_a_lost_robot_is_drawn_where_it_agrees_with_the_hint():
    hybrid_map = make_map()
    hybrid_map.set_arc(0, 5, uninformative_belief(np.array([1.0, 1.0, 1.0])), closure=False)
    parent, hint = make_parent(Lost(20), hybrid_map), PoseHint(23, 1, PoseGaussian(np.array([4.0, 2.0, 0.5]), SHARP))
    np.testing.assert_allclose(relocalization_arcs.hinted_pose(parent, 0, hint), se2.compose(ARC, hint.pose.mean))
    np.testing.assert_array_equal(relocalization_arcs.hinted_pose(parent, 2, hint), hint.pose.mean)
    pose = hybrid_map.keyframes(5)[23]
    (arc,) = relocalization_arcs.hinted_arcs(parent, 20, hint, pose)
    assert (arc.source, arc.target) == (0, 5)
    np.testing.assert_allclose(se2.compose(arc.pose.mean, pose), se2.compose(ARC, hint.pose.mean))
    np.testing.assert_array_equal(arc.pose.covariance, uninformative_belief(np.zeros(3)).covariance)
    assert relocalization_arcs.hinted_arcs(parent, 21, hint, pose) == ()


def test_an_initial_pose_of_a_lost_robot_is_that_of_its_newest_keyframe():
    hybrid_map = make_map()
    branching, parent = GivenSearch(options=OPTIONS, found=distribution()), make_parent(Lost(22), hybrid_map)
    given = PoseGaussian(np.array([4.0, 2.0, 0.5]), SHARP)
    scan = se2.compose(hybrid_map.keyframes(5)[25], [0.3, -0.2, 0.4])
    found = relocalization._relocalize_at_hint(branching, parent, Lost(22), InitialPose(1, given), scan)
    hint = found.children[0].state.localization.pose_hint
    assert (hint.keyframe, hint.area) == (25, 1)
    np.testing.assert_allclose(se2.compose(hint.pose.mean, [0.3, -0.2, 0.4]), given.mean)
    for localization, area in ((Lost(22), 77), (Lost(99), 1)):
        branches = relocalization._relocalize_at_hint(branching, parent, localization, InitialPose(area, given), scan)
        assert branches.children[0].state is parent.state


@pytest.mark.parametrize(
    ("pose", "tracked_keyframe", "kidnappings"),
    [((0.0, 0.0, 0.0), 22, 0), ((3.0, 0.0, 0.0), 22, 1), ((3.0, 0.0, 0.0), 9, 0)],
    ids=["false alarm", "elsewhere", "long ago"],
)
def test_a_relocalization_elsewhere_than_a_false_alarm_counts_as_a_kidnapping(pose, tracked_keyframe, kidnappings):
    """That the robot is still lost counts as none: it is counted once."""
    own = make_map().keyframes(5)
    tracked = np.array([3.0, 2.0, 0.5])
    alarm = FalseAlarm(PoseInArea(1, tracked_keyframe, tracked), 0.7, "after_gap")
    there = se2.compose(tracked, se2.between(own[22], own[21])) + np.array(pose)
    remembered = PoseInArea(1, 24, se2.compose(there, se2.between(own[21], own[24])))
    pair = (candidate(1, there), 0.99)
    lost, relocalized = search(Lost(21, false_alarm=alarm, candidate=remembered), pair)[2].children
    assert lost.state.kidnapping_counts == {}
    assert relocalized.state.kidnapping_counts == ({"after_gap": EventCounts(0, 1)} if kidnappings else {})
