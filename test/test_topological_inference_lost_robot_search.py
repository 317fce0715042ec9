"""Rules of the search for a lost robot: which keyframes, when it goes on, and when it is over."""

from dataclasses import replace

import numpy as np
import pytest
from relocalizing import OPTIONS, SHARP, GivenSearch, candidate, distribution, make_parent, search

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topological_inference import event_work, relocalization
from hmt_slam_ros.topological_inference.hypothesis_tree import (
    FalseAlarm,
    Lost,
    PoseInArea,
    Tracking,
)
from hmt_slam_ros.topological_inference.search_prior import PoseHint, SearchPrior


def test_a_lost_robot_is_searched_by_its_keyframes_seen_from_the_first():
    hint = PoseHint(23, 1, PoseGaussian(np.array([4.0, 2.0, 0.5]), SHARP))
    branching, parent, found = search(Lost(21, pose_hint=hint))
    poses, before, first_hint = branching.requested
    own = parent.hybrid_map.keyframes(5)
    assert (list(poses), before) == ([21, 22, 23, 24, 25], 21)
    for k, pose in poses.items():
        np.testing.assert_allclose(pose, se2.between(own[21], own[k]), atol=1e-12)
    assert (first_hint.keyframe, first_hint.area) == (21, 1)
    back = se2.between(own[23], own[21])
    np.testing.assert_allclose(first_hint.pose.mean, se2.compose(hint.pose.mean, back))
    ad = se2.adjoint(se2.inverse(back))
    np.testing.assert_allclose(first_hint.pose.covariance, ad @ SHARP @ ad.T)
    (child,) = found.children
    assert found.closures_searched
    assert (child.area, child.log_weight, child.arcs) == (5, -0.7, ())
    assert child.state.localization.candidate is None
    other, _, _ = search(Lost(21, pose_hint=replace(hint, keyframe=9)))
    assert other.requested[2] is None


def test_a_search_that_may_confirm_a_candidate_goes_through_all_areas_that_are_left_to_it():
    lost = Lost(21, candidate=PoseInArea(1, 22, np.zeros(3)), plausible_areas=frozenset({1, 2}))
    for before, events in ((lost, 2), (Lost(21), 1)):
        branching, parent = GivenSearch(2, options=OPTIONS, found=distribution()), make_parent(before)
        branching.map_search.is_conclusive = lambda *_: True
        branching.unexamined = {2: 0.5}
        for _ in range(events):
            assert parent.state.localization.searched < 0
            (child,) = relocalization.update_relocalization(branching, parent).children
            parent = replace(parent, state=child.state)
        if before is lost:
            assert parent.state.localization.searched == 25


def test_a_search_goes_on_with_its_keyframes_until_it_is_over():
    """Those that came meanwhile wait for the next search, which begins after three of them."""
    pair = (candidate(1, [2.0, 1.0, 0.4]), 0.9)
    branching, parent = GivenSearch(3, options=OPTIONS, found=distribution(pair)), make_parent(Lost(21))
    for _ in range(2):
        (child,) = relocalization.update_relocalization(branching, parent).children
        parent = replace(parent, state=child.state)
        assert relocalization.is_searching(parent)
        assert list(child.state.localization.search.poses) == [21, 22, 23, 24, 25]
        own = parent.hybrid_map.keyframes(5)
        parent.hybrid_map.set_keyframe(max(own) + 1, 5, se2.compose(own[max(own)], [0.5, 0.0, 0.1]))
        assert not relocalization.is_search_due(branching, parent)
    (child,) = relocalization.update_relocalization(branching, parent).children
    parent = replace(parent, state=child.state)
    lost = parent.state.localization
    assert (lost.search, lost.searched, lost.candidate.keyframe) == (None, 25, 25)
    assert branching.first_areas == [None] * 3
    assert not relocalization.is_searching(parent)
    due = []
    for keyframe in range(28, 31):
        due.append(relocalization.is_search_due(branching, parent))
        parent.hybrid_map.set_keyframe(keyframe, 5, np.zeros(3))
    assert due == [False, False, False]
    assert relocalization.is_search_due(branching, parent)
    assert not relocalization.is_search_due(branching, make_parent(Tracking()))
    branching.remaining = 1
    relocalization.update_relocalization(branching, parent)
    assert branching.first_areas[3:] == [1]
    assert branching.only == {1, 2}


def test_a_robot_at_a_mark_of_the_map_is_searched_after_three_keyframes():
    branching, parent = GivenSearch(options=OPTIONS, found=distribution()), make_parent(Lost(23))
    assert not relocalization.is_search_due(branching, parent)
    branching.marked = 24
    assert relocalization.is_search_due(branching, parent)
    assert not relocalization.is_search_due(branching, make_parent(Lost(24)))


