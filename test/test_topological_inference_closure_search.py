"""Areas in which keyframes surely do not lie: which are tried, and when their maps are made."""

from types import MappingProxyType

import numpy as np
import pytest

from benchmark.lattice import Lattice, LatticeScans
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map import surroundings
from hmt_slam_ros.topological_inference import event_work
from hmt_slam_ros.topological_inference.area_comparison import AreaComparison
from hmt_slam_ros.topological_inference.candidate_gating import Query
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch
from hmt_slam_ros.topological_inference.event_work import EventWork

HERE = 210  # in the middle of the lattice
SPREAD = np.diag([3.0, 3.0, 0.05]) ** 2


@pytest.fixture
def lattice():
    return Lattice(20, 20).hybrid_map()


def query(hybrid_map):
    keyframes = list(hybrid_map.keyframes(HERE).items())[:5]
    return Query(PoseGaussian(keyframes[0][1], SPREAD), dict(keyframes))


def begin(search, hybrid_map, keyframes, compared=MappingProxyType({})):
    return search.begin_comparison(hybrid_map, HERE, keyframes, compared, {HERE}, 8)


def finish(search, hybrid_map, comparison):
    """The result of a comparison, and what was left of it after each event before the last."""
    states = []
    while True:
        search.work.begin_event()
        comparison = search.continue_comparison(hybrid_map, comparison)
        if isinstance(comparison, AreaComparison):
            return comparison, states
        states.append(comparison)


def places_tried(search, hybrid_map, excluded):
    return search.gating.classify_areas(hybrid_map, HERE, query(hybrid_map), excluded)[2]


def test_the_places_tried_are_spread_over_the_map_and_most_stay_the_same(lattice):
    search = ClosureSearch(Configuration(), LatticeScans())
    places = places_tried(search, lattice, {HERE})
    assert np.diff(sorted([0, *places, 400])).max() < 150
    for excluded in ({HERE, places[0]}, {HERE, places[3], places[4]}):
        others = places_tried(search, lattice, excluded)
        assert len(others) == len(places)
        assert set(places) - set(others) == excluded - {HERE}


def test_their_maps_are_made_ahead_one_at_a_time(lattice, monkeypatch):
    built = []
    build = surroundings.build_area_grid
    monkeypatch.setattr(surroundings, "build_area_grid", lambda *args: built.append(len(args[0])) or build(*args))

    def maps_of(count):
        """Number of grids that a comparison builds after ``count`` calls to look ahead, and its result."""
        search = ClosureSearch(Configuration(), LatticeScans())
        keyframes = query(lattice)
        finish(search, lattice, begin(search, lattice, keyframes, dict.fromkeys(range(400), keyframes.poses)))
        for _ in range(count):
            before = len(built)
            search.work.begin_event()
            search.look_ahead(lattice)
            assert len(built) - before <= 1
        before = len(built)
        found, _ = finish(search, lattice, begin(search, lattice, keyframes))
        return len(built) - before, [fit.log_weight for fit in found.fits]

    without, plain = maps_of(0)
    halfway, _ = maps_of(3)
    ahead, same = maps_of(9)
    assert (without - halfway, without - ahead) == (3, 6)
    assert same == plain
    assert plain


@pytest.fixture
def works(monkeypatch):
    """The work of every step, in order."""
    done, add = [], EventWork.add
    monkeypatch.setattr(EventWork, "add", lambda self, work: (done.append(work), add(self, work)))
    return done


def test_a_wide_comparison_is_spread_over_events_with_the_result_of_a_single_one(lattice, works, monkeypatch):
    """Maps and matches of areas, and of the places where the keyframes do not lie, are steps of their own."""
    keyframes = query(lattice)
    monkeypatch.setattr(event_work, "_MAX_COMPARISON_WORK", 10**15)
    search = ClosureSearch(Configuration(), LatticeScans())
    comparison = begin(search, lattice, keyframes)
    at_once, states = finish(search, lattice, comparison)
    assert states == []
    assert search.state.negative_shares
    assert len(works) > 2 * len(comparison.candidates)
    total, alone = sum(works), search.state
    works.clear()
    budget = total // 8
    monkeypatch.setattr(event_work, "_MAX_COMPARISON_WORK", budget)
    search = ClosureSearch(Configuration(), LatticeScans())
    comparison, left, before = begin(search, lattice, keyframes), [], 0
    while not isinstance(comparison, AreaComparison):
        left.append(len(comparison.candidates) + len(comparison.elsewhere))
        search.work.begin_event()
        comparison = search.continue_comparison(lattice, comparison)
        own, before = works[before:], len(works)
        assert sum(own) < budget + max(own)
    assert sum(works) == total
    assert len(left) >= 4
    assert left == sorted(left, reverse=True)
    assert search.state == alone
    assert comparison.fits
    for one, two in zip(comparison.fits, at_once.fits, strict=True):
        assert (one.area, one.log_weight, one.mode.log_mass) == (two.area, two.log_weight, two.mode.log_mass)
        np.testing.assert_array_equal(one.mode.pose.mean, two.mode.pose.mean)
    assert comparison.transition == at_once.transition
    assert comparison[2:] == at_once[2:]


def test_the_hypotheses_of_an_event_share_its_work(lattice, works, monkeypatch):
    search, keyframes = ClosureSearch(Configuration(), LatticeScans()), query(lattice)
    monkeypatch.setattr(event_work, "_MAX_COMPARISON_WORK", 1)
    first, second = (begin(search, lattice, keyframes) for _ in range(2))
    search.work.begin_event()
    first = search.continue_comparison(lattice, first)
    assert search.continue_comparison(lattice, second).prepared is None
    assert first.prepared == next(iter(first.candidates))
    # The map of the query is made first, to find the candidates' entries.
    assert all(work % event_work.CELL_WORK == 0 for work in works)


def test_places_where_keyframes_do_not_lie_are_matched_for_one_of_two_hypotheses(lattice, monkeypatch):
    monkeypatch.setattr(event_work, "_MAX_COMPARISON_WORK", 1)
    search, keyframes = ClosureSearch(Configuration(), LatticeScans()), query(lattice)
    _, states = finish(search, lattice, begin(search, lattice, keyframes))
    shares = search.state.negative_shares
    assert any(state.negative_shares for state in states)
    _, states = finish(search, lattice, begin(search, lattice, keyframes))
    assert not any(state.negative_shares for state in states)
    assert search.state.negative_shares == shares


def test_a_comparison_goes_on_the_same_without_the_maps_that_were_made(lattice, monkeypatch):
    monkeypatch.setattr(event_work, "_MAX_COMPARISON_WORK", 1)
    found = []
    for is_resumed in (False, True):
        search = ClosureSearch(Configuration(), LatticeScans())
        comparison, events = begin(search, lattice, query(lattice)), 0
        while not isinstance(comparison, AreaComparison):
            if is_resumed:
                state, search = search.state, ClosureSearch(Configuration(), LatticeScans())
                search.restore(state)
            search.work.begin_event()
            comparison, events = search.continue_comparison(lattice, comparison), events + 1
        found.append((events, search.state, [(fit.area, fit.log_weight) for fit in comparison.fits]))
    assert found[0] == found[1]
