"""Rules of branching by their equations: queries, entries, arcs, merges and revisions, with a search that is given."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.topological_inference import area_entry
from hmt_slam_ros.topological_inference import branching as module
from hmt_slam_ros.topological_inference.area_comparison import AreaComparison, Fit, OngoingComparison
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.candidate_gating import Transition
from hmt_slam_ros.topological_inference.closure_search import _split_heaviest
from hmt_slam_ros.topological_inference.event_work import EventWork
from hmt_slam_ros.topological_inference.hypothesis_changes import apply_revision, merge_areas
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState

CONFIGURATION = with_changes(
    Configuration(),
    {
        "tlca.arc_sigma_floor": 0.03,
        "tlca.arc_angle_floor": 0.7,
        "tsbi.max_candidates": 9,
        "tsbi.max_comparisons": 20,
        "tsbi.recheck_keyframes": 2,
    },
)
FLOOR = np.diag([0.03, 0.03, math.radians(0.7)]) ** 2
SPREAD = np.array([[0.04, 0.01, 0.002], [0.01, 0.03, -0.001], [0.002, -0.001, 0.001]])
ARC, BACK = np.array([3.0, 1.0, 0.7]), np.array([-2.0, 4.0, 2.0])


def make_map():
    """Areas 0, 1 and 2 in a chain; the robot is in area 1 with keyframes 10 to 14; 6 is apart."""
    hybrid_map = HybridMap()
    for k in range(5):
        hybrid_map.set_keyframe(10 + k, 1, se2.compose([0.5, -0.3, 0.4], [0.4 * k, 0.1 * k, 0.1 * k]))
    for area in (0, 2, 6):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
        hybrid_map.set_keyframe(30 + area, area, np.array([1.0, 0.5, 0.3]))
    hybrid_map.set_arc(1, 0, PoseGaussian(BACK, SPREAD), closure=False)
    hybrid_map.set_arc(1, 2, PoseGaussian(ARC, 0.5 * SPREAD), closure=True)
    return hybrid_map


def growing(k):
    return (1.0 + 0.2 * k) * SPREAD


def make_parent(**changes):
    state = HypothesisState({10 + k: growing(k) for k in range(5)}, unmatched_keyframes=(12, 14, 99), **changes)
    return Parent(4, 1, make_map(), state, -0.7, probability=0.3)


def make_branching(**search):
    branching = Branching(CONFIGURATION, Replica())
    branching.search = SimpleNamespace(**{"work": EventWork(), "tracked_area": lambda *_: None, **search})
    branching.entry._search = branching.search
    return branching


class GivenComparison:
    """A comparison whose result is given, after some events, and what was requested."""

    def __init__(self, found, events=1):
        self.found, self.remaining, self.requested = found, events, []

    def begin_comparison(self, *given):
        self.requested.append(given)
        _, _, query, _, excluded, _, kind, *_ = given
        return OngoingComparison(query, frozenset(excluded), kind, {}, {}, ())

    def continue_comparison(self, _hybrid_map, comparison):
        self.remaining -= 1
        return self.found if self.remaining == 0 else comparison

    def branching(self):
        return make_branching(begin_comparison=self.begin_comparison, continue_comparison=self.continue_comparison)


def moved_covariance(entry, relative, relative_covariance):
    """Of a pose after another."""
    ad = se2.adjoint(se2.inverse(relative))
    return ad @ entry @ ad.T + relative_covariance


def test_a_query_is_seen_from_its_first_keyframe_with_the_covariance_of_that():
    parent, branching = make_parent(), make_branching()
    query = branching.entry.query(parent, [12, 13, 14])
    own = parent.hybrid_map.keyframes(1)
    np.testing.assert_array_equal(query.belief.mean, own[12])
    np.testing.assert_allclose(query.belief.covariance, growing(2) + FLOOR)
    assert list(query.poses) == [12, 13, 14]
    np.testing.assert_allclose(query.poses[14], se2.between(own[12], own[14]))
    unknown = branching.entry.query(replace(parent, state=HypothesisState()), [12])
    np.testing.assert_allclose(unknown.belief.covariance, FLOOR)


@pytest.mark.parametrize("arc", [None, PoseGaussian(np.array([1.0, -2.0, 0.5]), 2.0 * SPREAD)])
def test_keyframes_enter_an_area_with_the_covariance_of_the_entry_and_of_their_way_since(arc):
    parent, branching = make_parent(kidnapping_evidence={3: 1.0}), make_branching()
    query, entry = branching.entry.query(parent, [12, 13, 14]), PoseGaussian(np.array([5.0, -1.0, 2.0]), 3.0 * SPREAD)
    child = branching.entry.enter_area(parent, query, 2, entry, arc, 0.25)
    assert (child.parent, child.area, child.reload_local_map) == (4, 2, True)
    assert child.log_weight == pytest.approx(-0.45)
    assert [(m.keyframe, m.previous_area, m.area) for m in child.moved_keyframes] == [(k, 1, 2) for k in (12, 13, 14)]
    assert child.state.covariances.keys() == {12, 13, 14}
    assert child.state.kidnapping_evidence == {3: 1.0}
    for n, moved in enumerate(child.moved_keyframes):
        relative = query.poses[moved.keyframe]
        np.testing.assert_allclose(moved.pose, se2.compose(entry.mean, relative))
        ad = se2.adjoint(se2.inverse(relative))
        since = growing(2 + n) - ad @ growing(2) @ ad.T
        values, vectors = np.linalg.eigh(since)
        since = (vectors * np.maximum(values, 0.0)) @ vectors.T
        expected = moved_covariance(entry.covariance, relative, since)
        np.testing.assert_allclose(child.state.covariances[moved.keyframe], expected, atol=1e-12)
    # The robot's frame changes as its newest keyframe does.
    newest = parent.hybrid_map.keyframes(1)[14]
    np.testing.assert_allclose(se2.compose(child.frame_change.mean, newest), child.moved_keyframes[-1].pose, atol=1e-12)
    expected = moved_covariance(child.state.covariances[14], se2.inverse(newest), 0.0)
    np.testing.assert_allclose(child.frame_change.covariance, expected)
    if arc is None:
        assert child.arcs == ()
    else:
        assert [(a.source, a.target, a.closure) for a in child.arcs] == [(1, 2, True)]
        assert child.arcs[0].pose is arc


@pytest.mark.parametrize(("area", "closure"), [(0, False), (2, True), (6, True), (7, False)])
def test_an_arc_to_a_known_area_that_none_joined_closes_a_loop(area, closure):
    arc = area_entry._make_arc(make_parent(), area, PoseGaussian(ARC, SPREAD))
    assert (arc.source, arc.target, arc.closure) == (1, area, closure)


def fit(area, log_weight, pose=(1.0, 0.2, 0.3)):
    pose = np.array(pose)
    mode = MatchMode(PoseGaussian(pose, SPREAD), PoseGaussian(pose, 2.0 * SPREAD), 0.0)
    return Fit(area, mode, log_weight, 0.5, Agreement(60, 50, 4))


def test_a_cut_branches_over_new_ground_and_every_fit_by_their_weights():
    fits = fit(2, -1.5), fit(6, -2.5, (0.3, -0.1, -1.0))
    comparison = AreaComparison(Transition({2: 0.4, 6: 0.2}, 0.4), fits, (2, 6), (0,), 0.05)
    given = GivenComparison(comparison)
    branching, parent = given.branching(), make_parent(local_area_poses={0: BACK, 77: ARC})
    found = branching.cut(parent, [12, 13, 14])
    new, *known = found.children
    assert found.closures_searched
    assert found.log_skipped_weight == pytest.approx(math.log(0.05) - 0.7)
    assert new.log_weight == pytest.approx(-0.7 + math.log(0.4))
    assert [child.log_weight for child in known] == pytest.approx([-2.2, -3.2])
    assert (new.area, [child.area for child in known]) == (7, [2, 6])
    np.testing.assert_array_equal(new.moved_keyframes[0].pose, np.zeros(3))
    assert not new.arcs[0].closure
    query = branching.entry.query(parent, [12, 13, 14])
    np.testing.assert_allclose(new.arcs[0].pose.covariance, query.belief.covariance)
    for child, each in zip(known, fits, strict=True):
        np.testing.assert_allclose(child.moved_keyframes[0].pose, each.mode.pose.mean)
        expected = query.belief.compose(each.mode.measured.inverse())
        np.testing.assert_allclose(child.arcs[0].pose.mean, expected.mean)
        np.testing.assert_allclose(child.arcs[0].pose.covariance, expected.covariance)
    hybrid_map, area, _, _, excluded, most, kind, only, marks = given.requested[0]
    assert marks == {}
    assert (hybrid_map, area, excluded, kind, tuple(only)) == (parent.hybrid_map, 1, {0, 1}, "cut", ())
    assert most == 6  # 20 comparisons by the probability
    assert branching.entry.new_area(parent, query) == 7
    assert branching.entry.new_area(parent, branching.entry.query(parent, [13])) == 8
    branching.begin_event()
    assert branching.entry.new_area(parent, query) == 9


@pytest.mark.parametrize(("probability", "most"), [(1.0, 9), (0.44, 9), (0.31, 7), (0.001, module.MIN_EXAMINED_AREAS)])
def test_more_areas_are_examined_the_more_probable_the_hypothesis_is(probability, most):
    requested = []
    branching = make_branching(begin_comparison=lambda *given: requested.append(given[5]))
    parent = replace(make_parent(), probability=probability)
    branching._begin_comparison(parent, branching.entry.query(parent, [12]), (), "cut")
    assert requested == [most]


@pytest.mark.parametrize(
    ("only", "fits", "log_stay", "keyframes", "unmatched"),
    [
        ((), (), math.log(0.4), [12, 14], ()),
        ((), (fit(6, -2.0),), math.log(0.4), [12, 14], ()),
        ((6,), (), 0.0, [13, 14], (12, 14, 99)),
        ((6,), (fit(6, -2.0),), math.log(0.4), [13, 14], (12, 14, 99)),
    ],
)
def test_a_recheck_leaves_keyframes_where_they_are_and_joins_the_areas(only, fits, log_stay, keyframes, unmatched):
    given = GivenComparison(AreaComparison(Transition({6: 0.6}, 0.4), fits, (6,), (0,), 0.0))
    branching, parent = given.branching(), make_parent()
    found = branching.recheck(parent, only)
    stay, *joined = found.children
    assert found.log_skipped_weight == -math.inf
    assert stay.log_weight == pytest.approx(-0.7 + log_stay)
    assert (stay.area, stay.arcs, stay.moved_keyframes) == (1, (), ())
    assert (stay.state.unmatched_keyframes, stay.state.pending_candidates) == (unmatched, (0,))
    assert stay.state.matched_keyframes == {6: frozenset(keyframes)}
    assert list(given.requested[0][2].poses) == keyframes
    assert given.requested[0][4] == {0, 1, 2}
    assert given.requested[0][6:] == ("retry" if only else "recheck", only, {})
    assert len(joined) == len(fits)
    for child in joined:
        assert (child.area, child.moved_keyframes, child.reload_local_map) == (1, (), True)
        assert child.log_weight == pytest.approx(-2.7)
        (arc,) = child.arcs
        assert (arc.source, arc.target, arc.closure) == (1, 6, True)
        expected = branching.entry.query(parent, keyframes).belief.compose(fits[0].mode.measured.inverse())
        np.testing.assert_allclose(arc.pose.mean, expected.mean)
        np.testing.assert_allclose(arc.pose.covariance, expected.covariance)


def waiting(branches):
    """The comparison of an only child to which nothing else happened."""
    (child,) = branches.children
    assert not branches.closures_searched
    assert (child.area, child.log_weight, child.arcs, child.moved_keyframes) == (1, -0.7, (), ())
    return child.state.comparison


def test_a_recheck_ends_at_the_event_of_its_last_comparison_and_newer_keyframes_wait_for_the_next():
    fits = fit(6, -2.0), fit(2, -1.0)
    given = GivenComparison(AreaComparison(Transition({6: 0.3, 2: 0.3}, 0.4), fits, (6, 2), (), 0.1), 3)
    branching, parent = given.branching(), make_parent()
    comparison = waiting(branching.recheck(parent))
    assert list(comparison.query.poses) == [12, 14]
    assert waiting(branching.continue_comparison(parent, comparison)) is comparison
    state = replace(parent.state, unmatched_keyframes=(12, 14, 15), comparison=comparison)
    found = branching.continue_comparison(replace(parent, state=state), comparison)
    # An arc joins area 2 to the robot's.
    stay, joined = found.children
    assert (stay.log_weight, joined.log_weight) == pytest.approx((-0.7 + math.log(0.4), -2.7))
    assert joined.arcs[0].target == 6
    assert found.log_skipped_weight == pytest.approx(math.log(0.1) - 0.7)
    for child in (stay, joined):
        assert (child.state.comparison, child.state.unmatched_keyframes) == (None, (15,))
        assert child.state.matched_keyframes == {6: {12, 14}, 2: {12, 14}}
    assert len(given.requested) == 1


@pytest.mark.parametrize("newer", [(), (15,)])
def test_keyframes_are_cut_at_the_event_of_their_last_comparison_together_with_newer_ones(newer):
    given = GivenComparison(AreaComparison(Transition({6: 0.6}, 0.4), (fit(6, -2.0),), (6,), (), 0.0), 2)
    branching, parent = given.branching(), make_parent()
    comparison = waiting(branching.cut(parent, [12, 13, 14]))
    for keyframe in newer:
        parent.hybrid_map.set_keyframe(keyframe, 1, np.array([2.0, 0.5, 0.4]))
    parent = replace(parent, state=replace(parent.state, comparison=comparison))
    new, known = branching.cut(parent, [12, 13, 14, *newer]).children
    assert [child.area for child in (new, known)] == [7, 6]
    own, reference = parent.hybrid_map.keyframes(1), comparison.query.belief.mean
    for moved in known.moved_keyframes:
        expected = se2.compose(fit(6, 0.0).mode.pose.mean, se2.between(reference, own[moved.keyframe]))
        np.testing.assert_allclose(moved.pose, expected)
    for child in (new, known):
        assert [moved.keyframe for moved in child.moved_keyframes] == [12, 13, 14, *newer]
        assert child.state.comparison is None


@pytest.mark.parametrize(("kind", "compared"), [("recheck", [12, 13]), ("cut", [11, 12])])
def test_a_cut_waits_for_the_comparison_of_others(kind, compared):
    given = GivenComparison(AreaComparison(Transition({6: 0.1}, 1.0), (), (6,), (), 0.0), 2)
    branching, parent = given.branching(), make_parent()
    ongoing = OngoingComparison(branching.entry.query(parent, compared), frozenset({1}), kind, {}, {}, ())
    parent = replace(parent, state=replace(parent.state, comparison=ongoing))
    assert waiting(branching.cut(parent, [12, 13, 14])) is ongoing
    (child,) = branching.cut(parent, [12, 13, 14]).children
    assert (child.area, child.state.comparison, child.state.matched_keyframes) == (1, None, {6: set(compared)})
    assert given.requested == []


def test_where_arcs_are_wide_keyframes_begin_an_area_at_once_and_are_compared_there():
    given = GivenComparison(AreaComparison(Transition({6: 0.6}, 0.4), (fit(6, -2.0),), (6,), (), 0.0), 2)
    branching, parent = given.branching(), make_parent(local_area_poses={0: BACK})
    wide = {**parent.state.covariances, 14: 100.0 * SPREAD}
    parent = replace(parent, state=replace(parent.state, covariances=wide))
    (child,) = branching.cut(parent, [14]).children
    assert given.requested[0][4] == {1}
    assert (child.area, child.log_weight) == (7, -0.7)
    comparison = child.state.comparison
    np.testing.assert_array_equal(comparison.query.belief.mean, np.zeros(3))
    np.testing.assert_allclose(comparison.query.belief.covariance, child.state.covariances[14] + FLOOR)
    parent.hybrid_map.remove_keyframe(14, 1)
    parent.hybrid_map.set_keyframe(14, 7, np.zeros(3))
    entered = replace(parent, area=7, state=child.state)
    stay, joined = branching.continue_comparison(entered, comparison).children
    assert (stay.area, joined.area) == (7, 7)
    (arc,) = joined.arcs
    assert (arc.source, arc.target) == (7, 6)
    np.testing.assert_allclose(arc.pose.mean, se2.inverse(fit(6, 0.0).mode.measured.mean))


@pytest.mark.parametrize("condition", ["after_gap", "uncertain", None])
def test_behind_a_wide_heading_after_a_fault_keyframes_are_not_compared_where_the_robot_is_searched(condition):
    given = GivenComparison(AreaComparison(Transition({6: 0.6}, 0.4), (fit(6, -2.0),), (6,), (), 0.0), 1)
    branching, parent = given.branching(), make_parent(onset_conditions={14: condition} if condition else {})
    wide = {**parent.state.covariances, 14: np.diag([0.1, 0.1, 0.8]) ** 2}
    lost, *others = branching.cut(replace(parent, state=replace(parent.state, covariances=wide)), [14]).children
    assert lost.area == 7
    assert lost.state.is_lost
    assert [child.area for child in others] == ([] if condition else [6])
    if condition is None:
        return
    child = lost
    assert (child.area, child.log_weight, child.state.is_lost) == (7, -0.7, True)
    assert child.state.comparison is None
    assert given.requested == []


@pytest.mark.parametrize(("kind", "compared", "goes_on"), [("cut", [12, 13], True), ("recheck", [10, 11], False)])
def test_halfway_to_the_end_of_the_local_map_keyframes_begin_an_area_before_they_are_compared(kind, compared, goes_on):
    given = GivenComparison(AreaComparison(Transition({6: 0.1}, 1.0), (), (6,), (), 0.0), 3)
    branching, parent = given.branching(), make_parent()
    ongoing = OngoingComparison(branching.entry.query(parent, compared), frozenset({1}), kind, {}, {}, ())
    parent = replace(parent, state=replace(parent.state, comparison=ongoing))
    assert waiting(branching.cut(parent, [12, 13, 14])) is ongoing
    parent.hybrid_map.set_keyframe(14, 1, np.array([0.6 * Configuration().local_map.extent, 0.0, 0.0]))
    (child,) = branching.cut(parent, [12, 13, 14]).children
    assert (child.area, child.log_weight) == (7, -0.7)
    assert {moved.keyframe for moved in child.moved_keyframes} == {12, 13, 14}
    assert bool(given.requested) != goes_on
    comparison = child.state.comparison
    assert (comparison.kind, list(comparison.query.poses)) == ("recheck", compared if goes_on else [12, 13, 14])
    np.testing.assert_array_equal(comparison.query.belief.mean, np.zeros(3))


def test_where_the_robot_is_tracked_into_an_area_the_submap_gives_the_pose():
    nudged = se2.compose(ARC, [0.02, -0.01, 0.005])
    branching = make_branching(tracked_area=lambda *_: 2)
    parent = make_parent(local_area_poses={2: nudged})
    (child,) = branching.cut(parent, [12, 13]).children
    assert (child.area, child.log_weight, child.arcs) == (2, -0.7, ())
    own = parent.hybrid_map.keyframes(1)
    np.testing.assert_allclose(child.moved_keyframes[0].pose, se2.compose(se2.inverse(nudged), own[12]))
    moved = branching.entry.move(parent, 2).children[0]
    assert (moved.area, moved.log_weight, moved.reload_local_map, moved.moved_keyframes) == (2, -0.7, True, ())
    expected = PoseGaussian(nudged, 0.5 * SPREAD).inverse()
    np.testing.assert_allclose(moved.frame_change.mean, expected.mean)
    np.testing.assert_allclose(moved.frame_change.covariance, expected.covariance)
    assert moved.state.covariances == {}


@pytest.mark.parametrize(("x", "expected"), [(5.5, 6), (0.9, None)])
def test_an_overlap_counts_where_the_robot_is_nearer_to_the_other_area(x, expected):
    """Area 6 begins 6 m ahead, area 1 has keyframes up to 2 m."""
    requested = []
    branching = make_branching(tracked_area=lambda *given: requested.append(given) or 6)
    parent = make_parent(local_area_poses={2: ARC, 6: np.array([6.0, 0.0, 0.5])})
    assert branching.find_unlinked_overlap(parent, np.array([x, 0.2, 0.3])) == expected
    assert list(requested[0][2]) == [6]
    nowhere = make_branching(tracked_area=lambda *_: None)
    assert nowhere.find_unlinked_overlap(parent, np.array([x, 0.2, 0.3])) is None


def test_an_overlap_is_joined_by_the_arc_that_the_newest_scan_measures():
    measured, requested = PoseGaussian(np.array([0.4, 0.3, -0.2]), 0.1 * SPREAD), []
    branching = make_branching(measure_pose=lambda *given: requested.append(given) or measured)
    parent, pose = make_parent(unlinked_overlap=(2, 3)), PoseGaussian(np.array([2.0, 1.0, 0.4]), SPREAD)
    (child,) = branching.entry.link(parent, 2, None, pose).children
    (arc,) = child.arcs
    assert (arc.source, arc.target, arc.closure) == (1, 2, True)
    expected = pose.compose(measured.inverse())
    np.testing.assert_allclose(arc.pose.mean, expected.mean)
    np.testing.assert_allclose(arc.pose.covariance, expected.covariance)
    assert child.state.unlinked_overlap is None
    _, other, own, _, prior = requested[0]
    assert (other, own) == (2, 1)
    belief = PoseGaussian(ARC, 0.5 * SPREAD).inverse().compose(PoseGaussian(pose.mean, SPREAD + FLOOR))
    np.testing.assert_allclose(prior.mean, belief.mean)
    np.testing.assert_allclose(prior.covariance, belief.covariance)
    nothing = make_branching(measure_pose=lambda *_: None)
    assert nothing.entry.link(parent, 2, None, pose).children[0].arcs == ()


@pytest.mark.parametrize("is_same", [True, False])
@pytest.mark.parametrize("robot", [1, 2])
def test_areas_that_are_one_are_merged_and_the_robot_goes_along(robot, is_same):
    search = SimpleNamespace(is_same_place=lambda _map, into, area, pose: is_same and (into, area) == (2, 1))
    parent = replace(make_parent(matched_keyframes={0: frozenset({11, 80})}), area=robot)
    child = merge_areas(parent, 1, 2, search)
    assert child.area == (2 if is_same else robot)
    if not is_same:
        assert (child.area_merge, child.reload_local_map) == (None, False)
        return
    into_T_area = parent.hybrid_map.arc(2, 1)
    assert (child.area_merge.area, child.area_merge.into, child.reload_local_map) == (1, 2, True)
    np.testing.assert_allclose(child.area_merge.pose.mean, se2.inverse(ARC))
    if robot == 1:
        np.testing.assert_allclose(child.frame_change.mean, se2.inverse(ARC))
        assert child.state.matched_keyframes == {0: {11}}
        for k, pose in parent.hybrid_map.keyframes(1).items():
            expected = into_T_area.compose(PoseGaussian(pose, growing(k - 10))).covariance
            np.testing.assert_allclose(child.state.covariances[k], expected)
    else:
        assert child.frame_change is None
        assert child.state is parent.state
    assert merge_areas(parent, 6, 2, search).area_merge is None


@pytest.mark.parametrize("area", [1, 2])
def test_a_revision_moves_the_keyframe_that_came_since_and_forgets_comparisons(area):
    parent = make_parent(matched_keyframes={0: frozenset({11})}, unlinked_overlap=(2, 1))
    change = None if area == 1 else PoseGaussian(np.array([1.0, 2.0, 0.5]), np.zeros((3, 3)))
    moved = (MovedKeyframe(12, 1, 2, ARC), MovedKeyframe(13, 1, 0, ARC)) if area == 2 else ()
    explanation = Hypothesis(
        4, 4, 0.3, area, change, moved, (Arc(0, 2, PoseGaussian(ARC, SPREAD), True),), removed_arcs=(ArcEnds(1, 2),)
    )
    child = apply_revision(parent, explanation, 14)
    assert child.log_weight == pytest.approx(-0.7 + math.log(0.3))
    assert child.area == area
    assert child.arcs is explanation.arcs
    assert child.removed_arcs is explanation.removed_arcs
    assert child.frame_change is change
    assert child.state.matched_keyframes == {}
    assert child.state.unlinked_overlap is None
    if area == 1:
        assert child.moved_keyframes == ()
        assert child.state.covariances == parent.state.covariances
    else:
        assert [(m.keyframe, m.area) for m in child.moved_keyframes] == [(12, 2), (13, 0), (14, 2)]
        own = parent.hybrid_map.keyframes(1)[14]
        np.testing.assert_allclose(child.moved_keyframes[-1].pose, se2.compose(change.mean, own))
        assert child.state.covariances.keys() == {12, 14}
        assert child.state.unmatched_keyframes == (12, 14)
        assert apply_revision(parent, explanation, 98).moved_keyframes == moved


def test_of_the_fits_the_heaviest_of_each_area_are_kept_in_their_order():
    weights = (-3.0, -1.0, -2.0, -2.0, -0.5, -9.0)
    fits = [fit(area, weight) for area, weight in zip((2, 2, 6, 2, 6, 0), weights, strict=True)]
    kept, dropped = _split_heaviest(fits, 2)
    assert kept == tuple(fits[n] for n in (1, 2, 3, 4, 5))
    assert dropped == (fits[0],)
    kept, dropped = _split_heaviest(fits, 1)
    assert kept == tuple(fits[n] for n in (1, 4, 5))
    assert dropped == tuple(fits[n] for n in (0, 2, 3))