class ExhaustingSearch(GivenSearch):
    """A search that takes the work of an event, leaves an area where something fits, and checks walls at the next."""

    def __init__(self, **given):
        super().__init__(**given)
        self.map_search.check_candidates = self.check

    def go_on(self, hybrid_map, search, first=None, prior=None):
        search = super().go_on(hybrid_map, search, first, prior)
        self.map_search.work.add(event_work._MAX_WORK)
        return replace(search, unexamined={3: 0.1} if search.candidates else {})

    def check(self, _hybrid_map, search, _clutter, _prior=None):
        return search, not (search.candidates and self.map_search.work.is_exhausted)


@pytest.mark.parametrize(("probability", "refuted"), [(0.9, 0), (0.5, 1)])
def test_candidates_are_tested_at_the_event_after_a_search_that_took_the_work(probability, refuted):
    """Where they are refuted the search goes on, and they are not tested again before there is another."""
    pair = (candidate(1, [2.0, 1.0, 0.4]), probability)
    branching, parent = ExhaustingSearch(options=OPTIONS, found=distribution(pair)), make_parent(Lost(21))
    (child,) = (found := relocalization.update_relocalization(branching, parent)).children
    assert not found.closures_searched
    assert child.state.localization.search.candidates
    branching.map_search.work.begin_event()
    (child,) = relocalization.update_relocalization(branching, replace(parent, state=child.state)).children
    lost = child.state.localization
    assert len(branching.first_areas) == 1
    if not refuted:
        assert (lost.search, lost.candidate.area) == (None, 1)
        return
    assert (lost.search.refuted, lost.candidate) == (1, None)
    branching.remaining = 2
    (child,) = relocalization.update_relocalization(branching, replace(parent, state=child.state)).children
    assert len(branching.first_areas) == 2
    assert child.state.localization.search.refuted == 1


def test_a_search_without_candidates_ends_at_once():
    branching, parent = ExhaustingSearch(options=OPTIONS, found=distribution()), make_parent(Lost(21))
    found = relocalization.update_relocalization(branching, parent)
    assert found.pose_distribution is branching.found


def test_a_search_waits_at_an_event_whose_work_is_done():
    branching, parent = GivenSearch(options=OPTIONS, found=distribution()), make_parent(Lost(21))
    branching.map_search.work.add(event_work._MAX_WORK)
    (child,) = relocalization.update_relocalization(branching, parent).children
    assert child.state is parent.state
    assert branching.first_areas == []


def test_a_search_whose_keyframes_left_the_submap_is_given_up():
    branching, parent = GivenSearch(options=OPTIONS, found=distribution()), make_parent(Lost(21))
    search = branching.begin({}, {3: np.zeros(3), 4: np.ones(3)}, 2)
    parent = make_parent(Lost(21, search=search))
    (child,) = relocalization.update_relocalization(branching, parent).children
    assert (child.state.localization.search, child.state.localization.searched) == (None, 4)


def test_the_reference_of_a_search_lies_where_its_newest_keyframe_is_now():
    """The area has changed since, and the older keyframes are in none of the submap."""
    pose, hint = np.array([2.0, 1.0, 0.4]), PoseHint(25, 1, PoseGaussian(np.array([4.0, 2.0, 0.5]), SHARP))
    branching = GivenSearch(options=OPTIONS, found=distribution((candidate(1, pose), 0.95)))
    parent = make_parent(Lost(21, pose_hint=hint))
    poses = {3: np.zeros(3), 24: np.array([1.0, 0.2, 0.1]), 25: np.array([1.5, 0.3, 0.2])}
    search = branching.begin({}, poses, 2, SearchPrior(hint))
    parent = make_parent(Lost(21, pose_hint=hint, search=search))
    _, relocalized = relocalization.update_relocalization(branching, parent).children
    reference = se2.compose(parent.hybrid_map.keyframes(5)[25], se2.inverse(poses[25]))
    np.testing.assert_allclose(relocalized.arcs[0].pose.mean, se2.compose(reference, se2.inverse(pose)))


@pytest.mark.parametrize(("probability", "is_unknown"), [(0.09, True), (0.11, False)])
def test_keyframes_on_unmapped_ground_are_not_searched_again(probability, is_unknown):
    pair = (candidate(1, [2.0, 1.0, 0.4]), probability)
    (child,) = search(Lost(21), pair)[2].children
    assert child.state.localization.unknown == (25 if is_unknown else -1)
    alarm = FalseAlarm(PoseInArea(1, 40, np.array([3.0, 2.0, 0.5])), 0.7, "after_gap")
    (child,) = search(Lost(21, false_alarm=alarm), pair)[2].children
    assert child.state.localization.unknown == -1
    branching, _, _ = search(Lost(21, unknown=22), pair)
    assert list(branching.requested[0]) == [23, 24, 25]
    assert branching.requested[1] == 21
