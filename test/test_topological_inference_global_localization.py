"""Distributions over the pose of a lost robot, by Bayes' rule."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import (
    MAP_IN_MAP,
    MAPS_OUTLIER_RATE,
    NO_CLUTTER,
    WALLS_OF_MAP,
    WALLS_OUTLIER_RATE,
    Agreement,
)
from hmt_slam_ros.topological_inference import event_work
from hmt_slam_ros.topological_inference.event_work import EventWork
from hmt_slam_ros.topological_inference.global_localization import (
    GlobalSearch,
    begin_search,
    check_candidates,
    continue_search,
    is_conclusive,
    localize_globally,
    plausible_areas,
    search_region,
)
from hmt_slam_ros.topological_inference.global_scan_matching import (
    GlobalScanMatcher,
    PoseCandidate,
    Region,
    RegionMatch,
)
from hmt_slam_ros.topological_inference.marked_places import MarkedPlaces, MarkedPose
from hmt_slam_ros.topological_inference.pose_distribution import (
    UNMAPPED_PRIOR,
    PoseDistribution,
    summarize_localization,
)
from hmt_slam_ros.topological_inference.search_prior import FLAT_PRIOR, PoseHint, SearchPrior

shares = st.lists(st.floats(0.001, 1.0), min_size=1, max_size=5)


def make_candidate(area):
    belief = PoseGaussian(np.zeros(3), np.eye(3))
    return PoseCandidate(area, MatchMode(belief, belief, 0.0), Agreement(0, 0, 0))


def distribution(likelihoods, prior=UNMAPPED_PRIOR):
    """Candidates by their likelihood relative to unmapped ground, with a flat prior in the map."""
    weights = (1.0 - prior) / len(likelihoods) * np.array(likelihoods)
    return PoseDistribution(tuple(map(make_candidate, range(len(likelihoods)))), weights / (weights.sum() + prior))


@given(shares, st.floats(0.01, 0.99))
def test_another_prior_of_unmapped_ground_is_as_if_it_had_been_the_prior_at_first(likelihoods, prior):
    found = distribution(likelihoods).with_unmapped_prior(prior)
    np.testing.assert_allclose(found.probabilities, distribution(likelihoods, prior).probabilities, rtol=1e-9)


def test_one_fifth_of_poses_are_unmapped_before_any_evidence():
    assert summarize_localization({}, 1.0, 0.0, 4, None, 0.5).entropy == pytest.approx(
        -(0.2 * math.log(0.2) + 0.8 * math.log(0.2))
    )
    assert summarize_localization({}, 1.0, 0.0, 0, None, 0.5).entropy == 0.0


@given(shares, shares, st.floats(0.05, 0.95))
def test_the_entropy_is_that_of_the_areas_of_tracked_and_lost_robots(tracked, likelihoods, lost):
    total = sum(tracked)
    areas = {area: (1.0 - lost) * share / total for area, share in enumerate(tracked)}
    where = distribution(likelihoods)
    # Two candidates in one area count as one.
    where = where._replace(candidates=(make_candidate(0), *where.candidates[:-1]))
    joined = {}
    for candidate, probability in zip(where.candidates, where.probabilities, strict=True):
        joined[candidate.area] = joined.get(candidate.area, 0.0) + lost * probability
    unmapped = lost * (1.0 - where.probabilities.sum())
    expected = -sum(p * math.log(p) for p in (*areas.values(), *joined.values(), unmapped))
    found = summarize_localization(areas, lost, 0.0, 7, where, 0.5)
    assert found.entropy == pytest.approx(expected)
    assert found.localized == (lost <= 0.5)


def test_a_robot_in_one_area_for_certain_is_localized_without_entropy():
    assert summarize_localization({3: 1.0}, 0.0, 0.0, 5, None, 0.1) == (True, 0.0)
    assert not summarize_localization({3: 1.0}, 0.06, 0.0, 5, None, 0.1, 0.05).localized
    assert summarize_localization({3: 1.0}, 0.05, 0.0, 5, None, 0.1, 0.04).localized
    half = summarize_localization({3: 0.5}, 0.0, 0.5, 5, None, 0.1)
    assert half.entropy == pytest.approx(math.log(2.0))


@given(shares, st.floats(0.05, 0.95), st.integers(0, 4))
def test_a_false_alarm_leaves_the_robot_at_its_tracked_pose(likelihoods, probability, tracked):
    """Moved: a flat prior over the areas; not moved: at the tracked pose, where scans are as likely as elsewhere."""
    count = len(likelihoods)
    at_tracked_pose = np.arange(count) == tracked
    found = distribution(likelihoods).with_false_alarm(at_tracked_pose, probability, count)
    moved = (1.0 - UNMAPPED_PRIOR) / count * np.array(likelihoods)
    stayed = np.where(at_tracked_pose, likelihoods, 0.0)
    weights = (1.0 - probability) * moved + probability * stayed
    rest = (1.0 - probability) * UNMAPPED_PRIOR + probability * max(0.0, 1.0 - stayed.sum())
    np.testing.assert_allclose(found.probabilities, weights / (weights.sum() + rest), rtol=1e-9)


@given(st.lists(st.tuples(st.floats(0.01, 1.0), st.floats(-5.0, 5.0)), min_size=1, max_size=5))
def test_evidence_multiplies_odds_against_unmapped_ground(pairs):
    likelihoods, logs = zip(*pairs, strict=True)
    expected = distribution(np.array(likelihoods) * np.exp(logs))
    found = distribution(likelihoods).reweight(logs)
    np.testing.assert_allclose(found.probabilities, expected.probabilities, rtol=1e-6)
    best, probability = found.best
    assert probability == max(found.probabilities)
    assert found.candidates.index(best) == found.probabilities.argmax()


class GivenWalls(GlobalScanMatcher):
    """Finds one candidate in every area that is searched, each with given walls."""

    def __init__(self, walls, work=0, agreements=None, map_work=0):
        self.walls, self.work, self.map_work, self.agreements = walls, work, map_work, agreements or {}
        self.event, self.missing = EventWork(), set()
        self.prepared, self.searched, self.best_shares, self.checked = [], [], [], []

    def find_region(self, _hybrid_map, _before, unexamined):
        area = max(unexamined, key=unexamined.get)
        return Region(area, dict.fromkeys((area, area + 1)), frozenset({area}))

    def prepare_region(self, _hybrid_map, region, _before, *, whole):
        self.prepared.append(region.reference)
        if whole:
            self.missing.discard(region.reference)
        self.event.add(self.map_work)

    def match_region(self, _hybrid_map, region, _poses, _before, best_share):
        area = region.reference
        self.searched.append(area)
        if area in self.missing:
            return RegionMatch(None, self.work)
        self.best_shares.append(best_share)
        found = make_candidate(area)._replace(agreement=self.agreements.get(area, Agreement(0, 0, 0)))
        return RegionMatch((found,), self.work)

    def check_walls(self, _hybrid_map, candidate, _poses, _before):
        self.checked.append(candidate.area)
        return self.walls[candidate.area], self.work


def test_walls_that_beams_pass_count_against_a_candidate_and_others_count_for_none():
    passed = Agreement(400, 360, 40)
    matcher = GivenWalls({0: Agreement(400, 400, 0), 1: passed, 2: Agreement(0, 0, 0)})
    search = GlobalSearch({}, 9, 3, {}, tuple(map(make_candidate, range(3))))
    search, is_checked = check_candidates(search, matcher, EventWork(), 0.01, map_of(3), NO_CLUTTER)
    assert is_checked
    found = localize_globally(search, 0.01, HybridMap(), NO_CLUTTER)
    log_ratio = WALLS_OF_MAP.log_likelihood_ratio(passed, WALLS_OUTLIER_RATE)
    assert log_ratio < -1.0
    first, second, third = found.probabilities
    assert second / first == pytest.approx(math.exp(log_ratio))
    assert third == pytest.approx(first)


def map_of(areas):
    hybrid_map = HybridMap()
    for area in range(areas):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    return hybrid_map


def next_event(search, matcher, hybrid_map, first=None):
    """The search after an event."""
    matcher.event.begin_event()
    return continue_search(search, matcher, hybrid_map, matcher.event, first)


def test_an_event_searches_the_most_probable_regions_until_its_work_is_done():
    matcher = GivenWalls({}, event_work._MAX_WORK // 2, {3: Agreement(10, 6, 0)})
    probabilities = {0: 0.05, 1: 0.1, 2: 0.2, 3: 0.4, 4: 0.15, 5: 0.1}
    search = next_event(begin_search(map_of(6), {9: np.zeros(3)}, 9, probabilities), matcher, map_of(6), first=1)
    assert matcher.searched == [1, 3]
    # Area 2 was merged with another one.
    hybrid_map = map_of(6)
    hybrid_map.merge(2, 3, PoseGaussian(np.zeros(3), np.eye(3)))
    search = next_event(search, matcher, hybrid_map, first=1)
    assert matcher.searched == matcher.prepared == [1, 3, 4, 5]
    assert matcher.best_shares == [0.0, 0.0, 0.6, 0.6]
    assert list(search.unexamined) == [0]
    assert [candidate.area for candidate in search.candidates] == [1, 3, 4, 5]
    assert next_event(search, matcher, hybrid_map).unexamined == {}


def test_a_large_map_of_a_region_is_made_at_one_event_and_matched_at_the_next():
    matcher = GivenWalls({}, 0, map_work=event_work._MAX_WORK)
    search, steps = begin_search(map_of(2), {9: np.zeros(3)}, 9, {0: 0.2, 1: 0.8}), []
    while search.unexamined:
        search = next_event(search, matcher, map_of(2))
        steps.append((list(matcher.prepared), list(matcher.searched), search.prepared))
    assert steps == [([1], [], 1), ([1, 0], [1], 0), ([1, 0], [1, 0], None)]
    matcher.missing, steps = {0}, []
    search = begin_search(map_of(2), {9: np.zeros(3)}, 9, {0: 1.0})
    while search.unexamined:
        search = next_event(search, matcher, map_of(2))
        steps.append((len(matcher.prepared) - 2, len(matcher.searched) - 2, search.is_map_missing))
    # Its coarse map, a match that needs the whole map, and that match again.
    assert steps == [(1, 0, False), (2, 1, False), (2, 2, False)]
    # A kidnapping is tested at once.
    search, work = begin_search(map_of(3), {9: np.zeros(3)}, 9, {0: 0.2, 1: 0.7, 2: 0.1}), matcher.event
    search = search_region(search, matcher, map_of(3), work, 2)
    assert list(search.unexamined) == [0, 1]
    assert work.is_exhausted
    assert search_region(search, matcher, HybridMap(), work, 2).unexamined == {}


def test_the_walls_of_probable_candidates_are_checked_until_the_work_of_an_event_is_done():
    passed = Agreement(400, 360, 40)
    matcher = GivenWalls(dict.fromkeys(range(4), passed), event_work._MAX_WORK)
    candidates = [make_candidate(area) for area in range(4)]
    improbable = candidates[3]._replace(agreement=Agreement(400, 100, 300))
    search, states = GlobalSearch({}, 9, 4, {}, (*candidates[:3], improbable)), []
    while not states or not states[-1]:
        # The area of one of them has gone meanwhile.
        hybrid_map = map_of(4 if not states else 2)
        search, is_checked = check_candidates(search, matcher, EventWork(), 0.01, hybrid_map, NO_CLUTTER)
        states.append(is_checked)
    assert (states, matcher.checked) == ([False, True], [0, 1])
    assert [candidate.walls for candidate in search.candidates] == [passed, passed]
    again, is_checked = check_candidates(search, matcher, EventWork(), 0.01, map_of(2), NO_CLUTTER)
    assert is_checked
    assert (again.candidates, matcher.checked) == (search.candidates, [0, 1])
    none_left = EventWork()
    none_left.add(event_work._MAX_WORK)
    search = GlobalSearch({}, 9, 4, {}, (improbable,))
    assert check_candidates(search, matcher, none_left, 0.01, map_of(4), NO_CLUTTER)[1]


def test_candidates_that_were_refuted_wait_for_another_or_for_the_end():
    fit = Agreement(400, 400, 0)
    candidates = tuple(make_candidate(area)._replace(agreement=fit) for area in (4, 5))
    for count, refuted, left, conclusive in ((1, 0, 1, True), (1, 1, 1, False), (2, 1, 1, True), (1, 1, 0, True)):
        unexamined = {1: 0.1} if left else {}
        search = GlobalSearch({}, 9, 5, unexamined, candidates[:count], refuted=refuted)
        assert is_conclusive(search, 0.01, HybridMap(), NO_CLUTTER, 0.3) is conclusive


def test_what_was_not_searched_may_match_as_well_and_the_candidate_by_chance():
    fit, others = Agreement(400, 400, 0), {0: 0.2, 1: 0.1}
    candidate = make_candidate(4)._replace(agreement=fit)
    partial, whole = (GlobalSearch({}, 9, 5, left, (candidate,)) for left in (others, {}))
    there = MAP_IN_MAP.log_likelihood_ratio(fit, MAPS_OUTLIER_RATE)
    for search, negatives, unexamined in ((partial, 2, 0.3), (whole, 4, 0.0)):
        distinctiveness = (2.0 + negatives) / (2.0 * 0.01)
        weight = 0.8 / 5.0 * math.exp(there) * distinctiveness
        expected = weight / (weight + UNMAPPED_PRIOR + 0.8 * unexamined * math.exp(there))
        found = localize_globally(search, 0.01, HybridMap(), NO_CLUTTER)
        assert found.probabilities.tolist() == pytest.approx([expected])
        bounds = (expected - 1e-6, expected + 1e-6)
        conclusive = [is_conclusive(search, 0.01, HybridMap(), NO_CLUTTER, bound) for bound in bounds]
        assert conclusive == [True, not unexamined]


@pytest.mark.parametrize("reach", [-0.01, 0.01])
@pytest.mark.parametrize("turn", [0.3, 2.0])
def test_an_initial_pose_reaches_four_deviations_of_its_least_certain_direction(turn, reach):
    """From a keyframe amid area 1, whose other keyframe is farther away, in whatever direction it lies."""
    hybrid_map, rotation = HybridMap(), se2.adjoint([0.0, 0.0, turn])
    hybrid_map.set_keyframe(0, 0, np.array([50.0, 0.0, 0.0]))
    hybrid_map.set_keyframe(1, 1, np.array([20.0, 1.0, 0.0]))
    hybrid_map.set_keyframe(2, 1, np.array([1.0, -0.5, 0.3]))
    hybrid_map.set_keyframe(8, 2, np.zeros(3))
    arc = np.array([3.0, 7.0, 1.2])
    for area in (1, 2):
        hybrid_map.set_arc(0, area, PoseGaussian(arc, 1e-4 * np.eye(3)), closure=False)
    covariance = rotation @ np.diag([0.1, 0.6, 0.2]) ** 2 @ rotation.T
    at = se2.transform(arc, [1.0, -0.5]) + (1.5 + 4.0 * 0.6 - reach) * np.array([0.6, -0.8])
    prior = SearchPrior(PoseHint(9, 0, PoseGaussian(np.array([*at, 0.4]), covariance)))
    # The keyframe of area 2 came when the robot was lost already.
    areas = dict.fromkeys(range(3), 1.0 / 3.0)
    search = begin_search(hybrid_map, {9: np.zeros(3)}, 8, areas, prior, 1.5)
    assert list(search.unexamined) == ([1] if reach > 0.0 else [])


def test_an_initial_pose_weighs_candidates_by_their_distance_in_both_covariances():
    hybrid_map = HybridMap()
    for area in (0, 1):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    arc = PoseGaussian(np.array([1.0, 0.5, 0.9]), np.diag([0.02, 0.01, 0.004]))
    hybrid_map.set_arc(0, 1, arc, closure=False)
    hint = PoseGaussian(np.array([0.4, 0.9, 0.5]), np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.02], [0.0, 0.02, 0.1]]))
    search = GlobalSearch({9: np.zeros(3)}, 9, 2, {}, tuple(map(make_candidate, range(2))))
    flat, found = (
        localize_globally(search, 0.01, hybrid_map, NO_CLUTTER, prior).probabilities
        for prior in (FLAT_PRIOR, SearchPrior(PoseHint(9, 0, hint)))
    )
    measured = make_candidate(0).mode.measured
    odds = []
    for belief in (PoseGaussian(np.zeros(3), np.zeros((3, 3))), arc):
        ad = se2.adjoint(se2.inverse(measured.mean))
        pose, covariance = se2.compose(belief.mean, measured.mean), ad @ belief.covariance @ ad.T + measured.covariance
        off = se2.log(se2.between(hint.mean, pose))
        odds.append(math.exp(-0.5 * off @ np.linalg.inv(covariance + hint.covariance) @ off))
    # The flat prior gives each of the two areas a half.
    np.testing.assert_allclose(found / (1.0 - found.sum()), 2.0 * np.array(odds) * flat / (1.0 - flat.sum()))


@pytest.mark.parametrize(("x", "y", "near"), [(0.0, 8.0, [1]), (8.0, 0.0, [2]), (0.5, 0.5, [0]), (4.5, 4.5, [])])
def test_only_areas_near_an_initial_pose_are_searched(x, y, near):
    """One keyframe in each of three areas; the search reaches 2 m beyond four deviations of 0.5 m."""
    hybrid_map = HybridMap()
    for area, position in enumerate(((0.0, 0.0), (0.0, 8.0), (8.0, 0.0))):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
        if area:
            hybrid_map.set_arc(0, area, PoseGaussian(np.array([*position, 0.0]), 1e-4 * np.eye(3)), closure=False)
    prior = SearchPrior(PoseHint(9, 0, PoseGaussian(np.array([x, y, 0.0]), np.diag([0.25, 0.25, 0.1]))))
    areas = dict.fromkeys(range(3), 1.0 / 3.0)
    search = begin_search(hybrid_map, {9: np.zeros(3)}, 9, areas, prior, 2.0)
    assert (list(search.unexamined), search.areas) == (near, len(near))


def test_areas_are_plausible_where_a_candidate_is_and_around_if_the_keyframes_are_in_the_map():
    hybrid_map = map_of(6)
    for area, x in ((1, 4.0), (3, 40.0)):
        hybrid_map.set_arc(2, area, PoseGaussian(np.array([x, 0.0, 0.0]), 0.01 * np.eye(3)), closure=False)
    candidates = tuple(map(make_candidate, (2, 4, 5)))
    found = PoseDistribution(candidates, np.array([0.7, 0.0008, 0.0006]))
    assert plausible_areas(found, hybrid_map, 3.0) == {1, 2, 4}
    doubted = PoseDistribution(candidates, np.array([0.4, 0.05, 0.04]))
    assert plausible_areas(doubted, hybrid_map, 3.0) == frozenset()
    assert plausible_areas(PoseDistribution((), np.zeros(0)), hybrid_map, 3.0) == frozenset()


def test_the_area_that_a_mark_points_to_is_searched_first_and_ends_the_search():
    """Without the mark the first area that fits may be there by chance, as may all that were not searched."""
    walls = Agreement(0, 0, 0)
    areas = dict.fromkeys(range(20), 0.05)
    sharp = PoseGaussian(np.zeros(3), np.diag([0.1, 0.1, 0.05]) ** 2)
    marked = SearchPrior(marks=MarkedPlaces(((MarkedPose(7, sharp),),), 0.05))
    for prior, first, conclusive in ((marked, 7, True), (FLAT_PRIOR, 0, False)):
        matcher = GivenWalls([walls] * 20, agreements={area: Agreement(100, 90, 0) for area in areas})
        matcher.work = event_work._MAX_WORK
        search = begin_search(map_of(20), {90: np.zeros(3)}, 90, areas)
        search = continue_search(search, matcher, map_of(20), matcher.event, prior=prior)
        assert matcher.searched == [first]
        search = replace(
            search, candidates=tuple(c._replace(mode=c.mode._replace(measured=sharp)) for c in search.candidates)
        )
        assert is_conclusive(search, 0.3, map_of(20), NO_CLUTTER, 0.8, prior) is conclusive
